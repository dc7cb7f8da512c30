"""Averages over an aligned window; replacement of outliers and of non-finite pixels."""

import cv2
import numpy as np
from numba import njit

from loops.parallel import STRIP, Floats, Mask, run_bands

# How many robust scales above the median an outlier lies.
_FAR_ABOVE = np.float32(16)
# How far beyond the limit two or four pixels together are no highlight either. The non-local means would smear them:
# a 2×2 cluster of 1e6 left 1000 times the light three pixels away.
_SPARK = np.float32(100)


def average(window: Floats, weight: Floats) -> Floats:
    """Average an aligned window (T, H, W, C) by weight; the centre's value (H, W, C) where all weights are 0."""
    window, weight = check_window(window, weight)
    out = np.empty(window.shape[1:], np.float32)
    run_bands(_average, len(out), window, weight, False, out)
    return out


def robust_average(window: Floats, weight: Floats) -> Floats:
    """Average an aligned window without each pixel's minimum and maximum; the centre's value where all weights are 0.

    For n ≥ 3 equal weights: ravg(S) = (Σ S − min S − max S) / (n − 2), the "Robust Average Blocks" of Kalojanov and
    Thurston, Robust Average Networks for Monte Carlo Denoising. With unequal weights the minimum and the maximum
    lose the share clamp(Σw / max w − 2, 0, 1) of their weight, so that a trusted centre is never discarded in favour of
    frames of little weight. Values are ordered channel by channel, as in the paper; ordering whole pixels by luminance
    costs 0.02 dB on Cycles renders and biases the colour as much.

    The noise of path tracing is skewed, so the result is darker than the mean: by 1.5 to 7 % at 10 to 30 samples a
    pixel, by a third where most samples are 0. `average` after `reject_outliers` keeps the energy.
    """
    window, weight = check_window(window, weight)
    out = np.empty(window.shape[1:], np.float32)
    run_bands(_average, len(out), window, weight, True, out)
    return out


def reject_outliers(window: Floats, weight: Floats) -> tuple[Floats, Mask]:
    """Replace fireflies, values far above all neighbours in space and time: a cleaned copy, and where it was replaced.

    A pixel of weight 0 is neither evidence nor replaced.

    Notes
    -----
    In the 3×3×T neighbourhood of a pixel let m be the median of the mean over channels, and u its n-th
    largest value, n the number of frames trusted at that pixel (at least 2, one more than the firefly). A value is an
    outlier where it exceeds m + 16 (u − m) and eight times the mean of the others. A light present in every frame, even
    one pixel wide, is among the n largest and stays; a firefly is in one frame, and warping spreads it over at most
    four pixels. The centre is not warped: there a value with two such neighbours is an object and stays, unless the
    group is no larger than 2×2 pixels and a hundred times above the limit. The spread (u − m) widens with the skew of
    the noise, which a median absolute deviation does not; the spread is divided by the share of values above 0. Where u
    = 0 nothing is rejected: on black a spark may be all the light.

    An outlier becomes the weighted mean of the neighbours that are no outliers, which leaves neither a dark hole nor a
    halo. The energy of the firefly is lost: on Cycles renders without visible fireflies the window's mean fell by less
    than 0.1 %; with fireflies by 0.3 to 1.2 %; by 2 % (the centre by 6 %) where two samples in three are 0.
    """
    window, weight = check_window(window, weight)
    cleaned, mask = window.copy(), np.zeros(weight.shape, np.bool_)
    level = channel_mean(window.reshape(-1, *window.shape[2:])).reshape(weight.shape)
    run_bands(_reject_outliers, window.shape[1], window, weight, level, cleaned, mask)
    return cleaned, mask


def channel_mean(image: Floats) -> Floats:
    """Mean (H, W) over the channels of an image (H, W, C)."""
    channels = image.shape[2]
    if not image.size:  # which OpenCV refuses
        return np.empty(image.shape[:2], np.float32)
    total = cv2.transform(np.ascontiguousarray(image, np.float32), np.ones((1, channels), np.float32))
    return np.divide(total, np.float32(channels), out=total)


