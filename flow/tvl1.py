"""TV-L1 optical flow: refinement of a given flow, and a flow from the pictures alone."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from flow.guide import GuidePair, pair_guides, smooth_tones
from flow.selection import select_flow
from flow.warp import warp_block
from loops.parallel import run_bands

# Coupling of the data and the smoothness half of the energy (Zach's theta), and step of the dual ascent;
# tau / theta = 0.25 / 0.3 is below the bound for convergence.
_THETA = np.float32(0.3)
_DUAL_STEP = np.float32(0.25) / _THETA
# λ of each guide, for guides in [0, 1]: 255 times that of 8-bit images (0.03 to 0.06 there). Higher follows the guides
# more closely, as a flow from guides alone needs.
_REFINE_ATTACHMENT, _DENSE_ATTACHMENT = 8.0, 16.0
# Standard deviation, pixels, of the Gaussian that the guides are smoothed with first.
_BLUR = 0.8
# Side, pixels, of refined tiles, and the rim solved around each: with this rim 99 of 100 vectors are within 0.04 px of
# those of a whole frame, with half of it within 0.4. Beyond this share of tiles the rims cost more than is saved.
_TILE, _RIM, _MOST_TILES = 128, 32, 0.5
# Steps that a thread runs on its rows before it reads those of its neighbours again: as many rows around its own it
# computes too.
_STEPS = 10
# `rough_flow` works on pictures of at most so many pixels.
_ROUGH_PIXELS = 2**17


_Tile = tuple[slice, slice]  # rows and columns


class _Effort(NamedTuple):
    warps: int
    iterations: int
    attachment: float


def refine_flow(
    guides: GuidePair, start: np.ndarray, *, scales: int = 3, warps: int = 3, iterations: int = 30
) -> np.ndarray:
    """Refine a flow by TV-L1 from coarse to fine, where the result explains the guides better.

    Returns (H, W, 2) float32 array, finite, pixels.

    Parameters
    ----------
    guides : GuidePair, their noise weakens the data term where a gradient is no stronger than the noise
    start : (H, W, 2) float array, pixels; vectors that are not finite, or longer than the frame, start from 0
    scales : int, number of scales, each half the size of the one before; fewer where the image has not 16 pixels left
    warps, iterations : int, at each scale: linearisations, and steps of each; two thirds of both at the finest one

    Notes
    -----
    f = b + d, where b is `start` smoothed within the edges of the guides, and d minimises λ Σ_g w_g |I₁(x +
    b + d) − I₀(x)| + |∇d₁| + |∇d₂| by alternating a thresholding and a dual step; the thresholding steps of several
    guides follow one another. Areas without structure (flat walls, the direction along an edge) keep the renderer's
    motion, which plain TV-L1, smoothing f, would flatten: from exact vectors, 0.47 px of error against 1.5 on a
    rendered shot with a turning object. w_g = |∇I|² / (|∇I|² + σ_g²). Detail of `start` finer than b is lost: run
    `flow.selection.select_flow` afterwards.

    The finest scale is solved on tiles of 128 x 128 pixels: those where the next coarser one has a pixel that
    `select_flow` selects. Other tiles keep the start. If more than half of the tiles are needed, or with one scale, the
    whole frame is solved. With the next coarser scale on such tiles too one shot loses 0.8 dB of stability.

    References
    ----------
    Zach, Pock, Bischof: A duality based approach for realtime TV-L1 optical flow. 2007.
    doi:10.1007/978-3-540-74936-3_22
    Wedel et al.: An improved algorithm for TV-L1 optical flow. 2009. doi:10.1007/978-3-642-03061-1_2
    """
    for name, count in (("scales", scales), ("warps", warps), ("iterations", iterations)):
        if count < 1:
            raise ValueError(f"{name} is {count}, expected at least 1")
    shape = guides.centre.shape[:2]
    if start.shape != (*shape, 2):
        raise ValueError(f"start has shape {start.shape}, expected {(*shape, 2)}")
    # A vector longer than the frame lands nowhere, and would smear over its neighbours; NaN compares false.
    usable = (np.abs(start[..., 0]) <= shape[1]) & (np.abs(start[..., 1]) <= shape[0])
    start = np.array(start, np.float32)
    start[~usable] = 0
    pyramid = _build_pyramid(_blurred(guides), scales)
    base = _smooth_start(start, pyramid)
    effort = _Effort(warps, iterations, _REFINE_ATTACHMENT)
    finest, *coarser = pyramid
    change = np.zeros_like(base)
    for level in reversed(coarser):
        change = _solve(level, base, change, effort)
    tiles = None
    if coarser:
        tiles = _find_tiles(coarser[0], start, base, change)
        effort = _Effort(-(-2 * warps // 3), -(-2 * iterations // 3), _REFINE_ATTACHMENT)
    change = _solve(finest, base, change, effort, tiles)
    if tiles is None:
        return np.asarray(base + change)
    flow = start.copy()
    for tile in tiles:
        flow[tile] = base[tile] + change[tile]
    return flow


def dense_flow(guides: GuidePair) -> np.ndarray:
    """Estimate the flow (H, W, 2), pixels, from the guides alone, for renderers without vectors.

    Dense inverse search on 8 bits of the last guide, the least noisy (Kroeger et al. 2016.
    doi:10.1007/978-3-319-46493-0_29), refined by TV-L1 on the flow itself.
    """
    guides = _blurred(guides)
    height, width = guides.centre.shape[:2]
    start = np.zeros((height, width, 2), np.float32)
    # Below this the pyramid of DIS has no level with a whole 8 x 8 patch, and OpenCV raises.
    if min(height, width) >= 16:
        first, second = (
            (np.clip(planes[..., -1], 0, 1) * 255 + 0.5).astype(np.uint8)
            for planes in (guides.centre, guides.neighbour)
        )
        search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        start = np.asarray(search.calc(first, second, start), np.float32)
    flow, nothing = start, np.zeros_like(start)
    for level in reversed(_build_pyramid(guides, 3)):
        flow = _solve(level, nothing, flow, _Effort(3, 30, _DENSE_ATTACHMENT))
    return flow


def rough_flow(earlier: np.ndarray, later: np.ndarray) -> np.ndarray:
    """Estimate a flow (H, W, 2), pixels, from later to earlier `tone_map`s, reduced to `_ROUGH_PIXELS` pixels."""
    height, width = later.shape
    factor = min(1.0, float(np.sqrt(_ROUGH_PIXELS / (height * width))))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    pictures = (
        picture if factor == 1 else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        for picture in (later, earlier)
    )
    flow = dense_flow(pair_guides(*(smooth_tones(picture) for picture in pictures)))
    if factor == 1:
        return flow
    return cv2.resize(flow, (width, height)) * np.array([width / size[0], height / size[1]], np.float32)


def _blurred(guides: GuidePair) -> GuidePair:
    centre, neighbour = (
        cv2.GaussianBlur(planes, (0, 0), _BLUR).reshape(planes.shape) for planes in (guides.centre, guides.neighbour)
    )
    return guides._replace(centre=centre, neighbour=neighbour)


def _smooth_start(start: np.ndarray, pyramid: Sequence[GuidePair]) -> np.ndarray:
    """Smooth a flow within the guides' edges, over 17 pixels, or over 129 where that explains the guides better."""
    if min(start.shape[:2]) < 32:
        return start
    # (radius in pixels of the subsampled grid on which the filter is fitted, its spacing); 1e-3: contrasts of the
    # guide below 0.03 are smoothed over.
    near, far = (
        cv2.ximgproc.guidedFilter(pyramid[0].centre, start, radius, 1e-3, scale=1 / spacing)
        for radius, spacing in ((4, 2), (16, 4))
    )
    # Chosen at half the size, in half the time: vectors so smooth differ over many pixels.
    half = pyramid[:2][-1]
    choice = select_flow([_rescale(flow, *half.centre.shape[1::-1]) for flow in (near, far)], half)[1]
    chosen = cv2.resize(choice, start.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return np.where(chosen[..., None] > 0, far, near)


def _find_tiles(coarse: GuidePair, start: np.ndarray, base: np.ndarray, change: np.ndarray) -> list[_Tile] | None:
    """Find where base + change, solved at half size, explains the guides better; None: everywhere."""
    height, width = start.shape[:2]
    size = coarse.centre.shape[1::-1]
    better = select_flow([_rescale(start, *size), _rescale(base, *size) + change], coarse)[1] > 0
    half, called = _TILE // 2, 0
    tiles: list[_Tile] = []
    for y in range(0, better.shape[0], half):
        rows = slice(2 * y, min(2 * y + _TILE, height))
        for x in range(0, better.shape[1], half):
            if not better[y : y + half, x : x + half].any():
                continue
            called += 1
            columns = slice(2 * x, min(2 * x + _TILE, width))
            if tiles and tiles[-1][0] == rows and tiles[-1][1].stop == columns.start:  # the two are solved together
                columns = slice(tiles.pop()[1].start, columns.stop)
            tiles.append((rows, columns))
    share = called * _TILE**2 / (height * width)
    return None if share > _MOST_TILES else tiles


def _solve(
    level: GuidePair, base: np.ndarray, change: np.ndarray, effort: _Effort, tiles: Sequence[_Tile] | None = None
) -> np.ndarray:
    """Solve one scale for the change from `base`, starting at `change`; elsewhere than in the tiles this is kept."""
    height, width = level.centre.shape[:2]
    base, change = _rescale(base, width, height), _rescale(change, width, height)
    centre, neighbour = _with_gradients(level.centre), _with_gradients(level.neighbour)
    if tiles is None:
        return _solve_block(neighbour, centre, level.noise, base, change, (0, 0), effort)
    found = change.copy()

    def solve_some(first: int, last: int) -> None:
        for tile in tiles[first:last]:
            rows, columns = (
                slice(max(side.start - _RIM, 0), min(side.stop + _RIM, length))
                for side, length in zip(tile, (height, width), strict=True)
            )
            here, noise, near, known = (
                np.ascontiguousarray(layer[rows, columns]) for layer in (centre, level.noise, base, change)
            )
            corner = rows.start, columns.start
            solved = _solve_block(neighbour, here, noise, near, known, corner, effort, _run_whole)
            top, left = tile[0].start - rows.start, tile[1].start - columns.start
            found[tile] = solved[top : top + tile[0].stop - tile[0].start, left : left + tile[1].stop - tile[1].start]

    run_bands(solve_some, len(tiles))
    return found


def _run_whole(loop: Callable[..., None], count: int, *arguments: object) -> None:
    """Run all steps of a loop on the calling thread, as one of many tiles."""
    loop(0, count, *arguments)


def _build_pyramid(guides: GuidePair, scales: int) -> list[GuidePair]:
    """Halve guides and noise until there are `scales` of them, or fewer than 16 pixels would remain."""
    pyramid = [guides]
    while len(pyramid) < scales and min(pyramid[-1].centre.shape[:2]) >= 32:
        height, width = pyramid[-1].centre.shape[:2]
        size = ((width + 1) // 2, (height + 1) // 2)
        centre, neighbour, noise = (_resize(planes, *size, cv2.INTER_AREA) for planes in pyramid[-1])
        # The noise of a mean of four is half as strong.
        pyramid.append(GuidePair(centre, neighbour, 0.5 * noise))
    return pyramid


def _rescale(flow: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize a flow, and its vectors with it."""
    ratio = np.array([width / flow.shape[1], height / flow.shape[0]], np.float32)
    mode = cv2.INTER_AREA if width < flow.shape[1] else cv2.INTER_LINEAR
    return flow if flow.shape[:2] == (height, width) else _resize(flow, width, height, mode) * ratio


def _resize(planes: np.ndarray, width: int, height: int, interpolation: int) -> np.ndarray:
    return cv2.resize(planes, (width, height), interpolation=interpolation).reshape(height, width, -1)


def _solve_block(
    neighbour: np.ndarray, centre: np.ndarray, noise: np.ndarray, base: np.ndarray, change: np.ndarray,
    corner: tuple[int, int], effort: _Effort, run: Callable[..., None] = run_bands,
) -> np.ndarray:  # fmt: skip
    """Solve TV-L1 at one scale for the change from `base`, at `corner` of the neighbour, starting at `change`."""
    height, width, channels = noise.shape
    change = np.ascontiguousarray(change.transpose(2, 0, 1))
    dual = np.zeros((4, height + 1, width + 1), np.float32)
    next_change, next_dual = np.empty_like(change), np.zeros_like(dual)
    data = np.empty((4, channels, height, width), np.float32)
    given = neighbour, centre, noise, base
    for _ in range(effort.warps):
        run(_linearize, height, *given, change, corner, np.float32(effort.attachment), data)
        for done in range(0, effort.iterations, _STEPS):
            steps = min(_STEPS, effort.iterations - done)
            run(_iterate, height, change, dual, data, steps, next_change, next_dual)
            change, next_change, dual, next_dual = next_change, change, next_dual, dual
        # Median: what total variation leaves of single wrong vectors (Wedel 2009, section 3.3).
        change = np.stack([cv2.medianBlur(component, 3) for component in change])
    return change.transpose(1, 2, 0)


def _with_gradients(planes: np.ndarray) -> np.ndarray:
    """Interleave (H, W, G) with its central differences in x and y, halved across the edge."""
    beside, difference = np.ones(1, np.float32), np.array([-0.5, 0, 0.5], np.float32)
    slopes = (
        cv2.sepFilter2D(planes, -1, across, down, borderType=cv2.BORDER_REPLICATE).reshape(planes.shape)
        for across, down in ((difference, beside), (beside, difference))
    )
    return np.stack([planes, *slopes], axis=-1).reshape(*planes.shape[:2], -1)


def _linearize(
    first: int, last: int, neighbour: np.ndarray, centre: np.ndarray, noise: np.ndarray, base: np.ndarray,
    change: np.ndarray, corner: tuple[int, int], attachment: np.float32, data: np.ndarray,
) -> None:  # fmt: skip
    """Expand the difference of the guides to first order about base + change.

    The guides come with their gradients, (H, W, 3 G), the neighbour's of the whole frame. `data` is (4, G, H, W): the
    difference without a change, its slope in x and in y, all over the length of the slope, and the bound of a step.
    """
    rows = slice(first, last)
    u, v = change[:, rows]
    moved, inside = warp_block(neighbour, base[rows] + np.stack([u, v], axis=-1), (corner[0] + first, corner[1]))
    for g in range(noise.shape[2]):
        own, there = (planes[..., 3 * g : 3 * g + 3].transpose(2, 0, 1) for planes in (centre[rows], moved))
        # The mean of both frames' gradients: exact to second order, and half as noisy.
        ax, ay = np.float32(0.5) * (there[1:] + own[1:])
        square = ax * ax + ay * ay
        # A gradient at the level of the noise says nothing about motion.
        trust = square / (square + np.square(noise[rows, :, g]) + np.float32(1e-9))
        # 1e-9: a slope of 3e-5 of the guide's range per pixel, below what 8 bits distinguish from flat.
        length = np.sqrt(square + np.float32(1e-9))
        data[0, g, rows] = (there[0] - own[0] - ax * u - ay * v) / length
        data[1, g, rows], data[2, g, rows] = ax / length, ay / length
        data[3, g, rows] = np.where(inside, _THETA * attachment * trust * length, np.float32(0))


def _iterate(
    first: int, last: int, change: np.ndarray, dual: np.ndarray, data: np.ndarray, steps: int, next_change: np.ndarray,
    next_dual: np.ndarray,
) -> None:  # fmt: skip
    """Run some steps on rows, from `change` and `dual` to the next ones.

    A step reads one row beyond each side, so that as many more rows as there are steps make the result exact.
    """
    top, bottom = max(first - steps, 0), min(last + steps, change.shape[1])
    own_change, own_dual = change[:, top:bottom].copy(), dual[:, top : bottom + 1].copy()
    _step(own_change, own_dual, data, top, steps)
    next_change[:, first:last] = own_change[:, first - top : last - top]
    # Row y + 1 of the dual belongs to row y; the first is a border of zeros.
    next_dual[:, first + 1 : last + 1] = own_dual[:, first - top + 1 : last - top + 1]


@njit(nogil=True, cache=True, error_model="numpy")
def _step(change: np.ndarray, dual: np.ndarray, data: np.ndarray, top: int, steps: int) -> None:
    """Move each vector towards its match, then towards its neighbours, some times; the rows of `data` begin at `top`.

    The dual follows the gradient of the flow; its first row and column are a border of zeros.
    """
    u, v = change[0], change[1]
    height, width = u.shape
    one = np.float32(1)
    for _ in range(steps):
        for y in range(height):
            for g in range(data.shape[1]):
                rho, gx, gy = data[0, g, top + y], data[1, g, top + y], data[2, g, top + y]
                bound = data[3, g, top + y]
                for x in range(width):
                    residual = rho[x] + gx[x] * u[y, x] + gy[x] * v[y, x]
                    residual = min(max(residual, -bound[x]), bound[x])
                    u[y, x] -= residual * gx[x]
                    v[y, x] -= residual * gy[x]
            for k in range(2):
                f, across, down = change[k, y], dual[2 * k, y + 1], dual[2 * k + 1]
                for x in range(width):
                    f[x] += _THETA * (across[x + 1] - across[x] + down[y + 1, x + 1] - down[y, x + 1])
        for y in range(height):
            for k in range(2):
                f, below = change[k, y], change[k, min(y + 1, height - 1)]
                across, down = dual[2 * k, y + 1], dual[2 * k + 1, y + 1]
                for x in range(width - 1):
                    dx, dy = f[x + 1] - f[x], below[x] - f[x]
                    scale = one / (one + _DUAL_STEP * np.sqrt(dx * dx + dy * dy))
                    across[x + 1] = (across[x + 1] + _DUAL_STEP * dx) * scale
                    down[x + 1] = (down[x + 1] + _DUAL_STEP * dy) * scale
                dy = below[width - 1] - f[width - 1]
                down[width] = (down[width] + _DUAL_STEP * dy) / (one + _DUAL_STEP * abs(dy))
