"""Transfer curves, each a forward and an inverse function."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

# Added to the albedo before dividing. Albedo is dimensionless and around 0.05 to 0.9. On black and on purely
# specular surfaces the quotient is the radiance times at most 1/floor, so the floor bounds how much brighter a
# neighbour's light can get by crossing an edge between materials; KPCN's 0.00316 allows a factor of 300.
ALBEDO_FLOOR = 0.1
# Mean radiance that counts as none: far below any render's, and a spark of 1e8 over it is still a float32.
NO_LIGHT = 1e-30


def demodulate(radiance: Array, albedo: Array) -> Array:
    """Divide radiance by albedo, which leaves the light (irradiance, up to a constant) without the texture.

    Parameters
    ----------
    radiance : (H, W, C) array
        Linear radiance, unbounded.
    albedo : (H, W, 3) array
        Reflectance, finite, >= 0. Its mean over channels is used where C is not 3.

    Returns
    -------
    (H, W, C) array
        ``radiance / (albedo + ALBEDO_FLOOR)``.

    References
    ----------
    Bako et al. 2017, Kernel-Predicting Convolutional Networks, section 5.1, doi:10.1145/3072959.3073708.
    """
    return radiance / _divisor(albedo, radiance.shape[-1])


def remodulate(irradiance: Array, albedo: Array) -> Array:
    """Inverse of `demodulate`: multiply by ``albedo + ALBEDO_FLOOR``.

    Parameters
    ----------
    irradiance : (H, W, C) array
        From `demodulate`.
    albedo : (H, W, 3) array
        In [0, 1]; its mean where C is not 3.

    Returns
    -------
    (H, W, C) array
        Linear radiance.
    """
    return irradiance * _divisor(albedo, irradiance.shape[-1])


def _divisor(albedo: Array, channels: int) -> Array:
    if channels != albedo.shape[-1]:
        albedo = albedo.mean(axis=-1, keepdims=True)
    return np.maximum(albedo, 0) + np.float32(ALBEDO_FLOOR)


def compress(radiance: Array, exposure: float) -> Array:
    """Map [0, inf) to [0, 1).

    Parameters
    ----------
    radiance : (...) array
        Linear radiance; negative values count as 0.
    exposure : float
        Radiance that becomes 1/2.

    Returns
    -------
    (...) array of float32
        In [0, 1): ``x / (1 + x)`` with ``x = radiance / exposure``.

    References
    ----------
    Reinhard et al. 2002, doi:10.1145/566654.566575, eq. 3
    """
    light = np.asarray(np.maximum(radiance, 0), np.float32)
    # Not x / (1 + x): a spark over next to no exposure would be infinite.
    return light / (light + np.float32(exposure))


def expand(compressed: Array, exposure: float) -> Array:
    """Inverse of `compress`.

    Parameters
    ----------
    compressed : (...) array
        In [0, 1), from `compress`.
    exposure : float
        The same.

    Returns
    -------
    (...) array
        Linear radiance.
    """
    return compressed / (1 - compressed) * np.float32(exposure)


def measure_exposure(radiance: Array) -> float:
    """Measure the brightness of an image: its mean without the brightest hundredth.

    Parameters
    ----------
    radiance : (..., C) array
        Linear radiance; values that are not finite are left out.

    Returns
    -------
    float
        Positive, and proportional to the image, so that what is divided by it does not depend on the image's
        scale. 1 for an image without light, or with less than `NO_LIGHT`.
    """
    level = np.einsum("...c->...", radiance).ravel() / np.float32(radiance.shape[-1])
    level = level[np.isfinite(level)]
    if level.size == 0:
        return 1.0
    # Lamps, sky seen through a window and fireflies are few and bright; they must not decide the exposure.
    bright = np.partition(level, -1 - level.size // 100)[-1 - level.size // 100]
    mean = float(np.minimum(level, bright).mean(dtype=np.float64))
    return mean if mean > NO_LIGHT else 1.0


def autoexposure(radiance: Array) -> float:
    """Factor that OIDN multiplies an image by, so that all of its parts can be given that of the whole.

    Parameters
    ----------
    radiance : (H, W, 3) array
        Linear radiance, finite; what is negative counts as 0.

    Returns
    -------
    float
        Positive; ``autoexposure(a·x) = autoexposure(x) / a``. 1 for an image without light.

    Notes
    -----
    ``0.18 / 2^mean(log2 L)``, L the mean luminances above 1e-8 of bins of at most 16×16 pixels, as in OIDN's
    ``training/color.py``; `network.trunk.autoexposure` is the same in torch.
    """
    luminance = np.maximum(radiance, 0) @ np.array([0.212671, 0.715160, 0.072169])  # float64: no sum overflows
    for axis in (0, 1):
        length = luminance.shape[axis]
        bins = -(-length // 16)
        edges = np.arange(bins + 1) * length // bins
        luminance = np.add.reduceat(luminance, edges[:-1], axis=axis)
        luminance /= np.diff(edges).reshape((-1, 1) if axis == 0 else (1, -1))
    lit = luminance[luminance > 1e-8]
    return float(0.18 / np.exp2(np.log2(lit).mean())) if lit.size else 1.0
