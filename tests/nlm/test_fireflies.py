"""Isolated fireflies: found by space, spared by time, replaced without a trace."""

import numpy as np
import pytest

from nlm.fireflies import find_fireflies, recurring, replace_fireflies


def noisy(seed=0, size=(40, 56)):
    return np.random.default_rng(seed).gamma(2, 0.5, (*size, 3)).astype(np.float32)


@pytest.mark.parametrize("place", [(20, 30), (0, 0), (39, 55), (0, 17), (5, 1)])
def test_a_single_sample_is_found_anywhere(place):
    frame = noisy()
    frame[place] = 20_000
    np.testing.assert_array_equal(find_fireflies(frame), [place])


def test_a_sample_that_the_pixel_filter_has_spread_is_one_firefly():
    frame = noisy()
    frame[10:13, 20:23] = 5_000
    frame[11, 21] = 9_000
    np.testing.assert_array_equal(find_fireflies(frame), [(11, 21)])
    cleaned, replaced, _ = replace_fireflies(frame, find_fireflies(frame))
    assert replaced.sum() == 9
    assert cleaned.max() <= noisy().max()


def test_noise_lamps_of_some_size_and_sparks_on_black_are_none():
    assert len(find_fireflies(noisy())) == 0
    lamp = noisy()
    lamp[10:14, 20:24] = 20_000
    assert len(find_fireflies(lamp)) == 0
    black = np.zeros((9, 9, 3), np.float32)
    black[4, 4] = 100
    assert len(find_fireflies(black)) == 0


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_what_is_found_does_not_depend_on_the_scale(scale):
    frame = noisy()
    frame[7, 9] = 1000
    np.testing.assert_array_equal(find_fireflies(frame * np.float32(scale)), find_fireflies(frame))


def test_a_light_that_the_next_frame_shows_where_the_motion_leads_stays():
    frame, other, flow = noisy(), noisy(1), np.zeros((40, 56, 2), np.float32)
    frame[20, 30] = 2_000
    flow[..., 0] = 15
    places = find_fireflies(frame)
    assert not recurring(places, frame, other, flow).any()
    other[20, 45] = 1_500
    assert recurring(places, frame, other, flow).all()
    # Without vectors only what is near counts.
    assert not recurring(places, frame, other, None).any()
    other[24, 36] = 1_500
    assert recurring(places, frame, other, None).all()
    # A vector that holds nowhere is none.
    assert recurring(places, frame, other, np.full_like(flow, 40), np.zeros((40, 56), bool)).all()


def test_vectors_that_point_nowhere_are_no_error():
    frame = noisy()
    frame[20, 30] = 2_000
    flow = np.full((40, 56, 2), 9_999, np.float32)
    assert not recurring(find_fireflies(frame), frame, frame, flow).any()


def test_replaced_is_the_firefly_alone_and_its_light_is_accounted_for():
    frame, clean = noisy(), noisy()
    frame[20, 30] = 20_000
    cleaned, replaced, removed = replace_fireflies(frame, find_fireflies(frame))
    assert np.argwhere(replaced).tolist() == [[20, 30]]
    np.testing.assert_array_equal(cleaned[~replaced], clean[~replaced])
    assert clean.min() <= cleaned[20, 30].min()
    assert cleaned[20, 30].max() <= clean[18:23, 28:33].max()
    assert removed == pytest.approx(1 - cleaned.sum(dtype=float) / frame.sum(dtype=float), rel=1e-6)
    assert removed > 0.8


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match=r"color: expected \(height, width, channels\), got \(3, 4\)"):
        find_fireflies(np.ones((3, 4), np.float32))
