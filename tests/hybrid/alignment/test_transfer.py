import numpy as np
import pytest

from hybrid.alignment.transfer import (
    ALBEDO_FLOOR,
    autoexposure,
    compress,
    demodulate,
    expand,
    measure_exposure,
    measure_gain,
    measure_typical_exposure,
    remodulate,
)


@pytest.fixture
def radiance():
    return np.random.default_rng(1).gamma(0.5, 2, (13, 17, 3)).astype(np.float32)


def test_remodulation_undoes_demodulation(radiance):
    albedo = np.random.default_rng(2).uniform(0, 0.9, radiance.shape).astype(np.float32)
    # One division and one multiplication: two roundings of 6e-8.
    np.testing.assert_allclose(remodulate(demodulate(radiance, albedo), albedo), radiance, rtol=3e-7)


def test_demodulation_is_linear_so_that_aovs_still_sum(radiance):
    albedo = np.random.default_rng(3).uniform(0, 0.9, radiance.shape).astype(np.float32)
    parts = demodulate(0.25 * radiance, albedo) + demodulate(0.75 * radiance, albedo)
    np.testing.assert_allclose(parts, demodulate(radiance, albedo), rtol=3e-7)


def test_demodulation_of_black_is_bounded_by_the_floor(radiance):
    black = np.zeros_like(radiance)
    np.testing.assert_allclose(demodulate(radiance, black), radiance / np.float32(ALBEDO_FLOOR), rtol=1e-6)
    assert np.isfinite(demodulate(radiance, -black - 1)).all()  # a negative albedo counts as black


def test_one_channel_is_divided_by_the_mean_albedo(radiance):
    albedo = np.full_like(radiance, 0.45)
    divisor = np.float32(0.45 + ALBEDO_FLOOR)
    np.testing.assert_allclose(demodulate(radiance[..., :1], albedo), radiance[..., :1] / divisor, rtol=1e-6)


def test_compression_is_undone_by_expansion(radiance):
    # 1 − x/(1 + x) loses the digits that x/(1 + x) has above 1: a relative error of (1 + x) roundings.
    np.testing.assert_allclose(expand(compress(radiance, 0.7), 0.7), radiance, rtol=1e-5, atol=1e-6)
    assert compress(np.float32([[[1e30, 0, -1]]]), 1.0).tolist() == [[[1, 0, 0]]]


@pytest.mark.parametrize("scale", [1e-6, 3.0, 1e6])
def test_exposure_scales_with_the_image(radiance, scale):
    assert measure_exposure(radiance * np.float32(scale)) == pytest.approx(scale * measure_exposure(radiance), rel=1e-5)


def test_exposure_ignores_fireflies_and_what_is_not_finite(radiance):
    spoiled = radiance.copy()
    spoiled[3, 4], spoiled[5, 6, 1] = 1e6, np.nan
    # Two of 221 pixels: the clip moves by one rank and the mean by half a per cent of itself.
    assert measure_exposure(spoiled) == pytest.approx(measure_exposure(radiance), rel=0.02)


@pytest.mark.parametrize("image", [np.zeros((4, 5, 3)), np.full((4, 5, 3), np.nan), np.zeros((0, 5, 3))])
def test_exposure_of_an_image_without_light_is_one(image):
    assert measure_exposure(image.astype(np.float32)) == 1.0


