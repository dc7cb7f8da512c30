"""Corrections of a denoised picture by samples, where the noise of samples is smaller than the denoiser's error.

A denoiser errs by more than the noise where there is next to no noise, or where it takes detail for noise. The samples
of a window show where, as samples of one frame are independent of those of another.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from loops.parallel import run_bands
from nlm.average import check_window
from nlm.variance import gaussian_mean, ratio, second_differences

Floats = NDArray[np.float32]

# Deviations, and multiples of the variance, of its own noise that are subtracted from a correction. At 1, noise that
# looks like detail costs up to 1.3 dB of a rendered shot at 8 samples; at 2.5 no shot at 8 to 512 samples loses more
# than 0.03 dB.
_DEVIATIONS = 2.5
_VARIANCES = 2.5
# Without neighbours the noise comes from the spatial residual, which a renderer's pixel filter (σ = 1 pixel) makes up
# to 100 times too small.
_SPREAD = 300.0
# Deviations, pixels, of the Gaussians that average errors: over 200 pixels for detail that frames share, and over 50
# for detail of the centre alone.
_SIGMA_SHARED, _SIGMA_CENTRE = 4.0, 2.0
# Errors are relative to the light: the picture's mean over σ = 2 pixels plus this share of the exposure, as the eye
# sees an error in the dark by its size, and not by its ratio.
_DARK = 0.3
# A relative error counts up to this: a firefly must not decide for all pixels around it.
_LIMIT = np.float32(6)
# (deviation in pixels, k, f) of the Gaussians over which means are restored, where the square of a mean exceeds
# k (1 + f / N) times its variance, N the number of samples that make the noise: a variance from a few bright samples is
# unknown itself. Without f a shot at 54 dB lost 2 dB to five fireflies; with f no shot at 8 to 512 samples loses 0.1.
_MEANS = (48.0, 1.0, 3000.0), (12.0, 8.0, 300.0)
# Limit of the distance of a sample from the picture when means are compared, in units of the light. Limits of 20 to 200
# restore the mean equally well; 6 leaves 1 % where lamps are small.
_FAR = np.float32(20)
# This share of the surrounding mean is added to the light: black pixels have noise too.
_SOFT = 0.05
# Light beyond so many exposures is a highlight, and does not count in the mean of its surroundings.
_LAMP = 4.0
# Least weight of a frame with the centre's geometry and other light.
_OTHER_LIGHT = 0.02
# Cells per deviation of a mean.
_CELLS = 6
# Variance of a warped frame over that of a rendered one (`nlm.variance`).
_WARPED = np.float32(0.7)


class SampleMean(NamedTuple):
    """Samples of neighbouring frames, averaged at the pixels of a frame."""

    mean: Floats  # (H, W, 3) radiance; 0 where no frame is trusted
    frames: Floats  # (H, W) frames' worth of samples, (Σ c)² / Σ c², c the confidence; 0 where no frame is trusted
    trust: Floats  # (H, W) in [0, 1]: 1 where the confidence of all frames adds up to 1


def average_neighbours(
    estimates: Floats, residuals: Floats | None, confidence: Floats, geometry: Floats, modulation: Floats
) -> SampleMean:
    """Average the samples of all frames of a window except the centre.

    Parameters
    ----------
    estimates : (T, H, W, 3) float32
        Denoised, aligned; with `residuals` None the noisy frames.
    residuals : (T, H, W, 3) float32, optional, noisy frame minus estimate, aligned
    confidence, geometry : (T, H, W) float32
        Confidence, and confidence by geometry alone: frames that differ in light alone still measure the noise.
    modulation : (H, W, 3) float32, factor from the unit of the window to radiance
    """
    weight = np.maximum(confidence, np.float32(_OTHER_LIGHT) * geometry)
    estimates, weight = check_window(estimates, weight, "confidence")
    if residuals is not None and residuals.shape != estimates.shape:
        raise ValueError(f"residuals: expected shape {estimates.shape} like the estimates, got {residuals.shape}")
    mean, frames = np.zeros(estimates.shape[1:], np.float32), np.zeros(weight.shape[1:], np.float32)
    given = estimates, estimates if residuals is None else np.ascontiguousarray(residuals, np.float32)
    run_bands(_average, len(mean), *given, residuals is not None, weight, modulation, (mean, frames))
    middle = len(weight) // 2
    trust = np.minimum(np.maximum(confidence, geometry).sum(axis=0) - np.maximum(confidence, geometry)[middle], 1)
    return SampleMean(mean, frames, np.where(frames > 0, trust, 0))


def blend_samples(
    picture: Floats, noisy: Floats, neighbours: SampleMean, exposure: float, variance: Floats | None = None
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

    Notes
    -----
    With p the picture, n the noisy frame and m the mean of the neighbours, times K[n m] / K[m²] where the light has
    changed, all relative to the light, and K a Gaussian mean, first p becomes p + β (m − p),

        β = (K[(n − p)(m − p)] − 2.5 e) / K[(m − p)²],    e² = K[((n − m)(m − p))²] / 4πσ²,

    clamped to [0, 1]: the noise of n and that of m are independent, so that only differences from p that both show
    count. Then p becomes p + w (n − p), w = max(0, 1 − 2.5 K v / K (n − p)²), the shrinkage of James and Stein, with v
    = (n − m)² / (1 + 0.7 / frames). Where neighbours are not trusted v is the renderer's variance, or else 300 times
    `spatial_variance`.

    References
    ----------
    Firmino, Frisvad and Jensen, Progressive Denoising of Monte Carlo Rendered Images, 2022, doi:10.1111/cgf.14454
    """
    if not picture.shape == noisy.shape == neighbours.mean.shape:
        raise ValueError(f"noisy: expected shape {picture.shape} like the picture, got {noisy.shape}")
    # Radiance per unit of relative error.
    light = gaussian_mean(_gray(picture), 2.0) + np.float32(_DARK * exposure)
    rate = np.divide(1, light, out=np.zeros_like(light), where=light > 0)
    mean = neighbours.mean * _relative_light(noisy, neighbours, rate)[..., None]
    sums = np.zeros((4, *light.shape), np.float32)
    run_bands(_compare, len(light), picture, noisy, neighbours._replace(mean=mean), rate, sums)
    together, squares, products, temporal = sums
    # Over as many pixels as a Gaussian averages, 1 / Σ weight².
    noise = gaussian_mean(products, _SIGMA_SHARED) / np.float32(4 * np.pi * _SIGMA_SHARED**2)
    found = gaussian_mean(together, _SIGMA_SHARED) - np.float32(_DEVIATIONS) * np.sqrt(noise)
    shared = np.clip(ratio(found, gaussian_mean(squares, _SIGMA_SHARED)), 0, 1) * neighbours.trust
    blended = picture + shared[..., None] * (mean - picture)
    if variance is None:
        alone = np.float32(_SPREAD) * spatial_variance(noisy, blended, rate)
    else:
        alone = np.asarray(variance.sum(axis=-1) * np.square(rate), np.float32)
    alone = np.where(neighbours.trust >= 1, temporal, alone + neighbours.trust * (temporal - alone))
    error = np.square(np.clip((noisy - blended) * rate[..., None], -_LIMIT, _LIMIT)).sum(axis=-1)
    error, noise = (gaussian_mean(x, _SIGMA_CENTRE) for x in (error, np.minimum(alone, 3 * _LIMIT**2)))
    share = np.clip(ratio(error - np.float32(_VARIANCES) * noise, error), 0, 1)
    return np.asarray(blended + share[..., None] * (noisy - blended), np.float32)


