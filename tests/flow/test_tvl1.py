"""Refining flows: exact vectors stay, wrong ones are mended, nothing breaks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flow.guide import estimate_noise, prefilter_guide
from flow.tvl1 import dense_flow, refine_flow, select_flow
from flow.warp import warp

HEIGHT, WIDTH = 96, 128


def texture(rng: np.random.Generator, channels: int) -> np.ndarray:
    """Smooth random blobs of two sizes, in [0.1, 0.9]."""
    octaves = [
        cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH, channels)).astype(np.float32), (0, 0), s) * s for s in (1.5, 5)
    ]
    return np.clip(0.5 + 0.35 * sum(octaves), 0.1, 0.9).reshape(HEIGHT, WIDTH, channels)


@pytest.fixture(scope="module")
def shot() -> dict[str, np.ndarray]:
    """Two frames under a slow zoom and shift, their albedo, noisy colour, and guides made of them."""
    rng = np.random.default_rng(0)
    albedo = texture(rng, 3)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    flow = np.stack([2.3 + 0.01 * (x - WIDTH / 2), -1.6 + 0.01 * (y - HEIGHT / 2)], axis=-1)
    neighbour = albedo
    albedo = warp(neighbour, flow, interpolation="bicubic")[0]
    # Gamma noise of relative deviation 0.35 (8 samples or so).
    colors = [3 * a * rng.gamma(8, 1 / 8, a.shape).astype(np.float32) for a in (albedo, neighbour)]
    (centre_guide, noise), (neighbour_guide, _) = (
        prefilter_guide(c, a, exposure=1.5) for c, a in zip(colors, (albedo, neighbour), strict=True)
    )
    return {"flow": flow, "centre": centre_guide, "neighbour": neighbour_guide, "noise": noise}


def error(flow: np.ndarray, truth: np.ndarray) -> float:
    """Mean length, pixels, of the difference, away from what leaves the frame."""
    return float(np.hypot(*np.moveaxis(flow - truth, -1, 0))[8:-8, 8:-8].mean())


def refine_and_select(shot: dict[str, np.ndarray], start: np.ndarray) -> np.ndarray:
    refined = refine_flow(shot["centre"], shot["neighbour"], start, noise=shot["noise"])
    return select_flow([start, refined], shot["centre"], shot["neighbour"], noise=shot["noise"])[0]


def perturbation(rng: np.random.Generator, sigma: float) -> np.ndarray:
    """Noise of mean length 1.2 px, white or with blobs of `sigma` pixels."""
    noise = rng.normal(size=(HEIGHT, WIDTH, 2)).astype(np.float32)
    if sigma:
        noise = cv2.GaussianBlur(noise, (0, 0), sigma)
    return noise * (1.2 / np.hypot(*np.moveaxis(noise, -1, 0)).mean())


def test_exact_vectors_stay_exact(shot: dict[str, np.ndarray]) -> None:
    # The bound the project sets itself.
    assert error(refine_and_select(shot, shot["flow"]), shot["flow"]) < 0.05


@pytest.mark.parametrize("sigma", [0, 5])
def test_perturbed_vectors_are_mended(shot: dict[str, np.ndarray], sigma: float) -> None:
    start = shot["flow"] + perturbation(np.random.default_rng(1), sigma)
    # The bound the project sets itself.
    assert error(refine_and_select(shot, start), shot["flow"]) < 0.2


def test_a_patch_of_wrong_vectors_is_replaced_and_the_rest_is_kept(shot: dict[str, np.ndarray]) -> None:
    start = shot["flow"].copy()
    start[30:60, 40:80] += 2
    selected = refine_and_select(shot, start)
    # 9 px windows straddle the patch's border; within it half the error is the least that helps.
    assert np.hypot(*np.moveaxis(selected - shot["flow"], -1, 0))[36:54, 46:74].mean() < 0.7
    assert (selected[:20] == start[:20]).all()


def test_dense_flow_needs_no_vectors(shot: dict[str, np.ndarray]) -> None:
    flow = dense_flow(shot["centre"], shot["neighbour"], noise=shot["noise"])
    # As scikit-image asks of its own: half a pixel.
    assert error(flow, shot["flow"]) < 0.3


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.2), (1.6, 0.7)])
def test_known_translations(shift: tuple[float, float]) -> None:
    image = texture(np.random.default_rng(2), 1)[..., 0]
    truth = np.broadcast_to(np.float32(shift), (HEIGHT, WIDTH, 2))
    centre = warp(image, truth, interpolation="bicubic")[0]
    flow = refine_flow(centre, image, np.zeros_like(truth))
    if shift == (0.0, 0.0):
        assert not flow.any()
        assert not dense_flow(image, image).any()
    else:
        assert error(flow, truth) < 0.1  # interpolation error of the texture over its slope


def test_exactly_zero_where_nothing_is_seen() -> None:
    flat = np.full((40, 40), 0.5, np.float32)
    start = np.broadcast_to(np.float32([1.5, -0.5]), (40, 40, 2))
    # A blank picture has nothing to say: the start remains, up to the rounding of the smoothing's sums.
    np.testing.assert_allclose(refine_flow(flat, flat, start), start, atol=1e-5)
    assert not dense_flow(flat, flat).any()


def test_noise_alone_does_not_move_vectors() -> None:
    rng = np.random.default_rng(3)
    guides = [np.clip(0.5 + 0.1 * rng.normal(size=(64, 64)), 0, 1).astype(np.float32) for _ in range(2)]
    still = np.zeros((64, 64, 2), np.float32)
    noise = estimate_noise(guides[0])
    refined = refine_flow(*guides, still, noise=noise)
    assert np.abs(refined).max() < np.abs(refine_flow(*guides, still)).max()
    selected, choice = select_flow([still, refined], *guides, noise=noise)
    assert choice.mean() < 0.02
    assert np.abs(selected).mean() < 0.01


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (5, 5), (17, 33), (16, 16), (35, 31)])
def test_tiny_and_odd_sizes(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    centre, neighbour = rng.random((2, *shape), np.float32)
    flow = refine_flow(centre, neighbour, rng.normal(size=(*shape, 2)))
    assert flow.shape == (*shape, 2)
    assert np.isfinite(flow).all()
    assert np.isfinite(dense_flow(centre, neighbour)).all()
    selected, choice = select_flow([flow, 0 * flow], centre, neighbour)
    assert selected.shape == (*shape, 2)
    assert choice.shape == shape
    guide, noise = prefilter_guide(rng.random((*shape, 3)), rng.random((*shape, 3)), rng.random((*shape, 3)))
    assert guide.shape == noise.shape == (*shape, 2)


def test_broken_input_spreads_no_nan(shot: dict[str, np.ndarray]) -> None:
    centre, start = shot["centre"].copy(), shot["flow"].copy()
    centre[20, 30], centre[50, 60] = np.nan, np.inf
    start[10, 10], start[40, 90, 0], start[70, 20] = np.nan, np.inf, 1e9
    flow = refine_flow(centre, shot["neighbour"], start)
    assert np.isfinite(flow).all()
    assert error(flow, shot["flow"]) < 0.3


def test_given_arrays_are_not_written_to(shot: dict[str, np.ndarray]) -> None:
    copies = {name: array.copy() for name, array in shot.items()}
    visible = np.ones((HEIGHT, WIDTH), bool)
    flow = shot["flow"] + 50  # much of it leaves the frame
    refine_flow(shot["centre"], shot["neighbour"], shot["flow"], noise=shot["noise"])
    select_flow([flow, shot["flow"]], shot["centre"], shot["neighbour"], noise=shot["noise"], visible=visible)
    assert visible.all()
    for name, array in copies.items():
        np.testing.assert_array_equal(shot[name], array)


def test_hidden_pixels_are_no_evidence(shot: dict[str, np.ndarray]) -> None:
    wrong = shot["flow"] + 3
    candidates, guides = [wrong, shot["flow"]], (shot["centre"], shot["neighbour"])
    _, choice = select_flow(candidates, *guides)
    assert choice[10:-10, 10:-10].mean() > 0.9
    _, choice = select_flow(candidates, *guides, visible=np.zeros((HEIGHT, WIDTH), bool))
    assert not choice.any()


def test_the_guide_ignores_exposure_fireflies_and_what_is_not_finite() -> None:
    rng = np.random.default_rng(5)
    color, albedo = rng.random((20, 24, 3), np.float32), rng.random((20, 24, 3), np.float32)
    guide, _ = prefilter_guide(color, albedo)
    np.testing.assert_allclose(prefilter_guide(8 * color, albedo)[0], guide, atol=1e-6)
    assert guide.min() >= 0
    assert guide.max() <= 1
    spoiled = color.copy()
    spoiled[5, 5], spoiled[10, 10], spoiled[15, 15], spoiled[3, 20] = np.nan, np.inf, 1e30, -5
    changed, _ = prefilter_guide(spoiled, albedo, exposure=0.5)
    assert np.isfinite(changed).all()
    far = np.ones((20, 24), bool)
    for y, x in ((5, 5), (10, 10), (15, 15), (3, 20)):
        far[max(y - 4, 0) : y + 5, max(x - 4, 0) : x + 5] = False
    # The guided filter reaches twice its radius of 2.
    original, _ = prefilter_guide(color, albedo, exposure=0.5)
    np.testing.assert_allclose(changed[far], original[far], atol=1e-5)
    black, _ = prefilter_guide(np.zeros((8, 8, 3)))
    assert not black.any()


def test_noise_of_a_known_deviation() -> None:
    rng = np.random.default_rng(6)
    y, x = np.mgrid[:80, :80]
    slope = 0.1 * x + 0.03 * y + (x > 40)  # neither slopes nor straight edges count
    for deviation in (0.0, 0.02, 0.3):
        image = slope + deviation * rng.normal(size=slope.shape)
        # 225 pixels, each weighed with eight neighbours: about 60 independent ones; float32 rounding at 0.
        assert np.median(estimate_noise(image)) == pytest.approx(deviation, rel=0.1, abs=1e-5)


def test_errors_name_the_argument() -> None:
    guide, flow = np.zeros((8, 9), np.float32), np.zeros((8, 9, 2), np.float32)
    with pytest.raises(ValueError, match="neighbour_guide has shape"):
        refine_flow(guide, guide[:4], flow)
    with pytest.raises(ValueError, match="start has shape"):
        refine_flow(guide, guide, flow[:4])
    with pytest.raises(ValueError, match="warps is 0"):
        refine_flow(guide, guide, flow, warps=0)
    with pytest.raises(ValueError, match="noise has shape"):
        refine_flow(guide, guide, flow, noise=np.zeros(3))
    with pytest.raises(ValueError, match="candidates is empty"):
        select_flow([], guide, guide)
    with pytest.raises(ValueError, match="window is 4"):
        select_flow([flow], guide, guide, window=4)
    with pytest.raises(ValueError, match="exposure is 0"):
        prefilter_guide(np.zeros((4, 4, 3)), exposure=0)
