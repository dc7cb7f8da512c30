"""Light that has changed evenly: pictures of other frames, in the light of the centre."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from loops.parallel import run_bands
from nlm.average import check_window
from nlm.variance import gaussian_mean

Floats = NDArray[np.float32]

# Means over σ = 1.5 cells of 4×4 pixels; 4 to 10 pixels are alike to 0.03 dB.
_CELL, _SIGMA = 4, 1.5


def relight(window: Floats, alike: Floats, trusted: Floats, exposure: float, *, first_row: int = 0) -> None:
    """Take from aligned pictures by what their light differs from the centre's in the mean.

    Where pictures differ by more than their errors, light has changed; where it has changed evenly, as under a shadow's
    soft edge or a lamp that grows, their detail is the centre's nevertheless.

    Parameters
    ----------
    window : (T, H, W, 3) float32
        Pictures, aligned, linear, finite; the centre is ``T // 2``. Is changed.
    alike : (T, H, W) float32
        Trust in each pixel as it is, at least 0.
    trusted : (T, H, W) float32
        Trust in it but for its light, at least `alike`.
    exposure : float
        Radiance of what is neither dark nor bright; it scales with the pictures.
    first_row : int
        Which row of the frame the first one is: means are of the same pixels as in the whole frame.

    Raises
    ------
    ValueError
        If the shapes do not fit each other, T is even, or `exposure` is not a positive number.

    Notes
    -----
    With a and c the two kinds of trust, d_s becomes d_s − (1 − a/c) · l · K[c (d_s − d_t) / l] / K[c], K a Gaussian
    mean over σ = 6 pixels, and not less than 0. The light l is the mean of both pictures in this channel, and the
    exposure: a pixel counts by its relative difference, 2 at most, so that a firefly leaves no ring.
    """
    checked, trusted = check_window(window, trusted, "trusted")
    if checked is not window:
        raise ValueError(f"window: expected contiguous float32, got {window.dtype}")
    if alike.shape != trusted.shape:
        raise ValueError(f"alike: expected shape {trusted.shape} to fit the window, got {alike.shape}")
    if not (exposure > 0 and np.isfinite(exposure)):
        raise ValueError(f"exposure: expected a positive number, got {exposure}")
    frames, height, width, channels = window.shape
    alike = np.ascontiguousarray(alike, np.float32)
    above = first_row % _CELL
    rows, columns = -(-(above + height) // _CELL), -(-width // _CELL)
    for t in range(frames):
        if t == frames // 2:
            continue
        sums = np.zeros((channels + 1, rows, columns), np.float32)
        pair = window[t], window[frames // 2], trusted[t], np.float32(exposure)
        run_bands(_sum_cells, rows, *pair, above, sums)
        means = [gaussian_mean(part, _SIGMA) for part in sums]
        change = np.stack([_ratio(part, means[-1]) for part in means[:-1]], axis=-1)
        whole = (columns * _CELL, rows * _CELL)
        change = np.asarray(cv2.resize(change, whole, interpolation=cv2.INTER_LINEAR), np.float32)
        run_bands(_take, height, *pair, alike[t], change[above : above + height, :width])


def _ratio(a: Floats, b: Floats) -> Floats:
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0)


@njit(cache=True, nogil=True, inline="always")
def _light(there: np.float32, here: np.float32, exposure: np.float32) -> np.float32:
    return np.float32(0.5) * (max(there, np.float32(0)) + max(here, np.float32(0))) + exposure


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_cells(
    first: int, last: int, there: Floats, here: Floats, trusted: Floats, exposure: np.float32, above: int, sums: Floats
) -> None:
    """Sum over cells the relative difference of each channel, weighed by trust, and the trust."""
    H, W, C = there.shape
    for row in range(first, last):
        for y in range(max(row * _CELL - above, 0), min((row + 1) * _CELL - above, H)):
            for x in range(W):
                weight = trusted[y, x]
                if not weight > 0:
                    continue
                for c in range(C):
                    own, other = here[y, x, c], there[y, x, c]
                    sums[c, row, x // _CELL] += weight * ((other - own) / _light(other, own, exposure))
                sums[C, row, x // _CELL] += weight


@njit(cache=True, nogil=True, error_model="numpy")
def _take(
    first: int, last: int, there: Floats, here: Floats, trusted: Floats, exposure: np.float32, alike: Floats,
    change: Floats,
) -> None:  # fmt: skip
    for y in range(first, last):
        for x in range(there.shape[1]):
            if not trusted[y, x] > alike[y, x]:
                continue
            share = np.float32(1) - alike[y, x] / trusted[y, x]
            for c in range(there.shape[2]):
                own, other = here[y, x, c], there[y, x, c]
                taken = share * change[y, x, c] * _light(other, own, exposure)
                there[y, x, c] = max(other - taken, min(other, np.float32(0)))  # not below 0, but for what was
