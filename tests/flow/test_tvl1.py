import cv2
import numpy as np
import pytest

from flow import tvl1
from flow.guide import Guide, estimate_noise, pair_guides
from flow.selection import select_flow
from flow.tvl1 import dense_flow, refine_flow
from flow.warp import warp
from loops import parallel
from tests.flow.scenes import HEIGHT, WIDTH, Shot, error, moved, perturbation, plain, texture


@pytest.fixture(scope="module")
def shot() -> Shot:
    return moved()


def refine_and_select(shot: Shot, start: np.ndarray) -> np.ndarray:
    return select_flow([start, refine_flow(shot.guides, start)], shot.guides)[0]


def test_exact_vectors_stay_exact(shot: Shot) -> None:
    # The bound the project sets itself.
    assert error(refine_and_select(shot, shot.flow), shot.flow) < 0.05


@pytest.mark.parametrize("sigma", [0, 5])
def test_perturbed_vectors_are_mended(shot: Shot, sigma: float) -> None:
    start = shot.flow + perturbation(np.random.default_rng(1), sigma)
    # The bound the project sets itself.
    assert error(refine_and_select(shot, start), shot.flow) < 0.2


def test_it_starts_where_it_is_told_to() -> None:
    """Motion beyond the reach of the coarsest scale is found only from vectors that are about right."""
    far = moved((14.0, -9.0))
    assert error(refine_flow(far.guides, np.zeros_like(far.flow)), far.flow) > 5
    start = far.flow + perturbation(np.random.default_rng(1), 5)
    # From 1.2 px; the bound the project sets itself.
    assert error(refine_flow(far.guides, start), far.flow) < 0.2


def test_more_work_is_more_exact() -> None:
    """Scales, warps and iterations each have a part in the result."""
    far = moved((5.0, -3.5))
    still = np.zeros_like(far.flow)
    full = error(refine_flow(far.guides, still), far.flow)
    assert full < 0.05
    for less in ({"scales": 1}, {"warps": 1}, {"iterations": 3}):
        assert error(refine_flow(far.guides, still, **less), far.flow) > 5 * full, less


def test_a_patch_of_wrong_vectors_is_replaced_and_the_rest_is_kept(shot: Shot) -> None:
    start = shot.flow.copy()
    start[30:60, 40:80] += 2
    selected = refine_and_select(shot, start)
    # 9 px windows straddle the patch's border; within it half the error is the least that helps.
    assert np.hypot(*np.moveaxis(selected - shot.flow, -1, 0))[36:54, 46:74].mean() < 0.7
    assert (selected[:20] == start[:20]).all()


