import numpy as np
import pytest

from flow.warp import warp
from hybrid.alignment.residual import measure_limited, warp_residual
from hybrid.alignment.transfer import ALBEDO_FLOOR, demodulate


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("divided", [False, True])
def test_the_difference_is_moved_by_whole_pixels(moves, divided):
    rng = np.random.default_rng(0)
    irradiance, first_pass, albedo = rng.random((3, 20, 30, 3), np.float32)
    flow, rows = rng.normal(0, 4, (20, 30, 2)).astype(np.float32), slice(3, 17)
    difference = irradiance - (demodulate(first_pass, albedo) if divided else first_pass)
    expected = warp(difference, flow[rows], interpolation="nearest", first_row=rows.start)[0]
    found = np.empty((14, 30, 3), np.float32)
    given = irradiance, first_pass, albedo if divided else None, flow[rows] if moves else None
    warp_residual(*given, (rows.start, 0), found)
    np.testing.assert_array_equal(found, expected if moves else difference[rows])


def test_residuals_of_an_albedo_far_from_that_of_the_centre_are_those_of_the_radiance():
    rng = np.random.default_rng(0)
    radiance, first_pass = rng.random((2, 20, 30, 3), np.float32)
    flow = rng.normal(0, 4, (20, 30, 2)).astype(np.float32)
    moved = warp(radiance - first_pass, flow, interpolation="nearest")[0]
    modulation = np.full_like(radiance, 0.15)
    for own, divisor in ((0.15, 0.15), (0.16, 0.16), (1.15, 0.15), (2.15, 0.15)):
        albedo, found = np.full_like(radiance, own - ALBEDO_FLOOR), np.empty_like(radiance)
        warp_residual(demodulate(radiance, albedo), first_pass, albedo, flow, (0, 0), found, modulation=modulation)
        np.testing.assert_allclose(found, moved / divisor, rtol=0.01, atol=1e-5)


def few_bright_samples(scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A gray wall of light 1 that one sample in fifty carries, and a first pass that is right."""
    rng = np.random.default_rng(1)
    bright = rng.random((120, 160, 1)) < 0.02
    irradiance = np.where(bright, np.float32(50), np.float32(0)) * np.ones(3, np.float32)
    return np.float32(scale) * irradiance, np.full(irradiance.shape, scale, np.float32)


def limited_residual(irradiance, first_pass, limited, rows=slice(0, 120)):
    out = np.empty((rows.stop - rows.start, 160, 3), np.float32)
    warp_residual(irradiance, first_pass, None, None, (rows.start, 0), out, limited)
    return out


@pytest.mark.parametrize("scale", [1.0, 1e-4, 1e5])
def test_limited_residuals_keep_the_light_of_a_first_pass_that_is_right(scale):
    """The limit alone leaves a seventh of it; noise of few samples keeps some of it cut."""
    irradiance, first_pass = few_bright_samples(scale)
    limited = measure_limited(irradiance, first_pass, None, 0.1 * scale)
    found = limited_residual(irradiance, first_pass, limited) / scale
    assert found.max() < 8
    assert abs(found.mean()) < 0.1


def test_no_more_light_is_spread_than_was_cut():
    irradiance, first_pass = few_bright_samples()
    limited = measure_limited(irradiance, 2 * first_pass, None, 0.1)
    found = limited_residual(irradiance, 2 * first_pass, limited)
    assert found.mean() == pytest.approx(float((irradiance - 2 * first_pass).mean()), abs=0.05)


def test_noise_within_the_limit_is_left_alone():
    first_pass = np.ones((40, 50, 3), np.float32)
    noisy = np.random.default_rng(0).exponential(1.0, first_pass.shape).astype(np.float32)
    assert measure_limited(np.minimum(noisy, 6), first_pass, None, 0.1) is None
    assert measure_limited(first_pass, 2 * first_pass, None, 0.1) is None  # a first pass that is too bright


def test_one_firefly_brightens_nothing():
    """The light that the limit removes from it is missing nowhere around it."""
    first_pass = np.ones((120, 160, 3), np.float32)
    noisy = first_pass.copy()
    noisy[60, 80] = 1e6
    assert measure_limited(noisy, first_pass, None, 0.1) is None


def test_a_part_is_limited_as_the_whole():
    irradiance, first_pass = few_bright_samples()
    limited = measure_limited(irradiance, first_pass, None, 0.1)
    whole = limited_residual(irradiance, first_pass, limited)
    np.testing.assert_array_equal(limited_residual(irradiance, first_pass, limited, slice(37, 80)), whole[37:80])
