"""Colour gate: weights of aligned frames by whether they show the same light as the centre."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from loops.parallel import run_bands
from nlm.average import check_exposure

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

_MEAN_SIZE = (9, 9)
_NOISE_SIZE = (15, 15)
_AROUND_SIZE = (15, 15)
# q = share · s + _FLOOR in tone-mapped units: a difference of means of a third of the centre's noise is noise; 0.004,
# one step of 8 bits, is the difference of the estimates without noise.
SHARE, _FLOOR = 0.3, 0.004


def color_gate(estimates: Floats, noisy: Floats, exposure: float) -> Floats:
    """Return the weights (T, H, W) of `color_gates` for the share 0.3."""
    return color_gates(estimates, noisy, exposure, (SHARE,))[0]


def color_gates(estimates: Floats, noisy: Floats, exposure: float, shares: Sequence[float]) -> list[Floats]:
    """Weigh aligned frames by how well their denoised colours agree with the centre's, for several strictnesses.

    Geometry does not show a moving shadow, highlight or reflection; the colour of a clean enough estimate does.

    Parameters
    ----------
    estimates : (T, H, W, 3) float32, denoised, aligned, at least 0
    noisy : (H, W, 3) float32, the centre frame as rendered, in the same unit
    exposure : float
    shares : sequence of float, tolerated difference of two estimates as a share of the centre's noise, at least 0

    Returns
    -------
    list of (T, H, W) float32
        For each share weights in [0, 1], 1 at the centre; a greater share gives nowhere less.

    Notes
    -----
    exp(−(m/q)²), q = share · s + 0.004. All in x / (x + exposure): m is the RMS over channels of the 9×9 mean of the
    difference from the centre, or the 15×15 RMS of that, whichever is greater; s the 15×15 RMS of noisy − centre.
    Non-finite values get weight 0 and do not spread.

    Between a shadow that has come and one that has gone lies a line of mean difference 0. Without the 15×15 RMS
    averages ran along such lines: 4 dB on a shot of moving shadows, nothing elsewhere.

    The difference of a single pixel is the error of the two estimates; weights by it choose the frames whose errors are
    the centre's. Without it averages are up to 2 dB steadier, and pooled samples (`nlm.pooling`) 0.5 dB better.
    """
    if estimates.ndim != 4 or estimates.shape[0] % 2 == 0:
        raise ValueError(f"estimates: expected (odd frames, height, width, channels), got {estimates.shape}")
    if noisy.shape != estimates.shape[1:]:
        raise ValueError(f"noisy: expected shape {estimates.shape[1:]} like an estimate, got {noisy.shape}")
    check_exposure(exposure)
    centre_index = estimates.shape[0] // 2
    shape = noisy.shape
    estimates, noisy = (np.ascontiguousarray(images, np.float32) for images in (estimates, noisy))
    centre, difference = estimates[centre_index], np.empty(shape, np.float32)
    both = np.empty(shape[:2], np.bool_)
    run_bands(_compare, shape[0], noisy, centre, np.float32(exposure), difference, both)
    # The running sums of a box filter round to a little below 0 where nothing differs.
    noise = np.sqrt(np.maximum(cv2.blur(_mean_square(difference), _NOISE_SIZE), 0))
    rates = [1 / np.square(np.float32(share) * noise + np.float32(_FLOOR)) for share in shares]
    weights = [np.ones(estimates.shape[:3], np.float32) for _ in shares]
    for t, estimate in enumerate(estimates):
        if t == centre_index:
            continue
        run_bands(_compare, shape[0], estimate, centre, np.float32(exposure), difference, both)
        mean = _mean_square(np.asarray(cv2.blur(difference, _MEAN_SIZE), np.float32))
        around = cv2.blur(mean, _AROUND_SIZE)
        for rate, weight in zip(rates, weights, strict=True):
            run_bands(_weigh, shape[0], mean, around, rate, both, weight[t])
    return weights


@njit(cache=True, nogil=True, error_model="numpy")
def _compare(
    first: int, last: int, image: Floats, centre: Floats, exposure: np.float32, difference: Floats, both: Mask
) -> None:
    """Write image − centre, each as x / (x + exposure), and where both are finite; elsewhere the difference is 0."""
    zero, one = np.float32(0), np.float32(1)
    for y in range(first, last):
        values, others, flat = image[y].reshape(-1), centre[y].reshape(-1), difference[y].reshape(-1)
        for i in range(len(flat)):
            # exposure / (x + exposure) and not x / …: it cannot overflow
            here = one - exposure / (max(values[i], zero) + exposure)
            there = one - exposure / (max(others[i], zero) + exposure)
            flat[i] = here - there
        for x in range(image.shape[1]):
            finite = True
            for c in range(image.shape[2]):
                finite = finite and np.isfinite(image[y, x, c]) and np.isfinite(centre[y, x, c])
            both[y, x] = finite
            if not finite:
                difference[y, x] = 0


def _mean_square(x: Floats) -> Floats:
    """Mean (H, W) over channels of x²."""
    mean = np.empty(x.shape[:2], np.float32)
    run_bands(_square, len(x), x, mean)
    return mean


@njit(cache=True, nogil=True, error_model="numpy")
def _square(first: int, last: int, x: Floats, mean: Floats) -> None:
    channels = x.shape[2]
    for row in range(first, last):
        for column in range(x.shape[1]):
            total = np.float32(0)
            for c in range(channels):
                total += x[row, column, c] * x[row, column, c]
            mean[row, column] = total / np.float32(channels)


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(first: int, last: int, mean: Floats, around: Floats, rate: Floats, both: Mask, weight: Floats) -> None:
    """Write exp(−rate · max(mean, around)), 0 where a pixel is not finite."""
    for y in range(first, last):
        for x in range(mean.shape[1]):
            weight[y, x] = np.exp(-rate[y, x] * max(mean[y, x], around[y, x])) if both[y, x] else np.float32(0)