def test_only_the_tiles_that_call_for_it_are_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wrong vectors in the corner where four tiles meet: there as in the whole frame, the rest is kept."""
    height, width = 330, 470  # neither a multiple of a tile nor even at half size
    rng = np.random.default_rng(5)
    picture = np.clip(0.5 + 2 * cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), 2), 0, 1)
    flow = np.broadcast_to(np.float32([4.25, -2.5]), (height, width, 2))
    guides = plain(warp(picture, flow, interpolation="bicubic")[0], picture)
    start = flow.copy()
    start[110:146, 110:146] += 2
    tiles = refine_flow(guides, start)
    # Pixels outside of the refined tiles keep their vectors to the bit.
    kept = np.ones((height, width), bool)
    kept[:256, :256] = False
    assert (tiles[kept] == start[kept]).all()
    monkeypatch.setattr(tvl1, "_MOST_TILES", -1.0)
    whole = refine_flow(guides, start)
    assert (whole[kept] != start[kept]).any()  # so that the comparison above says something
    length = np.hypot(*np.moveaxis(tiles - whole, -1, 0))[110:146, 110:146]
    assert length.max() < 0.05  # a tenth of what is told from a right vector
    assert error(tiles[110:146, 110:146], flow[110:146, 110:146]) < 0.2  # the bound the project sets itself


def test_where_most_tiles_call_for_it_the_frame_is_refined_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    picture = np.clip(0.5 + 2 * cv2.GaussianBlur(rng.normal(size=(200, 300)).astype(np.float32), (0, 0), 2), 0, 1)
    flow = np.broadcast_to(np.float32([1.5, -1.0]), (200, 300, 2))
    guides = plain(warp(picture, flow, interpolation="bicubic")[0], picture)
    found = refine_flow(guides, np.zeros_like(flow))
    monkeypatch.setattr(tvl1, "_MOST_TILES", -1.0)
    np.testing.assert_array_equal(found, refine_flow(guides, np.zeros_like(flow)))


def test_dense_flow_needs_no_vectors(shot: Shot) -> None:
    # As scikit-image asks of its own: half a pixel.
    assert error(dense_flow(shot.guides), shot.flow) < 0.3


def test_dense_flow_finds_what_is_far() -> None:
    """TV-L1 by itself does not: see above."""
    far = moved((14.0, -9.0))
    assert error(dense_flow(far.guides), far.flow) < 0.3


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.2), (1.6, 0.7)])
def test_known_translations(shift: tuple[float, float]) -> None:
    image = texture(np.random.default_rng(2), 1)[..., 0]
    truth = np.broadcast_to(np.float32(shift), (HEIGHT, WIDTH, 2))
    guides = plain(warp(image, truth, interpolation="bicubic")[0], image)
    flow = refine_flow(guides, np.zeros_like(truth))
    if shift == (0.0, 0.0):
        assert not flow.any()
        assert not dense_flow(guides).any()
    else:
        assert error(flow, truth) < 0.1  # interpolation error of the texture over its slope


def test_the_start_remains_where_nothing_is_seen() -> None:
    flat = np.full((40, 40), 0.5, np.float32)
    start = np.broadcast_to(np.float32([1.5, -0.5]), (40, 40, 2))
    # A blank picture has nothing to say: the start remains, up to the rounding of the smoothing's sums.
    np.testing.assert_allclose(refine_flow(plain(flat, flat), start), start, atol=1e-5)
    assert not dense_flow(plain(flat, flat)).any()


def test_noise_alone_does_not_move_vectors() -> None:
    rng = np.random.default_rng(3)
    pictures = [np.clip(0.5 + 0.1 * rng.normal(size=(64, 64, 1)), 0, 1).astype(np.float32) for _ in range(2)]
    still = np.zeros((64, 64, 2), np.float32)
    guides = pair_guides(*(Guide(picture, estimate_noise(picture)) for picture in pictures))
    refined = refine_flow(guides, still)
    assert np.abs(refined).max() < np.abs(refine_flow(plain(*pictures), still)).max()
    selected, choice = select_flow([still, refined], guides)
    assert choice.mean() < 0.02
    assert np.abs(selected).mean() < 0.01


@pytest.mark.parametrize("threads", [2, 5, 16])
def test_the_flow_does_not_depend_on_the_number_of_threads(shot, threads, monkeypatch):
    start = shot.flow + perturbation(np.random.default_rng(1), 2)
    flows = []
    for count in (1, threads):
        monkeypatch.setattr(parallel, "thread_count", lambda count=count: count)
        flows.append(refine_flow(shot.guides, start, iterations=23))
    np.testing.assert_array_equal(*flows)


def test_broken_vectors_spread_no_nan(shot: Shot) -> None:
    start = shot.flow.copy()
    start[10, 10], start[40, 90, 0], start[70, 20] = np.nan, np.inf, 1e9
    flow = refine_flow(shot.guides, start)
    assert np.isfinite(flow).all()
    assert error(flow, shot.flow) < 0.3


def test_given_arrays_are_not_written_to(shot: Shot) -> None:
    copies = [array.copy() for array in (*shot.guides, shot.flow)]
    refine_flow(shot.guides, shot.flow)
    dense_flow(shot.guides)
    for array, copy in zip((*shot.guides, shot.flow), copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_errors_name_the_argument() -> None:
    guides, flow = plain(np.zeros((8, 9)), np.zeros((8, 9))), np.zeros((8, 9, 2), np.float32)
    with pytest.raises(ValueError, match="start has shape"):
        refine_flow(guides, flow[:4])
    with pytest.raises(ValueError, match="warps is 0"):
        refine_flow(guides, flow, warps=0)
