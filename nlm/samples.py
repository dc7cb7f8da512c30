"""Corrections of a denoised picture by samples, where the noise of samples is smaller than the denoiser's error.

A denoiser errs by more than the noise where there is next to no noise, or where it takes detail for noise. The samples
of a window show where, as samples of one frame are independent of those of another.
"""

from collections.abc import Iterable, Sequence
from functools import reduce
from typing import NamedTuple, Self

import cv2
import numpy as np
from numba import njit

from loops.parallel import Floats, Mask, run_bands
from nlm.average import channel_mean, check_colors, check_strip, check_window
from nlm.cells import Axis, between_cells, cell_axis, cell_means
from nlm.pooling import RESIDUAL_LIMIT as _LIMIT
from nlm.variance import WARPED, gaussian_mean, ratio, spatial_variance

# Deviations of its own noise that are subtracted from the detail that frames share. At 1, noise that looks like detail
# costs up to 1.3 dB of a rendered shot at 8 samples.
_DEVIATIONS = 2.5
# Deviations of the estimate of that noise: at 0, places where no frame has a bright sample became dimples in a wall
# at 8 samples. No shot at 8 or 512 samples changes by more than 0.04 dB, and the steadiest gains 0.3 dB in time.
_SCATTER = 2.0
# The squared error of the picture counts as far as it exceeds the variance of the samples by 4 deviations: a shot at 58
# to 64 dB gains 0.9 and 2.6 dB at 128 and 512 samples, and no shot at 8 to 512 samples loses 0.05 dB. With 2 the same
# gains 1.3 and 3.1 dB, and another shot loses 0.5 dB at 32 samples.
_UNSURE = 4.0
# Where no neighbour is trusted, the noise counts this many times: no frame denoised alone, at 8 to 512 samples, then
# loses 0.01 dB; at 1 one loses 0.4.
_ALONE = 1.5
# If at least 80 % of the lit pixels are trusted, the variance of the others is capped at twice the largest trusted one:
# otherwise one-pixel detail at rims that no neighbour shows is mistaken for noise. This holds for noise of a few
# hundredths: where it is greater, a place may have ten times that of all others (0.5 dB of the last frame of a shot at
# 8 samples). Bounds by what is trusted nearby cost a shot of hair and glass 0.9 dB.
_MOSTLY, _GREATEST, _SMALL = 0.8, np.float32(2), np.float32(0.003)
# Deviation, pixels, of the Gaussian that averages errors and variances: over 200 pixels. Over fewer, noise of few
# bright samples exceeds its own variance.
_SIGMA = 4.0
_PIXELS = np.float32(4 * np.pi * _SIGMA**2)
# Errors are relative to the light: the picture's mean over σ = 2 pixels plus this share of the exposure, as the eye
# sees an error in the dark by its size, and not by its ratio.
_DARK = 0.3
# (deviation in pixels, k, f, bins) of the Gaussians over which means are restored, where the square of a mean exceeds
# k (1 + (f / N)²) times its variance, N the number of samples that make the noise: a variance from a few bright samples
# is unknown itself. Without f a shot at 54 dB lost 2 dB to five fireflies; with f no shot at 8 to 512 samples loses
# 0.1. f / N in place of its square loses more of the light that a thousand samples measure.
_MEANS = (48.0, 1.0, 800.0, 1), (12.0, 7.0, 300.0, 1), (48.0, 4.0, 1000.0, 4)
# Stops of light in a bin: darkness beside bright places has a mean of its own. Noise that is left in a picture
# correlates its light with the samples: with bins of 2 stops the classical chain loses 0.44 dB of a shot at 8 samples,
# with 6 it loses 0.04.
_STOPS = np.float32(6)
# Samples that make the noise of the whole picture, without which its mean is not known: two pictures in which 30 to 60
# bright ones do at 512 samples lose 0.1 and 1.5 dB by a mean of their own variance.
_FEWEST = 60
# Limit of the distance of a sample from the picture when means are compared, in units of the light. Limits of 20 to 200
# restore the mean equally well; 6 leaves 1 % where lamps are small.
FAR = np.float32(20)
# This share of the surrounding mean is added to the light: black pixels have noise too.
_SOFT = 0.05
# Light beyond so many exposures is a highlight, and does not count in the mean of its surroundings.
_LAMP = 4.0
# Beyond so many, what a denoiser gets wrong of it is more than the light of all pixels beside it.
_GLARE = 64.0
# Least weight of a frame with the centre's geometry and other light.
_OTHER_LIGHT = 0.02
# The variance of a sample is estimated as its second least squared distance from N others, times 0.33 N − 0.28: exact
# for Gaussian noise that all channels share, too large for other noise. By the least distance, a bright sample that one
# of six frames repeats by chance counts as light without noise: a sparkle, 0.13 dB of a shot.
_SECOND, _FEW = 0.33, 0.28
# Deviation, pixels, of the Gaussian over which the ratio of the centre's light to the neighbours' is fitted for the
# variance. The fit over 20 pixels removes a twentieth of the noise; `_LEFT` is the share that remains. Over 4 pixels
# light that changes by 2 % a frame passes for 3 % of noise at a rim that one neighbour shows.
_LIGHT = 1.25
_LEFT = np.float32(1 - 1 / (4 * np.pi * _LIGHT**2))
# Greatest factor between the light of neighbours and the centre's: where half of a picture fades by 0.6 a frame it is
# 2.1, and with 2 the first frame lost 1.6 dB at 1 % of noise. Rare samples that only neighbours have exceed it: with
# 2.5 a place of a wall without any became 70 % too bright, and with 4 a shot at 8 samples loses 0.05 dB.
_RELIT = np.float32(2.25)
# Cells per deviation of a mean.
_CELLS = 4
_WARPED = np.float32(WARPED)