def _relative_light(noisy: Floats, neighbours: SampleMean, rate: Floats) -> Floats:
    """Light of a frame over the light of its neighbours (H, W), by least squares around each pixel."""
    weight = np.square(rate) * neighbours.trust
    together, alone = (
        gaussian_mean(np.einsum("yxc,yxc->yx", image, neighbours.mean) * weight, _SIGMA_SHARED)
        for image in (noisy, neighbours.mean)
    )
    return np.clip(np.divide(together, alone, out=np.ones_like(alone), where=alone > 0), 0.5, 2)


def spatial_variance(noisy: Floats, picture: Floats, rate: Floats) -> Floats:
    """Variance (H, W) of a frame's noise, relative to the light (`rate` is one over that), summed over channels.

    The lesser of the high-pass energies of ``noisy`` and ``noisy − picture``: detail of the frame adds to the first,
    detail that the picture has lost or invented to the second (Immerkær, as `nlm.variance.variance_from_residual`).
    """
    residuals = (second_differences(image) * rate[..., None] for image in (noisy, noisy - picture))
    energies = (np.square(residual).sum(axis=-1) / np.float32(36) for residual in residuals)
    return np.minimum(*(gaussian_mean(energy, _SIGMA_SHARED) for energy in energies))


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
    picture), of noisy − picture at most 20 l, the picture becomes picture + s l K d / K(u l),

        s = max(0, 1 − k (1 + f / N) v / (K d)²),    v = K[d²] / n,    N = n K[d²]² / K[d⁴],

    in the mean over channels, n the pixels of K: the shrinkage of James and Stein. N counts the samples that make the
    noise: five fireflies determine neither a mean nor its variance. The weight u keeps the light of all pixels but
    those much brighter than their surroundings, which count by their relative error: a lamp that is too bright darkens
    nothing around it. The means over σ = 48 pixels come first (k = 1, f = 3000), then those over 12 (8, 300).
    """
    for sigma, certain, few in _MEANS:
        level = np.maximum(_gray(picture), 0)
        around = _mean(np.minimum(level, np.float32(_LAMP * exposure)), sigma)
        light = level + np.float32(_SOFT) * around + np.float32(1e-3 * exposure)
        weight = 1 / np.maximum(light, around)
        lit = _mean(weight * light, sigma)
        reach = _FAR * light[..., None]
        difference = weight[..., None] * np.clip(noisy - picture, -reach, reach)
        mean = np.dstack([_mean(difference[..., c], sigma) for c in range(3)])
        square = np.square(difference).mean(axis=-1)
        # As many pixels as a Gaussian averages, 1 / Σ weight², and no more than there are.
        pixels = np.float32(min(4 * np.pi * sigma**2, square.size))
        noise, fourth = (_mean(power, sigma) for power in (square, np.square(square)))
        unsure = np.float32(certain) * (1 + ratio(np.float32(few) * fourth, pixels * np.square(noise)))
        known = np.square(mean).mean(axis=-1)
        share = np.clip(ratio(known - unsure * noise / pixels, known), 0, 1)
        picture = np.maximum(picture + mean * (share * light / lit)[..., None], np.minimum(picture, 0))
    return np.asarray(picture, np.float32)


def _mean(image: Floats, sigma: float) -> Floats:
    """Gaussian mean around each pixel, on cells of σ / 6 pixels, which blur nothing that the mean keeps."""
    side, (height, width) = max(int(sigma / _CELLS), 1), image.shape
    whole = cv2.copyMakeBorder(image, 0, -height % side, 0, -width % side, cv2.BORDER_REFLECT)
    rows, columns = whole.shape[0] // side, whole.shape[1] // side
    cells = np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)
    mean = gaussian_mean(cells, sigma / side)
    spread = cv2.resize(mean, (columns * side, rows * side), interpolation=cv2.INTER_LINEAR)
    return np.asarray(spread[:height, :width], np.float32)


def _gray(image: Floats) -> Floats:
    return np.asarray(np.einsum("yxc->yx", image) / np.float32(image.shape[-1]), np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _average(
    first: int, last: int, estimates: Floats, residuals: Floats, add: bool, confidence: Floats, modulation: Floats,
    out: tuple[Floats, Floats],
) -> None:  # fmt: skip
    mean, frames = out
    T, _, W, C = estimates.shape
    for y in range(first, last):
        for x in range(W):
            total, squares = np.float64(0), np.float64(0)  # the square of a small confidence must not vanish
            for t in range(T):
                weight = confidence[t, y, x]
                if t == T // 2 or not weight > 0:
                    continue
                level = np.float32(0)
                for c in range(C):
                    level += estimates[t, y, x, c] + (residuals[t, y, x, c] if add else np.float32(0))
                if not np.isfinite(level):
                    continue
                total += weight
                squares += np.float64(weight) ** 2
                for c in range(C):
                    value = estimates[t, y, x, c] + (residuals[t, y, x, c] if add else np.float32(0))
                    mean[y, x, c] += weight * value * modulation[y, x, c]
            if total > 0:
                frames[y, x] = total * total / squares
                for c in range(C):
                    mean[y, x, c] /= np.float32(total)


@njit(cache=True, nogil=True, error_model="numpy")
def _compare(
    first: int, last: int, picture: Floats, noisy: Floats, neighbours: SampleMean, rate: Floats, sums: Floats
) -> None:
    """Sum over channels, where neighbours are trusted: (n − p)(m − p), (m − p)², ((n − m)(m − p))², variance."""
    _, W, C = picture.shape
    for y in range(first, last):
        for x in range(W):
            if not neighbours.trust[y, x] > 0:
                continue
            scale, product = rate[y, x], np.float32(0)
            for c in range(C):
                n_p = min(max(scale * (noisy[y, x, c] - picture[y, x, c]), -_LIMIT), _LIMIT)
                m_p = min(max(scale * (neighbours.mean[y, x, c] - picture[y, x, c]), -_LIMIT), _LIMIT)
                n_m = min(max(scale * (noisy[y, x, c] - neighbours.mean[y, x, c]), -_LIMIT), _LIMIT)
                sums[0, y, x] += n_p * m_p
                sums[1, y, x] += m_p * m_p
                product += n_m * m_p
                sums[3, y, x] += n_m * n_m / (1 + _WARPED / neighbours.frames[y, x])
            sums[2, y, x] = product * product
