"""Error measures of denoised frames against a reference, in space and in time.

All measures take (H, W, 3) linear radiance. The exposure e is one factor for the whole shot: on the tone curve
T(x) = e·x / (1 + e·x) for PSNR, SSIM and the temporal measures, on the radiance for relMSE and SMAPE.

- A reference may be two independent halves ``(a, b)``: every squared error (x − r)² becomes the product (x − a)(x − b),
  whose expectation is free of the reference's noise. The bias that the tone curve makes of that noise is subtracted.
- An image with a non-finite pixel scores NaN: one such pixel must not be averaged away, and must not stop the
  comparison of other methods. A non-finite *reference* is the caller's mistake and raises ValueError.
"""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from flow.warp import warp

T = TypeVar("T")
Array = NDArray[np.floating]
Reference = Array | tuple[Array, Array]

EPSILON = 1e-2  # prevents division by zero at black; assumes radiance around 1 after the exposure


def tone_map(x: Array, exposure: float = 1.0) -> NDArray[np.float64]:
    """Map linear radiance to [0, 1) by T(x) = e·x / (1 + e·x); negative values, near its pole at −1/e, count as 0."""
    scaled = np.maximum(np.asarray(x, np.float64) * exposure, 0.0)
    with np.errstate(invalid="ignore"):  # inf / inf gives NaN, as intended for non-finite pixels
        return scaled / (1.0 + scaled)


def psnr(image: Array, reference: Reference, *, exposure: float = 1.0) -> float:
    """Peak signal-to-noise ratio −10 log₁₀ mean (T(x) − T(r))² dB, with peak 1; infinite for errors not above zero."""
    errors = _tone_errors(image, reference, exposure)
    return _decibels(np.mean(errors[0] * errors[-1]))