class SampleMean(NamedTuple):
    """Samples of neighbouring frames, averaged at the pixels of a frame."""

    mean: Floats  # (H, W, 3) radiance; 0 where no frame is trusted
    frames: Floats  # (H, W) frames' worth of samples, (Σ c)² / Σ c², c the confidence; 0 where no frame is trusted
    trust: Floats  # (H, W) in [0, 1]: 1 where the confidence of all frames adds up to 1
    nearest: Floats  # (H, W) variance of the centre, summed over channels, by the second nearest neighbour

    @classmethod
    def unknown(cls, shape: tuple[int, ...]) -> Self:
        """No samples for a frame (H, W, 3): no neighbour is trusted."""
        return cls(np.zeros(shape, np.float32), *np.zeros((3, *shape[:2]), np.float32))


def average_neighbours(
    estimates: Floats,
    residuals: Iterable[tuple[int, Floats]] | None,
    confidence: Floats,
    geometry: Floats,
    modulation: Floats,
    noisy: Floats,
) -> SampleMean:
    """Average the samples of all frames of a window except the centre.

    Parameters
    ----------
    estimates : (T, H, W, 3) float32, denoised, aligned; with `residuals` None the noisy frames
    residuals : iterable of (int, (T, h, W, 3) float32), optional
        Noisy frame minus estimate, aligned, in strips of rows with the first row of each; together they are the frame.
    confidence, geometry : (T, H, W) float32
        Confidence, and confidence by geometry alone: frames that differ in light alone still measure the noise.
    modulation : (H, W, 3) float32, factor from the unit of the window to radiance
    noisy : (H, W, 3) float32, radiance of the centre as rendered
    """
    estimates, confidence = check_window(estimates, confidence, "confidence")
    check_colors(noisy, estimates)
    noisy = np.ascontiguousarray(noisy, np.float32)
    mean = SampleMean.unknown(estimates.shape[1:])
    for top, strip in [(0, estimates)] if residuals is None else residuals:
        check_strip(strip, estimates, top)
        given = estimates, np.ascontiguousarray(strip, np.float32), residuals is not None
        run_bands(_average, strip.shape[1], *given, confidence, geometry, modulation, noisy, mean, top)
    return mean


