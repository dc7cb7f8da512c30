"""The renderer's motion vectors: into one convention, composed, inverted, checked."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from flow.warp import warp

# Longer than any frame is wide: renderers write 1e9, 1e10 or similar where they know no motion.
ABSURD_LENGTH = 1e4


class Motion(NamedTuple):
    """Flows of one frame to its neighbours; the `next` pair is None where the renderer gives no such vectors."""

    to_previous: np.ndarray
    previous_valid: np.ndarray
    to_next: np.ndarray | None
    next_valid: np.ndarray | None


def _sanitize(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stack two components into a flow, 0 where they are not finite or absurdly long."""
    # Written so that NaN compares false.
    valid = (np.abs(u) <= ABSURD_LENGTH) & (np.abs(v) <= ABSURD_LENGTH)
    flow = np.stack([u, v], axis=-1).astype(np.float32)
    flow[~valid] = 0
    return flow, valid


def normalize_motion(vectors: np.ndarray, convention: str) -> Motion:
    """Turn a renderer's motion vectors into flows to the previous and to the next frame.

    Parameters
    ----------
    vectors
        (H, W, 4) or (H, W, 2) float, pixels, as the renderer wrote them.
    convention
        "cycles": four channels X, Y, Z, W; the previous frame is sampled at (x + X, y - Y), the next one at
        (x - Z, y + W), y pointing down. "backward": two channels, the offset to the previous frame, y down.

    Returns
    -------
    Motion
        Flows (H, W, 2) float32, pixels, x right then y down, and masks (H, W) bool. Vectors that are NaN,
        infinite, or longer than `ABSURD_LENGTH` in a component are 0 in the flow and False in the mask.

    Raises
    ------
    ValueError
        Unknown convention, or a shape it does not have.
    """
    channels = {"cycles": 4, "backward": 2}
    if convention not in channels:
        raise ValueError(f"convention is {convention!r}, expected one of {', '.join(channels)}")
    if vectors.ndim != 3 or vectors.shape[2] != channels[convention]:
        raise ValueError(
            f"vectors has shape {vectors.shape}, expected (H, W, {channels[convention]}) for {convention!r}"
        )
    if convention == "backward":
        return Motion(*_sanitize(vectors[..., 0], vectors[..., 1]), None, None)
    x, y, z, w = np.moveaxis(vectors, -1, 0)
    return Motion(*_sanitize(x, -y), *_sanitize(-z, w))


