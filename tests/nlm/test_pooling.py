import numpy as np
import pytest

from nlm.pooling import pool_samples


@pytest.fixture
def window() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimates, residuals and confidence of five frames; some pixels are trusted in no frame, or in one."""
    rng = np.random.default_rng(7)
    estimates = rng.random((5, 9, 11, 3), np.float32)
    residuals = (estimates * (rng.gamma(0.5, 2, estimates.shape) - 1)).astype(np.float32)
    confidence = rng.random((5, 9, 11), np.float32)
    confidence[:, 2:4] = 0
    confidence[1, 3] = 0.3
    return estimates, residuals, confidence


def plain_gather(e: np.ndarray, r: np.ndarray, c: np.ndarray, exposure: float) -> list[np.ndarray]:
    """The definition, pixel by pixel, in float64."""
    average, image = np.zeros(e.shape[1:]), np.zeros(e.shape[1:])
    for y, x in np.ndindex(e.shape[1:3]):
        light, noise, weights = np.zeros(3), np.zeros(3), []
        for t in range(len(e)):
            if c[t, y, x] > 0 and np.isfinite([e[t, y, x], r[t, y, x]]).all():
                limit = 6 * (max(e[t, y, x].mean(), 0) + exposure)
                weights.append(float(c[t, y, x]))
                light += weights[-1] * e[t, y, x]
                noise += weights[-1] * r[t, y, x] * min(1, limit / max(abs(r[t, y, x].mean()), 1e-30))
        if weights:
            average[y, x], image[y, x] = light / sum(weights), (light + noise) / sum(weights)
        else:
            average[y, x] = image[y, x] = e[len(e) // 2, y, x]
    return [average, image]


def test_gather_is_its_definition(window) -> None:
    estimates, residuals, confidence = window
    residuals[3, 5, 5] = 1e6, 2e6, 5e5
    estimates[0, 6, 6, 1] = np.nan
    residuals[4, 7, 7] = np.inf, -np.inf, 0
    confidence[2, 8, 8] = np.nan
    gathered = pool_samples(*window, exposure=0.4)
    expected = plain_gather(*window, exposure=0.4)
    for found, wanted in zip(gathered, expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=2e-5, atol=1e-6)  # sums of five float32


def test_constants_are_preserved(window) -> None:
    _, _, confidence = window
    constant = np.full((5, 9, 11, 3), 0.7, np.float32)
    gathered = pool_samples(constant, np.zeros_like(constant), confidence, 0.5)
    np.testing.assert_allclose(gathered.average, 0.7, rtol=1e-6)
    np.testing.assert_allclose(gathered.image, 0.7, rtol=1e-6)


@pytest.mark.parametrize("scale", [2**-60, 2**10, 2**60])
def test_a_scaled_window_is_gathered_to_a_scaled_one(window, scale: float) -> None:
    estimates, residuals, confidence = window
    residuals[3, 5, 5] = 1e6
    plain = pool_samples(estimates, residuals, confidence, 0.4)
    scaled = pool_samples(scale * estimates, scale * residuals, confidence, scale * 0.4)
    np.testing.assert_array_equal(scaled.average, scale * plain.average)
    np.testing.assert_array_equal(scaled.image, scale * plain.image)


def test_equal_trust_brings_the_noise_of_as_many_frames() -> None:
    rng = np.random.default_rng(3)
    estimates = np.ones((5, 60, 60, 3), np.float32)
    residuals = rng.normal(0, 0.3, estimates.shape).astype(np.float32)
    gathered = pool_samples(estimates, residuals, np.ones((5, 60, 60), np.float32), 1.0)
    # 10800 samples: the variance is known to 1.4 %, four deviations are 5.5 %.
    assert gathered.image.var() == pytest.approx(0.3**2 / 5, rel=0.055)
    # Unbiased: the mean of 54000 samples, four deviations.
    assert gathered.image.mean() == pytest.approx(1, abs=4 * 0.3 / np.sqrt(54000))


def test_without_trust_the_centre_is_left(window) -> None:
    estimates, residuals, confidence = window
    gathered = pool_samples(estimates, residuals, np.zeros_like(confidence), 1.0)
    np.testing.assert_array_equal(gathered.average, estimates[2])
    np.testing.assert_array_equal(gathered.image, estimates[2])


def test_a_frame_that_nobody_trusts_may_hold_anything(window) -> None:
    estimates, residuals, confidence = window
    confidence[4] = 0
    plain = pool_samples(estimates, residuals, confidence, 1.0)
    for value in (np.nan, np.inf, 1e30):
        estimates[4] = residuals[4] = value
        again = pool_samples(estimates, residuals, confidence, 1.0)
        for name in ("average", "image"):
            np.testing.assert_array_equal(getattr(again, name), getattr(plain, name))


def test_a_firefly_keeps_its_hue_and_loses_its_power() -> None:
    estimates = np.full((5, 3, 3, 3), 0.5, np.float32)
    residuals = np.zeros_like(estimates)
    residuals[3, 1, 1] = 3e5, 2e5, 1e5
    image = pool_samples(estimates, residuals, np.ones((5, 3, 3), np.float32), 1.0).image
    added = image[1, 1] - 0.5
    # A fifth of 6 · (0.5 + 1) in the mean over channels.
    assert added.mean() == pytest.approx(6 * 1.5 / 5, rel=1e-5)
    np.testing.assert_allclose(added / added.sum(), [1 / 2, 1 / 3, 1 / 6], rtol=1e-5)
    image[1, 1] = 0.5
    np.testing.assert_array_equal(image, 0.5)


def test_noise_below_the_limit_is_left_alone() -> None:
    estimates = np.full((1, 2, 2, 3), 0.5, np.float32)
    residuals = np.full_like(estimates, 8.9)
    confidence = np.ones((1, 2, 2), np.float32)
    np.testing.assert_allclose(pool_samples(estimates, residuals, confidence, 1.0).image, 9.4, rtol=1e-6)
    # Samples without light lie an estimate below: never far enough.
    np.testing.assert_allclose(pool_samples(estimates, -estimates, confidence, 1e-9).image, 0, atol=1e-7)


def test_bad_arguments_are_errors(window) -> None:
    estimates, residuals, confidence = window
    with pytest.raises(ValueError, match="residuals: expected shape"):
        pool_samples(estimates, residuals[:, 1:], confidence, 1.0)
    with pytest.raises(ValueError, match="confidence: expected shape"):
        pool_samples(estimates, residuals, confidence[:, 1:], 1.0)
    with pytest.raises(ValueError, match=r"window: expected .* odd frames"):
        pool_samples(estimates[1:], residuals[1:], confidence[1:], 1.0)
    for exposure in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="exposure: expected a positive number"):
            pool_samples(estimates, residuals, confidence, exposure)