def blend_samples(
    picture: Floats,
    noisy: Floats,
    neighbours: SampleMean,
    exposure: float,
    variance: Floats | None = None,
    albedo: Floats | None = None,
) -> Floats:
    """Blend samples into a denoised picture where the picture is wrong beyond doubt.

    Returns (H, W, 3) float32, `noisy` where it has no noise, `picture` where the noise exceeds the difference of both.

    Parameters
    ----------
    picture : (H, W, 3) float32, denoised, finite
    noisy : (H, W, 3) float32, the frame as rendered, finite
    neighbours : SampleMean
    exposure : float
    variance : (H, W, 3) float32, optional, variance of `noisy` from the renderer, used where no neighbour is trusted
    albedo : (H, W, 3) float32, optional, at least 0, without noise

    Notes
    -----
    With p the picture, n the noisy frame and m the mean of the neighbours, times K[n m] / K[m²] as the light may have
    changed (over 20 pixels in v), all relative to the light, and K a Gaussian mean, first p becomes p + β (m − p),

        β = (K[(n − p)(m − p)] − 2.5 e) / K[(m − p)²],    e² = (K[q] + 2 √(K[q²] / N)) / N,    q = ((n − m)(m − p))²,

    clamped to [0, 1]: the noise of n and that of m are independent, so that only differences from p that both show
    count. Then p becomes p + w (n − p), the shrinkage of James and Stein: with d = (n − p)², N = 4πσ² the pixels of K,

        w = max(0, 1 − (1 + 4 √(K[d²] / N (K d)²)) v / K d),    v = min(K[(n − m)² / (1 + 0.7 / frames)], K[s], r).

    s is `SampleMean.nearest`: lights that pass over a neighbour are no noise of the centre. r is `spatial_variance`.
    Along outlines, where pictures err most, (n − m)² holds the error of the alignment and is up to 30 times the noise.
    Where neighbours are not trusted v is the renderer's variance, or else 1.5 r, and if four fifths of what is lit
    are trusted at most 2 g (1 + g / 0.003), g the greatest v there.

    References
    ----------
    Firmino, Frisvad and Jensen, Progressive Denoising of Monte Carlo Rendered Images, 2022, doi:10.1111/cgf.14454
    """
    if not (*picture.shape[:2], 3) == picture.shape == noisy.shape == neighbours.mean.shape:
        raise ValueError(f"noisy: expected shape {picture.shape} like the picture, got {noisy.shape}")
    picture, noisy = (np.ascontiguousarray(image, np.float32) for image in (picture, noisy))
    # Radiance per unit of relative error.
    light = _light_around(picture, noisy, neighbours.mean, exposure) + np.float32(_DARK * exposure)
    rate, height = np.divide(1, light, out=np.zeros_like(light), where=light > 0), len(picture)
    factor, near = _relative_light(noisy, neighbours, rate)
    sums = tuple(np.zeros_like(light) for _ in range(5))
    run_bands(_compare, height, picture, noisy, neighbours, factor, near, rate, sums)
    together, squares, products, temporal, nearest = sums
    del light, near, sums  # frames are large
    # Where no bright sample is near, the noise is greater than it seems: by two deviations of its own estimate.
    scatter = np.sqrt(gaussian_mean(np.square(products), _SIGMA) / _PIXELS)
    noise = (gaussian_mean(products, _SIGMA) + np.float32(_SCATTER) * scatter) / _PIXELS
    means = gaussian_mean(together, _SIGMA), gaussian_mean(squares, _SIGMA), noise
    del together, squares, products, scatter, noise
    blended, error = np.empty_like(picture), np.empty_like(rate)
    run_bands(_blend_shared, height, picture, noisy, neighbours, factor, rate, means, blended, error)
    del means, factor
    around, nearest = gaussian_mean(temporal, _SIGMA), gaussian_mean(nearest, _SIGMA)
    temporal *= np.divide(np.minimum(nearest, around), around, out=np.ones_like(around), where=around > 0)
    del around, nearest
    spatial = spatial_variance(noisy, blended, rate, _SIGMA, albedo)
    if variance is None:
        alone = np.float32(_ALONE) * spatial
        red, green, blue = np.moveaxis(noisy != 0, -1, 0)
        lit = red | green | blue  # `any` over the last axis takes ten times as long
        sure = lit & (neighbours.trust >= 1)
        if sure.any() and np.count_nonzero(sure) >= _MOSTLY * np.count_nonzero(lit):
            greatest = gaussian_mean(neighbours.trust * temporal, _SIGMA)[sure].max()
            alone = np.minimum(alone, _GREATEST * greatest * (1 + greatest / _SMALL))
    else:
        alone = np.asarray(variance.sum(axis=-1) * np.square(rate), np.float32)
    # Spatial as far as no neighbour is trusted; at 1 the sum would round.
    mixed = alone + neighbours.trust * (temporal - alone)
    np.copyto(mixed, temporal, where=neighbours.trust >= 1)
    np.minimum(mixed, 3 * _LIMIT * _LIMIT, out=mixed)
    fourth = gaussian_mean(np.square(error), _SIGMA)
    certainty = gaussian_mean(error, _SIGMA), fourth, gaussian_mean(mixed, _SIGMA)
    run_bands(_blend_centre, height, noisy, certainty, spatial, neighbours.trust, blended)
    return blended


