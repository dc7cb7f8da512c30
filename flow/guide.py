"""Guides for optical flow: planes comparable between frames, and little disturbed by noise."""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from loops.parallel import STRIP

_REC709 = np.array([0.2126, 0.7152, 0.0722], np.float32)
# Radius of the guided filter of the luminance, pixels.
_RADIUS = 2


def _luminance(
    image: np.ndarray, lift: float = 0.0, finish: Callable[[np.ndarray], np.ndarray] = np.asarray
) -> np.ndarray:
    """Luminance of (H, W, 3) + lift, not negative, and a function of it; NaN is 0. In strips: one plane is made."""
    found = np.empty(image.shape[:2], np.float32)
    for top in range(0, len(found), STRIP):
        rows = slice(top, top + STRIP)
        with np.errstate(invalid="ignore", over="ignore"):
            strip = np.asarray(image[rows], np.float32)
            luminance = (strip + np.float32(lift) if lift else strip) @ _REC709
        # No more than 1e30: the median of two of the largest floats is infinite, and so is an exposure made of it.
        luminance = np.clip(np.nan_to_num(luminance, copy=False, nan=0.0, posinf=1e30), 0, np.float32(1e30))
        found[rows] = finish(luminance)
    return found


def median_luminance(color: np.ndarray, lift: float = 0.0) -> float:
    """Median of the positive luminances of radiance (H, W, 3) + lift; 1 without any. NaN is 0, Inf very bright."""
    luminance = _luminance(color, lift)
    positive = luminance[luminance > 0]
    return float(np.median(positive)) if positive.size else 1.0


def tone_map(color: np.ndarray, exposure: float, lift: float = 0.0) -> np.ndarray:
    """Luminance of color + lift on L / (L + exposure), (H, W) in [0, 1]; negative and NaN count as 0, Inf as white."""
    if not exposure > 0:
        raise ValueError(f"exposure is {exposure}, expected a positive number")
    # As 1 − e / (L + e), which is 1 and not NaN for the largest float.
    return _luminance(color, lift, lambda luminance: 1 - np.float32(exposure) / (luminance + np.float32(exposure)))


def estimate_noise(image: np.ndarray, *, spacing: int = 1) -> np.ndarray:
    """Estimate the local noise of an image from the image alone: standard deviation, float32, of its shape and unit.

    `spacing` is the distance, pixels, at which the noise is independent: 1, or the diameter of an earlier filter.

    The second difference in x of the second difference in y, [1 -2 1]ᵀ [1 -2 1] / 6, is blind to slopes and
    to straight edges and has the noise's own deviation (Immerkær: Fast noise variance estimation. 1996.
    doi:10.1006/cviu.1996.0060). Its magnitude is averaged over 15 x 15 pixels by the square of
    the mean root, to which outliers (corners, fireflies) add little. Texture of the size of a pixel counts as noise.
    """
    if image.ndim not in (2, 3) or image.size == 0:
        raise ValueError(f"image has shape {image.shape}, expected a non-empty (H, W) or (H, W, C)")
    kernel = np.zeros(2 * spacing + 1, np.float32)
    kernel[[0, spacing, -1]] = 1, -2, 1
    image = np.asarray(image, np.float32)
    response = np.abs(cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT)) / 6
    # (E √|z|)² = 0.676 for a normal z of deviation 1.
    return (cv2.blur(np.sqrt(response), (15, 15)) ** 2 / np.float32(0.676)).reshape(image.shape)


class Guide(NamedTuple):
    """Guide planes of one frame."""

    planes: np.ndarray  # (H, W, G) in [0, 1]
    noise: np.ndarray  # (H, W, G) standard deviation of the remaining noise


class GuidePair(NamedTuple):
    """Guides of two frames of equal exposure, finite, from `pair_guides`."""

    centre: np.ndarray  # (H, W, G) float32 in [0, 1]
    neighbour: np.ndarray
    noise: np.ndarray  # the greater standard deviation of the two


def pair_guides(centre: Guide, neighbour: Guide) -> GuidePair:
    """Combine the guides of two frames, finite, for `flow.tvl1` and `flow.selection`; the greater noise counts."""
    shape = centre.planes.shape
    if centre.planes.ndim != 3 or centre.planes.size == 0:
        raise ValueError(f"centre guide has shape {shape}, expected a non-empty (H, W, G)")
    others = {"noise of the centre": centre.noise, "neighbour guide": neighbour.planes, "its noise": neighbour.noise}
    for name, planes in others.items():
        if planes.shape != shape:
            raise ValueError(f"{name} has shape {planes.shape}, expected that of the centre guide, {shape}")
    first, second = (
        np.nan_to_num(np.ascontiguousarray(guide.planes, np.float32), nan=0.0, posinf=1.0, neginf=0.0)
        for guide in (centre, neighbour)
    )
    return GuidePair(first, second, np.maximum(centre.noise, neighbour.noise, dtype=np.float32))


def make_guide(color: np.ndarray, albedo: np.ndarray | None = None, *, exposure: float) -> Guide:
    """Make the guide of a frame (H, W, 3): tone-mapped luminance, smoothed within its surfaces, and albedo, if given.

    In linear radiance negative and NaN count as 0, Inf as white. The albedo, at least 0, steers the smoothing, and is a
    guide plane of its own; without it the luminance steers itself. `exposure` is the radiance that maps to 0.5, one
    value for both frames of a pair; the guide is the same for ``a * color`` and ``a * exposure``.

    Reinhard's L / (L + exposure) comes first, so that a firefly counts for one white pixel, then a guided filter over 5
    x 5 pixels (He, Sun, Tang: Guided image filtering. 2013. doi:10.1109/TPAMI.2012.213).
    """
    if color.ndim != 3 or color.shape[2] != 3:
        raise ValueError(f"color has shape {color.shape}, expected (H, W, 3)")
    if albedo is not None and albedo.shape != color.shape:
        raise ValueError(f"albedo has shape {albedo.shape}, expected that of color, {color.shape}")
    tone = tone_map(color, exposure)
    if albedo is None:
        return smooth_tones(tone)
    reflectance = _luminance(albedo)
    reflectance /= 1 + reflectance
    luminance = smooth_tones(tone, reflectance[..., None])
    planes, noise = (luminance.planes, reflectance), (luminance.noise, estimate_noise(reflectance))
    return Guide(np.dstack(planes), np.dstack(noise))


def smooth_tones(tone: np.ndarray, steer: np.ndarray | None = None) -> Guide:
    """Smooth tones (H, W) in [0, 1] within the surfaces of a steering image of a range of about 1, or of themselves."""
    # Contrasts of the steering image below the root of this are smoothed over. A picture's own noise is strong.
    tolerance = 1e-2 if steer is None else 1e-3
    smooth = np.clip(cv2.ximgproc.guidedFilter(tone if steer is None else steer, tone, _RADIUS, tolerance), 0, 1)
    return Guide(smooth[..., None], estimate_noise(smooth, spacing=2 * _RADIUS)[..., None])
