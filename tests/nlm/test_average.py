import numpy as np
import pytest

from nlm.average import average, reject_outliers, replace_nonfinite, robust_average


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def test_average_is_the_weighted_mean(rng):
    window = rng.random((5, 7, 9, 3), np.float32)
    weight = rng.random((5, 7, 9), np.float32)
    expected = (window * weight[..., None]).sum(0) / weight.sum(0)[..., None]
    np.testing.assert_allclose(average(window, weight), expected, rtol=1e-5)  # sums of five float32


@pytest.mark.parametrize("frames", [3, 5, 7])
def test_robust_average_discards_minimum_and_maximum(rng, frames):
    window = rng.random((frames, 7, 9, 3), np.float32)
    expected = np.sort(window, axis=0)[1:-1].mean(0)
    result = robust_average(window, np.ones(window.shape[:3], np.float32))
    np.testing.assert_allclose(result, expected, rtol=1e-5)  # sums of a few float32


def test_robust_average_counts_only_trusted_frames(rng):
    window, weight = rng.random((5, 6, 6, 2), np.float32), np.zeros((5, 6, 6), np.float32)
    weight[1:4, :3] = 1  # three frames: the median of them
    weight[1:3, 3:] = 1  # two: their mean
    window[0], window[4] = np.nan, np.inf
    result = robust_average(window, weight)
    np.testing.assert_array_equal(result[:3], np.median(window[1:4, :3], axis=0))
    np.testing.assert_allclose(result[3:], window[1:3, 3:].mean(0), rtol=1e-6)


def test_robust_average_never_prefers_frames_that_hardly_count():
    window = np.full((5, 4, 4, 1), 9, np.float32)
    window[2] = 1  # the centre is the minimum, and the only frame that is trusted
    weight = np.full((5, 4, 4), 0.01, np.float32)
    weight[2] = 1
    # four frames of 0.01 may add 8 · 0.04 / 1.04
    assert robust_average(window, weight).max() <= 1.31


@pytest.mark.parametrize("function", [average, robust_average])
def test_averages_keep_constants_scale_and_the_lone_centre(rng, function):
    window, weight = rng.random((5, 6, 6, 3), np.float32), rng.random((5, 6, 6), np.float32)
    np.testing.assert_allclose(function(np.full_like(window, 0.3), weight), 0.3, rtol=1e-6)
    np.testing.assert_array_equal(function(window * 1024, weight), function(window, weight) * 1024)
    np.testing.assert_array_equal(function(window, np.zeros_like(weight)), window[2])


def test_one_outlier_moves_the_robust_average_by_a_bounded_amount(rng):
    window = rng.random((5, 6, 6, 3), np.float32)
    window[1] = 1e6
    assert robust_average(window, np.ones((5, 6, 6), np.float32)).max() <= 1


@pytest.mark.parametrize("frames", [1, 3, 5])
def test_fireflies_go_and_leave_neither_hole_nor_halo(rng, frames):
    window = rng.gamma(4, 0.25, (frames, 24, 24, 3)).astype(np.float32)
    weight = np.ones(window.shape[:3], np.float32)
    hit = window.copy()
    centre = frames // 2
    hit[centre, 10, 12] = 1e6
    hit[centre, 0, 0] = 300
    cleaned, mask = reject_outliers(hit, weight)
    assert set(zip(*np.nonzero(mask), strict=True)) == {(centre, 10, 12), (centre, 0, 0)}
    np.testing.assert_array_equal(cleaned[~mask], hit[~mask])
    # a mean of 44 values of mean 1 and deviation 1/2 (of 8 where there is one frame): four deviations
    limit = 4 * 0.5 / np.sqrt(9 * frames - 1) if frames > 1 else 0.75
    assert np.abs(cleaned[centre, 10, 12] - 1).max() < limit


def test_a_warped_firefly_goes_as_a_whole(rng):
    window = rng.gamma(4, 0.25, (5, 16, 16, 3)).astype(np.float32)
    window[3, 8:10, 8:10] = 1e4
    cleaned, mask = reject_outliers(window, np.ones(window.shape[:3], np.float32))
    assert mask.sum() == 4
    assert cleaned.max() < 10


def test_light_that_stays_is_no_firefly(rng):
    window = rng.gamma(4, 0.25, (5, 16, 16, 3)).astype(np.float32)
    window[:, 8, 8] = 1000  # a lamp of one pixel, in every frame
    window[2, 3:6, 3:6] = 50  # a highlight that came and went, larger than a pixel
    window[2, 12:14] = 50  # one that reaches the edge of the frame
    _, mask = reject_outliers(window, np.ones(window.shape[:3], np.float32))
    assert not mask.any()


@pytest.mark.parametrize("lit", [1.0, 0.3])
def test_ordinary_noise_keeps_its_mean(rng, lit):
    # exponential noise, all of it or three pixels in ten: more skewed than most renders
    window = (rng.exponential(1, (5, 64, 64, 1)) * (rng.random((5, 64, 64, 1)) < lit)).astype(np.float32)
    cleaned, _ = reject_outliers(window, np.ones(window.shape[:3], np.float32))
    assert abs(cleaned.mean() / window.mean() - 1) < 1e-3


def test_outliers_scale_and_untrusted_pixels(rng):
    window = rng.gamma(2, 0.5, (3, 12, 12, 3)).astype(np.float32)
    window[1, 5, 5], window[0, 6, 6] = 1e4, np.nan
    weight = np.ones((3, 12, 12), np.float32)
    weight[0, 6, 6] = 0
    cleaned, mask = reject_outliers(window, weight)
    assert mask.sum() == 1
    np.testing.assert_array_equal(reject_outliers(window * 256, weight)[0], cleaned * 256)


def test_nonfinite_pixels_are_filled_from_the_nearest():
    image = np.full((9, 9, 3), 2, np.float32)
    image[4, 4, 1], image[0, :3] = np.nan, -np.inf
    filled, mask = replace_nonfinite(image)
    assert mask.sum() == 4
    np.testing.assert_array_equal(filled, 2)
    ramp = np.repeat(np.arange(9, dtype=np.float32)[None, :, None], 5, axis=0)
    ramp[:, 3:] = np.nan
    filled, _ = replace_nonfinite(ramp)
    np.testing.assert_allclose(filled[:, 3], 2, rtol=1e-6)  # the one finite column it touches
    assert np.isfinite(filled).all()
    assert filled.max() <= 2


def test_nonfinite_extremes():
    assert not replace_nonfinite(np.full((4, 5, 3), np.nan, np.float32))[0].any()
    huge = np.full((4, 5, 3), 3e38, np.float32)
    huge[1, 1] = np.inf
    assert np.isfinite(replace_nonfinite(huge)[0]).all()
    assert np.isinf(huge[1, 1]).all()  # the input stays as it is
    image = np.ones((4, 5, 3), np.float32)
    filled, mask = replace_nonfinite(image)
    assert filled is image  # no copy where nothing is replaced
    assert not mask.any()


@pytest.mark.parametrize("function", [average, robust_average, reject_outliers])
def test_shapes_are_checked(function):
    with pytest.raises(ValueError, match="window"):
        function(np.zeros((4, 5, 6, 3), np.float32), np.zeros((4, 5, 6), np.float32))
    with pytest.raises(ValueError, match="weight"):
        function(np.zeros((3, 5, 6, 3), np.float32), np.zeros((3, 6, 5), np.float32))
