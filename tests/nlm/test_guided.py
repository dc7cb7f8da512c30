import cv2
import numpy as np
import pytest

from nlm.guided import guided_filter


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def naive(image, guide, radius, eps, weight):
    """He's equations, box by box, in float64."""
    H, W, C = image.shape
    guide = (guide - guide.mean((0, 1))) / guide.std((0, 1))
    total, boxes = np.zeros((H, W, C)), np.zeros((H, W, 1))
    for y in range(H):
        for x in range(W):
            box = np.s_[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
            w = weight[box].reshape(-1, 1) / weight[box].sum()
            g, p = guide[box].reshape(-1, guide.shape[2]), image[box].reshape(-1, C)
            mean_g, mean_p = (w * g).sum(0), (w * p).sum(0)
            covariance = (w * (g - mean_g)).T @ (g - mean_g) + eps * np.eye(g.shape[1])
            a = np.linalg.solve(covariance, (w * (g - mean_g)).T @ (p - mean_p))
            total[box] += (guide[box] - mean_g) @ a + mean_p
            boxes[box] += 1
    return total / boxes


@pytest.mark.parametrize("channels", [1, 3, 7])
def test_matches_the_equations(rng, channels):
    image = rng.gamma(4, 0.25, (14, 17, 3))
    guide = rng.random((14, 17, channels)) * np.arange(1, channels + 1)
    missing = rng.random((14, 17)) < 0.05
    for left_out in (np.zeros_like(missing), missing):
        given = np.where(left_out[..., None], np.nan, image).astype(np.float32)
        result = guided_filter(given, guide.astype(np.float32), radius=2, eps=0.05)
        # coefficients are stored in float32 and cancel; the range's clamp is not reached at this eps
        np.testing.assert_allclose(result, naive(image, guide, 2, 0.05, 1.0 - left_out), atol=2e-5)


@pytest.mark.parametrize("channels", [1, 3])
def test_agrees_with_opencv_away_from_the_border(rng, channels):
    image, guide = rng.random((40, 50, 3), np.float32), rng.random((40, 50, channels), np.float32)
    standard = (guide - guide.mean((0, 1))) / guide.std((0, 1))
    peer = cv2.ximgproc.guidedFilter(standard, image, 3, 0.1)
    result = guided_filter(image, guide, radius=3, eps=0.1)
    # OpenCV repeats the edge where we cut the box; float32 covariances there
    np.testing.assert_allclose(result[6:-6, 6:-6], peer[6:-6, 6:-6], atol=2e-5)


@pytest.mark.parametrize("subsample", [1, 2, 4])
def test_constants_scale_sign_and_range(rng, subsample):
    image, guide = rng.exponential(1, (37, 45, 3)).astype(np.float32), rng.random((37, 45, 7), np.float32)
    image[10, 10] = 1e6  # the firefly that sends OpenCV's filter to -8196
    result = guided_filter(image, guide, radius=4, subsample=subsample)
    assert result.min() >= 0
    assert np.isfinite(result).all()
    np.testing.assert_array_equal(guided_filter(image * 64, guide, radius=4, subsample=subsample), result * 64)
    flat = guided_filter(np.full_like(image, 0.3), guide, radius=4, subsample=subsample)
    np.testing.assert_allclose(flat, 0.3, rtol=1e-6)
    # outside the boxes of the firefly nothing of it is left
    image[10, 10] = 1
    other = guided_filter(image, guide, radius=4, subsample=subsample)
    np.testing.assert_allclose(result[30:, 34:], other[30:, 34:], rtol=1e-5)


@pytest.mark.parametrize("subsample", [1, 2, 4])
def test_an_affine_function_of_the_guide_survives(rng, subsample):
    y, x = np.mgrid[:40, :40] / 40
    guide = np.stack([np.sin(5 * x), np.cos(4 * y), x * y, x > 0.5], -1).astype(np.float32)
    image = (guide @ rng.random((4, 3)) + 3).astype(np.float32)
    result = guided_filter(image, guide, radius=4, eps=1e-6, subsample=subsample)
    # eps pulls the slopes down where a box hardly varies; a coefficient between two pixels of the small image is
    # not that of either
    np.testing.assert_allclose(result, image, atol=0.01 if subsample == 1 else 0.05)


def test_the_guide_has_no_unit(rng):
    image, guide = rng.random((30, 30, 3), np.float32), rng.random((30, 30, 4), np.float32)
    expected = guided_filter(image, guide, radius=3)
    moved = guide * np.array([1, 1e3, 1e-3, 2], np.float32) + np.array([5, 0, 0, -1], np.float32)
    np.testing.assert_allclose(guided_filter(image, moved, radius=3), expected, atol=1e-4)  # 5 ± rounding
    constant = np.concatenate([guide, np.full((30, 30, 1), 0.7, np.float32)], -1)
    np.testing.assert_allclose(guided_filter(image, constant, radius=3), expected, atol=1e-6)


def test_what_is_not_finite_spreads_nowhere(rng):
    image, guide = rng.random((30, 30, 3), np.float32), rng.random((30, 30, 4), np.float32)
    guide[20, 20, 2] = np.inf
    assert np.isfinite(guided_filter(image, guide, radius=3)).all()
    assert np.isfinite(guided_filter(np.full_like(image, np.nan), guide, radius=3)).all()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("guide", {"guide": np.zeros((8, 9, 3), np.float32)}),
        ("radius", {"radius": 0}),
        ("eps", {"eps": 0.0}),
        ("subsample", {"subsample": 3}),
    ],
)
def test_arguments_are_checked(name, change):
    good = {"image": np.zeros((8, 8, 3), np.float32), "guide": np.zeros((8, 8, 3), np.float32), "radius": 2}
    with pytest.raises(ValueError, match=f"^{name}:"):
        guided_filter(**{**good, **change})
