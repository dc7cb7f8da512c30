"""Guides of the flow: comparable, finite, and of a known noise."""

import numpy as np
import pytest

from flow.guide import Guide, estimate_noise, make_guide, pair_guides


def pictures() -> tuple[np.ndarray, np.ndarray]:
    """Color and albedo."""
    rng = np.random.default_rng(5)
    return rng.random((20, 24, 3), np.float32), rng.random((20, 24, 3), np.float32)


def test_luminance_is_first_and_albedo_second() -> None:
    flat = np.ones((20, 24, 3), np.float32)
    color, albedo = flat * np.float32([3, 0, 0]), flat * np.float32([0, 0.5, 0])
    guide = make_guide(color, albedo, exposure=0.2126 * 3)
    # Reinhard's curve of Rec. 709's luminance; half at the exposure.
    np.testing.assert_allclose(guide.planes[..., 0], 0.5, rtol=1e-5)
    np.testing.assert_allclose(guide.planes[..., 1], 0.3576 / 1.3576, rtol=1e-5)
    assert make_guide(color, exposure=1.0).planes.shape == (20, 24, 1)


def test_the_guide_scales_with_exposure() -> None:
    color, albedo = pictures()
    guide = make_guide(color, albedo, exposure=0.5).planes
    np.testing.assert_allclose(make_guide(8 * color, albedo, exposure=4.0).planes, guide, atol=1e-6)
    assert guide.min() >= 0
    assert guide.max() <= 1


def test_it_is_smoothed_within_surfaces_and_not_across_them() -> None:
    rng = np.random.default_rng(8)
    albedo = np.full((40, 40, 3), 0.2, np.float32)
    albedo[:, 20:] = 0.8
    color = 2 * albedo * rng.gamma(8, 1 / 8, albedo.shape).astype(np.float32)
    planes, noise = make_guide(color, albedo, exposure=0.5)
    raw = make_guide(color, exposure=0.5).planes[..., 0]
    for half in (np.s_[8:-8, 2:18], np.s_[8:-8, 22:38]):
        assert planes[half][..., 0].std() < 0.8 * raw[half].std()
        assert np.median(noise[half][..., 0]) < 0.1
    # The step stays where it is, within a pixel.
    assert planes[:, 20, 0].mean() - planes[:, 19, 0].mean() > 0.7 * (planes[:, 30, 0].mean() - planes[:, 10, 0].mean())


def test_fireflies_and_what_is_not_finite_stay_local() -> None:
    color, albedo = pictures()
    spoiled = color.copy()
    spoiled[5, 5], spoiled[10, 10], spoiled[15, 15], spoiled[3, 20] = np.nan, np.inf, 1e30, -5
    changed = make_guide(spoiled, albedo, exposure=0.5).planes
    assert np.isfinite(changed).all()
    far = np.ones((20, 24), bool)
    for y, x in ((5, 5), (10, 10), (15, 15), (3, 20)):
        far[max(y - 4, 0) : y + 5, max(x - 4, 0) : x + 5] = False
    # The guided filter reaches twice its radius of 2.
    np.testing.assert_allclose(changed[far], make_guide(color, albedo, exposure=0.5).planes[far], atol=1e-5)
    assert not make_guide(np.zeros((8, 8, 3)), exposure=1.0).planes.any()


def test_noise_of_a_known_deviation() -> None:
    rng = np.random.default_rng(6)
    y, x = np.mgrid[:80, :80]
    slope = 0.1 * x + 0.03 * y + (x > 40)  # neither slopes nor straight edges count
    for deviation in (0.0, 0.02, 0.3):
        image = slope + deviation * rng.normal(size=slope.shape)
        # 225 pixels, each weighed with eight neighbours: about 60 independent ones; float32 rounding at 0.
        assert np.median(estimate_noise(image)) == pytest.approx(deviation, rel=0.1, abs=1e-5)


def test_noise_is_that_of_scikit_image_where_it_is_the_same_everywhere() -> None:
    """scikit-image's is one figure for the picture, from its finest wavelets; ours is one for each place."""
    pytest.importorskip("pywt")  # which scikit-image leaves to its callers to install
    from skimage.restoration import estimate_sigma

    rng = np.random.default_rng(7)
    y, x = np.mgrid[:160, :160] / 160
    image = np.sin(5 * x) * y + 0.05 * rng.normal(size=x.shape)
    # Both are within 3 % of the truth here; 15×15 pixels vary by 10 %, their mean by 1 %.
    assert estimate_noise(image).mean() == pytest.approx(estimate_sigma(image), rel=0.05)


def test_noise_of_a_smoothed_picture_is_measured_at_the_filters_distance() -> None:
    rng = np.random.default_rng(9)
    white = rng.normal(size=(120, 120))
    smooth = sum(np.roll(white, (i, j), (0, 1)) for i in range(4) for j in range(4)) / 16
    # 4×4 pixels averaged: a quarter of the deviation, and nothing left of it between neighbours.
    assert np.median(estimate_noise(smooth, spacing=4)) == pytest.approx(0.25, rel=0.15)
    assert np.median(estimate_noise(smooth)) < 0.15


def test_a_pair_has_the_greater_noise_and_is_finite() -> None:
    one, other = np.full((4, 5, 2), 0.25), np.full((4, 5, 2), 0.75)
    one[1, 1], one[2, 2], one[3, 3] = np.nan, np.inf, -np.inf
    pair = pair_guides(Guide(one, np.full((4, 5, 2), 0.1)), Guide(other, np.full((4, 5, 2), [0.2, 0.0])))
    assert (pair.centre[1, 1] == 0).all()
    assert (pair.centre[2, 2] == 1).all()
    assert (pair.centre[3, 3] == 0).all()
    assert (pair.centre[0] == 0.25).all()
    assert (pair.neighbour == 0.75).all()
    np.testing.assert_array_equal(pair.noise, np.full((4, 5, 2), [0.2, 0.1], np.float32))
    assert {planes.dtype for planes in pair} == {np.dtype(np.float32)}


def test_errors_name_the_argument() -> None:
    color = np.zeros((4, 4, 3))
    with pytest.raises(ValueError, match="exposure is 0"):
        make_guide(color, exposure=0)
    with pytest.raises(ValueError, match=r"color has shape \(4, 4\), expected \(H, W, 3\)"):
        make_guide(color[..., 0], exposure=1)
    with pytest.raises(ValueError, match="albedo has shape"):
        make_guide(color, color[:2], exposure=1)
    with pytest.raises(ValueError, match="image has shape"):
        estimate_noise(np.zeros(4))
    guide = Guide(color, color)
    with pytest.raises(ValueError, match=r"neighbour guide has shape \(2, 4, 3\), expected that of the centre guide"):
        pair_guides(guide, Guide(color[:2], color[:2]))
    with pytest.raises(ValueError, match="noise of the centre has shape"):
        pair_guides(Guide(color, color[:2]), guide)
    with pytest.raises(ValueError, match="centre guide has shape"):
        pair_guides(Guide(color[0], color[0]), guide)