@pytest.mark.parametrize(
    ("share", "left"), [(share, left) for share in (0.001, 0.01, 0.1, 1.0) for left in (0.0, 1e-10)] + [(0.1, 1e-5)]
)
def test_exposure_and_gain_of_an_object_on_black_are_those_of_the_object(share, left):
    """Denoisers leave tiny values on black: these are no light, whatever share of the frame is black."""
    side = round(np.sqrt(share) * 640)
    item = np.random.default_rng(5).uniform(0.5, 1.5, (side, side, 3)).astype(np.float32)
    image = np.full((640, 640, 3), left, np.float32)
    top, start = 16 * ((640 - side) // 32), 16 * ((640 - side) // 32)
    image[top : top + side, start : start + side] = item
    # Bins at the border hold black pixels too: of objects of 20 pixels three quarters of all bins.
    assert measure_exposure(image) == pytest.approx(measure_exposure(item), rel=0.65 if side < 64 else 0.2)
    assert measure_gain(image) == pytest.approx(measure_gain(item), rel=4 if side < 64 else 0.3)
    assert measure_gain(64 * image) == pytest.approx(measure_gain(image) / 64, rel=1e-5)


@pytest.mark.parametrize("window", [50.0, 200.0, 500.0])
def test_a_room_beside_a_window_counts_in_the_gain(window):
    """From 100 times its light on, over more than a hundredth of the picture, the networks saw the room as black."""
    image = np.ones((96, 192, 3), np.float32)
    image[:48, :128] = window
    assert measure_gain(image) == pytest.approx(0.18 / window ** (1 / 3), rel=0.01)


def test_the_typical_exposure_is_less_than_the_mean_beside_a_window_alone():
    image = np.random.default_rng(7).uniform(0.5, 1.5, (96, 192, 3)).astype(np.float32)
    assert measure_typical_exposure(image) == measure_exposure(image)
    image[:48, :128] = 100
    assert measure_exposure(image) > 30
    assert measure_typical_exposure(image) == pytest.approx(2 * 100 ** (1 / 3), rel=0.02)
    assert measure_typical_exposure(64 * image) == pytest.approx(64 * measure_typical_exposure(image), rel=1e-5)


def test_exposure_of_a_lit_image_is_its_mean_without_the_brightest_hundredth():
    image = np.random.default_rng(6).uniform(0.1, 1, (50, 70, 3)).astype(np.float32)
    level = np.sort(image.mean(axis=-1).ravel())
    expected = np.minimum(level, level[-1 - level.size // 100]).mean()
    assert measure_exposure(image) == pytest.approx(expected, rel=1e-6)


def test_autoexposure_is_that_of_bins():
    radiance = np.random.default_rng(4).gamma(0.3, 1, (33, 50, 3)).astype(np.float32)
    radiance[:11, :13] = 0  # a bin without light counts for nothing
    logs = []
    for i in range(3):
        for j in range(4):
            block = radiance[i * 33 // 3 : (i + 1) * 33 // 3, j * 50 // 4 : (j + 1) * 50 // 4]
            luminance = (block @ [0.212671, 0.715160, 0.072169]).mean()
            if luminance > 1e-8:
                logs.append(np.log2(luminance))
    assert len(logs) == 11
    assert autoexposure(radiance) == pytest.approx(0.18 / 2 ** np.mean(logs), rel=1e-6)
    assert autoexposure(64 * radiance) == pytest.approx(autoexposure(radiance) / 64, rel=1e-6)
    assert autoexposure(np.full((3, 3, 3), 3e38, np.float32)) > 0
    assert autoexposure(np.zeros((20, 20, 3), np.float32)) == 1


def test_exposure_is_the_mean_of_the_lit_bins_up_to_their_brightest_hundredth():
    rng = np.random.default_rng(3)
    image = rng.gamma(0.5, 1, (40, 70, 3)).astype(np.float32)
    image[:16] = 0  # whole bins without light
    image[20, 20], image[30, 60] = np.nan, -1
    level = (image[..., 0] + image[..., 1] + image[..., 2]) / np.float32(3)
    # Bins of 40 rows in three are 13, 13 and 14 high: those of the first are black, those of the second partly.
    lit = level[13:]
    lit = np.sort(lit[np.isfinite(lit)])
    bright = lit[-1 - lit.size // 100]
    expected = float(np.minimum(lit, bright).mean(dtype=np.float64))
    assert measure_exposure(image) == pytest.approx(expected, rel=1e-12)
    assert measure_exposure(-np.abs(image)) == 1