def mean_square(image: Floats) -> Floats:
    """Mean (H, W) over the channels of the square of an image (H, W, C)."""
    mean = np.empty(image.shape[:2], np.float32)
    for top in range(0, len(image), STRIP):
        strip = image[top : top + STRIP]
        mean[top : top + STRIP] = channel_mean(strip * strip)
    return mean


def replace_nonfinite(image: Floats) -> tuple[Floats, Mask]:
    """Fill pixels that hold NaN or infinities in any channel; return a finite copy, and where (H, W) it was filled.

    The image itself comes back where all is finite. Values come from the nearest finite pixels, by a normalised box
    filter whose radius doubles; 0 if no pixel is finite.
    """
    if image.ndim != 3:
        raise ValueError(f"image: expected (height, width, channels), got shape {image.shape}")
    with np.errstate(invalid="ignore", over="ignore"):  # inf − inf; where it overflows pixels are looked at
        total = image.sum()  # by far the quickest way to see that nothing is missing
    if np.isfinite(total):
        return np.asarray(image, np.float32), np.zeros(image.shape[:2], np.bool_)
    mask: Mask = np.any(~np.isfinite(image), axis=-1, keepdims=True)[..., 0]
    filled = np.where(mask[..., None], np.float32(0), image).astype(np.float32, copy=False)
    if mask.all():
        return filled, mask
    # float64: the sum of a box may exceed float32 where its mean does not
    values, known = np.asarray(filled, np.float64), np.asarray(~mask, np.float64)
    missing, radius = mask.copy(), 1
    while missing.any():
        size = (2 * radius + 1, 2 * radius + 1)
        count = cv2.boxFilter(known, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        total = cv2.boxFilter(values, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        now = missing & (count > 0.5)
        filled[now] = total.reshape(image.shape)[now] / count[now][:, None]
        missing &= ~now
        radius *= 2
    return filled, mask


def check_window(window: Floats, weight: Floats, name: str = "weight") -> tuple[Floats, Floats]:
    """Return window and weights as contiguous float32; ValueError, with their name, if shapes differ or T is even."""
    if window.ndim != 4 or window.shape[0] % 2 == 0:
        raise ValueError(f"window: expected (frames, height, width, channels) with odd frames, got {window.shape}")
    if weight.shape != window.shape[:3]:
        raise ValueError(f"{name}: expected shape {window.shape[:3]} to fit the window, got {weight.shape}")
    return np.ascontiguousarray(window, np.float32), np.ascontiguousarray(weight, np.float32)


def check_strip(strip: Floats, window: Floats, top: int) -> None:
    """Raise ValueError unless a strip holds rows of a window from row `top` on."""
    expected = (len(window), min(strip.shape[1], window.shape[1] - top), *window.shape[2:])
    if strip.shape != expected:
        raise ValueError(f"residuals: expected shape {expected} from row {top} on, got {strip.shape}")


def check_colors(noisy: Floats, estimates: Floats) -> None:
    """Raise ValueError unless a noisy image (H, W, 3) fits estimates (T, H, W, 3): loops are written for three."""
    expected = (*estimates.shape[1:3], 3)
    if noisy.shape != expected or estimates.shape[1:] != expected:
        raise ValueError(f"noisy: expected shape {expected} like an estimate, got {noisy.shape}")


def check_exposure(exposure: float) -> None:
    """Raise ValueError unless the exposure is positive and finite."""
    if not (exposure > 0 and np.isfinite(exposure)):
        raise ValueError(f"exposure: expected a positive number, got {exposure}")


@njit(cache=True, nogil=True)
def _average(first: int, last: int, window: Floats, weight: Floats, robust: bool, out: Floats) -> None:
    T, _, W, C = window.shape
    for y in range(first, last):
        for x in range(W):
            total, most, trusted = np.float32(0), np.float32(0), 0
            for t in range(T):
                w = weight[t, y, x]
                total += w
                most = max(most, w)
                trusted += w > 0
            share = np.float32(0)
            if robust and trusted >= 3:
                share = min(max(total / most - np.float32(2), np.float32(0)), np.float32(1))
            for c in range(C):
                low, high = np.float32(np.inf), np.float32(-np.inf)
                lowest, brightest = -1, -1
                for t in range(T if share > 0 else 0):
                    if weight[t, y, x] > 0:
                        v = window[t, y, x, c]
                        if v < low:
                            low, lowest = v, t
                        if v >= high:  # not the minimum again where all are equal
                            high, brightest = v, t
                value, left = np.float32(0), np.float32(0)
                for t in range(T):
                    w = weight[t, y, x]
                    if t in (lowest, brightest):  # left out, not subtracted: 1e6 would leave its rounding
                        w *= 1 - share
                    if w > 0:  # a NaN of weight 0 must not count
                        value += w * window[t, y, x, c]
                        left += w
                out[y, x, c] = value / left if left > 0 else window[T // 2, y, x, c]


@njit(cache=True, nogil=True, error_model="numpy")
def _reject_outliers(
    first: int, last: int, window: Floats, weight: Floats, level: Floats, cleaned: Floats, mask: Mask
) -> None:
    T, H, W, C = window.shape
    for y in range(first, last):
        ordered = np.empty(9 * T, np.float32)
        mean = np.empty(C, np.float32)
        top, bottom = max(y - 1, 0), min(y + 2, H)
        # three columns' sums, so that most pixels are passed over at little cost
        sums, counts = np.zeros(W, np.float64), np.zeros(W, np.int64)
        for t in range(T):
            for ny in range(top, bottom):
                for x in range(W):
                    if weight[t, ny, x] > 0:
                        sums[x] += level[t, ny, x]
                        counts[x] += 1
        for x in range(W):
            left, right = max(x - 1, 0), min(x + 2, W)
            near, count = 0.0, 0
            for nx in range(left, right):
                near += sums[nx]
                count += counts[nx]
            highest, frames = np.float32(-np.inf), 0
            for t in range(T):
                if weight[t, y, x] > 0:
                    frames += 1
                    highest = max(highest, level[t, y, x])
            # of the others, so that a firefly does not hide itself where there are few
            floor = 8 * (near - highest) / max(count - 1, 1)
            if not highest > floor:
                continue
            n = 0
            for t in range(T):
                for ny in range(top, bottom):
                    for nx in range(left, right):
                        if weight[t, ny, nx] > 0:
                            # put in its place: `np.sort` would take a second to compile
                            value, i = level[t, ny, nx], n
                            while i > 0 and ordered[i - 1] > value:
                                ordered[i] = ordered[i - 1]
                                i -= 1
                            ordered[i] = value
                            n += 1
            # the lower median: of two values the greater one would be its own yardstick
            median, upper = ordered[(n - 1) // 2], ordered[max(n - max(frames, 2), 0)]
            lit = 0
            for i in range(n):
                lit += ordered[i] > 0
            # where few pixels have found the light, each of them is far above the others
            limit = median + _FAR_ABOVE * max(upper - median, np.float32(0)) * np.float32(n) / np.float32(max(lit, 1))
            if not (highest > limit and upper > 0):
                continue
            mean[:] = 0
            trust = np.float32(0)
            for t in range(T):
                for ny in range(top, bottom):
                    for nx in range(left, right):
                        if weight[t, ny, nx] > 0 and level[t, ny, nx] <= limit:
                            trust += weight[t, ny, nx]
                            for c in range(C):
                                mean[c] += weight[t, ny, nx] * window[t, ny, nx, c]
            for t in range(T):
                if weight[t, y, x] > 0 and level[t, y, x] > max(limit, floor):
                    bright = 0
                    for ny in range(top, bottom):
                        for nx in range(left, right):
                            bright += level[t, ny, nx] > limit
                    spark = bright <= 4 and level[t, y, x] > _SPARK * limit
                    if t == T // 2 and bright > 2 and not spark:
                        continue
                    mask[t, y, x] = True
                    for c in range(C):
                        cleaned[t, y, x, c] = mean[c] / trust
