"""Transfer curves, each a forward and an inverse function."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

# Added to the albedo before dividing. Albedo is dimensionless and around 0.05 to 0.9. On black and on purely specular
# surfaces the quotient is the radiance times at most 1/floor, so the floor bounds how much brighter a neighbour's light
# gets across an edge between materials; KPCN's 0.00316 allows a factor of 300.
ALBEDO_FLOOR = 0.1
# Mean radiance that counts as no light: far below any render's, and 1e8 divided by it is still a float32.
NO_LIGHT = 1e-30
# Share of an image's exposure below which a part is not lit. Denoisers leave 1e-10 to 1e-4 on black next to an object;
# the darkest hundredth of a lit picture hardly changes its mean.
LIT = 1e-2


def demodulate(radiance: Array, albedo: Array) -> Array:
    """Divide radiance by albedo, which leaves the light (irradiance, up to a constant) without the texture.

    ``radiance / (albedo + ALBEDO_FLOOR)`` (Bako et al. 2017, Kernel-Predicting Convolutional Networks, section 5.1,
    doi:10.1145/3072959.3073708); with the albedo's mean over channels where radiance has other than three.
    """
    return radiance / _divisor(albedo, radiance.shape[-1])


def remodulate(irradiance: Array, albedo: Array) -> Array:
    """Invert `demodulate`: multiply by ``albedo + ALBEDO_FLOOR``."""
    return irradiance * _divisor(albedo, irradiance.shape[-1])


def _divisor(albedo: Array, channels: int) -> Array:
    if channels != albedo.shape[-1]:
        albedo = albedo.mean(axis=-1, keepdims=True)
    return np.maximum(albedo, 0) + np.float32(ALBEDO_FLOOR)


def compress(radiance: Array, exposure: float) -> Array:
    """Map [0, inf) to [0, 1), the exposure to 1/2; negative values count as 0.

    ``x / (1 + x)`` with ``x = radiance / exposure``; Reinhard et al. 2002, doi:10.1145/566654.566575, eq. 3.
    """
    light = np.asarray(np.maximum(radiance, 0), np.float32)
    # Not x / (1 + x): a spark over next to no exposure would be infinite.
    return light / (light + np.float32(exposure))


def expand(compressed: Array, exposure: float) -> Array:
    """Invert `compress`."""
    return compressed / (1 - compressed) * np.float32(exposure)


def measure_exposure(radiance: Array) -> float:
    """Return the mean radiance of the lit part of an image (H, W, C), with its brightest hundredth clipped.

    Positive, and proportional to the image; 1 for an image with less light than `NO_LIGHT`. Non-finite values are
    excluded. The image is divided into bins of at most 16×16 pixels. A bin is lit where its mean exceeds `LIT` times
    the result, so that an object on black has the exposure of the object alone. Single pixels do not show whether a
    surface is lit: in noisy images many of its pixels are black.
    """
    if radiance.size == 0:
        return 1.0
    level = np.einsum("...c->...", radiance, dtype=np.float32) / np.float32(radiance.shape[-1])
    level = np.where(np.isfinite(level), level, np.float32(np.nan))
    means = _bin_means(level)
    # Far below any surface next to the brightest lamp that a half float holds, and far above the residue of a denoiser
    # on black: the first guess needs no exposure.
    brightest = float(np.nanmax(means, initial=0.0))
    lit = means > max(1e-9 * brightest, NO_LIGHT)
    exposure = 0.0
    while lit.any():
        # Lamps, sky in a window and fireflies are few and bright; they must not decide the exposure.
        inside = level[_spread(lit, level.shape)]
        inside = inside[np.isfinite(inside)]
        bright = np.partition(inside, -1 - inside.size // 100)[-1 - inside.size // 100]
        exposure = float(np.minimum(inside, bright).mean(dtype=np.float64))
        still_lit = lit & (means > LIT * exposure)
        if (still_lit == lit).all():
            break
        lit = still_lit
    return exposure if exposure > NO_LIGHT else 1.0


def measure_gain(picture: Array) -> float:
    """Return the factor of a denoised picture (H, W, 3) before OIDN's transfer curve: `autoexposure` of its lit part.

    ``measure_gain(a·x) = measure_gain(x) / a``. Denoisers leave tiny values on black, which are no light.
    """
    exposure = measure_exposure(picture)
    return autoexposure(picture / np.float32(exposure), dark=LIT) / exposure


def autoexposure(radiance: Array, *, dark: float = 1e-8) -> float:
    """Return OIDN's factor of an image; ``autoexposure(a·x) = autoexposure(x) / a``; 1 without light.

    ``0.18 / 2^mean(log2 L)``, L the mean luminances above `dark` of bins of at most 16×16 pixels, as in OIDN's
    ``training/color.py``; `network.unet.autoexposure` is the same in torch.
    """
    # float64: no sum overflows
    means = _bin_means(np.maximum(radiance, 0) @ np.array([0.212671, 0.715160, 0.072169]))
    lit = means[means > dark]
    return float(0.18 / np.exp2(np.log2(lit).mean())) if lit.size else 1.0


def _edges(length: int) -> NDArray[np.intp]:
    """Limits of bins of at most 16 pixels."""
    bins = max(-(-length // 16), 1)
    return np.asarray(np.arange(bins + 1) * length // bins, np.intp)


def _bin_means(level: NDArray[np.floating]) -> NDArray[np.float64]:
    """Means over bins of at most 16×16 pixels, without NaN; NaN for a bin without other values."""
    known = np.isfinite(level)
    sums, counts = np.where(known, level, 0).astype(np.float64), known.astype(np.float64)
    for axis in (0, 1):
        first = _edges(level.shape[axis])[:-1]
        sums, counts = (np.add.reduceat(part, first, axis=axis) for part in (sums, counts))
    return np.asarray(np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0), np.float64)


def _spread(bins: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Repeat the value of each bin over its pixels."""
    for axis in (0, 1):
        bins = np.repeat(bins, np.diff(_edges(shape[axis])), axis=axis)
    return bins
