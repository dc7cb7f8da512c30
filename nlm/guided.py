"""Guided filter with any number of guide channels."""

import cv2
import numpy as np
from numba import njit

from loops.parallel import STRIP, Doubles, Floats, run_bands
from nlm.average import replace_nonfinite

# Rows that are measured together, which stay in the caches in float64.
_ROWS = 8


def guided_filter(
    image: Floats, guide: Floats, *, radius: int, eps: float = 1e-2, subsample: int = 1, moments: Doubles | None = None
) -> Floats:
    """Fit the image, in every box, by an affine function of the guide.

    Returns (H, W, C) float32, within the range of the input in the (4·radius + 1)² box that a pixel depends on.

    Parameters
    ----------
    image : (H, W, C) float32, non-finite pixels are left out and filled
    guide : (H, W, G) float32
        Albedo, normal, depth … in any units: each channel is normalised to mean 0 and variance 1 first.
    radius : int, of the boxes, in pixels of the image
    eps : float, regularisation ε as a share of each guide's variance: structure fainter than its root is smoothed
    subsample : int, 1, 2 or 4: coefficients are fitted on an image so many times smaller
    moments : (2, G) float64, optional
        Means and deviations of the guide in the whole frame, from `measure_guide`, where the arrays are a part of it.

    Notes
    -----
    In each box a = (Σ_I + ε·1)⁻¹ cov(I, p) and b = mean(p) − a · mean(I), Σ_I the covariance of the guide;
    the output is mean(a) · I + mean(b), the means over all boxes that cover the pixel. Boxes are cut at the frame's
    edge. G × G systems are solved by Cholesky in float64, as are the running sums: a firefly of 1e6 would leave its
    rounding in float32 sums.

    References
    ----------
    He, Sun and Tang, Guided Image Filtering, 2013, doi:10.1109/TPAMI.2012.213
    He and Sun, Fast Guided Filter, 2015, arXiv:1505.00996
    """
    if image.ndim != 3 or guide.ndim != 3 or guide.shape[:2] != image.shape[:2]:
        raise ValueError(
            f"guide: expected (height, width, channels) as large as the image's {image.shape}, got {guide.shape}"
        )
    if radius < 1:
        raise ValueError(f"radius: expected at least 1, got {radius}")
    if not eps > 0:
        raise ValueError(f"eps: expected a positive number, got {eps}")
    if subsample not in (1, 2, 4):
        raise ValueError(f"subsample: expected 1, 2 or 4, got {subsample}")
    if moments is not None and moments.shape != (2, guide.shape[2]):
        raise ValueError(f"moments: expected shape {(2, guide.shape[2])}, got {moments.shape}")
    image, missing = replace_nonfinite(image)
    guide = np.ascontiguousarray(replace_nonfinite(guide)[0])
    guide = _standardise(guide, measure_guide(guide) if moments is None else moments)

    image, trust = np.ascontiguousarray(image), (~missing[..., None]).astype(np.float32)
    small_image, small_guide, small_trust = image, guide, trust
    if subsample > 1:
        small_image, small_guide, small_trust = (_shrink(full, subsample) for full in (image * trust, guide, trust))
        # the mean over trusted pixels only; what is not trusted at all weighs nothing
        small_image /= np.where(small_trust > 0, small_trust, np.float32(1))
    small_radius = max(radius // subsample, 1)
    size, channels, planes = small_guide.shape[:2], image.shape[2], guide.shape[2]
    strips = -(-size[0] // STRIP)
    boxes, coefficients = (np.empty((*size, channels * planes + channels + 1), np.float32) for _ in range(2))
    run_bands(_solve, strips, small_image, small_guide, small_trust, small_radius, float(eps), boxes)
    run_bands(_sum_boxes, strips, boxes, small_radius, coefficients)
    output = np.empty(image.shape, np.float32)
    run_bands(_apply, len(output), coefficients, guide, image, subsample, output)
    box = np.ones((4 * radius + 1, 4 * radius + 1), np.uint8)
    low, high = (np.asarray(fold(image, box)).reshape(image.shape) for fold in (cv2.erode, cv2.dilate))
    return np.asarray(np.clip(output, low, high), np.float32)


def measure_guide(guide: Floats) -> Doubles:
    """Return mean and standard deviation (2, G) float64 of the channels of a finite guide (H, W, G)."""
    height, width, channels = guide.shape
    sums = np.zeros((2, width * channels))
    for top in range(0, height, _ROWS):
        rows = guide[top : top + _ROWS].reshape(-1, width * channels).astype(np.float64)
        sums[0] += rows.sum(axis=0)
        sums[1] += np.square(rows, out=rows).sum(axis=0)
    first, second = sums.reshape(2, width, channels).sum(axis=1) / (height * width)
    return np.stack([first, np.sqrt(np.maximum(second - first * first, 0))])


def _standardise(guide: Floats, moments: Doubles) -> Floats:
    """Normalise each channel to mean 0 and variance 1; a constant channel becomes 0."""
    mean, deviation = moments
    # Below the rounding of float32 there is no structure (float64's rounding of the variance is 1e-8); the inverse of a
    # deviation below its normal numbers overflows.
    constant = deviation <= np.maximum(1e-6 * np.abs(mean), np.finfo(np.float32).tiny)
    scale = np.where(constant, 0.0, 1.0 / np.where(constant, 1.0, deviation))
    # Whole rows at a time: numpy takes long over the short axis.
    centre, factor = (np.tile(np.float32(values), guide.shape[1]) for values in (mean, scale))
    out = guide.reshape(len(guide), -1) - centre
    out *= factor
    return out.reshape(guide.shape)


def _shrink(image: Floats, step: int) -> Floats:
    """Mean of each step × step block, cut at the lower and right edge."""
    height, width, channels = image.shape
    below, right = -height % step, -width % step
    # Zeros beyond the edge, by which the means are too small.
    whole = cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_CONSTANT) if below or right else image
    size = (width + right) // step, (height + below) // step
    means = cv2.resize(whole, size, interpolation=cv2.INTER_AREA).reshape(size[1], size[0], channels)
    means[-1] *= step / (step - below)
    means[:, -1] *= step / (step - right)
    return np.asarray(means, np.float32)


def _sum_boxes(first: int, last: int, values: Floats, radius: int, out: Floats) -> None:
    """Sum of (H, W, M) over the box around each pixel, cut at the frame's edge, for strips of rows."""
    for strip in range(first, last):
        top, bottom = strip * STRIP, min(strip * STRIP + STRIP, len(values))
        above, size = max(top - radius, 0), (2 * radius + 1, 2 * radius + 1)
        rows = values[above : bottom + radius]
        sums = cv2.boxFilter(rows, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        out[top:bottom] = sums.reshape(rows.shape)[top - above : bottom - above]


@njit(cache=True, nogil=True, boundscheck=False, inline="always")
def _add_moments(sums: Doubles, image: Floats, guide: Floats, weight: float) -> None:
    """Add (or with a negative weight subtract) Σ w, w I, w I Iᵀ, w p, w I pᵀ of one pixel."""
    G, C = guide.size, image.size
    sums[0] += weight
    n = 1
    for i in range(G):
        wi = weight * guide[i]
        sums[1 + i] += wi
        n = 1 + G + i * (i + 1) // 2
        for j in range(i + 1):
            sums[n + j] += wi * guide[j]
        n = 1 + G + G * (G + 1) // 2 + C + i * C
        for c in range(C):
            sums[n + c] += wi * image[c]
    n = 1 + G + G * (G + 1) // 2
    for c in range(C):
        sums[n + c] += weight * image[c]


@njit(cache=True, nogil=True, boundscheck=False, error_model="numpy", inline="always")
def _solve_box(out: Floats, sums: Doubles, matrix: Doubles, right: Doubles, G: int, C: int, eps: float) -> None:
    """Coefficients of one box, a (C × G) then b (C) then 1; all 0 where nothing is trusted."""
    if not sums[0] > 0:
        out[:] = 0
        return
    inverse = 1.0 / sums[0]
    quadratic, linear = 1 + G, 1 + G + G * (G + 1) // 2
    for i in range(G):
        mean = sums[1 + i] * inverse
        for j in range(i + 1):
            matrix[i, j] = sums[quadratic + i * (i + 1) // 2 + j] * inverse - mean * (sums[1 + j] * inverse)
        matrix[i, i] = max(matrix[i, i], 0.0) + eps
        for c in range(C):
            right[i, c] = sums[linear + C + i * C + c] * inverse - mean * (sums[linear + c] * inverse)
    for i in range(G):  # Cholesky, its lower triangle in place, its diagonal inverted
        for j in range(i):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = value * matrix[j, j]
        value = matrix[i, i]
        for k in range(i):
            value -= matrix[i, k] * matrix[i, k]
        matrix[i, i] = 1.0 / np.sqrt(max(value, 0.5 * eps))  # never below eps but for rounding
    for c in range(C):
        for i in range(G):
            value = right[i, c]
            for k in range(i):
                value -= matrix[i, k] * right[k, c]
            right[i, c] = value * matrix[i, i]
        offset = sums[linear + c] * inverse
        for i in range(G - 1, -1, -1):
            value = right[i, c]
            for k in range(i + 1, G):
                value -= matrix[k, i] * right[k, c]
            right[i, c] = value * matrix[i, i]
            out[c * G + i] = right[i, c]
            offset -= right[i, c] * (sums[1 + i] * inverse)
        out[C * G + c] = offset
    out[C * G + C] = 1


@njit(cache=True, nogil=True, boundscheck=False)
def _solve(
    first: int, last: int, image: Floats, guide: Floats, weight: Floats, radius: int, eps: float, out: Floats
) -> None:
    """Coefficients of the box around each pixel, (H, W, C·G + C + 1), for strips of rows."""
    H, W, C = image.shape
    G = guide.shape[2]
    for strip in range(first, last):
        top, bottom = strip * STRIP, min(strip * STRIP + STRIP, H)
        columns = np.zeros((W, 1 + G + G * (G + 1) // 2 + C + G * C))
        box = np.empty(columns.shape[1])
        matrix, right = np.empty((G, G)), np.empty((G, C))
        # Each sum has one statement for what enters and what leaves: a copy of it costs a second of compilation.
        for y in range(max(top - radius, 0) - radius, bottom):
            for sign in (1.0, -1.0):
                row = y + radius if sign > 0 else y - radius - 1
                if max(top - radius, 0) <= row < H:
                    for x in range(W):
                        _add_moments(columns[x], image[row, x], guide[row, x], np.float32(sign) * weight[row, x, 0])
            if y < top:
                continue
            box[:] = 0
            for x in range(-radius, W):
                for sign in (1.0, -1.0):
                    column = x + radius if sign > 0 else x - radius - 1
                    if 0 <= column < W:
                        for m in range(box.size):
                            box[m] += sign * columns[column, m]
                if x >= 0:
                    _solve_box(out[y, x], box, matrix, right, G, C, eps)


@njit(cache=True, nogil=True, boundscheck=False, error_model="numpy")
def _apply(first: int, last: int, coefficients: Floats, guide: Floats, image: Floats, step: int, out: Floats) -> None:
    """Apply coefficients, upsampled bilinearly, to the guide; copy the image where no box has coefficients."""
    _, W, G = guide.shape
    C = image.shape[2]
    h, w, M = coefficients.shape
    for y in range(first, last):
        here, row = np.empty(M, np.float32), np.empty((w, M), np.float32)
        sy = min(max((y + 0.5) / step - 0.5, 0.0), h - 1.0)
        top = int(sy)
        below, fy = coefficients[min(top + 1, h - 1)], np.float32(sy - top)
        for x in range(w):
            for m in range(M):
                row[x, m] = coefficients[top, x, m] + fy * (below[x, m] - coefficients[top, x, m])
        for x in range(W):
            sx = min(max((x + 0.5) / step - 0.5, 0.0), w - 1.0)
            left = int(sx)
            right, fx = min(left + 1, w - 1), np.float32(sx - left)
            for m in range(M):
                here[m] = row[left, m] + fx * (row[right, m] - row[left, m])
            boxes = here[M - 1]
            for c in range(C):
                value = here[C * G + c]
                for i in range(G):
                    value += here[c * G + i] * guide[y, x, i]
                out[y, x, c] = value / boxes if boxes > 0 else image[y, x, c]