def ssim(image: Array, reference: Array, *, exposure: float = 1.0) -> float:
    """Mean structural similarity of the tone-mapped image, at least 11 × 11 pixels, 1 at best; by scikit-image.

    As in the paper (Wang et al. 2004, doi:10.1109/TIP.2003.819861): Gaussian window with σ = 1.5 (11 × 11),
    K = (0.01, 0.03), population covariance, mean over the channels.
    """
    from skimage.metrics import structural_similarity  # of the extra `compare`; other measures do without

    x, r = (tone_map(v, exposure) for v in _checked(image, reference)[:2])
    settings = {"data_range": 1.0, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(structural_similarity(r, x, channel_axis=-1, **settings))


def relmse(image: Array, reference: Reference, *, trim: float = 0.0, exposure: float = 1.0) -> float:
    """Relative mean squared error: mean (x − r)² / (r² + 0.01); the mean of two halves is the r of the denominator.

    The fraction `trim` of the pixels, with the largest errors, in [0, 1), is excluded; 0.001 is usual, since a single
    firefly can outweigh the rest of the frame.
    """
    x, a, b = _checked(image, reference, exposure)
    truth = a if b is a else (a + b) / 2
    errors = np.mean((x - a) * (x - b) / (truth**2 + EPSILON), axis=-1).ravel()
    kept = errors.size - int(trim * errors.size)
    return float(np.mean(np.partition(errors, kept - 1)[:kept]))


def smape(image: Array, reference: Array, *, exposure: float = 1.0) -> float:
    """Symmetric mean absolute percentage error: mean |x − r| / (|x| + |r| + 0.01), in [0, 1]."""
    x, r, _ = _checked(image, reference, exposure)
    return float(np.mean(np.abs(x - r) / (np.abs(x) + np.abs(r) + EPSILON)))


def mean_bias(image: Array, reference: Array) -> float:
    """Relative error of the mean radiance: (mean x − mean r) / mean r; NaN for a black reference."""
    x, r, _ = _checked(image, reference)
    return float(np.mean(x) / np.mean(r) - 1.0) if r.any() else float("nan")


def temporal_psnr(
    frames: Iterable[Array],
    references: Iterable[Reference],
    flows: Iterable[Array],
    valid: Iterable[NDArray[np.bool_]],
    *,
    exposure: float = 1.0,
) -> NDArray[np.float64]:
    """PSNR of motion-compensated frame differences against those of the reference, for each pair of N frames.

    With W the bilinear warp along flow k from frame k + 1 back to frame k, pixels, D_t(x) = T(x_t) − W T(x_{t−1}), and
    the value is −10 log₁₀ mean (D_t(d) − D_t(r))² over valid pixels; NaN where a frame is not finite or no pixel is
    valid. Subtracting the reference's differences excludes real changes: light, reflections, the interpolation itself;
    without it, blur would score above the truth. An error that is the same on every frame is no flicker. Generators are
    accepted.
    """
    series = zip(frames, references, strict=True)
    values = []
    for ((previous, r0), (current, r1)), flow, mask in zip(pairwise(series), flows, valid, strict=True):
        before, after = (
            [error.astype(np.float32) for error in _tone_errors(frame, truth, exposure)]
            for frame, truth in ((previous, r0), (current, r1))
        )
        # W is linear: the difference of the differences is the change of the error.
        change = [e1 - warp(e0, flow)[0] for e0, e1 in zip(before, after, strict=True)]
        product = np.multiply(change[0], change[-1], dtype=np.float64)[mask]
        values.append(_decibels(np.mean(product)) if product.size else float("nan"))
    return np.array(values)


def mean_over_shots(values: Sequence[float] | Array, shots: Sequence[int] = ()) -> float:
    """Average the means of the shots, of which `shots` has the numbers of values; none: all are of one shot."""
    data = np.asarray(values, np.float64)
    return float(np.mean([part.mean() for part in _by_shot(data, shots)]))


def _by_shot(data: NDArray[np.float64], shots: Sequence[int]) -> list[NDArray[np.float64]]:
    return np.split(data, np.cumsum(shots)[:-1]) if shots else [data]


def bootstrap_interval(values: Sequence[float] | Array, *, shots: Sequence[int] = ()) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean of `values`, one per frame; NaN if a value is NaN.

    To decide whether A is better than B, pass the differences A − B frame by frame: both have the same frames, and most
    of their spread cancels. An interval that contains 0 is a tie. With several shots (`shots` has their numbers of
    values), the shots are resampled first, then the frames within each: frames of one shot are correlated, and more of
    them say little about another shot. Efron 1979, doi:10.1214/aos/1176344552.
    """
    data = np.asarray(values, np.float64)
    if np.isnan(data).any():
        return float("nan"), float("nan")
    rng = np.random.default_rng(0)
    parts, resamples = _by_shot(data, shots), 2000

    def draw(part: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(part[rng.integers(0, part.size, (resamples, part.size))].mean(axis=1))

    if len(parts) == 1:
        means = draw(parts[0])
    else:
        drawn = [rng.integers(0, len(parts), resamples) for _ in parts]
        means = np.mean([np.choose(shot, [draw(part) for part in parts]) for shot in drawn], axis=0)
    # An order statistic without interpolation, which would make NaN of two infinite PSNRs.
    low, high = np.quantile(means, [0.025, 0.975], method="inverted_cdf")
    return float(low), float(high)


def halves_of(reference: T | tuple[T, T]) -> tuple[T, ...]:
    """Return the halves of a reference, or the whole one alone."""
    return reference if isinstance(reference, tuple) else (reference,)


def check_images(image: Array, reference: Reference) -> None:
    """Raise ValueError if the shapes differ or the reference is not finite."""
    for half in halves_of(reference):
        if half.shape != image.shape or image.ndim != 3:
            raise ValueError(f"image and reference must be (H, W, C) alike: {image.shape}, {half.shape}")
        lost = half.size - int(np.isfinite(half).sum())
        if lost:
            raise ValueError(f"reference must be finite, {lost} of its {half.size} values are not")


def _checked(image: Array, reference: Reference, scale: float = 1.0) -> tuple[NDArray[np.float64], ...]:
    """Image (all NaN if not finite) and the halves of the reference; a whole reference is returned as both."""
    check_images(image, reference)
    if not np.isfinite(image).all():
        image = np.full(image.shape, np.nan)
    x, *truths = (np.multiply(v, scale, dtype=np.float64) for v in (image, *halves_of(reference)))
    return x, truths[0], truths[-1]


def _tone_errors(image: Array, reference: Reference, exposure: float) -> list[NDArray[np.float64]]:
    """Tone-mapped error against a whole reference, or against each half; the product of two is the squared error.

    T is concave: halves with noise of variance v give tone-mapped images that are T'' v / 2 too dark, which would
    favor dark images. The curve of the halves' mean has half of that bias, so twice the difference is all of it
    (Quenouille 1956, doi:10.1093/biomet/43.3-4.353, the jackknife); averaged over some pixels against variance.
    """
    x, a, b = _checked(image, reference)
    tone = tone_map(x, exposure)
    if b is a:
        return [tone - tone_map(a, exposure)]
    halves = [tone_map(half, exposure) for half in (a, b)]
    difference = 2 * tone_map((a + b) / 2, exposure) - halves[0] - halves[1]
    # A half of more than ten times the other is a firefly: the bias is a second-order term of little noise, and would
    # put such a pixel's whole light into the errors of 200 pixels around it.
    difference[np.maximum(a, b) > 10 * np.minimum(a, b)] = 0
    bias = np.asarray(cv2.GaussianBlur(difference, (0, 0), 2.0), np.float64)
    return [tone - half - bias for half in halves]


def _decibels(mse: np.floating) -> float:
    """−10 log₁₀ of a mean squared error; infinite at zero and below, where an unbiased estimate may lie."""
    return float("inf") if mse <= 0 else float(-10.0 * np.log10(mse))
