"""Samples of all frames of a window, pooled at the centre before denoising."""

from typing import NamedTuple

import numpy as np
from numba import njit

from loops.parallel import Floats, run_bands
from nlm.average import check_exposure, check_window

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
