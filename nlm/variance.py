"""Variance of a pixel's value: from half buffers, the aligned window, a denoised picture, or the image alone."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numba import njit

from loops.parallel import STRIP, Floats, Mask, run_bands
from nlm.average import channel_mean, check_window, mean_square
from nlm.gate import AROUND_SIZE
from nlm.nonlocal_means import BAND, joint_nlm

# How far above its surroundings' median a pixel's variance may lie before it is cut. A variance from five
# Gaussian samples stays below 4 times its mean in 997 of 1000 cases; Monte Carlo noise has longer tails.
_CAP = 16.0
# Variance of a bilinearly warped frame over the centre's: the mean of (2/3)² (any fraction of a pixel along
# both axes), 2/3 (along one) and 1 (none). It counts only where side frames are few.
WARPED = 0.7
# Variance of guides without noise: deviations of a thousandth of their range. In tiles with no more the filter would
# change 1e-4 (RMS, five shots).
_NOISELESS = np.float32(1e-6)
# Least variance, of deviations of 1e-4: below that is what the box filters round to, which depends on where they began.
_LEAST = np.float32(1e-8)
# Between pixels this far apart no pixel filter of a renderer correlates the noise (σ = 1 pixel).
_APART = 6
# Albedo below that of any surface, by which light is divided in place of black.
LEAST_ALBEDO = np.float32(1e-3)
# Beyond this share of the columns a window is filtered as a whole.
_MOST_COLUMNS = 0.75


def variance_from_halves(a: Floats, b: Floats) -> Floats:
    """Variance (a − b)² / 4 of the mean of two half buffers: one degree of freedom, so smooth before use."""
    if a.shape != b.shape:
        raise ValueError(f"b: expected shape {a.shape} like a, got {b.shape}")
    return np.asarray(np.square(a - b, dtype=np.float32) * np.float32(0.25))


def variance_from_window(window: Floats, confidence: Floats) -> Floats:
    """Variance (H, W, C) of the centre frame's pixels, smoothed, from the differences between aligned frames.

    (x − m)² / (1 + 0.7 Σ w² / (Σ w)²), x the centre's value, m = Σ w x_t / Σ w over the neighbours; then
    `smooth_variance`, which bounds the contribution of an outlier. Unlike the sample variance of all frames this hardly
    depends on how much noise warping has removed from the neighbours (which halves the sample variance at half a
    pixel). With fewer than two neighbours' worth of confidence the result fades into `variance_from_residual`. Moving
    light counts as noise; so does texture where the flow is wrong.
    """
    window, confidence = check_window(window, confidence, "confidence")
    temporal, trust = _temporal_variance(window, confidence)
    if trust.min() >= 1:
        return temporal
    return _fade(temporal, variance_from_residual(window[window.shape[0] // 2]), trust)


def _temporal_variance(window: Floats, confidence: Floats) -> tuple[Floats, Floats]:
    """Variance from the neighbours, and whether two of these are trusted, in [0, 1]."""
    deviation, trust = np.zeros(window.shape[1:], np.float32), np.zeros(window.shape[1:3], np.float32)
    run_bands(_centre_deviation, len(trust), window, confidence, deviation, trust)
    return smooth_variance(deviation), trust


def _fade(temporal: Floats, spatial: Floats, trust: Floats) -> Floats:
    """Blend from spatial to temporal variance by `trust`."""
    # For each channel: numpy takes long to spread a plane over the short axis.
    share = cv2.merge([trust] * temporal.shape[2]).reshape(temporal.shape)
    mixed = temporal - spatial
    mixed *= share
    mixed += spatial
    # Not the sum where trust is 1: it would round otherwise in a part of a frame than in the whole.
    np.copyto(mixed, temporal, where=share >= 1)
    return mixed


def variance_from_residual(image: Floats) -> Floats:
    """Variance (H, W, C) of the noise in a single finite image, smoothed; fine texture counts as noise.

    The square of the second difference in x and y, blind to planes and to straight edges along an axis, over the sum of
    its squared coefficients, 36 (Immerkær, Fast noise variance estimation, 1996, doi:10.1006/cviu.1996.0060).
    """
    return smooth_variance(np.square(second_differences(image)) * np.float32(1 / 36))


def variance_from_estimate(noisy: Floats, estimate: Floats, exposure: float) -> Floats:
    """Variance of a frame's samples by its difference from a denoised frame.

    Parameters
    ----------
    noisy, estimate : (H, W, 3) float32, the frame as rendered and denoised, in one unit
    exposure : float, in that unit

    Returns
    -------
    (H, W) float32
        (l + exposure) · K[(noisy − estimate)² / (l + exposure)], l the estimate and the square in the mean over
        channels, K the 15×15 mean.

    Notes
    -----
    The variance of samples grows with their light. In the plain mean a lamp of thousands of exposures gives its noise
    to the dark pixels beside it, and warped frames that spread the lamp over these count: 0.9 dB of a car's headlamps
    at 128 samples.
    """
    light = np.maximum(channel_mean(estimate), 0) + np.float32(exposure)
    # The running sums of a box filter round to a little below 0.
    return np.asarray(light * np.maximum(cv2.blur(mean_square(noisy - estimate) / light, AROUND_SIZE), 0), np.float32)


def spatial_variance(
    noisy: Floats, picture: Floats, rate: Floats, sigma: float, albedo: Floats | None = None
) -> Floats:
    """Variance (H, W) of a frame's noise over the light, summed over channels, by a Gaussian of `sigma` pixels.

    `rate` (H, W) is one over the light. The least of the high-pass energies of ``noisy``, ``noisy − picture`` and,
    times the albedo, ``noisy / albedo``: detail of the frame adds to the first, detail that the picture has lost or
    invented to the second, that of the light to the third (as `variance_from_residual`).
    A renderer's pixel filter makes noise smooth, and these energies up to 150 times too small; the median over the
    frame of the same energies at pixels 6 apart, over these, is the factor.
    """
    some = np.s_[::_APART, ::_APART]
    near = _least_energy(noisy, picture, rate, albedo, sigma)
    few, shown, rates = (np.ascontiguousarray(layer[some]) for layer in (noisy, picture, rate))
    far = _least_energy(few, shown, rates, None if albedo is None else albedo[some], 2.0)
    around = gaussian_mean(near[some], 2.0)
    factors = np.divide(far, around, out=np.zeros_like(far), where=around > 0)
    return near * np.float32(max(np.median(factors[factors > 0]), 1) if factors.any() else 1)


def _least_energy(noisy: Floats, picture: Floats, rate: Floats, albedo: Floats | None, sigma: float) -> Floats:
    """Least Gaussian mean of the energies of a frame, of its difference from a picture, and of its light."""
    ways = [(None, None), (picture, None), *([] if albedo is None else [(None, albedo)])]
    least = np.full_like(rate, np.inf)
    for way in ways:
        np.minimum(least, gaussian_mean(_energy_of(noisy, rate, *way), sigma), out=least)
    return least


def _energy_of(noisy: Floats, rate: Floats, picture: Floats | None, albedo: Floats | None) -> Floats:
    """Squares of second differences relative to the light, summed over channels: of white noise its variance.

    The image is `noisy`, its difference from a picture, or its light; in strips, which stay in the caches.
    """
    energy = np.empty(rate.shape, np.float32)
    for top in range(0, len(rate), STRIP):
        rows, bottom = slice(top, top + STRIP), min(top + STRIP, len(rate))
        outer = slice(max(top - 1, 0), bottom + 1)
        strip = noisy[outer] if picture is None else noisy[outer] - picture[outer]
        if albedo is not None:
            strip = strip / np.maximum(albedo[outer], LEAST_ALBEDO)
        found = second_differences(np.ascontiguousarray(strip))[top - outer.start :]
        if albedo is not None:
            found = found[: bottom - top] * np.maximum(albedo[rows], LEAST_ALBEDO)
        found = found[: bottom - top] * rate[rows, :, None]
        energy[rows] = np.einsum("yxc,yxc->yx", found, found) / np.float32(36)  # the squares of the coefficients
    return energy


def second_differences(image: Floats) -> Floats:
    """Filter (H, W, C) by [1 −2 1]ᵀ [1 −2 1], which multiplies the variance of white noise by 36."""
    kernel = np.array([1, -2, 1], np.float32)
    found = cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(found, np.float32).reshape(image.shape)


def ratio(a: Floats, b: Floats) -> Floats:
    """Return a / b, 0 where b is not positive."""
    return np.divide(a, b, out=np.zeros_like(b), where=b > 0)


def smooth_variance(variance: Floats) -> Floats:
    """Means over 5×5 pixels of a finite variance (H, W, C) of few degrees of freedom, with outliers cut.

    A pixel is cut at 16 times the 5×5 median of the 3×3 means, which an isolated outlier cannot move.
    """
    # Squares of more than 1e18 overflow, and an infinity would spoil the filters' running sums.
    variance = np.minimum(variance, np.float32(1e36))
    means = np.asarray(cv2.blur(variance, (3, 3)), np.float32).reshape(variance.shape)
    if variance.shape[-1] == 3:
        median = np.asarray(cv2.medianBlur(means, 5), np.float32)
    else:  # plane by plane: medianBlur takes at most four channels
        planes = [cv2.medianBlur(np.ascontiguousarray(means[..., c]), 5) for c in range(variance.shape[-1])]
        median = np.stack(planes, -1)
    median *= np.float32(_CAP)
    cut = np.minimum(variance, median, out=median)
    # Running sums beside values of 1e24 round to below 0.
    smooth = np.asarray(cv2.blur(cut, (5, 5)), np.float32)
    return np.maximum(smooth, 0, out=smooth).reshape(variance.shape)


def prefilter_guide(centre: Floats, read: Callable[[slice], Floats], confidence: Floats) -> Floats:
    """Denoise the centre frame's guides: albedo and normals under depth of field or behind glass.

    Guides (H, W, F) of about unit range without noise come back as they are, to about 1e-3. `read` returns the window
    (T, h, W, F) of rows around noise that the guides show.

    Non-local means over 3×3 pixels and all frames. The variance is the lesser of that between frames and
    that of the spatial residual: noise shows in both, texture only in the second, and texture resampled by warping
    mainly in the first. A radius above 1 gains nothing on Cycles shots. Tiles of the picture without noise are left
    out.
    """
    spatial, filtered = variance_from_residual(centre), centre.copy()
    for rows in _around(spatial.max(axis=(1, 2)) > _NOISELESS):
        window = read(rows)
        parts = [*_around(spatial[rows].max(axis=0).max(axis=1) > _NOISELESS)]
        # A part of the columns is copied first.
        if sum(part.stop - part.start for part in parts) > _MOST_COLUMNS * centre.shape[1]:
            parts = [slice(None)]
        for columns in parts:
            guides, trusted = check_window(window[:, :, columns], confidence[:, rows, columns], "confidence")
            temporal, trust = _temporal_variance(guides, trusted)
            variance = _fade(temporal, spatial[rows, columns], trust)
            np.clip(variance, _LEAST, np.maximum(spatial[rows, columns], _LEAST), out=variance)
            noisy = np.logical_or.reduce([plane > _NOISELESS for plane in np.moveaxis(variance, -1, 0)])
            filtered[rows, columns] = joint_nlm(
                guides, variance, confidence=trusted, radius=1, patch_radius=1, k=1.0, where=noisy
            )
    return filtered


def _around(rows: Mask) -> Iterator[slice]:
    """Yield runs of bands that hold one of these rows or columns, with a band on each side: more than filters reach."""
    bands = np.logical_or.reduceat(rows, np.arange(0, len(rows), BAND))
    wide = np.convolve(bands, np.ones(3), "same") > 0
    edges = np.flatnonzero(np.diff(wide, prepend=False, append=False))
    for first, last in edges.reshape(-1, 2):
        yield slice(first * BAND, min(last * BAND, len(rows)))


def gaussian_mean(image: Floats, sigma: float) -> Floats:
    """Mean (H, W) with Gaussian weights up to three deviations; the image is mirrored at its borders."""
    side = 2 * int(3 * sigma) + 1
    return np.asarray(cv2.GaussianBlur(image, (side, side), sigma, borderType=cv2.BORDER_REFLECT), np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _centre_deviation(
    first: int, last: int, window: Floats, confidence: Floats, deviation: Floats, trust: Floats
) -> None:
    """Squared deviation of the centre from the neighbours, and in [0, 1] whether two of these are trusted."""
    T, _, W, C = window.shape
    centre = T // 2
    for y in range(first, last):
        for x in range(W):
            total, squares = np.float32(0), np.float32(0)
            for t in range(T):
                if t != centre:
                    total += confidence[t, y, x]
                    squares += confidence[t, y, x] ** 2
            if total <= 1 or not confidence[centre, y, x] > 0:
                continue
            trust[y, x] = min(total - np.float32(1), np.float32(1))
            for c in range(C):
                mean = np.float32(0)
                for t in range(T):
                    if t != centre and confidence[t, y, x] > 0:
                        mean += confidence[t, y, x] * window[t, y, x, c]
                difference = window[centre, y, x, c] - mean / total
                deviation[y, x, c] = difference**2 / (1 + np.float32(WARPED) * squares / (total * total))
