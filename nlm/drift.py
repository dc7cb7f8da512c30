"""Lighting that drifts slowly: measured with samples that the compared estimates were made without."""

import cv2
import numpy as np
from numba import njit

from loops.parallel import Floats, run_bands
from nlm.average import check_colors, check_exposure, check_window
from nlm.samples import FAR
from nlm.variance import gaussian_mean, ratio

# Cells of 8×8 pixels, smoothed by σ = 2 of them: σ of 8, 16 and 32 pixels are as good to 0.05 dB.
CELL, SIGMA = 8, 2.0
_DEVIATIONS = 1.5  # deviations of its own noise subtracted from the measured drift: 1 and 2 differ by 0.03 dB
_ERROR = 0.1  # at least this share of two estimates' difference is their own error: no frame gets the weight 0


def drift_weights(
    estimates: Floats, noisy: Floats, confidence: Floats, exposure: float, *, first_row: int = 0
) -> Floats:
    """Weigh aligned estimates by how far the lighting has drifted from the centre's.

    The gate (`nlm.gate`) does not detect light that changes by less than the noise of the estimates. The centre's
    samples detect such a change in the mean over many pixels, as the other frames' estimates are made without these
    samples.

    Parameters
    ----------
    estimates : (T, H, W, 3) float32
        Denoised, aligned. Non-finite pixels are skipped.
    noisy : (H, W, 3) float32, the centre frame as rendered, in the same unit
    confidence : (T, H, W) float32
    exposure : float
    first_row : int, the frame's row that the first row belongs to: cells lie as in the whole frame

    Returns
    -------
    (T, H, W) float32
        Factors in (0, 1] for the confidence; 1 at the centre, and everywhere in windows of three frames.

    Notes
    -----
    With n the centre's samples and e_l the estimate l frames away, the mean of (n − e_l)² − (n − e_1)² is
    by how much the farther estimate is worse: the noise of n cancels. Light that drifts by δ a frame adds (l² − 1) δ².
    Where the centre's estimate and its neighbours' differ by d², (d² − δ²) / 2 = v is the error of each, and the
    average of least error weighs e_l by v / (v + l² δ²). Means are over σ = 16 pixels, weighed by the lesser confidence
    of both frames; differences are multiplied by the slope of x / (x + exposure) at the mean of the other frames. δ² is
    the part above 1.5 deviations of its own noise.
    """
    estimates, confidence = check_window(estimates, confidence, "confidence")
    check_colors(noisy, estimates)
    check_exposure(exposure)
    frames, height, width, _ = estimates.shape
    if frames < 5:
        return np.ones(confidence.shape, np.float32)
    offset = first_row % CELL
    rows, columns = -(-(offset + height) // CELL), -(-width // CELL)
    sums = np.zeros((5, rows, columns), np.float32)
    given = estimates, np.ascontiguousarray(noisy, np.float32), confidence, np.float32(exposure), offset
    run_bands(_hold_out, rows, *given, sums)
    worse, lags, squares, trusted, disagreement = sums
    worse, lags, trusted, disagreement = (gaussian_mean(part, SIGMA) for part in (worse, lags, trusted, disagreement))
    # The squares of a Gaussian's weights are those of one narrower by √2, over 4πσ².
    noise = np.sqrt(gaussian_mean(squares, SIGMA / np.sqrt(2)) / np.float32(4 * np.pi * SIGMA**2))
    drift = ratio(np.maximum(worse - np.float32(_DEVIATIONS) * noise, 0), lags)
    differ = ratio(disagreement, trusted)
    error = np.maximum((differ - drift) / 2, np.float32(_ERROR) * differ)
    off = cv2.resize(ratio(drift, error), (columns * CELL, rows * CELL), interpolation=cv2.INTER_LINEAR)
    off = off[offset : offset + height, :width]
    weight = np.empty(confidence.shape, np.float32)
    for t, plane in enumerate(weight):
        np.multiply(off, np.float32((t - frames // 2) ** 2), out=plane)
        plane += 1
        np.divide(1, plane, out=plane)
    return weight


def pull_to_centre(estimates: Floats, confidence: Floats, weight: Floats) -> None:
    """Pull estimates to the centre's, in place, so that their average is as if confidence were multiplied.

    Samples and all else that is averaged keep their confidence: e_s becomes e_t + m_s (e_s − e_t), m_s = w_s Σ c / Σ c
    w. This moves near frames away from the centre by a third at most in windows of seven; only the average matters.

    Parameters
    ----------
    estimates : (T, H, W, 3) float32
    confidence : (T, H, W) float32
    weight : (T, H, W) float32, the factor, from `drift_weights`
    """
    run_bands(_pull, estimates.shape[1], estimates, confidence, weight)


@njit(cache=True, nogil=True, error_model="numpy")
def _hold_out(
    first: int, last: int, estimates: Floats, noisy: Floats, confidence: Floats, exposure: np.float32, offset: int,
    sums: Floats,
) -> None:  # fmt: skip
    """Accumulate per cell: error increase with lag, Σ (lag² − 1), squared increase, confidence, disagreement."""
    T, H, W, _ = estimates.shape
    middle = T // 2
    for row in range(first, last):
        for y in range(max(row * CELL - offset, 0), min((row + 1) * CELL - offset, H)):
            for x in range(W):
                cell = x // CELL
                light = np.float32(0)
                for t in range(T):
                    if t != middle:
                        for c in range(3):
                            light += max(estimates[t, y, x, c], np.float32(0))
                light = light / np.float32((T - 1) * 3) + exposure
                # of x / (x + exposure), as (e/l)·(1/l): e² would vanish in dark scenes
                slope = exposure / light / light
                limit = FAR * light  # fireflies carry no evidence of drift
                for side in (-1, 1):
                    near = middle + side
                    close, away = np.float32(0), np.float32(0)
                    for c in range(3):
                        close += (slope * (min(noisy[y, x, c], limit) - estimates[near, y, x, c])) ** 2
                        away += (slope * (estimates[near, y, x, c] - estimates[middle, y, x, c])) ** 2
                    for lag in range(2, middle + 1):
                        far = middle + side * lag
                        both = min(confidence[near, y, x], confidence[far, y, x])
                        if not both > 0:
                            continue
                        off = np.float32(0)
                        for c in range(3):
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
    """Write centre + m (estimate − centre) into the estimates."""
    T, _, W, _ = estimates.shape
    middle = T // 2
    for y in range(first, last):
        for x in range(W):
            total, left = np.float32(0), np.float32(0)
            for t in range(T):
                total += confidence[t, y, x]
                left += confidence[t, y, x] * weight[t, y, x]
            # Where drift leaves nothing of the only frames that are trusted, they count as before.
            if left == total or not left > 0:
                continue
            for t in range(T):
                share = weight[t, y, x] * total / left
                if t != middle:
                    for c in range(3):
                        centre = estimates[middle, y, x, c]
                        estimates[t, y, x, c] = centre + share * (estimates[t, y, x, c] - centre)
