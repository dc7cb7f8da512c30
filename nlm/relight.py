"""Neighbours in the light of the centre: the smooth difference in light is subtracted, detail is kept."""

import cv2
import numpy as np
from numba import njit

from loops.parallel import Floats, run_bands
from nlm.average import check_exposure, check_window
from nlm.variance import gaussian_mean, ratio

_CELL, _SIGMA = 4, 1.5  # means over σ = 1.5 cells of 4×4 pixels; 4 to 10 pixels are alike to 0.03 dB


def relight(window: Floats, alike: Floats, trusted: Floats, exposure: float, *, first_row: int = 0) -> None:
    """Subtract from aligned pictures, in place, their mean difference in light from the centre.

    Light that changes evenly (a shadow's soft edge, a growing lamp) leaves the detail of a neighbour usable.

    Parameters
    ----------
    window : (T, H, W, 3) float32, aligned pictures, contiguous, finite
    alike : (T, H, W) float32, confidence of each pixel as is
    trusted : (T, H, W) float32, confidence without regard to light, at least `alike`
    exposure : float
    first_row : int, the frame's row that the first row belongs to: cells lie as in the whole frame

    Notes
    -----
    With a and c the two confidences, d_s becomes max(0, d_s − (1 − a/c) · l · K[c (d_s − d_t) / l] / K[c]),
    K a Gaussian mean over σ = 6 pixels. The light l is the mean of both pictures in this channel plus the exposure: a
    pixel counts by its relative difference, at most 2, so that a firefly leaves no ring.
    """
    checked, trusted = check_window(window, trusted, "trusted")
    if checked is not window:
        raise ValueError(f"window: expected contiguous float32, got {window.dtype}")
    if alike.shape != trusted.shape:
        raise ValueError(f"alike: expected shape {trusted.shape} to fit the window, got {alike.shape}")
    check_exposure(exposure)
    frames, height, width, channels = window.shape
    alike = np.ascontiguousarray(alike, np.float32)
    offset = first_row % _CELL
    rows, columns = -(-(offset + height) // _CELL), -(-width // _CELL)
    for t in range(frames):
        if t == frames // 2:
            continue
        sums = np.zeros((channels + 1, rows, columns), np.float32)
        pair = window[t], window[frames // 2], trusted[t], np.float32(exposure)
        run_bands(_sum_cells, rows, *pair, offset, sums)
        means = [gaussian_mean(part, _SIGMA) for part in sums]
        change = np.stack([ratio(part, means[-1]) for part in means[:-1]], axis=-1)
        whole = (columns * _CELL, rows * _CELL)
        change = np.asarray(cv2.resize(change, whole, interpolation=cv2.INTER_LINEAR), np.float32)
        run_bands(_subtract, height, *pair, alike[t], change[offset : offset + height, :width])


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_cells(
    first: int, last: int, there: Floats, here: Floats, trusted: Floats, exposure: np.float32, offset: int, sums: Floats
) -> None:
    """Sum over cells the relative difference of each channel, weighted by confidence, and the confidence."""
    H, W, C = there.shape
    half, zero = np.float32(0.5), np.float32(0)
    for row in range(first, last):
        for y in range(max(row * _CELL - offset, 0), min((row + 1) * _CELL - offset, H)):
            for x in range(W):
                weight = trusted[y, x]
                if not weight > 0:
                    continue
                for c in range(C):
                    centre, other = here[y, x, c], there[y, x, c]
                    light = half * (max(other, zero) + max(centre, zero)) + exposure
                    sums[c, row, x // _CELL] += weight * ((other - centre) / light)
                sums[C, row, x // _CELL] += weight


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract(
    first: int, last: int, there: Floats, here: Floats, trusted: Floats, exposure: np.float32, alike: Floats,
    change: Floats,
) -> None:  # fmt: skip
    half, zero = np.float32(0.5), np.float32(0)
    for y in range(first, last):
        for x in range(there.shape[1]):
            if not trusted[y, x] > alike[y, x]:
                continue
            share = np.float32(1) - alike[y, x] / trusted[y, x]
            for c in range(there.shape[2]):
                centre, other = here[y, x, c], there[y, x, c]
                light = half * (max(other, zero) + max(centre, zero)) + exposure
                # Below 0 only where it was.
                there[y, x, c] = max(other - share * change[y, x, c] * light, min(other, zero))
