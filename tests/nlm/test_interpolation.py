import numpy as np
import pytest

from nlm.interpolation import interpolation_weight
from nlm.variance import variance_from_estimate


def images(*values: float) -> list[np.ndarray]:
    return [np.full((6, 7, 3), value, np.float32) for value in values]


def test_it_is_its_formula() -> None:
    rng = np.random.default_rng(1)
    warped, bilinear = rng.gamma(1, 1, (2, 6, 7, 3)).astype(np.float32)
    variance = rng.gamma(1, 0.1, (6, 7)).astype(np.float32)
    wanted = variance / (variance + ((warped - bilinear) ** 2).mean(axis=-1))
    np.testing.assert_allclose(interpolation_weight(warped, bilinear, variance), wanted, rtol=1e-5)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_equal_warps_count_in_full_with_and_without_noise(noise: float) -> None:
    (warped,) = images(1.0)
    assert (interpolation_weight(warped, warped, np.full((6, 7), noise, np.float32)) == 1).all()


def test_a_rim_of_a_lamp_does_not_count() -> None:
    warped, bilinear = images(300.0, 200.0)
    assert interpolation_weight(warped, bilinear, np.full((6, 7), 1.0, np.float32)).max() < 1e-3


@pytest.mark.parametrize("scale", [2**-20, 2**20])
def test_the_unit_of_light_does_not_matter(scale: float) -> None:
    rng = np.random.default_rng(2)
    given = rng.gamma(1, 1, (2, 6, 7, 3)).astype(np.float32)
    variance = rng.gamma(1, 0.1, (6, 7)).astype(np.float32)
    plain = interpolation_weight(*given, variance)
    np.testing.assert_array_equal(interpolation_weight(*(scale * given), scale**2 * variance), plain)


def test_noise_is_that_of_the_samples() -> None:
    rng = np.random.default_rng(3)
    estimate = np.full((60, 60, 3), rng.random(), np.float32)
    noisy = estimate + rng.normal(0, 0.2, estimate.shape).astype(np.float32)
    # 675 samples: a variance is known to 5.4 %, and four deviations are 22 %.
    np.testing.assert_allclose(variance_from_estimate(noisy, estimate, 0.5)[8:-8, 8:-8], 0.04, rtol=0.22)
    assert (variance_from_estimate(estimate, estimate, 0.5) == 0).all()


def test_a_lamp_does_not_give_its_noise_to_the_dark_pixels_beside_it() -> None:
    rng = np.random.default_rng(4)
    estimate = np.full((40, 40, 3), 0.1, np.float32)
    estimate[20, 20] = 5000
    noisy = (estimate * rng.gamma(100, 0.01, (40, 40, 1))).astype(np.float32)
    noisy[20, 20] = 5500
    alone = variance_from_estimate(
        np.where(estimate > 1, 0.1, noisy).astype(np.float32), np.full_like(estimate, 0.1), 0.1
    )
    beside = variance_from_estimate(noisy, estimate, 0.1)
    assert beside[20, 22] < 1e-3 * 500**2 / 225  # a thousandth of the plain mean
    assert beside[5, 5] == pytest.approx(alone[5, 5], rel=1e-3)
