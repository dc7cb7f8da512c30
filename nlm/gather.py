"""The samples of a window of frames, gathered at the centre before anything denoises them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from loops.cores import on_all_cores
from nlm.average import check_window
from nlm.variance import gaussian_mean

Floats = NDArray[np.float32]

# What a pixel shows beyond its estimate counts up to so many times its light and the exposure. Noise of a few samples
# seldom goes so far; a firefly goes hundreds of times as far, and no denoiser forgives it: at 15 to 30 samples a
# picture made without this limit lost up to 10 dB. Limits of 4 to 8 differ by less than 0.1 dB.
_LIMIT = np.float32(6)
# Cells of `restore_mean` on a side of σ: what is smoothed by σ = 6 cells has nothing smaller than a cell in it.
_CELLS = 6


@dataclass(frozen=True)
class Gathered:
    """A frame with the samples of its neighbours.

    Attributes
    ----------
    average : (H, W, 3) float32
        Of the estimates, weighted by confidence.
    image : (H, W, 3) float32
        The same and the average of what the noisy frames show beyond their estimates: as unbiased as they are, with the
        noise of `samples` frames.
    samples : (H, W) float32
        Frames' worth of samples at each pixel, (Σ c)² / Σ c², between 1 and T; 0 where no frame is trusted.
    """

    average: Floats
    image: Floats
    samples: Floats


def gather(estimates: Floats, residuals: Floats, confidence: Floats, exposure: float) -> Gathered:
    """Gather the samples of aligned frames at the centre.

    Parameters
    ----------
    estimates : (T, H, W, 3) float32
        Denoised frames, aligned by an interpolation that keeps detail; the centre is ``T // 2``.
    residuals : (T, H, W, 3) float32
        Noisy frame minus estimate, each taken in its own place and aligned to the nearest pixel: noise that is
        interpolated is no longer white, and a denoiser takes it for texture.
    confidence : (T, H, W) float32
        Trust in each pixel of each frame, at least 0.
    exposure : float
        Radiance of middle brightness; it scales with the frames.

    Returns
    -------
    Gathered
        Where no frame is trusted, the centre's estimate. Pixels that are not finite in a frame count for nothing there.

    Raises
    ------
    ValueError
        If shapes do not fit each other, T is even, or `exposure` is not a positive number.

    Notes
    -----
    With e the estimates, r the residuals and c the confidence,

        G = Σ c e / Σ c,    b = G + Σ c r' / Σ c,    N = (Σ c)² / Σ c²,

    where r' is r scaled down to |r'| ≤ 6 (e + exposure), in the mean over channels, so that fireflies keep their hue
    and lose their power. What that takes from the light is for the denoised picture's mean to bring back.
    """
    if residuals.shape != estimates.shape:
        raise ValueError(f"residuals: expected shape {estimates.shape} like the estimates, got {residuals.shape}")
    if not (exposure > 0 and np.isfinite(exposure)):
        raise ValueError(f"exposure: expected a positive number, got {exposure}")
    estimates, confidence = check_window(estimates, confidence, "confidence")
    residuals = np.ascontiguousarray(residuals, np.float32)
    average, image = np.empty(estimates.shape[1:], np.float32), np.empty(estimates.shape[1:], np.float32)
    samples = np.empty(estimates.shape[1:3], np.float32)
    given = estimates, residuals, confidence, np.float32(exposure)
    on_all_cores(_gather, len(samples), *given, average, image, samples)
    return Gathered(average, image, samples)


def restore_mean(
    picture: Floats, samples: Floats, *, sigma: float = 24, most: float = 0.1, limit: float = np.inf
) -> Floats:
    """Give a denoised picture the local mean of the samples that it was made from.

    Parameters
    ----------
    picture : (H, W, 3) float32
        Denoised, linear, finite.
    samples : (H, W, 3) float32
        What it was made from, finite: right in the mean, and noisy.
    sigma : float
        Pixels, at least 6.
    most : float
        How much may be added or taken away, relative.
    limit : float
        How far from the picture a pixel of the samples may be, in units of the picture there and in the mean.

    Returns
    -------
    (H, W, 3) float32
        The picture times a smooth factor between 1 − most and 1 + most.

    Notes
    -----
    With K a Gaussian mean of deviation σ and d = samples − picture in the mean over channels, held to the limit, the
    factor is 1 + ρ K d / K picture, ρ = max(0, 1 − v / (K d)²): the shrinkage of James and Stein, which adds only what
    stands out of the noise, whose variance is v = K²(d²), K² the squared weights of K. One bright sample is its own
    noise, so that nothing is added for it. All means are of cells of σ / 6 pixels.
    """
    difference, level = _gray(samples) - _gray(picture), _gray(picture)
    if np.isfinite(limit):
        bound = np.float32(limit) * (level + level.mean(dtype=np.float64).astype(np.float32))
        np.clip(difference, -bound, bound, out=difference)
    side, (height, width) = int(sigma / _CELLS), level.shape
    deviation = sigma / side
    square_of_difference = _cells(np.square(difference), side)
    mean = gaussian_mean(_cells(difference, side), deviation)
    # The squares of a Gaussian's weights are those of one narrower by √2, over 4πσ².
    variance = gaussian_mean(square_of_difference, deviation / np.sqrt(2)) / np.float32(4 * np.pi * sigma**2)
    square = np.square(mean)
    share = np.divide(np.maximum(square - variance, 0), square, out=np.zeros_like(square), where=square > 0)
    below = gaussian_mean(_cells(level, side), deviation)
    change = np.divide(share * mean, below, out=np.zeros_like(mean), where=below > 0)
    factor = 1 + np.clip(change, -most, most)
    rows, columns = factor.shape
    factor = cv2.resize(factor, (columns * side, rows * side), interpolation=cv2.INTER_LINEAR)
    return np.asarray(picture * factor[:height, :width, None], np.float32)


def _cells(image: Floats, side: int) -> Floats:
    """Means of cells of so many pixels on a side, mirrored to whole ones."""
    height, width = image.shape
    whole = cv2.copyMakeBorder(image, 0, -height % side, 0, -width % side, cv2.BORDER_REFLECT)
    rows, columns = whole.shape[0] // side, whole.shape[1] // side
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)


def _gray(image: Floats) -> Floats:
    return np.asarray(np.einsum("yxc->yx", image) / np.float32(image.shape[-1]), np.float32)


@njit(cache=True, nogil=True)
def _gather(
    first: int, last: int, estimates: Floats, residuals: Floats, confidence: Floats, exposure: np.float32,
    average: Floats, image: Floats, samples: Floats,
) -> None:  # fmt: skip
    T, _, W, C = estimates.shape
    for y in range(first, last):
        light, noise = np.empty(C, np.float32), np.empty(C, np.float32)
        for x in range(W):
            light[:] = 0
            noise[:] = 0
            total, squares = 0.0, 0.0  # float64: the square of a small confidence must not vanish
            for t in range(T):
                weight = confidence[t, y, x]
                if not weight > 0:
                    continue
                level, excess = np.float32(0), np.float32(0)
                for c in range(C):
                    level += estimates[t, y, x, c]
                    excess += residuals[t, y, x, c]
                if not np.isfinite(level + excess):
                    continue
                limit = _LIMIT * (max(level, np.float32(0)) + C * exposure)
                share = min(limit / max(abs(excess), limit), np.float32(1))
                total += weight
                squares += np.float64(weight) ** 2
                for c in range(C):
                    light[c] += weight * estimates[t, y, x, c]
                    noise[c] += weight * share * residuals[t, y, x, c]
            samples[y, x] = total * total / squares if squares > 0 else 0
            for c in range(C):
                if total > 0:
                    average[y, x, c] = light[c] / total
                    image[y, x, c] = (light[c] + noise[c]) / total
                else:
                    average[y, x, c] = image[y, x, c] = estimates[T // 2, y, x, c]
