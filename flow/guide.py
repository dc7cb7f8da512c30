"""The pictures that flows are refined on: comparable between frames, and little disturbed by noise."""

from __future__ import annotations

import cv2
import numpy as np

_REC709 = np.array([0.2126, 0.7152, 0.0722], np.float32)


def _luminance(image: np.ndarray) -> np.ndarray:
    """Luminance of (H, W, 3), not negative; NaN is 0."""
    with np.errstate(invalid="ignore", over="ignore"):
        luminance = np.asarray(image, np.float32) @ _REC709
    # No more than 1e30: the median of two of the largest floats is infinite, and so is an exposure made of it.
    return np.clip(np.nan_to_num(luminance, nan=0.0, posinf=1e30), 0, np.float32(1e30))


def median_luminance(color: np.ndarray) -> float:
    """Median of the positive luminances of (H, W, 3) radiance; 1 where there are none."""
    luminance = _luminance(color)
    positive = luminance[luminance > 0]
    return float(np.median(positive)) if positive.size else 1.0


def tone_map(color: np.ndarray, exposure: float) -> np.ndarray:
    """Luminance of (H, W, 3) radiance in [0, 1], ``L / (L + exposure)``; NaN is 0, Inf is 1.

    Raises
    ------
    ValueError
        If `exposure` is not positive.
    """
    if not exposure > 0:
        raise ValueError(f"exposure is {exposure}, expected a positive number")
    # As 1 − e / (L + e), which is 1 and not NaN for the largest float.
    return 1 - np.float32(exposure) / (_luminance(color) + np.float32(exposure))


def estimate_noise(image: np.ndarray, *, spacing: int = 1) -> np.ndarray:
    """Estimate the local noise of an image from the image alone.

    Parameters
    ----------
    image
        (H, W) or (H, W, C) float, finite, in any unit.
    spacing
        Distance, pixels, at which the noise is independent: 1, or the diameter of the filter it went through.

    Returns
    -------
    numpy.ndarray
        Standard deviation, float32, the shape and unit of `image`.

    Notes
    -----
    The second difference in x of the second difference in y, [1 -2 1]ᵀ [1 -2 1] / 6, is blind to slopes and to
    straight edges and has the noise's own deviation. Its magnitude is averaged over 15 x 15 pixels by the square
    of the mean root, to which outliers (corners, fireflies) add little. Texture of the size of a pixel counts as
    noise.

    References
    ----------
    Immerkær: Fast noise variance estimation. 1996. doi:10.1006/cviu.1996.0060
    """
    if image.ndim not in (2, 3) or image.size == 0:
        raise ValueError(f"image has shape {image.shape}, expected a non-empty (H, W) or (H, W, C)")
    kernel = np.zeros(2 * spacing + 1, np.float32)
    kernel[[0, spacing, -1]] = 1, -2, 1
    image = np.asarray(image, np.float32)
    response = np.abs(cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT)) / 6
    # (E √|z|)² = 0.676 for a normal z of deviation 1.
    return (cv2.blur(np.sqrt(response), (15, 15)) ** 2 / np.float32(0.676)).reshape(image.shape)


def prefilter_guide(
    color: np.ndarray,
    albedo: np.ndarray | None = None,
    normal: np.ndarray | None = None,
    *,
    exposure: float | None = None,
    radius: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """Make the guides that flows are refined on: tone-mapped luminance, smoothed within its surfaces, and albedo.

    Parameters
    ----------
    color
        (H, W, 3) float, linear radiance. Negative and NaN count as 0, Inf as white.
    albedo
        (H, W, 3) float >= 0, or None. It steers the smoothing, and is a guide of its own.
    normal
        (H, W, 3) float, or None. It steers the smoothing too.
    exposure
        The radiance that maps to 0.5. Missing: `color`'s own median of positive luminances; pass one value for
        all frames of a shot, or their guides may differ in brightness.
    radius
        Of the guided filter, pixels.

    Returns
    -------
    guide
        (H, W, G) float32 in [0, 1]: luminance, and the albedo's where there is an albedo. The same for
        `a * color` where `exposure` is missing.
    noise
        (H, W, G) float32: the estimated standard deviation of each.

    Notes
    -----
    Reinhard's L / (L + exposure) comes first, so that a firefly counts for one white pixel, then a guided filter.
    With neither albedo nor normal the luminance steers itself.

    References
    ----------
    He, Sun, Tang: Guided image filtering. 2013. doi:10.1109/TPAMI.2012.213
    """
    if color.ndim != 3 or color.shape[2] != 3:
        raise ValueError(f"color has shape {color.shape}, expected (H, W, 3)")
    for name, aov in (("albedo", albedo), ("normal", normal)):
        if aov is not None and aov.shape != color.shape:
            raise ValueError(f"{name} has shape {aov.shape}, expected that of color, {color.shape}")
    tone = tone_map(color, median_luminance(color) if exposure is None else exposure)
    steer = []
    if albedo is not None:
        reflectance = _luminance(albedo)
        reflectance /= 1 + reflectance
        steer.append(reflectance)
    if normal is not None:
        # Two components tell surfaces apart, and the filter takes three channels at most.
        steer.append(0.5 * np.nan_to_num(np.asarray(normal[..., :2], np.float32), posinf=0.0, neginf=0.0))
    # 1e-3: contrasts of the steering image below 0.03 (its range is about 1) are smoothed over. Noise of the
    # luminance itself is stronger than that, so it steers itself with 0.1.
    tolerance = 1e-3 if steer else 1e-2
    smooth = cv2.ximgproc.guidedFilter(np.dstack(steer) if steer else tone, tone, radius, tolerance)
    guide = [np.clip(smooth, 0, 1)]
    noise = [estimate_noise(guide[0], spacing=2 * radius)]
    if albedo is not None:
        guide.append(reflectance)
        noise.append(estimate_noise(reflectance))
    return np.dstack(guide), np.dstack(noise)
