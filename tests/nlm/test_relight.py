"""Pictures of other frames, in the light of the centre."""

import numpy as np
import pytest

from nlm.relight import relight

SHAPE = (64, 80)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(8)


def scene(rng, light=1.0):
    """Three pictures of a texture with errors of their own; the first in another light."""
    texture = rng.uniform(0.2, 2, (*SHAPE, 3))
    window = texture * (1 + rng.normal(0, 0.02, (3, *SHAPE, 3)))
    window[0] *= light
    return np.asarray(window, np.float32), np.asarray(texture, np.float32)


def trust(alike=0.0):
    """Both kinds, of three frames: of the centre all, of the others this much as they are."""
    return np.full((3, *SHAPE), alike, np.float32), np.ones((3, *SHAPE), np.float32)


def test_a_change_that_is_even_is_taken_away_and_detail_stays(rng):
    window, texture = scene(rng, light=1.3)
    before = window.copy()
    relight(window, *trust(), 0.01)
    np.testing.assert_array_equal(window[1], before[1])
    assert before[0].mean() / texture.mean() == pytest.approx(1.3, abs=0.01)
    assert window[0].mean() / texture.mean() == pytest.approx(1, abs=0.003)
    # Its errors are its own, 2 % and little more. The centre's enter it through the light of both, by an eighth,
    # the other way round.
    errors = window[:2] / texture - 1
    assert errors[0].std() == pytest.approx(0.0215, abs=0.003)
    assert -0.2 < np.corrcoef(errors[0].ravel(), errors[1].ravel())[0, 1] < 0


def test_what_is_alike_keeps_its_own(rng):
    window, _ = scene(rng, light=1.3)
    window[2] = window[0]
    before = window.copy()
    alike, trusted = trust(1.0)
    relight(window, alike, trusted, 1.0)
    np.testing.assert_array_equal(window, before)
    half, whole = before.copy(), before.copy()
    relight(half, 0.5 * alike, trusted, 1.0)
    relight(whole, 0 * alike, trusted, 1.0)
    np.testing.assert_allclose(half[0] - before[0], 0.5 * (whole[0] - before[0]), rtol=1e-3, atol=1e-5)


def test_what_nobody_trusts_counts_for_nothing(rng):
    window, _ = scene(rng)
    window[2] = window[1]
    window[0, :, 40:] = 1e30
    alike, trusted = trust()
    trusted[0, :, 40:] = 0
    before = window.copy()
    relight(window, alike, trusted, 1.0)
    np.testing.assert_array_equal(window[0, :, 40:], before[0, :, 40:])
    assert abs(window[0, :, :40] - before[0, :, :40]).max() < 0.05


def test_a_firefly_leaves_no_ring(rng):
    window, _ = scene(rng)
    one, other = window.copy(), window.copy()
    other[0, 30, 30] = 1e6
    relight(one, *trust(), 1.0)
    relight(other, *trust(), 1.0)
    ring = abs(other[0] - one[0])[24:37, 24:37]
    ring[6, 6] = 0
    # Its difference is twice the light, of which 1 / 2πσ² = 0.4 % reach a pixel beside it.
    assert 0 < ring.max() < 2 * 0.0044 * (window[:2].max() + 1)


def test_no_pixel_becomes_negative():
    window = np.full((3, *SHAPE, 3), 1.0, np.float32)
    window[0, ::2] = 0.01
    window[1] = 0.02
    relight(window, *trust(), 0.1)
    assert window.min() == 0


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_is_kept(rng, scale):
    window, _ = scene(rng, light=1.3)
    scaled = window * np.float32(scale)
    relight(window, *trust(), 1.0)
    relight(scaled, *trust(), scale)
    np.testing.assert_allclose(scaled / np.float32(scale), window, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("top", [8, 13])
def test_a_part_of_a_frame_is_what_the_whole_is_there(rng, top):
    window, _ = scene(rng, light=1.3)
    alike, trusted = trust()
    trusted[:] = rng.uniform(0, 1, trusted.shape)
    part = window[:, top:].copy()
    relight(window, alike, trusted, 1.0)
    relight(part, alike[:, top:], trusted[:, top:], 1.0, first_row=top)
    below = 24  # what three deviations, and cells, reach
    np.testing.assert_allclose(part[:, below:], window[:, top + below :], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("window", (np.zeros((2, 8, 8, 3), np.float32), np.zeros((2, 8, 8)), np.zeros((2, 8, 8)), 1.0)),
        ("window", (np.zeros((3, 8, 8, 3)), np.zeros((3, 8, 8)), np.zeros((3, 8, 8)), 1.0)),
        ("trusted", (np.zeros((3, 8, 8, 3), np.float32), np.zeros((3, 8, 8)), np.zeros((3, 8, 9)), 1.0)),
        ("alike", (np.zeros((3, 8, 8, 3), np.float32), np.zeros((3, 8, 9)), np.zeros((3, 8, 8)), 1.0)),
        ("exposure", (np.zeros((3, 8, 8, 3), np.float32), np.zeros((3, 8, 8)), np.zeros((3, 8, 8)), 0.0)),
    ],
)
def test_arguments_are_checked(name, arguments):
    with pytest.raises(ValueError, match=f"^{name}:"):
        relight(*arguments)