def compose_flow(
    first: np.ndarray,
    second: np.ndarray,
    *,
    first_valid: np.ndarray | None = None,
    second_valid: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Chain the flow from t to t' with that from t' to t'', giving the flow from t to t''.

    Parameters
    ----------
    first, second
        (H, W, 2) float, finite, pixels; `second` belongs to the frame that `first` points to.
    first_valid, second_valid
        (H, W) bool; missing: all True.

    Returns
    -------
    flow
        (H, W, 2) float32.
    valid
        (H, W) bool: `first` is valid, lands in the frame, and every vector of `second` it mixes is valid.

    Raises
    ------
    ValueError
        The shapes do not agree.

    Notes
    -----
    f₂(x) = f₁(x) + f₁'(x + f₁(x)), f₁' sampled bilinearly, with its edge value outside the frame.
    """
    if first.shape != second.shape:
        raise ValueError(f"first has shape {first.shape}, expected that of second, {second.shape}")
    known = np.ones(first.shape[:2], bool) if second_valid is None else second_valid
    sampled, inside = warp(np.dstack([second, ~known]), first)
    # The last channel is the share of invalid vectors in the bilinear mix: any at all is too much.
    valid = inside & (sampled[..., 2] == 0)
    if first_valid is not None:
        valid &= first_valid
    return np.asarray(first, np.float32) + sampled[..., :2], valid


@njit(nogil=True, cache=True)
def _splat(
    flow: np.ndarray, valid: np.ndarray, depth: np.ndarray, nearest: np.ndarray, out: np.ndarray, weight: np.ndarray
) -> None:
    height, width = valid.shape
    # First the nearest depth that reaches each pixel, then the mean of what lies at about that depth.
    for accumulate in (False, True):
        for y in range(height):
            for x in range(width):
                if not valid[y, x]:
                    continue
                px, py = x + flow[y, x, 0], y + flow[y, x, 1]
                x0, y0 = int(np.floor(px)), int(np.floor(py))
                for j in range(2):
                    for i in range(2):
                        tx, ty = x0 + i, y0 + j
                        w = (1 - abs(px - tx)) * (1 - abs(py - ty))
                        # A corner that is barely touched must not occlude: 1e-3 of a pixel's area.
                        if w < 1e-3 or tx < 0 or ty < 0 or tx >= width or ty >= height:
                            continue
                        d = depth[y, x]
                        if not accumulate:
                            nearest[ty, tx] = min(nearest[ty, tx], d)
                        # 5 %: slanted surfaces differ a little from pixel to pixel, objects by more.
                        elif d <= nearest[ty, tx] + np.float32(0.05) * abs(nearest[ty, tx]):
                            out[ty, tx, 0] -= w * flow[y, x, 0]
                            out[ty, tx, 1] -= w * flow[y, x, 1]
                            weight[ty, tx] += w


def invert_flow(
    flow: np.ndarray, *, valid: np.ndarray | None = None, depth: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Turn the flow from frame b to frame a into that from a to b, by splatting.

    The vectors to the next frame, where a renderer gives only those to the previous one, are
    `invert_flow(the next frame's to_previous)`: it alone knows where each of its pixels came from.

    Parameters
    ----------
    flow
        (H, W, 2) float, pixels, finite, of frame b.
    valid
        (H, W) bool, of frame b; invalid vectors are left out.
    depth
        (H, W) float > 0, of frame b, smaller is nearer. Where several pixels arrive at one place the nearest
        wins. Without it the fastest does: what moves most in the picture tends to be in front.

    Returns
    -------
    inverse
        (H, W, 2) float32, of frame a. Where nothing arrives (hidden in b), the mean of the neighbours where
        there are some within two pixels, else 0.
    valid
        (H, W) bool: something arrived.
    """
    if flow.ndim != 3 or flow.shape[2] != 2:
        raise ValueError(f"flow has shape {flow.shape}, expected (H, W, 2)")
    shape = flow.shape[:2]
    for name, array in (("valid", valid), ("depth", depth)):
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    flow = np.ascontiguousarray(flow, np.float32)
    usable = np.all(np.abs(flow) <= ABSURD_LENGTH, axis=-1)
    if valid is not None:
        usable &= valid
    # 1 / (1 + speed) orders by speed as a depth does by nearness, with steps of 5 % where speeds differ by that.
    order = 1 / (1 + np.hypot(flow[..., 0], flow[..., 1])) if depth is None else depth
    order = np.nan_to_num(np.asarray(order, np.float32), nan=np.inf)
    inverse, weight = np.zeros_like(flow), np.zeros(shape, np.float32)
    _splat(flow, usable, order, np.full(shape, np.inf, np.float32), inverse, weight)
    arrived = weight > 0
    inverse[arrived] /= weight[arrived, None]
    near = cv2.boxFilter(arrived.astype(np.float32), -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
    total = cv2.boxFilter(inverse, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
    # Counts are whole numbers, up to the rounding of the filter's running sum.
    fill = ~arrived & (near > 0.5)
    inverse[fill] = total[fill] / near[fill, None]
    return inverse, arrived


def forward_backward_error(flow: np.ndarray, reverse: np.ndarray, *, first_row: int = 0) -> np.ndarray:
    """Measure how far from its start a pixel ends when it goes there and back.

    Parameters
    ----------
    flow, reverse
        (H, W, 2) float, pixels, finite: centre to neighbour, and neighbour to centre. `flow` may be of some of the
        rows only.
    first_row
        The frame's row that the first row of `flow` belongs to.

    Returns
    -------
    numpy.ndarray
        (H, W) float32, pixels: |f(x) + r(x + f(x))|; outside the frame r has its edge value.
    """
    loop, _ = warp(reverse, flow, first_row=first_row)
    loop += flow
    return np.hypot(loop[..., 0], loop[..., 1])
