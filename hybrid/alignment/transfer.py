"""Transfer curves, each a forward and an inverse function."""

import cv2
import numpy as np

from hybrid.files.frame import Array
from loops.parallel import Doubles, Mask, Places
from nlm.average import channel_mean

# Added to the albedo before dividing. Albedo is dimensionless and around 0.05 to 0.9. On black and on purely specular
# surfaces the quotient is the radiance times at most 1/floor, so the floor bounds how much brighter a neighbour's light
# gets across an edge between materials; KPCN's 0.00316 allows a factor of 300.
ALBEDO_FLOOR = 0.1
# Mean radiance that counts as no light: far below any render's, and 1e8 divided by it is still a float32.
NO_LIGHT = 1e-30
# Share of an image's exposure below which a part is not lit. Denoisers leave 1e-10 to 1e-4 on black next to an object;
# the darkest hundredth of a lit picture hardly changes its mean.
LIT = 1e-2
# The same for OIDN's curve: where a window makes the exposure 750 times that of the room, the room still counts. The
# networks otherwise see it as black, 1 to 4 dB worse than their first pass in place of 3 to 7 dB better. With 1e-4 the
# rim of a cut-out object loses 0.5 dB.
DIM = 1e-3
# Share of an image's exposure below which OIDN's measure excludes pixels as black. OIDN excludes 1e-8 in any unit.
BLACK = 1e-8
MIDDLE_GRAY = 0.18  # OIDN's factor maps the geometric mean to it


def demodulate(radiance: Array, albedo: Array) -> Array:
    """Divide radiance by albedo, which leaves the light (irradiance, up to a constant) without the texture.

    ``radiance / (albedo + ALBEDO_FLOOR)`` (Bako et al. 2017, Kernel-Predicting Convolutional Networks, section 5.1,
    doi:10.1145/3072959.3073708); with the albedo's mean over channels where radiance has other than three.
    """
    return np.asarray(radiance / _divisor(radiance, albedo), np.float32)


def remodulate(irradiance: Array, albedo: Array) -> Array:
    """Invert `demodulate`: multiply by ``albedo + ALBEDO_FLOOR``."""
    return np.asarray(irradiance * _divisor(irradiance, albedo), np.float32)


def _divisor(layer: Array, albedo: Array) -> Array:
    """The albedo plus the floor, with as many channels as a layer, or one."""
    if layer.shape[-1] != albedo.shape[-1]:
        albedo = albedo.mean(axis=-1, keepdims=True)
    return np.maximum(albedo, np.float32(0)) + np.float32(ALBEDO_FLOOR)


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


def measure_exposure(*images: Array) -> float:
    """Return the mean radiance of the lit part of an image (H, W, C), with its brightest hundredth clipped.

    The first of several images with light counts: what compares a black and a lit frame must not depend on the unit.
    Positive, and proportional to the image; 1 without an image of more light than `NO_LIGHT`. Non-finite values are
    excluded. The image is divided into bins of at most 16×16 pixels. A bin is lit where its mean exceeds `LIT` times
    the result, so that an object on black has the exposure of the object alone. Single pixels do not show whether a
    surface is lit: in noisy images many of its pixels are black.
    """
    return next((exposure for exposure in map(_mean_of_lit, images) if exposure > NO_LIGHT), 1.0)


def _mean_of_lit(radiance: Array) -> float:
    """The exposure of an image, 0 without light."""
    if radiance.size == 0:
        return 0.0
    level = channel_mean(radiance)
    finite = np.isfinite(level)
    means = _bin_means(level, finite)
    # Far below any surface next to the brightest lamp that a half float holds, and far above the residue of a denoiser
    # on black: the first guess needs no exposure.
    brightest = float(np.nanmax(means, initial=0.0))
    lit = means > max(1e-9 * brightest, NO_LIGHT)
    exposure = 0.0
    while lit.any():
        # Lamps, sky in a window and fireflies are few and bright; they must not decide the exposure.
        levels = level.reshape(-1) if lit.all() and finite.all() else level[finite & _in_bins(lit, level.shape)]
        place = len(levels) - 1 - len(levels) // 100
        exposure = float(np.minimum(levels, np.partition(levels, place)[place]).mean(dtype=np.float64))
        still_lit = lit & (means > LIT * exposure)
        if (still_lit == lit).all():
            break
        lit = still_lit
    return exposure


def measure_gain(picture: Array, dark: float = DIM) -> float:
    """Return a picture's (H, W, 3) factor before OIDN's transfer curve: `autoexposure` without tiny values on black.

    Bins of at most `dark` times the picture's exposure are excluded: ``measure_gain(a·x) = measure_gain(x) / a``.
    """
    exposure = measure_exposure(picture)
    return autoexposure(picture, dark=dark, exposure=exposure) / exposure


def measure_typical_exposure(picture: Array) -> float:
    """Return the exposure of a picture (H, W, 3), or twice the geometric mean of its lit part, if that is less.

    Beside a window over a third of a picture, its mean would hide errors of the room: the noise of the room then
    came through, 2 dB where the window has 100 times its light. In 38 of 40 rendered shots the first is less.
    """
    exposure = measure_exposure(picture)
    return min(exposure, 2 * MIDDLE_GRAY * exposure / autoexposure(picture, dark=DIM, exposure=exposure))


def autoexposure(radiance: Array, *, dark: float = BLACK, exposure: float = 1.0) -> float:
    """Return OIDN's factor of an image; ``autoexposure(a·x) = autoexposure(x) / a``; 1 without light.

    The radiance is divided by `exposure` first; bins of a luminance of at most `dark` are excluded.

    ``0.18 / 2^mean(log2 L)``, L the mean luminances above `dark` of bins of at most 16×16 pixels, as in OIDN's
    ``training/color.py``.
    """
    # The sum of the weights is below 1: none overflows.
    weights = np.array([[0.212671, 0.715160, 0.072169]], np.float32)
    luminance = cv2.transform(np.maximum(radiance, np.float32(0)), weights) / np.float32(exposure)
    means = _bin_means(luminance, np.isfinite(luminance))
    lit = means[means > dark]
    return float(MIDDLE_GRAY / np.exp2(np.log2(lit).mean())) if lit.size else 1.0


def _edges(length: int) -> Places:
    """Limits of bins of at most 16 pixels."""
    bins = max(-(-length // 16), 1)
    return np.asarray(np.arange(bins + 1) * length // bins, np.intp)


def _bin_means(layer: Array | Doubles, finite: Mask) -> Doubles:
    """Mean of the finite values of each bin of a layer (H, W), NaN for a bin without."""
    edges = [_edges(size) for size in layer.shape]

    def add(part: Array | Doubles | Mask, kind: type) -> Doubles:
        sums = np.add.reduceat(np.add.reduceat(part, edges[1][:-1], axis=1, dtype=kind), edges[0][:-1], axis=0)
        return np.asarray(sums, np.float64)

    if finite.all():
        return add(layer, np.float64) / np.outer(*map(np.diff, edges))
    sums, counts = add(np.where(finite, layer, 0), np.float64), add(finite, np.intp)
    return np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)


def _in_bins(lit: Mask, shape: tuple[int, ...]) -> Mask:
    """The pixels (H, W) of some bins."""
    rows, columns = (np.diff(_edges(size)) for size in shape)
    return np.repeat(np.repeat(lit, rows, axis=0), columns, axis=1)
