"""Light that drifts: estimates that agree within their noise, and which samples that they do not know tell apart."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from loops.parallel import run_bands
from nlm.average import check_window
from nlm.variance import gaussian_mean

Floats = NDArray[np.float32]

# Cells of 8×8 pixels, smoothed by σ = 2 of them: σ of 8, 16 and 32 pixels are as good to 0.05 dB.
_CELL, _SIGMA = 8, 2.0
# Drift counts as far as it stands out of its own noise by so many deviations: 1 and 2 differ by 0.03 dB.
_DEVIATIONS = 1.5
# Of what two estimates differ by, this much at least is their own error: a frame is never weighed 0.
_ERROR = 0.1
# A sample counts up to so many times the light: fireflies know nothing of drift.
_LIMIT = np.float32(12)


def drift_weights(
    estimates: Floats, noisy: Floats, confidence: Floats, exposure: float, *, first_row: int = 0
) -> Floats:
    """Weigh aligned estimates by how far the light has drifted from the centre's.

    The gate (`nlm.gate`) cannot see light that changes by less than the estimates' own noise. The centre's samples can,
    in the mean over many pixels, as the other frames' estimates are made without them.

    Parameters
    ----------
    estimates : (T, H, W, 3) float32
        Denoised frames, aligned, linear; the centre is ``T // 2``. Where one is not finite nothing is learnt.
    noisy : (H, W, 3) float32
        The centre frame as it was rendered, in the same unit.
    confidence : (T, H, W) float32
        Trust in each pixel of each frame, at least 0.
    exposure : float
        The radiance that is mapped to one half; it scales with the frames.
    first_row : int
        Which row of the frame the first one is: cells lie as in the whole frame.

    Returns
    -------
    (T, H, W) float32
        In (0, 1], to be multiplied by the confidence; 1 at the centre, and everywhere in windows of three frames.

    Raises
    ------
    ValueError
        If the shapes do not fit each other, T is even, or `exposure` is not a positive number.

    Notes
    -----
    With n the centre's samples and e_l the estimate of l frames away, the mean of (n − e_l)² − (n − e_1)² is by how
    much the farther estimate is worse: what noise n has cancels. Light that drifts by δ a frame makes it (l² − 1) δ².
    Where the centre's estimate and its neighbours' differ by d², (d² − δ²) / 2 = v is the error of each, and the
    average with the least error weighs e_l by v / (v + l² δ²). Means are over σ = 16 pixels, weighed by the lesser
    confidence of both frames; differences are multiplied by the slope of x / (x + exposure) at the mean of the other
    frames. δ² is what stands out of 1.5 deviations of its own noise.
    """
    estimates, confidence = check_window(estimates, confidence, "confidence")
    if noisy.shape != estimates.shape[1:]:
        raise ValueError(f"noisy: expected shape {estimates.shape[1:]} like an estimate, got {noisy.shape}")
    if not (exposure > 0 and np.isfinite(exposure)):
        raise ValueError(f"exposure: expected a positive number, got {exposure}")
    frames, height, width, _ = estimates.shape
    weight = np.ones(confidence.shape, np.float32)
    if frames < 5:
        return weight
    above = first_row % _CELL
    rows, columns = -(-(above + height) // _CELL), -(-width // _CELL)
    sums = np.zeros((5, rows, columns), np.float32)
    given = estimates, np.ascontiguousarray(noisy, np.float32), confidence, np.float32(exposure), above
    run_bands(_hold_out, rows, *given, sums)
    worse, lags, squares, trusted, apart = sums
    worse, lags, trusted, apart = (gaussian_mean(part, _SIGMA) for part in (worse, lags, trusted, apart))
    # The squares of a Gaussian's weights are those of one narrower by √2, over 4πσ².
    noise = np.sqrt(gaussian_mean(squares, _SIGMA / np.sqrt(2)) / np.float32(4 * np.pi * _SIGMA**2))
    drift = _ratio(np.maximum(worse - np.float32(_DEVIATIONS) * noise, 0), lags)
    differ = _ratio(apart, trusted)
    error = np.maximum((differ - drift) / 2, np.float32(_ERROR) * differ)
    off = cv2.resize(_ratio(drift, error), (columns * _CELL, rows * _CELL), interpolation=cv2.INTER_LINEAR)
    off = off[above : above + height, :width]
    for t in range(frames):
        if t != frames // 2:
            np.divide(1, 1 + np.float32((t - frames // 2) ** 2) * off, out=weight[t])
    return weight


def pull_to_centre(estimates: Floats, confidence: Floats, weight: Floats) -> None:
    """Pull estimates to the centre's, so that their average is as if their confidence were multiplied by `weight`.

    What is averaged beside the estimates, samples above all, keeps the confidence that it has.

    Parameters
    ----------
    estimates : (T, H, W, 3) float32
        Aligned; the centre is ``T // 2``. Is changed.
    confidence : (T, H, W) float32
        At least 0.
    weight : (T, H, W) float32
        In (0, 1]; 1 at the centre.

    Notes
    -----
    e_s becomes e_t + m_s (e_s − e_t), m_s = w_s Σ c / Σ c w. Near frames may move away from the centre by it, by a
    third at most in windows of seven: what is sought is the average.
    """
    run_bands(_pull, estimates.shape[1], estimates, confidence, weight)


def _ratio(a: Floats, b: Floats) -> Floats:
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _hold_out(
    first: int, last: int, estimates: Floats, noisy: Floats, confidence: Floats, exposure: np.float32, above: int,
    sums: Floats,
) -> None:  # fmt: skip
    """Sum over cells by how much farther frames are worse, of how many lags, the squares; the trust, what is apart."""
    T, H, W, C = estimates.shape
    middle = T // 2
    for row in range(first, last):
        for y in range(max(row * _CELL - above, 0), min((row + 1) * _CELL - above, H)):
            for x in range(W):
                cell = x // _CELL
                light = np.float32(0)
                for t in range(T):
                    if t != middle:
                        for c in range(C):
                            light += max(estimates[t, y, x, c], np.float32(0))
                light = light / np.float32((T - 1) * C) + exposure
                # of x / (x + exposure), as (e/l)·(1/l): e² would vanish in dark scenes
                slope = exposure / light / light
                limit = _LIMIT * light
                for side in (-1, 1):
                    near = middle + side
                    close, away = np.float32(0), np.float32(0)
                    for c in range(C):
                        close += (slope * (min(noisy[y, x, c], limit) - estimates[near, y, x, c])) ** 2
                        away += (slope * (estimates[near, y, x, c] - estimates[middle, y, x, c])) ** 2
                    for lag in range(2, middle + 1):
                        far = middle + side * lag
                        both = min(confidence[near, y, x], confidence[far, y, x])
                        if not both > 0:
                            continue
                        off = np.float32(0)
                        for c in range(C):
                            off += (slope * (min(noisy[y, x, c], limit) - estimates[far, y, x, c])) ** 2
                        off = both * (off - close)
                        if not np.isfinite(off + away):
                            continue
                        sums[0, row, cell] += off
                        sums[1, row, cell] += both * np.float32(lag * lag - 1)
                        sums[2, row, cell] += off * off
                        sums[3, row, cell] += both
                        sums[4, row, cell] += both * away


@njit(cache=True, nogil=True)
def _pull(first: int, last: int, estimates: Floats, confidence: Floats, weight: Floats) -> None:
    T, _, W, C = estimates.shape
    middle = T // 2
    for y in range(first, last):
        for x in range(W):
            total, left = np.float32(0), np.float32(0)
            for t in range(T):
                total += confidence[t, y, x]
                left += confidence[t, y, x] * weight[t, y, x]
            if left == total:
                continue
            for t in range(T):
                share = weight[t, y, x] * total / left
                if t != middle:
                    for c in range(C):
                        own = estimates[middle, y, x, c]
                        estimates[t, y, x, c] = own + share * (estimates[t, y, x, c] - own)
