import numpy as np
import pytest
from skimage.restoration import denoise_nl_means

from nlm.nonlocal_means import joint_nlm


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def naive(window, variance, features, confidence, radius, patch, k):
    """The formulas of the docstring, pixel by pixel, in float64; taps outside the frame do not exist."""
    window, variance = window.astype(np.float64), variance.astype(np.float64)
    T, H, W, C = window.shape
    centre = T // 2
    margin = radius + patch
    pad = lambda x: np.pad(x, ((margin, margin), (margin, margin), (0, 0)), mode="edge")  # noqa: E731
    u = pad(window[centre])
    noise = lambda v: k * k * pad(variance) + 1e-6 * v * v  # noqa: E731
    a = noise(u)
    out = np.zeros((H, W, C))
    gy, gx = (
        np.stack(g, -1)
        for g in zip(
            *(np.gradient(np.pad(features[..., f], 1, mode="edge")) for f in range(features.shape[2])), strict=True
        )
    )
    tolerance = np.maximum((gx**2 + gy**2)[1:-1, 1:-1], 1e-3)
    for y in range(H):
        for x in range(W):
            total, weights = np.zeros(C), 0.0
            for t in range(T):
                v = pad(window[t])
                b = noise(v)
                for qy in range(max(y - radius, 0), min(y + radius + 1, H)):
                    for qx in range(max(x - radius, 0), min(x + radius + 1, W)):
                        p = np.s_[
                            y + margin - patch : y + margin + patch + 1, x + margin - patch : x + margin + patch + 1
                        ]
                        q = np.s_[
                            qy + margin - patch : qy + margin + patch + 1, qx + margin - patch : qx + margin + patch + 1
                        ]
                        d = ((u[p] - v[q]) ** 2 - (a[p] + np.minimum(a[p], b[q])) / k**2) / (a[p] + b[q])
                        d = np.minimum(d, 25).mean()
                        m = margin
                        spread = a[y + m, x + m] + b[qy + m, qx + m]
                        if ((u[y + m, x + m] - v[qy + m, qx + m]) ** 2 > 400 / k**2 * spread).any():
                            continue
                        f = (features[y, x] - features[qy, qx]) ** 2
                        d = max(d, (f / tolerance[y, x]).max(), 0)
                        w = max(1 - d / 16, 0) ** 16 * confidence[t, qy, qx]
                        total, weights = total + w * window[t, qy, qx], weights + w
            out[y, x] = total / weights
    return out


def test_matches_the_formula(rng):
    window = rng.gamma(4, 0.25, (3, 6, 8, 3)).astype(np.float32)
    variance = rng.uniform(0.1, 0.4, (6, 8, 3)).astype(np.float32)
    features = rng.uniform(0, 0.2, (6, 8, 2)).astype(np.float32)
    confidence = rng.uniform(0.1, 1, (3, 6, 8)).astype(np.float32)
    for radius, patch, k in ((2, 1, 0.5), (1, 2, 0.8)):
        result = joint_nlm(window, variance, features, confidence, radius=radius, patch_radius=patch, k=k)
        expected = naive(window, variance, features, confidence, radius, patch, k)
        np.testing.assert_allclose(result, expected, rtol=2e-4)  # running sums in float32


def test_tiles_meet_without_a_seam(rng):
    # larger than a tile both ways; cut so that tile borders fall elsewhere
    window = rng.gamma(4, 0.25, (1, 70, 560, 1)).astype(np.float32)
    variance = np.full((70, 560, 1), 0.2, np.float32)
    whole = joint_nlm(window, variance, radius=2, patch_radius=1)
    part = joint_nlm(window[:, 10:, 30:], variance[10:, 30:], radius=2, patch_radius=1)
    np.testing.assert_allclose(whole[13:, 33:], part[3:, 3:], rtol=1e-4)  # other order of float32 sums


def test_what_does_not_call_for_it_stays_as_it_is(rng):
    window = rng.random((3, 70, 40, 3), np.float32)
    variance = np.full(window.shape[1:], 0.05, np.float32)
    where = np.zeros((70, 40), np.bool_)
    where[40, 3] = True  # of the second row of tiles
    whole, part = joint_nlm(window, variance), joint_nlm(window, variance, where=where)
    np.testing.assert_array_equal(part[32:64, :12], whole[32:64, :12])  # with eight columns beside it
    for block in (np.s_[:32], np.s_[64:], np.s_[32:64, 12:]):
        np.testing.assert_array_equal(part[block], window[1][block])
        assert np.abs(whole[block] - window[1][block]).mean() > 0.1


