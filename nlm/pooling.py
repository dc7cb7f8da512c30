"""Samples of all frames of a window, pooled at the centre before denoising."""

from collections.abc import Iterable
from typing import NamedTuple, Self

import cv2
import numpy as np
from numba import njit

from loops.parallel import Floats, run_bands
from nlm.average import check_exposure, check_strip, check_window

# A residual counts up to so many times the pixel's light and the exposure. Noise of a few samples seldom exceeds this
# limit; a firefly exceeds it hundreds of times, and no denoiser removes such a value: at 15 to 30 samples pictures
# without this limit lost up to 10 dB. Limits of 4 to 8 differ by less than 0.1 dB.
RESIDUAL_LIMIT = np.float32(6)


class PooledSamples(NamedTuple):
    """A frame with the samples of its neighbours."""

    average: Floats  # (H, W, 3) estimates weighted by confidence
    image: Floats  # (H, W, 3) average + averaged residuals: unbiased, with the noise of (Σ c)² / Σ c² frames


def pool_samples(estimates: Floats, residuals: Floats, confidence: Floats, exposure: float) -> PooledSamples:
    """Pool the samples of aligned frames at the centre.

    Parameters
    ----------
    estimates : (T, H, W, 3) float32, denoised, aligned by an interpolation that keeps detail
    residuals : (T, H, W, 3) float32
        Noisy frame minus estimate, subtracted before alignment and aligned to the nearest pixel: interpolated noise is
        no longer white, and a denoiser takes such noise for texture.
    confidence : (T, H, W) float32
    exposure : float

    Returns
    -------
    PooledSamples
        The centre's estimate where no frame is trusted. Non-finite pixels of a frame are skipped.

    Notes
    -----
    With e the estimates, r the residuals and c the confidence,

        G = Σ c e / Σ c,    b = G + Σ c r' / Σ c,

    where r' is r scaled down to |r'| ≤ 6 (e + exposure), in the mean over channels, so that fireflies keep their hue
    and lose their power. `hybrid.alignment.residual` spreads that light around them beforehand, as far as it is missed.
    """
    if residuals.shape != estimates.shape:
        raise ValueError(f"residuals: expected shape {estimates.shape} like the estimates, got {residuals.shape}")
    check_exposure(exposure)
    estimates, confidence = check_window(estimates, confidence, "confidence")
    residuals = np.ascontiguousarray(residuals, np.float32)
    pooled = PooledSamples(*(np.empty(estimates.shape[1:], np.float32) for _ in PooledSamples._fields))
    run_bands(_pool, len(pooled.image), estimates, residuals, confidence, np.float32(exposure), pooled)
    return pooled


class SampleRange(NamedTuple):
    """Least and greatest of the estimates and the samples of all frames of a window, (H, W, 3) each."""

    low: Floats
    high: Floats

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> Self:
        """Make the range of a picture of this shape, to be filled by `add`."""
        return cls(np.empty(shape, np.float32), np.empty(shape, np.float32))

    def add(self, estimates: Floats, residuals: Floats, top: int) -> None:
        """Fill the rows from `top` on by residuals (T, h, W, 3) and all estimates of `pool_samples`, where finite."""
        check_strip(residuals, estimates, top)
        run_bands(_range, residuals.shape[1], estimates, residuals, *self, top)


def find_range(estimates: Floats, residuals: Iterable[tuple[int, Floats]]) -> SampleRange:
    """Find the range of a window from its residuals in strips of rows, with the first row of each."""
    found = SampleRange.empty(estimates.shape[1:])
    for top, strip in residuals:
        found.add(estimates, strip, top)
    return found


def clamp_to_range(picture: Floats, found: SampleRange) -> Floats:
    """Clamp each channel of a picture (H, W, 3) to the range of a window within 3×3 pixels."""
    box = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(found.low, box), cv2.dilate(found.high, box)
    return np.clip(picture, low.reshape(picture.shape), high.reshape(picture.shape))


@njit(cache=True, nogil=True)
def _pool(
    first: int, last: int, estimates: Floats, residuals: Floats, confidence: Floats, exposure: np.float32,
    pooled: PooledSamples,
) -> None:  # fmt: skip
    T, _, W, C = estimates.shape
    for y in range(first, last):
        light, noise = np.empty(C, np.float32), np.empty(C, np.float32)
        for x in range(W):
            light[:] = 0
            noise[:] = 0
            total = np.float32(0)
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
                limit = RESIDUAL_LIMIT * (max(level, np.float32(0)) + C * exposure)
                share = min(limit / max(abs(excess), limit), np.float32(1))
                total += weight
                for c in range(C):
                    light[c] += weight * estimates[t, y, x, c]
                    noise[c] += weight * share * residuals[t, y, x, c]
            for c in range(C):
                if total > 0:
                    pooled.average[y, x, c] = light[c] / total
                    pooled.image[y, x, c] = (light[c] + noise[c]) / total
                else:
                    pooled.average[y, x, c] = pooled.image[y, x, c] = estimates[T // 2, y, x, c]


@njit(cache=True, nogil=True)
def _range(first: int, last: int, estimates: Floats, residuals: Floats, low: Floats, high: Floats, top: int) -> None:
    """Write the least and the greatest finite value of the estimates and the samples of all frames."""
    infinite = np.float32(np.inf)
    for row in range(first, last):
        y = top + row
        least, most = low[y].reshape(-1), high[y].reshape(-1)
        least[:], most[:] = infinite, -infinite
        for t in range(len(estimates)):
            estimate, residual = estimates[t, y].reshape(-1), residuals[t, row].reshape(-1)
            # Choices and no branches, so that several values are computed at once.
            for i in range(len(least)):
                value = estimate[i]
                sample = value + residual[i]
                finite, whole = abs(value) < infinite, abs(sample) < infinite
                least[i] = value if finite and value < least[i] else least[i]
                most[i] = value if finite and value > most[i] else most[i]
                least[i] = sample if whole and sample < least[i] else least[i]
                most[i] = sample if whole and sample > most[i] else most[i]
