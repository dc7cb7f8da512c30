"""HDR-FLIP: the visible difference of two images when flipping between them, over all relevant exposures.

Written from the papers, with separable filters of OpenCV, and the reference processed once for all methods: the
authors' code (the package flip-evaluator, which tests compare with) takes 18 CPU seconds for an image of 1920×1080.

Andersson et al. 2020, FLIP: A Difference Evaluator for Alternating Images, doi:10.1145/3406183;
2021, Visualizing Errors in Rendered High Dynamic Range Images, doi:10.2312/egs.20211015.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hybrid.comparison.metrics import check_images
from hybrid.files.frame import Array

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * np.pi / 180  # 0.7 m from a display 0.7 m and 3840 pixels wide
# The curve of ACES, (k0 x² + k1 x + k2) / (k3 x² + k4 x + k5), after the 0.6 that it is usually given before.
ACES = (0.9036, 0.018, 0.0, 0.8748, 0.354, 0.14)
TOP = 0.85  # of the curve: the least exposure brings the brightest pixel there, the greatest the median
# Linear sRGB to XYZ; rows sum to the white of D65.
XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
RELATIVE = XYZ / XYZ.sum(axis=1, keepdims=True)  # to XYZ over that of white
OPPONENT = np.array([[0, 116, 0], [500, -500, 0], [0, 200, -200]])  # YCxCz of that, where Y has 16 taken off
# Contrast sensitivity to Y, Cx and Cz: sums of Gaussians a·√(π/b)·exp(−π²x²/b), x in degrees.
SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
COLOR_POWER = 0.7
KNEE, BELOW = 0.4, 0.95  # color errors up to KNEE of the greatest are spread over [0, BELOW]
BORDER = cv2.BORDER_REPLICATE
ROWS = 128  # processed at a time: they stay in the processor's cache from filter to filter
# Pixels: three deviations of the widest Gaussian; the filters of features are narrower.
_REACH = int(np.ceil(3 * np.sqrt(0.04 / (2 * np.pi**2)) * PIXELS_PER_DEGREE))


def flip_maps(images: Sequence[Array], reference: Array, scale: float = 1.0) -> list[Array]:
    """HDR-FLIP error (H, W) of each pixel of several images of one frame, the greatest over all exposures, in [0, 1].

    The reference determines the exposures and is processed once. Images are linear radiance in sRGB primaries, times
    `scale`; negative values count as 0. They are read `ROWS` at a time, so memory maps will do. The error is NaN
    everywhere for an image that is not finite everywhere. Raises ValueError if shapes differ, or the reference is not
    finite.
    """
    for image in images:
        check_images(image, reference)
    reference = np.maximum(reference * np.float32(scale), 0)
    exposures = find_exposures(reference)
    errors = [np.zeros(reference.shape[:2], np.float32) for _ in images]
    height = reference.shape[0]
    for top in range(0, height, ROWS):
        rows = slice(max(top - _REACH, 0), min(top + ROWS + _REACH, height))
        inner = slice(top - rows.start, top - rows.start + ROWS)
        strips = [np.maximum(image[rows] * np.float32(scale), 0) for image in images]
        for exposure in exposures:
            truth = _perceive(reference[rows], exposure)
            for strip, worst in zip(strips, errors, strict=True):
                part = worst[top : top + ROWS]
                np.maximum(part, _difference(_perceive(strip, exposure), truth)[inner], out=part)
    return [
        worst if np.isfinite(image).all() else np.full_like(worst, np.nan)
        for image, worst in zip(images, errors, strict=True)
    ]


def find_exposures(reference: Array) -> NDArray[np.float64]:
    """Return the exposures in stops at which images are compared, at least two, evenly spaced, at most one apart.

    The first brings the brightest pixel of the reference (not negative) to `TOP` of the tone curve, the last the
    (upper) median.
    """
    light = _mix(reference, np.array([[0.2126, 0.7152, 0.0722]])).ravel()
    median = np.partition(light, light.size // 2)[light.size // 2]
    a, b, c = (ACES[i] - TOP * ACES[i + 3] for i in range(3))
    level = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
    # 1e-5 keeps the exposures of a black reference finite, and assumes radiance around 1.
    first, last = (np.log2(level / max(float(y), 1e-5)) for y in (light.max(), median))
    return np.linspace(first, last, max(2, int(np.ceil(last - first))))


class _Perceived(NamedTuple):
    """An image as perceived: (H, W, 3) color in L*a*b* after Hunt, and strength of edges and points, (H, W) each."""

    color: Array
    edges: Array
    points: Array


def _perceive(image: Array, exposure: float) -> _Perceived:
    """Perceive an image, not negative, on a display."""
    scaled = image * np.float32(2**exposure)
    k = [np.float32(value) for value in ACES]
    shown = np.minimum(((k[0] * scaled + k[1]) * scaled + k[2]) / ((k[3] * scaled + k[4]) * scaled + k[5]), 1)
    # The 16 missing in Y cancel: color filters preserve constants, filters of edges and points remove them.
    opponent = _mix(shown, OPPONENT @ RELATIVE)
    filtered = np.dstack([_blur(opponent[..., i], gaussians) for i, gaussians in enumerate(SENSITIVITY)])
    light = np.clip(_mix(filtered, np.linalg.inv(OPPONENT @ RELATIVE)), 0, 1)
    wide, edge, point = _feature_filters()
    gray = opponent[..., 0] * np.float32(1 / 116)
    return _Perceived(_hunt(light), _strength(gray, edge, wide), _strength(gray, point, wide))


def _difference(one: _Perceived, other: _Perceived) -> Array:
    """Error of each pixel at one exposure: ΔC^(1 − ΔF), with the errors of color and of features in [0, 1]."""
    greatest = _greatest_color_error()
    color = _power(_hyab(one.color, other.color), COLOR_POWER)
    below = color * np.float32(BELOW / (KNEE * greatest))
    above = BELOW + (color - np.float32(KNEE * greatest)) * np.float32((1 - BELOW) / (greatest - KNEE * greatest))
    color = np.where(color < KNEE * greatest, below, above)
    features = cv2.max(cv2.absdiff(one.edges, other.edges), cv2.absdiff(one.points, other.points))
    features = cv2.sqrt(features * np.float32(1 / np.sqrt(2)))
    # OpenCV's logarithm of 0 is finite, and its power is 0.
    return np.asarray(cv2.exp(cv2.log(color) * (1 - features)), np.float32)


def _mix(image: Array, matrix: NDArray[np.float64]) -> Array:
    """The channels of each pixel, times a matrix."""
    return np.asarray(cv2.transform(image, matrix), np.float32)


def _length(x: NDArray[Any], y: NDArray[Any]) -> Array:
    return np.asarray(np.sqrt(x * x + y * y), np.float32)  # OpenCV's result differs in the last bit from call to call


def _power(x: Array, power: float) -> Array:
    return np.asarray(cv2.pow(x, power), np.float32)


def _hyab(one: Array, other: Array) -> Array:
    """HyAB distance for large color differences: the distance in lightness plus that in a* and b*."""
    apart = one - other
    return np.asarray(np.abs(apart[..., 0]) + _length(apart[..., 1], apart[..., 2]), np.float32)


def _hunt(light: Array) -> Array:
    """L*a*b* of linear sRGB, chroma scaled by lightness (Hunt effect): dark colors look alike."""
    xyz = _mix(light, RELATIVE)
    edge = 6 / 29
    low = xyz * np.float32(1 / (3 * edge**2)) + np.float32(4 / 29)
    x, y, z = np.moveaxis(np.where(xyz > edge**3, _power(xyz, 1 / 3), low), -1, 0)
    lightness = 116 * y - 16
    return np.dstack([lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)])


@lru_cache(maxsize=1)
def _greatest_color_error() -> float:
    """The color error between green and blue."""
    green, blue = (_hunt(np.array([[color]], np.float32)) for color in ((0, 1, 0), (0, 0, 1)))
    return float(_hyab(green, blue)[0, 0] ** COLOR_POWER)


def _blur(plane: Array, gaussians: Sequence[tuple[float, float]]) -> Array:
    """Filter by a sum of Gaussians with a total weight of one."""
    degrees = np.arange(-_REACH, _REACH + 1) / PIXELS_PER_DEGREE
    rows = [np.exp(-(np.pi**2) / b * degrees**2) for _, b in gaussians]
    heights = [a * np.sqrt(np.pi / b) for a, b in gaussians]
    total = sum(height * row.sum() ** 2 for height, row in zip(heights, rows, strict=True))
    parts = [
        cv2.sepFilter2D(plane, -1, height / total * row, row, borderType=BORDER)
        for height, row in zip(heights, rows, strict=True)
    ]
    return np.asarray(sum(parts), np.float32)


def _strength(gray: Array, across: NDArray[np.float64], along: NDArray[np.float64]) -> Array:
    """Magnitude of a filter's horizontal and vertical responses."""
    x = cv2.sepFilter2D(gray, -1, across, along, borderType=BORDER)
    y = cv2.sepFilter2D(gray, -1, along, across, borderType=BORDER)
    return _length(x, y)


@lru_cache(maxsize=1)
def _feature_filters() -> tuple[NDArray[np.float64], ...]:
    """A Gaussian, its first and its second derivative; what is positive sums to 1, what is negative to −1."""
    sigma = 0.5 * 0.082 * PIXELS_PER_DEGREE  # edges and points are 0.082 degrees wide
    reach = int(np.ceil(3 * sigma))
    x = np.arange(-reach, reach + 1)
    wide = np.exp(-(x**2) / (2 * sigma**2))
    derived = (-x * wide, (x**2 / sigma**2 - 1) * wide)
    sides = [np.where(d > 0, d / d[d > 0].sum(), -d / d[d < 0].sum()) for d in derived]
    return wide / wide.sum(), *sides