def test_constants_scale_and_range(rng):
    window = rng.gamma(4, 0.25, (3, 20, 20, 3)).astype(np.float32)
    variance = np.full((20, 20, 3), 0.2, np.float32)
    result = joint_nlm(window, variance, radius=2)
    assert result.min() >= window.min()
    assert result.max() <= window.max() * (1 + 1e-6)
    for scale in (2.0**-20, 2.0**20):
        scaled = joint_nlm(window * np.float32(scale), variance * np.float32(scale * scale), radius=2)
        np.testing.assert_allclose(scaled, result * scale, rtol=1e-5)  # powers of two: only 1e-30 differs
    flat = np.full((3, 20, 20, 3), 0.3, np.float32)
    for v in (variance, variance * 0):
        np.testing.assert_allclose(joint_nlm(flat, v, radius=2), 0.3, rtol=1e-6)
    black = joint_nlm(flat * 0, variance * 0, radius=2)
    np.testing.assert_array_equal(black, 0)


def test_without_variance_an_image_stays_as_it_is(rng):
    window = rng.random((1, 16, 16, 3), np.float32)
    result = joint_nlm(window, np.zeros((16, 16, 3), np.float32), radius=3, patch_radius=1)
    np.testing.assert_allclose(result, window[0], rtol=1e-5)


def test_features_and_confidence_stop_the_average(rng):
    window = np.zeros((3, 16, 16, 1), np.float32)
    window[:, :, 8:] = 0.5
    window += rng.normal(0, 0.3, window.shape).astype(np.float32)  # the edge drowns in noise…
    features = np.zeros((16, 16, 1), np.float32)
    features[:, 9:] = 1  # … and is seen only by the feature; not at 8, where the gradient forgives
    window[0], window[2] = 100, np.nan  # wrong frames, and nobody trusts them
    confidence = np.zeros((3, 16, 16), np.float32)
    confidence[1] = 1
    variance = np.full((16, 16, 1), 0.09, np.float32)
    result = joint_nlm(window, variance, features, confidence=confidence, radius=4, k=1.0)
    assert np.isfinite(result).all()
    moved = window.copy()
    moved[1, :, 12:] += 0.2  # beyond the patch of pixels at 7 or less, within their search
    other = joint_nlm(moved, variance, features, confidence=confidence, radius=4, k=1.0)
    np.testing.assert_allclose(result[:, :7], other[:, :7], rtol=1e-5)


def test_hard_values_stay_where_they_are(rng):
    window = rng.gamma(4, 0.25, (3, 24, 24, 3)).astype(np.float32)
    variance = np.full((24, 24, 3), 0.25, np.float32)
    clean = joint_nlm(window, variance, radius=2, patch_radius=1)
    window[1, 12, 12] = 1e6
    window[0, 3, 3], window[2, 20, 4] = np.nan, np.inf
    result = joint_nlm(window, variance, radius=2, patch_radius=1)
    assert np.isfinite(result).all()
    far = np.ones((24, 24), bool)
    for y, x in ((12, 12), (3, 3), (20, 4)):
        far[max(y - 3, 0) : y + 4, max(x - 3, 0) : x + 4] = False
    # running sums keep a trace of 1e-6 of the firefly's capped distance
    np.testing.assert_allclose(result[far], clean[far], rtol=1e-4)
    far[12, 12] = True
    assert result[~far].max() < window[window < 100].max() * 1.01  # nothing of the firefly around it


def test_denoises_no_worse_than_scikit_image(rng):
    y, x = np.mgrid[:64, :64]
    clean = (0.5 + 0.3 * np.sin(x / 6) * (y > 30)).astype(np.float32)
    noisy = (clean + rng.normal(0, 0.1, clean.shape)).astype(np.float32)
    peer = denoise_nl_means(noisy, patch_size=5, patch_distance=5, h=0.06, sigma=0.1, fast_mode=True)
    ours = joint_nlm(noisy[None, ..., None], np.full((64, 64, 1), 0.01, np.float32), radius=5, patch_radius=2, k=0.6)
    error = lambda image: np.mean((np.squeeze(image) - clean) ** 2)  # noqa: E731
    assert error(ours) < 1.1 * error(peer)  # the same method; weights and border differ
    assert error(ours) < 0.15 * error(noisy)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("window", {"window": np.zeros((2, 8, 8, 3), np.float32)}),
        ("variance", {"variance": np.zeros((8, 8, 1), np.float32)}),
        ("features", {"features": np.zeros((8, 7, 2), np.float32)}),
        ("confidence", {"confidence": np.zeros((1, 8, 8), np.float32)}),
        ("radius", {"radius": -1}),
        ("k", {"k": 0.0}),
    ],
)
def test_arguments_are_checked(name, change):
    good = {"window": np.zeros((3, 8, 8, 3), np.float32), "variance": np.zeros((8, 8, 3), np.float32)}
    with pytest.raises(ValueError, match=f"^{name}:"):
        joint_nlm(**{**good, **change})
