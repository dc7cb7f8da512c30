"""Transfer curves, each a forward and an inverse function."""

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hybrid.files.frame import Array
from loops.parallel import Doubles, Mask, Places, run_bands

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
# Share of an image's exposure that OIDN's measure leaves out as black. OIDN leaves out 1e-8 whatever the unit.
BLACK = 1e-8
MIDDLE_GRAY = 0.18  # OIDN's factor maps the geometric mean to it


def demodulate(radiance: Array, albedo: Array) -> Array:
    """Divide radiance by albedo, which leaves the light (irradiance, up to a constant) without the texture.

    ``radiance / (albedo + ALBEDO_FLOOR)`` (Bako et al. 2017, Kernel-Predicting Convolutional Networks, section 5.1,
    doi:10.1145/3072959.3073708); with the albedo's mean over channels where radiance has other than three.
    """
    return _with_divisor(_divide, radiance, albedo)


def remodulate(irradiance: Array, albedo: Array) -> Array:
    """Invert `demodulate`: multiply by ``albedo + ALBEDO_FLOOR``."""
    return _with_divisor(_multiply, irradiance, albedo)


def _with_divisor(loop: Callable[..., None], layer: Array, albedo: Array) -> Array:
    """Divide or multiply a layer (..., H, W, C) by the albedo plus the floor."""
    if layer.shape[-1] != albedo.shape[-1]:
        albedo = np.broadcast_to(albedo.mean(axis=-1, keepdims=True), (*albedo.shape[:2], layer.shape[-1]))
    height = len(albedo)
    result = np.empty(layer.shape, np.float32)
    given = np.ascontiguousarray(layer, np.float32), np.ascontiguousarray(albedo, np.float32)
    flat = given[0].reshape(-1, height, albedo[0].size), given[1].reshape(height, -1)
    run_bands(loop, height, *flat, result.reshape(flat[0].shape))
    return result


@njit(nogil=True, cache=True, error_model="numpy")
def _divide(first: int, last: int, layer: Array, albedo: Array, result: Array) -> None:
    floor, zero = np.float32(ALBEDO_FLOOR), np.float32(0)
    for t in range(len(layer)):
        for y in range(first, last):
            for i in range(albedo.shape[1]):
                result[t, y, i] = layer[t, y, i] / (max(albedo[y, i], zero) + floor)