def _light_around(picture: Floats, noisy: Floats, others: Floats, exposure: float) -> Floats:
    """Mean light of a picture (H, W) over σ = 2 pixels, and of lamps beyond 64 exposures their own.

    Errors beside a lamp are not divided by the lamp's light. A denoiser may turn such pixels into lamps, so no lamp
    counts as brighter than the samples of the frame or of others. With the frame's samples alone, weights were greatest
    where their noise was dark, and a lamp lost 17 %.
    """
    level, bright = channel_mean(picture), np.float32(_GLARE * exposure)
    samples = np.maximum(channel_mean(noisy), channel_mean(others))
    level = np.where(level > bright, np.minimum(level, samples), level)
    lamp = level > bright
    around, counted = (gaussian_mean(np.where(lamp, np.float32(0), part), 2.0) for part in (level, np.float32(1)))
    return np.where(lamp, level, ratio(around, counted))


def _relative_light(noisy: Floats, neighbours: SampleMean, rate: Floats) -> list[Floats]:
    """Light of a frame over the light of its neighbours (H, W), by least squares around each pixel, over two sizes."""
    weight = rate * neighbours.trust
    near = rate[..., None] * neighbours.mean  # the square of the rate may overflow
    products = [weight * np.einsum("yxc,yxc->yx", layer, near) for layer in (noisy, neighbours.mean)]
    factors = []
    for sigma in (_SIGMA, _LIGHT):
        together, alone = (gaussian_mean(product, sigma) for product in products)
        factors.append(
            np.clip(np.divide(together, alone, out=np.ones_like(alone), where=alone > 0), 1 / _RELIT, _RELIT)
        )
    return factors


def beside_lamps(picture: Floats, exposure: float) -> Mask:
    """Return the pixels (H, W) within two of a light that a picture shows beyond 64 exposures."""
    lamp = (channel_mean(picture) > _GLARE * exposure).astype(np.uint8)
    return np.asarray(cv2.dilate(lamp, np.ones((5, 5), np.uint8)) > 0)


