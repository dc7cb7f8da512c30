"""Isolated fireflies: found by space, spared by time, replaced without a trace."""

import numpy as np
import pytest

from nlm.fireflies import (
    Highlights,
    add_highlights,
    average_highlights,
    clamp_halos,
    find_bright_samples,
    follow_motion,
    measure_highlights,
    nearest_pixel,
    recurs_nearby,
    remove_highlights,
    replace_fireflies,
    same_highlight,
    without_strangers,
)


def noisy(seed=0, size=(40, 56)):
    return np.random.default_rng(seed).gamma(2, 0.5, (*size, 3)).astype(np.float32)


def find_fireflies(color: np.ndarray) -> np.ndarray:
    places, isolated = find_bright_samples(color)
    return places[isolated]


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


@pytest.mark.parametrize("light", [200, 20_000])
def test_a_sample_that_may_be_light_is_a_candidate_and_no_firefly(light):
    frame = noisy()
    frame[20, 30] = light
    places, firefly = find_bright_samples(frame)
    assert places.tolist() == [[20, 30]]
    assert firefly.tolist() == [light == 20_000]


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_what_is_found_does_not_depend_on_the_scale(scale):
    frame = noisy()
    frame[7, 9] = 1000
    np.testing.assert_array_equal(find_fireflies(frame * np.float32(scale)), find_fireflies(frame))


def calm(star=(), size=(24, 32)):
    """A dim frame with stars: (row, column, radiance), spread bilinearly where they are between pixels."""
    frame = np.full((*size, 3), 0.01, np.float32)
    for row, column, light in star:
        y, x = int(row), int(column)
        for j, i in ((y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)):
            share = (1 - abs(row - j)) * (1 - abs(column - i))
            frame[j, i] += np.float32(share) * np.asarray(light, np.float32)
    return frame


def lights_of(frame):
    places, _ = find_bright_samples(frame)
    return measure_highlights(frame, nearest_pixel(measure_highlights(frame, places).points))


@pytest.mark.parametrize("place", [(10, 14), (10, 14.5), (10.3, 14.5), (0, 14), (22, 30)])
def test_a_light_is_measured_taken_and_added_again(place):
    frame = calm([(*place, (8, 4, 1))])
    own = lights_of(frame)
    np.testing.assert_allclose(own.light, [[8, 4, 1]], rtol=1e-4)
    np.testing.assert_allclose(own.points, [place], atol=0.06)
    without = remove_highlights(frame, own.pixels)
    np.testing.assert_allclose(without, calm(), rtol=1e-4)
    np.testing.assert_allclose(add_highlights(without, average_highlights(own, [])), frame, rtol=2e-2, atol=0.02)


def test_of_two_lights_beside_each_other_neither_is_isolated_and_both_are_taken():
    frame = calm([(10, 14, 5), (11, 16, 9)])
    places, isolated = find_bright_samples(frame)
    assert places.tolist() == [[10, 14], [11, 16]]
    assert not isolated.any()
    assert len(find_fireflies(frame)) == 0
    own = lights_of(frame)
    np.testing.assert_allclose(own.light.mean(axis=1), [5, 9], rtol=1e-4)
    np.testing.assert_allclose(remove_highlights(frame, own.pixels), calm(), rtol=1e-4)


@pytest.mark.parametrize(
    ("other", "same"),
    [
        ((10, 20, (8, 4, 1)), True),
        ((10.5, 20, (8, 4, 1)), True),
        ((10, 20, (12, 6, 1.5)), True),
        ((10, 20, (16, 8, 2)), False),
        ((10, 20, (1, 4, 8)), False),
        ((10, 21, (8, 4, 1)), False),
    ],
)
def test_the_same_light_is_at_the_same_place_along_the_motion_in_the_same_color(other, same):
    own, moved = lights_of(calm([(10, 14, (8, 4, 1))])), np.array([[0.0, 6.0]])
    seen = measure_highlights(calm([other]), follow_motion(own, moved))
    assert same_highlight(own, moved, seen).tolist() == [same]


def test_the_mean_of_lights_leaves_out_patterns_of_another_place_in_the_pixel():
    own = lights_of(calm([(10, 14, 6)]))
    moved = np.array([[0.0, 0.5]])
    seen = measure_highlights(calm([(10, 14.5, 8)]), follow_motion(own, moved))
    mean = average_highlights(own, [(seen, moved, np.array([True]))])
    np.testing.assert_allclose(mean.light, [[7, 7, 7]], rtol=1e-4)
    np.testing.assert_allclose(mean.pattern[0, 1, 1], 1)


def test_a_sample_below_its_surroundings_is_no_light():
    """Beside a brighter light, where a pixel filter is undone."""
    own = lights_of(calm([(10, 14, 6)]))
    below = Highlights(own.pixels, own.points, -own.light, -own.pattern)
    np.testing.assert_array_equal(add_highlights(calm(), average_highlights(below, [])), calm())


def test_a_light_outside_the_frame_is_none():
    own, moved = lights_of(calm([(10, 14, 6)])), np.array([[0.0, 9999.0]])
    seen = measure_highlights(calm(), follow_motion(own, moved))
    assert np.isnan(seen.light).all()
    assert not same_highlight(own, moved, seen).any()


def test_a_sample_near_which_another_frame_is_bright_is_told_from_one_that_is_alone():
    frame, other = noisy(), noisy(1)
    frame[20, 30] = 2_000
    places = find_fireflies(frame)
    assert not recurs_nearby(places, frame, places, other).any()
    other[23, 33] = 1_500
    assert recurs_nearby(places, frame, places, other).all()
    assert not recurs_nearby(places, frame, places - [[0, 1]], other).any()
    assert not recurs_nearby(places, frame, places + 9_999, other).any()


def test_calm_is_where_other_frames_have_few_bright_samples_of_their_own():
    frame, other = calm([(10, 14, 6), (13, 20, 9)]), calm([(10, 14, 6), (13, 20, 9)])
    own = lights_of(frame)
    assert without_strangers(own, frame, own.pixels, other).all()
    other[6, 10:14] = 5
    assert without_strangers(own, frame, own.pixels, other).tolist() == [False, True]


def test_a_halo_is_held_to_its_surroundings_and_an_outline_stays():
    picture = calm()
    picture[:, 20:] = 1
    halo = picture.copy()
    halo[8:13, 10:15] += 0.3
    np.testing.assert_array_equal(clamp_halos(halo, np.array([[10, 12]])), picture)
    np.testing.assert_array_equal(clamp_halos(picture, np.array([[10, 19]])), picture)


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