@njit(nogil=True, cache=True, error_model="numpy")
def _multiply(first: int, last: int, layer: Array, albedo: Array, result: Array) -> None:
    floor, zero = np.float32(ALBEDO_FLOOR), np.float32(0)
    for t in range(len(layer)):
        for y in range(first, last):
            for i in range(albedo.shape[1]):
                result[t, y, i] = layer[t, y, i] * (max(albedo[y, i], zero) + floor)


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
    rows, columns = (_edges(size) for size in radiance.shape[:2])
    level = np.empty(radiance.shape[:2], np.float32)
    sums, counts = np.zeros((2, len(rows) - 1, len(columns) - 1))
    image = np.ascontiguousarray(radiance, np.float32)
    run_bands(_bin_levels, len(sums), image, rows, columns, level, sums, counts)
    means = np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)
    # Far below any surface next to the brightest lamp that a half float holds, and far above the residue of a denoiser
    # on black: the first guess needs no exposure.
    brightest = float(np.nanmax(means, initial=0.0))
    lit = means > max(1e-9 * brightest, NO_LIGHT)
    exposure = 0.0
    while lit.any():
        # Lamps, sky in a window and fireflies are few and bright; they must not decide the exposure.
        size = int(counts[lit].sum())
        bright = _find_greatest(level.view(np.uint32), rows, columns, lit, size // 100)
        limited = np.zeros_like(sums)
        run_bands(_bin_limited, len(sums), level, rows, columns, lit, np.uint32(bright).view(np.float32), limited)
        exposure = float(limited[lit].sum()) / size
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
    """Return the exposure of a picture (H, W, 3), or twice the geometric mean of what is lit, whichever is less.

    Beside a window over a third of a picture, its mean would hide errors of the room: the noise of the room then
    came through, 2 dB where the window has 100 times its light. In 38 of 40 rendered shots the first is less.
    """
    exposure = measure_exposure(picture)
    return min(exposure, 2 * MIDDLE_GRAY * exposure / autoexposure(picture, dark=DIM, exposure=exposure))


def autoexposure(radiance: Array, *, dark: float = BLACK, exposure: float = 1.0) -> float:
    """Return OIDN's factor of an image; ``autoexposure(a·x) = autoexposure(x) / a``; 1 without light.

    The radiance is divided by `exposure` first; bins of a luminance of at most `dark` are excluded.

    ``0.18 / 2^mean(log2 L)``, L the mean luminances above `dark` of bins of at most 16×16 pixels, as in OIDN's
    ``training/color.py``; `network.unet.autoexposure` is the same in torch.
    """
    rows, columns = (_edges(size) for size in radiance.shape[:2])
    means = np.empty((len(rows) - 1, len(columns) - 1))
    image = np.ascontiguousarray(radiance, np.float32)
    run_bands(_bin_luminances, len(means), image, np.float32(exposure), rows, columns, means)
    lit = means[means > dark]
    return float(MIDDLE_GRAY / np.exp2(np.log2(lit).mean())) if lit.size else 1.0


def _edges(length: int) -> Places:
    """Limits of bins of at most 16 pixels."""
    bins = max(-(-length // 16), 1)
    return np.asarray(np.arange(bins + 1) * length // bins, np.intp)


@njit(nogil=True, cache=True, error_model="numpy")
def _bin_levels(
    first: int, last: int, image: Array, rows: Places, columns: Places, level: Array, sums: Doubles, counts: Doubles
) -> None:
    """Write the mean over channels, NaN where it is not finite; in each bin the sum and number of finite means."""
    for row in range(first, last):
        for y in range(rows[row], rows[row + 1]):
            for column in range(sums.shape[1]):
                total, count = np.float64(0), 0
                for x in range(columns[column], columns[column + 1]):
                    value = np.float32(0)
                    for c in range(image.shape[2]):
                        value += image[y, x, c]
                    value /= np.float32(image.shape[2])
                    finite = np.isfinite(value)
                    level[y, x] = value if finite else np.float32(np.nan)
                    total += value if finite else np.float32(0)
                    count += finite
                sums[row, column] += total
                counts[row, column] += count


@njit(nogil=True, cache=True)
def _find_greatest(bits: NDArray[np.uint32], rows: Places, columns: Places, lit: Mask, rank: int) -> int:
    """Bits of the level of this rank, the greatest first, in the lit bins; NaN is left out."""
    # Two digits of 16 bits each, in an order of integers that is that of floats.
    prefix, left = np.uint32(0), rank
    for digit in range(2):
        counts = np.zeros(1 << 16, np.int64)
        for row in range(lit.shape[0]):
            for column in range(lit.shape[1]):
                if not lit[row, column]:
                    continue
                for y in range(rows[row], rows[row + 1]):
                    for x in range(columns[column], columns[column + 1]):
                        value = bits[y, x]
                        if value & np.uint32(0x7FFFFFFF) > np.uint32(0x7F800000):
                            continue
                        negative = value >> np.uint32(31)
                        key = value ^ (np.uint32(0xFFFFFFFF) if negative else np.uint32(0x80000000))
                        if digit == 0:
                            counts[key >> np.uint32(16)] += 1
                        elif key >> np.uint32(16) == prefix:
                            counts[key & np.uint32(0xFFFF)] += 1
        place = len(counts) - 1
        while place > 0 and left >= counts[place]:
            left -= counts[place]
            place -= 1
        prefix = np.uint32(prefix << np.uint32(16)) | np.uint32(place)
    return int(prefix ^ (np.uint32(0x80000000) if prefix >> np.uint32(31) else np.uint32(0xFFFFFFFF)))


@njit(nogil=True, cache=True)
def _bin_limited(
    first: int, last: int, level: Array, rows: Places, columns: Places, lit: Mask, limit: np.float32, sums: Doubles
) -> None:
    """Sum in each lit bin the levels, each up to the limit."""
    for row in range(first, last):
        for y in range(rows[row], rows[row + 1]):
            for column in range(lit.shape[1]):
                if lit[row, column]:
                    total = np.float64(0)
                    for x in range(columns[column], columns[column + 1]):
                        value = level[y, x]
                        total += min(value, limit) if value == value else np.float32(0)
                    sums[row, column] += total


@njit(nogil=True, cache=True, error_model="numpy")
def _bin_luminances(
    first: int, last: int, image: Array, exposure: np.float32, rows: Places, columns: Places, means: Doubles
) -> None:
    """Mean luminance of each bin, without values that are not finite; NaN for a bin without others."""
    zero = np.float32(0)
    for row in range(first, last):
        for column in range(means.shape[1]):
            total, count = np.float64(0), 0
            for y in range(rows[row], rows[row + 1]):
                for x in range(columns[column], columns[column + 1]):
                    # float64: no sum overflows
                    red, green, blue = image[y, x, 0] / exposure, image[y, x, 1] / exposure, image[y, x, 2] / exposure
                    # Written so that NaN remains.
                    red, green, blue = (
                        zero if red < zero else red, zero if green < zero else green, zero if blue < zero else blue
                    )  # fmt: skip
                    value = 0.212671 * red + 0.715160 * green + 0.072169 * blue
                    if np.isfinite(value):
                        total += value
                        count += 1
            means[row, column] = total / count if count else np.nan