def limit_lamps(picture: Floats, samples: Sequence[Floats], exposure: float) -> Floats:
    """Clamp light beyond four exposures (H, W, 3), in each channel, to the brightest of the samples within two pixels.

    A denoiser makes up to three times the light of a lamp of 10,000 exposures, which no mean of few samples corrects.
    """
    light = channel_mean(picture)
    lamp = (light > _LAMP * exposure) & np.isfinite(light)  # what is not finite is refused, and not mended
    if not lamp.any():
        return picture
    brightest = cv2.dilate(reduce(np.maximum, samples), np.ones((5, 5), np.uint8))
    limited = np.minimum(picture, np.maximum(brightest, np.float32(_LAMP * exposure)))
    return np.where(lamp[..., None], limited, picture)


def restore_mean(picture: Floats, noisy: Floats, exposure: float) -> Floats:
    """Give a denoised picture the local means of the samples, as far as these are known.

    Returns (H, W, 3) float32, nowhere below 0 where the picture is not.

    Parameters
    ----------
    picture : (H, W, 3) float32, denoised, finite
    noisy : (H, W, 3) float32, the frame as rendered, fireflies included, finite: right in the mean
    exposure : float

    Notes
    -----
    With K a Gaussian mean, a that of the picture in the mean over channels (highlights count as at most
    four exposures), l the picture plus 5 % of a and 0.1 % of the exposure, u = 1 / max(l, a) and d = u (noisy −
    picture), of noisy − picture at most 20 l, the picture becomes picture + s l D / K(u l),

        s = max(0, 1 − k (1 + (f / N)²) v / D²),    v = K[d²] / n,    N = n K[d²]² / K[d⁴],

    D is K d, moved towards 0 by up to the mean light that the limit cut off: without its brightest samples a mean is
    too dark. All in the mean over channels, n the pixels of K: the shrinkage of James and Stein. N counts the samples
    that make the noise: five fireflies determine neither a mean nor its variance. The weight u keeps the light of all
    pixels but those much brighter than their surroundings, which count by their relative error: a lamp that is too
    bright darkens nothing around it. The means over σ = 48 pixels come first (k = 1, f = 800), then those over 12 (7,
    300), and then those over 48 (4, 1000) of pixels of similar light: K is then over each of 4 bins of six stops, a =
    0, and a pixel counts in the two bins next to it. Last, with K the mean of the whole picture and u one over the
    mean, the picture becomes (1 + s D w / K(w u l)) picture, w = u l / (u l + 1), s = max(0, 1 − v / D² − (60 / N)²):
    right in the relative light, a picture of too little contrast is too dark where it is bright.
    """
    picture, noisy = (np.ascontiguousarray(image, np.float32) for image in (picture, noisy))
    for sigma, certain, few, bins in _MEANS:
        # Cells of σ / 4 pixels blur nothing that a Gaussian mean keeps.
        side = max(int(sigma / _CELLS), 1)
        rows, columns = (cell_axis(length, side) for length in picture.shape[:2])
        dark, light = np.float32(1e-3 * exposure), np.maximum(channel_mean(picture), 0)
        place = level = np.zeros_like(light)
        if bins == 1:
            lit = np.minimum(light, np.float32(_LAMP * exposure))
            level = between_cells(gaussian_mean(cell_means(lit, rows, columns), sigma / side), rows, columns)
        light += np.float32(_SOFT) * level
        light += dark
        if bins > 1:
            place = np.minimum(np.log2(np.maximum(light / dark, 1)) / _STOPS, np.float32(bins - 1))
        weight = 1 / np.maximum(light, level)
        sums = np.zeros((7 * bins, len(rows.pixels) // side, len(columns.pixels) // side), np.float32)
        given = picture, noisy, light, weight, place
        run_bands(_sum_differences, sums.shape[1], *given, rows, columns, side, sums)
        means = np.stack([gaussian_mean(part / np.float32(side**2), sigma / side) for part in sums])
        # As many pixels as a Gaussian averages, 1 / Σ weight², and no more than there are.
        pixels = np.float32(min(4 * np.pi * sigma**2, picture.shape[0] * picture.shape[1]))
        changes = _known_changes(means.reshape(bins, 7, *sums.shape[1:]), pixels, np.float32(certain), np.float32(few))
        if not changes.any():
            continue
        restored = np.empty_like(picture)
        run_bands(_restore, len(picture), picture, changes, light, place, rows, columns, restored)
        picture = restored
    return _with_mean(picture, channel_mean(picture), channel_mean(noisy), np.float32(1e-3 * exposure))


def _with_mean(picture: Floats, light: Floats, noisy: Floats, dark: np.float32) -> Floats:
    """Give a picture of a light (H, W) the mean of the whole frame's samples, as far as it is known."""
    mean, reach = light.mean(dtype=np.float64), FAR * (light + dark)
    if not mean > 0:
        return picture
    difference = noisy - light
    counted = np.clip(difference, -reach, reach) / np.float32(mean)
    change, cut = counted.mean(dtype=np.float64), difference.mean(dtype=np.float64) / mean
    cut -= change
    change += np.clip(-change, min(cut, 0), max(cut, 0))
    squares = np.square(counted, out=counted)
    noise = squares.mean(dtype=np.float64)
    if not (change and noise):
        return picture
    samples = squares.size / np.square(squares / np.float32(noise)).mean(dtype=np.float64)
    share = max(0, 1 - noise / squares.size / change**2 - (_FEWEST / samples) ** 2)
    if not share:
        return picture
    bright = np.maximum(light, 0)
    bright /= bright + np.float32(mean)
    factor = np.float32(share * change * mean / np.mean(bright * light, dtype=np.float64)) * bright
    return np.asarray(picture * (1 + factor)[..., None])


def _known_changes(sums: Floats, pixels: np.float32, certain: np.float32, few: np.float32) -> Floats:
    """Known relative changes of three channels, from the means of each bin (bins, 7, rows, columns)."""
    lit, noise, fourth, cut = sums[:, 0], sums[:, 4], sums[:, 5], sums[:, 6:]
    differences = sums[:, 1:4] + np.clip(-sums[:, 1:4], np.minimum(cut, 0), np.maximum(cut, 0))
    known = np.square(differences).mean(axis=1)
    unsure = certain * (np.float32(1) + np.square(few * ratio(fourth, pixels * np.square(noise))))
    share = np.clip(np.float32(1) - ratio(unsure * noise / pixels, known), 0, 1)
    return np.asarray((differences * ratio(share, lit)[:, None]).reshape(-1, *lit.shape[1:]), np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_differences(
    first: int, last: int, picture: Floats, noisy: Floats, light: Floats, weight: Floats, place: Floats, rows: Axis,
    columns: Axis, side: int, sums: Floats,
) -> None:  # fmt: skip
    """Sum over cells, for each bin: weight × light, differences of three channels, square, square², and what is cut.

    `place` is that of a pixel among the bins: 1.25 for a quarter in the third, and the rest in the second.
    """
    bins = len(sums) // 7
    cells = np.empty((sums.shape[2], len(sums)), np.float32)
    for row in range(first, last):
        cells[:] = 0
        for y in rows.pixels[row * side : (row + 1) * side]:
            for column in range(sums.shape[2]):
                for x in columns.pixels[column * side : (column + 1) * side]:
                    scale, reach = weight[y, x], FAR * light[y, x]
                    red = noisy[y, x, 0] - picture[y, x, 0]
                    green = noisy[y, x, 1] - picture[y, x, 1]
                    blue = noisy[y, x, 2] - picture[y, x, 2]
                    r = scale * min(max(red, -reach), reach)
                    g = scale * min(max(green, -reach), reach)
                    b = scale * min(max(blue, -reach), reach)
                    cut = (scale * (red + green + blue) - (r + g + b)) / np.float32(3)
                    power = (r * r + g * g + b * b) / np.float32(3)
                    below = min(int(place[y, x]), max(bins - 2, 0))
                    above = np.float32(place[y, x] - below)
                    for near in range(min(bins, 2)):
                        share = above if near else np.float32(1) - above
                        cell = cells[column, 7 * (below + near) :]
                        cell[0] += share * scale * light[y, x]
                        cell[1] += share * r
                        cell[2] += share * g
                        cell[3] += share * b
                        cell[4] += share * power
                        cell[5] += share * (power * power)
                        cell[6] += share * cut
        # Not `cells.T` at once: numba would compile the text of an error about shapes, for two seconds.
        for plane in range(cells.shape[1]):
            for column in range(len(cells)):
                sums[plane, row, column] = cells[column, plane]


@njit(cache=True, nogil=True, error_model="numpy")
def _restore(
    first: int, last: int, picture: Floats, changes: Floats, light: Floats, place: Floats, rows: Axis, columns: Axis,
    restored: Floats,
) -> None:  # fmt: skip
    """Add the known relative changes, of three channels for each bin, to a picture."""
    zero, bins, width = np.float32(0), len(changes) // 3, changes.shape[2]
    blended = np.empty((len(changes), width), np.float32)
    for y in range(first, last):
        above, below, down = rows.before[y], rows.after[y], rows.share[y]
        for k in range(len(changes)):
            for column in range(width):
                upper = changes[k, above, column]
                blended[k, column] = upper + down * (changes[k, below, column] - upper)
        for x in range(picture.shape[1]):
            before, after, across = columns.before[x], columns.after[x], columns.share[x]
            low = min(int(place[y, x]), max(bins - 2, 0))
            share = np.float32(place[y, x] - low)
            for c in range(3):
                k = 3 * low + c
                change = blended[k, before] + across * (blended[k, after] - blended[k, before])
                if share > zero:
                    other = blended[k + 3, before]
                    change += share * (other + across * (blended[k + 3, after] - other) - change)
                restored[y, x, c] = max(picture[y, x, c] + light[y, x] * change, min(picture[y, x, c], zero))


@njit(cache=True, nogil=True, error_model="numpy")
def _average(
    first: int, last: int, estimates: Floats, residuals: Floats, add: bool, confidence: Floats, geometry: Floats,
    modulation: Floats, noisy: Floats, out: SampleMean, top: int,
) -> None:  # fmt: skip
    mean, frames, trust, nearest = out
    T, _, W, _ = estimates.shape
    for row in range(first, last):
        y = top + row
        for x in range(W):
            total, squares = np.float64(0), np.float64(0)  # the square of a small confidence must not vanish
            greatest, count = np.float32(0), 0
            least, second = np.float32(np.inf), np.float32(np.inf)
            for t in range(T):
                weight = max(confidence[t, y, x], np.float32(_OTHER_LIGHT) * geometry[t, y, x])
                greatest += max(confidence[t, y, x], geometry[t, y, x])
                if t == T // 2 or not weight > 0:
                    continue
                level = np.float32(0)
                for c in range(3):
                    level += estimates[t, y, x, c] + (residuals[t, row, x, c] if add else np.float32(0))
                if not np.isfinite(level):
                    continue
                total += weight
                squares += np.float64(weight) ** 2
                distance = np.float32(0)
                for c in range(3):
                    value = estimates[t, y, x, c] + (residuals[t, row, x, c] if add else np.float32(0))
                    value *= modulation[y, x, c]
                    mean[y, x, c] += weight * value
                    distance += (noisy[y, x, c] - value) ** 2
                count += 1
                least, second = min(least, distance), min(max(least, distance), second)
            if total > 0:
                frames[y, x] = total * total / squares
                nearest[y, x] = second * np.float32(_SECOND * count - _FEW) if count > 1 else least / (1 + _WARPED)
                centre = max(confidence[T // 2, y, x], geometry[T // 2, y, x])
                trust[y, x] = min(greatest - centre, np.float32(1))
                for c in range(3):
                    mean[y, x, c] /= np.float32(total)


@njit(cache=True, nogil=True, error_model="numpy")
def _compare(
    first: int, last: int, picture: Floats, noisy: Floats, neighbours: SampleMean, factor: Floats, near: Floats,
    rate: Floats, sums: tuple[Floats, ...],
) -> None:  # fmt: skip
    """Sum over channels, where neighbours are trusted: (n − p)(m − p), (m − p)², ((n − m)(m − p))², two variances."""
    W = picture.shape[1]
    together, squares, products, temporal, nearest = sums
    for y in range(first, last):
        for x in range(W):
            if not neighbours.trust[y, x] > 0:
                continue
            scale, product = rate[y, x], np.float32(0)
            for c in range(3):
                n, m, p = noisy[y, x, c], neighbours.mean[y, x, c] * factor[y, x], picture[y, x, c]
                n_p = min(max(scale * (n - p), -_LIMIT), _LIMIT)
                m_p = min(max(scale * (m - p), -_LIMIT), _LIMIT)
                n_m = min(max(scale * (n - m), -_LIMIT), _LIMIT)
                together[y, x] += n_p * m_p
                squares[y, x] += m_p * m_p
                product += n_m * m_p
                n_m = scale * (n - neighbours.mean[y, x, c] * near[y, x])
                n_m = min(max(n_m, -_LIMIT), _LIMIT)
                temporal[y, x] += n_m * n_m / (_LEFT * (1 + _WARPED / neighbours.frames[y, x]))
            nearest[y, x] = min(scale * neighbours.nearest[y, x] * scale, np.float32(3) * _LIMIT * _LIMIT)
            products[y, x] = product * product


@njit(cache=True, nogil=True, error_model="numpy")
def _blend_shared(
    first: int, last: int, picture: Floats, noisy: Floats, neighbours: SampleMean, factor: Floats, rate: Floats,
    means: tuple[Floats, Floats, Floats], blended: Floats, error: Floats,
) -> None:  # fmt: skip
    """Blend the neighbours' mean into a picture where both frames show the same difference.

    With the squared difference of the result from the samples, relative to the light.
    """
    together, squares, noise = means
    zero, one = np.float32(0), np.float32(1)
    for y in range(first, last):
        for x in range(picture.shape[1]):
            found = together[y, x] - np.float32(_DEVIATIONS) * np.sqrt(noise[y, x])
            share = found / squares[y, x] if squares[y, x] > zero else zero
            share = min(max(share, zero), one) * neighbours.trust[y, x]
            total = zero
            for c in range(3):
                own = picture[y, x, c]
                own += share * (neighbours.mean[y, x, c] * factor[y, x] - own)
                total += min(max((noisy[y, x, c] - own) * rate[y, x], -_LIMIT), _LIMIT) ** 2
                blended[y, x, c] = own
            error[y, x] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _blend_centre(
    first: int, last: int, noisy: Floats, means: tuple[Floats, Floats, Floats], spatial: Floats, trust: Floats,
    blended: Floats,
) -> None:  # fmt: skip
    """Blend the samples into a picture, in place, where it differs from them by more than their noise."""
    errors, fourths, variances = means
    zero, one, alone = np.float32(0), np.float32(1), np.float32(_ALONE)
    for y in range(first, last):
        for x in range(blended.shape[1]):
            error, noise, known = errors[y, x], variances[y, x], trust[y, x]
            if not error > zero:
                continue
            noise += known * (min(noise, spatial[y, x] * (alone + (one - alone) * known)) - noise)
            # Divided twice: the square of an error below 1e-19 would vanish.
            unsure = np.sqrt(fourths[y, x] / error / error / _PIXELS)
            share = min(max(one - (one + np.float32(_UNSURE) * unsure) * noise / error, zero), one)
            for c in range(3):
                blended[y, x, c] += share * (noisy[y, x, c] - blended[y, x, c])
