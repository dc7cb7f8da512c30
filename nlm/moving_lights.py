"""Bright pixels that move together without motion vectors: snow, rain, sparks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

# A bright pixel exceeds the picture by half of the light, and by eight robust deviations of the excess.
_ABOVE, _DEVIATIONS = 0.5, 8.0
# Fewer bright pixels show no motion; a greater share of all pixels is noise.
LEAST, _MOST = 20, 0.05
# Search radius, pixels a frame, and side of the searched block.
_REACH, _BLOCK = 32, 512
# This share of the bright pixels must share a motion, and more than chance by six deviations and eight pixels.
_SHARE, _SIGMAS, _MORE = 0.2, 6.0, 8
# Bright pixels that move within so many pixels of the surfaces' motion are highlights with noisy samples: added back as
# rendered they cost 2.5 dB of a pan over a bar with many lamps.
_APART = 2.5
# The same light differs by a factor of two at most.
_ALIKE = 2.0


def find_bright(excess: Floats) -> Mask:
    """Find the bright pixels (H, W) of a frame; none where too few or too many are bright to detect a motion.

    `excess` (H, W) is what the frame shows beyond its denoised picture, relative to the light.
    """
    bulk = 1.4826 * float(np.median(np.abs(excess)))
    bright = excess > max(_ABOVE, _DEVIATIONS * bulk)
    count = np.count_nonzero(bright)
    return bright if LEAST <= count <= _MOST * bright.size else np.zeros_like(bright)


def shared_motions(here: Mask, there: Mask) -> list[tuple[int, int]]:
    """Find the motions, rows and columns, that many bright pixels of one frame share on the way to another.

    The cross-correlation of both masks counts the pixels of each motion. Independent bright pixels, N and M of A, give
    N M / A with Poisson's deviation. Motions of at most one pixel are left out: noise of one seed has these too.
    """
    rows, columns = (_busiest(here.sum(axis=1 - axis)) for axis in (0, 1))
    a, b = (mask[rows, columns].astype(np.float64) for mask in (here, there))
    if a.sum() < LEAST or b.sum() < LEAST:
        return []
    size = [length + _REACH for length in a.shape]
    counts = np.fft.irfft2(np.conj(np.fft.rfft2(a, size)) * np.fft.rfft2(b, size), size).round()
    steps = np.arange(-_REACH, _REACH + 1)
    counts = counts[np.ix_(steps % size[0], steps % size[1])]
    counts[_REACH - 1 : _REACH + 2, _REACH - 1 : _REACH + 2] = 0
    chance = a.sum() * b.sum() / a.size
    enough = max(chance + _SIGMAS * np.sqrt(chance) + _MORE, _SHARE * a.sum())
    return [(int(y) - _REACH, int(x) - _REACH) for y, x in np.argwhere(counts >= enough)]


def confirmed_by_neighbour(
    excess: Floats, bright: Mask, other_excess: Floats, other_bright: Mask, flow: Floats | None
) -> Mask:
    """Return the bright pixels (H, W) that another frame shows at the end of a shared motion other than the surfaces'.

    Parameters
    ----------
    excess, bright : (H, W) array, of the frame, as for `find_bright` and from `find_bright`
    other_excess, other_bright : (H, W) array, of the other frame
    flow : (H, W, 2) float32 or None
        Motion of surfaces to the other frame, pixels, x first; None: nothing moves.
    """
    found = np.zeros_like(bright)
    height, width = bright.shape
    rows, columns = np.nonzero(bright)
    for down, right in shared_motions(bright, other_bright):
        y, x = rows + down, columns + right
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        if flow is not None:
            moved = flow[rows, columns] - np.array([right, down], np.float32)
            inside &= np.hypot(moved[:, 0], moved[:, 1]) > _APART
        elif np.hypot(down, right) <= _APART:
            continue
        y, x, from_y, from_x = y[inside], x[inside], rows[inside], columns[inside]
        here, there = excess[from_y, from_x], other_excess[y, x]
        alike = other_bright[y, x] & (there <= _ALIKE * here) & (here <= _ALIKE * there)
        found[from_y[alike], from_x[alike]] = True
    return found


def _busiest(counts: NDArray[np.intp]) -> slice:
    """Return the `_BLOCK` rows or columns with the most bright pixels."""
    length = min(_BLOCK, len(counts))
    sums = np.convolve(counts, np.ones(length), "valid")
    first = int(np.argmax(sums))
    return slice(first, first + length)
