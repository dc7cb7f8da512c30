"""Isolated fireflies: single bright samples, taken out of a frame before anything spreads them."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
Places = NDArray[np.intp]

# A firefly is so many times as bright as the brightest pixel of the ring around it, and as the ring's mean. Half of it
# is two stops above what denoisers of single frames take for noise; below that they do without our help.
OVER_BRIGHTEST, OVER_MEAN = 16.0, 64.0
# A light that another frame shows within so many pixels of where the motion leads, at a quarter of its brightness or
# more, is no firefly. Reflections leave their vectors by a few pixels; without vectors a light may be anywhere near.
NEAR, NEAR_WITHOUT_VECTORS = 3, 12
RECURS = 0.25


def find_fireflies(color: Floats) -> Places:
    """Find single pixels, or blots of up to 3×3, far above everything around them.

    Parameters
    ----------
    color : (H, W, C) float32
        Linear radiance or irradiance, finite.

    Returns
    -------
    (K, 2) intp
        Row and column of the brightest pixel of each.

    Raises
    ------
    ValueError
        If `color` is not (H, W, C).

    Notes
    -----
    In the mean over channels, a pixel that no other of its 3×3 exceeds is a firefly where it is above
    16 times the brightest and 64 times the mean of the 5×5 ring around these. A renderer's pixel filter may spread a
    sample over 3×3 pixels. Where the ring is black nothing is found: there a spark may be all the light there is.
    """
    if color.ndim != 3:
        raise ValueError(f"color: expected (height, width, channels), got {color.shape}")
    level = np.ascontiguousarray(np.einsum("hwc->hw", color, dtype=np.float32) / np.float32(color.shape[-1]))
    return np.argwhere(_find(level, OVER_BRIGHTEST, OVER_MEAN))


def recurring(places: Places, color: Floats, other: Floats, flow: Floats | None, valid: Mask | None = None) -> Mask:
    """Tell which of the bright places of a frame another frame shows as well.

    Parameters
    ----------
    places : (K, 2) intp
        From `find_fireflies` on `color`.
    color, other : (H, W, C) float32
        The frame, and a neighbour, finite.
    flow : (H, W, 2) float32 or None
        From the frame to the neighbour, pixels; None where it is not known.
    valid : (H, W) bool, optional
        Where the flow holds; elsewhere it counts as unknown.

    Returns
    -------
    (K,) bool
        True where the neighbour holds a quarter of the place's brightness near where the motion leads.
    """
    height, width = color.shape[:2]
    found = np.zeros(len(places), bool)
    for index, (y, x) in enumerate(places):
        known = flow is not None and (valid is None or bool(valid[y, x]))
        u, v = flow[y, x] if known and flow is not None else (0.0, 0.0)
        reach = NEAR if known else NEAR_WITHOUT_VECTORS
        row, column = round(float(y + v)), round(float(x + u))
        near = other[
            max(row - reach, 0) : max(min(row + reach + 1, height), 0),
            max(column - reach, 0) : max(min(column + reach + 1, width), 0),
        ]
        if near.size:
            found[index] = near.mean(axis=-1).max() >= RECURS * color[y, x].mean()
    return found


def replace_fireflies(color: Floats, places: Places) -> tuple[Floats, Mask, float]:
    """Replace fireflies by the mean of the ring around them.

    Parameters
    ----------
    color : (H, W, C) float32
        The frame.
    places : (K, 2) intp
        Rows and columns.

    Returns
    -------
    cleaned : (H, W, C) float32
        A copy.
    replaced : (H, W) bool
        Which pixels were.
    removed : float
        Share of the frame's light that is gone, in [0, 1]: what fireflies carry belongs to the picture in expectation.

    Notes
    -----
    Of the 3×3 around a place those pixels are replaced that are above four times the brightest of the ring. The ring's
    mean leaves neither a dark hole nor a halo.
    """
    cleaned, replaced = color.copy(), np.zeros(color.shape[:2], bool)
    height, width = color.shape[:2]
    level = np.einsum("...c->...", color) / np.float32(color.shape[-1])
    for y, x in places:
        top, left = max(y - 2, 0), max(x - 2, 0)
        block = slice(top, min(y + 3, height)), slice(left, min(x + 3, width))
        rows, columns = np.mgrid[block]
        core = (np.abs(rows - y) <= 1) & (np.abs(columns - x) <= 1)
        ring = ~core
        bright = core & (level[block] > 4 * level[block][ring].max())
        cleaned[block][bright] = color[block][ring].mean(axis=0)
        replaced[block] |= bright
    before = float(color.sum(dtype=np.float64))
    removed = 1 - float(cleaned.sum(dtype=np.float64)) / before if before > 0 else 0.0
    return cleaned, replaced, max(removed, 0.0)


@njit(cache=True)
def _find(level, over_brightest, over_mean):  # type: ignore[no-untyped-def]
    height, width = level.shape
    found = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            value = level[y, x]
            # Nearly all pixels end here: a firefly towers over the pixel two to its left, or right at the border.
            other = level[y, x - 2] if x >= 2 else level[y, min(x + 2, width - 1)]
            if not value > over_brightest * other:
                continue
            brightest, total, count, peak = np.float32(0), 0.0, 0, True
            for j in range(max(y - 2, 0), min(y + 3, height)):
                for i in range(max(x - 2, 0), min(x + 3, width)):
                    near = level[j, i]
                    if abs(j - y) <= 1 and abs(i - x) <= 1:
                        # Of equal pixels the first counts.
                        if near > value or (near == value and (j, i) < (y, x)):
                            peak = False
                    else:
                        brightest = max(brightest, near)
                        total += near
                        count += 1
            if peak and brightest > 0 and value > over_brightest * brightest and value * count > over_mean * total:
                found[y, x] = True
    return found
