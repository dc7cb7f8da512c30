"""Parts of a frame's color that are not filtered: removed before denoising, and restored in the finished picture.

Filters would mix the black outside a render region into its edges, and an object into the black around it, and spread
a sun beyond the range of half; every denoiser would clip the negative light of a color outside of the gamut, and tint a
gray picture.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from hybrid.alignment.transfer import compress, measure_exposure
from hybrid.files.exr import HALF_MAX
from hybrid.files.frame import Array, Frame
from loops.parallel import Mask
from nlm.guided import guided_filter

Region = tuple[slice, slice]

# Pixels by which a frame is mirrored beyond the edges of a render region: the support of most weights of a filter.
_MIRRORED = 32
# Least pixels on a side of a region, and the share of each of its edges that is lit; the outline of an object touches
# its box in a smaller share.
_LEAST, _EDGE = 16, 0.9
# Fewer connected pixels of +Inf are fireflies: one bright sample covers a pixel, with a renderer's filter up to 2×2.
_LIGHT = 5
# Side, pixels, of the least square without samples of anything: few samples leave single pixels of a volume black. One
# in a hundred of them lit leaves such squares, but hardly one that is four times as wide.
_EMPTY = 15


@dataclass(frozen=True)
class Unfiltered:
    """Light that is restored in the finished picture of a frame."""

    # (H, W, 3): radiance of lights brighter than half can hold: `HALF_MAX` where it is +Inf; NaN in all other pixels
    beyond: Array | None = None
    # (H, W, 3): "color" or AOV → noisy negative radiance of colors outside of the gamut
    negative: Mapping[str, Array] = field(default_factory=dict)
    gray: frozenset[str] = frozenset()  # names, "color" or AOVs, whose three channels are equal everywhere
    region: Region | None = None  # rows and columns of a render region, outside which the frame is black
    empty: Mask | None = None  # (H, W): where no sample hit anything, and the color is 0

    @property
    def lights(self) -> Mask | None:
        """The pixels of lights beyond half (H, W), or None."""
        return None if self.beyond is None else ~np.isnan(self.beyond[..., 0])

    @property
    def count(self) -> int:
        """Number of values that are `HALF_MAX` instead of +Inf."""
        return 0 if self.beyond is None else int(np.count_nonzero(self.beyond == np.float32(HALF_MAX)))

    def restore(self, picture: Array, guide: Array | None) -> Array:
        """Restore the light, of negative light the mean within `guide`, in a denoised picture (H, W, 3)."""
        if "color" in self.gray:
            picture = as_gray(picture)
        if "color" in self.negative:
            picture = picture + self.smooth_negative("color", picture, guide)
        if self.beyond is not None:
            picture = np.where(np.isnan(self.beyond), picture, self.beyond)
        return np.asarray(self.without_outside(self.without_empty(picture)), np.float32)

    def smooth_negative(self, name: str, picture: Array, guide: Array | None) -> Array:
        """Return the local mean of a layer's negative radiance, which follows edges of `picture` and `guide`."""
        shown = compress(picture, measure_exposure(picture))
        shown = shown if guide is None else np.concatenate([shown, guide], axis=-1)
        return guided_filter(self.negative[name], shown, radius=4, eps=1e-3)

    def without_empty(self, light: Array) -> Array:
        """Return the color or a part of it (H, W, 3) set to 0 at the pixels of `empty`, if there are any."""
        return light if self.empty is None else np.where(self.empty[..., None], np.float32(0), light)

    def without_outside(self, layer: Array) -> Array:
        """Return a layer (H, W, ...) set to 0 outside the render region, if there is one."""
        if self.region is None:
            return layer
        inside = np.zeros_like(layer)
        inside[self.region] = layer[self.region]
        return inside


def find_region(color: Array) -> Region | None:
    """Return rows and columns of the rectangle around which a frame (H, W, 3) is black; None if there is none."""
    # Channel by channel: numpy takes long over the short axis.
    some = np.logical_or.reduce([plane != 0 for plane in np.moveaxis(color, -1, 0)])
    # Closed: noise leaves single pixels of lit surfaces black.
    lit = cv2.morphologyEx(some.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    shown = [np.flatnonzero(lit.any(axis=1 - axis)) for axis in (0, 1)]
    if not shown[0].size:
        return None
    rows, columns = (slice(int(places[0]), int(places[-1]) + 1) for places in shown)
    if min(rows.stop - rows.start, columns.stop - columns.start) < _LEAST:
        return None
    # Three rows or columns at each edge: noise leaves pixels of a single one black.
    edges = [lit[rows.start : rows.start + 3, columns].max(axis=0)] if rows.start > 0 else []
    edges += [lit[rows.stop - 3 : rows.stop, columns].max(axis=0)] if rows.stop < len(lit) else []
    edges += [lit[rows, columns.start : columns.start + 3].max(axis=1)] if columns.start > 0 else []
    edges += [lit[rows, columns.stop - 3 : columns.stop].max(axis=1)] if columns.stop < lit.shape[1] else []
    return (rows, columns) if edges and min(edge.mean() for edge in edges) >= _EDGE else None


def mirror_region(frame: Frame, region: Region) -> Frame:
    """Mirror the color and the guides of a frame beyond the edges of the render region of `find_region`."""
    height, width = frame.color.shape[:2]
    (rows, columns), size = region, (region[0].stop - region[0].start, region[1].stop - region[1].start)
    top, left = min(rows.start, _MIRRORED), min(columns.start, _MIRRORED)
    bottom, right = min(height - rows.stop, _MIRRORED), min(width - columns.stop, _MIRRORED)
    outer = slice(rows.start - top, rows.stop + bottom), slice(columns.start - left, columns.stop + right)
    y, x = (
        np.pad(np.arange(length), border, mode="symmetric")
        for length, border in zip(size, ((top, bottom), (left, right)), strict=True)
    )
    mirrored = {}
    for name in ("color", "albedo", "normal"):
        if (layer := getattr(frame, name)) is not None:
            mirrored[name] = layer.copy()
            mirrored[name][outer] = layer[region][y][:, x]
    return replace(frame, **mirrored)


def split_unfiltered(frame: Frame) -> tuple[Array, Unfiltered]:
    """Split a frame's color (H, W, 3) into radiance to denoise, not finite where it is lost, and unfiltered light.

    The negative part of a color outside of the gamut counts up to the light of the brightest channel. A pixel that is
    negative in all channels is the trace of a filter with negative lobes next to a lamp, and stays.
    """
    layers = {"color": frame.color, **frame.aovs}
    negative = {name: part for name, layer in layers.items() if (part := _negative(layer)) is not None}
    color = frame.color - negative["color"] if "color" in negative else frame.color
    gray = frozenset(name for name, layer in layers.items() if _is_gray(layer))
    return color, Unfiltered(_lights(frame), negative, gray, empty=_empty(frame))


def as_gray(picture: Array) -> Array:
    """Return the mean of three channels, in all three."""
    return np.repeat(picture.mean(axis=-1, keepdims=True), 3, axis=-1)


def _is_gray(layer: Array) -> bool:
    """Whether three channels are the same everywhere."""
    if layer.shape[-1] != 3:
        return False
    # Some rows first, in which nearly all layers differ.
    return all(
        np.array_equal(part[..., 0], part[..., c], equal_nan=True) for part in (layer[::16], layer) for c in (1, 2)
    )


def _empty(frame: Frame) -> Mask | None:
    """Where color and alpha, or color and all guides, are 0 in whole squares of pixels; None if nowhere."""
    black = _is_zero(frame.color)
    guides = [layer for layer in (frame.albedo, frame.normal) if layer is not None]
    if not black.any() or (frame.alpha is None and not guides):
        return None
    transparent = np.False_ if frame.alpha is None else frame.alpha == 0
    bare = np.logical_and.reduce([_is_zero(layer) for layer in guides]) if guides else np.False_
    missed = np.asarray(black & (transparent | bare), np.uint8)
    empty = cv2.morphologyEx(missed, cv2.MORPH_OPEN, np.ones((_EMPTY, _EMPTY), np.uint8)) > 0
    _, labels, sizes, _ = cv2.connectedComponentsWithStats(1 - missed, connectivity=8)
    single = (missed == 0) & (sizes[labels, cv2.CC_STAT_AREA] < _LIGHT)
    if single.any():
        empty &= cv2.dilate(single.astype(np.uint8), np.ones((4 * _EMPTY + 1, 4 * _EMPTY + 1), np.uint8)) == 0
    return empty if empty.any() else None


def _is_zero(layer: Array) -> Mask:
    """The pixels (H, W) of a layer that are 0 in all channels."""
    return np.asarray(np.logical_and.reduce([plane == 0 for plane in np.moveaxis(layer, -1, 0)]))


def _negative(layer: Array) -> Array | None:
    """The negative part of three channels, up to the light of the brightest; None if there is none."""
    if layer.shape[-1] != 3 or not (layer < 0).any():
        return None
    light = np.maximum(layer.max(axis=-1, keepdims=True), 0)
    negative = np.nan_to_num(np.maximum(np.minimum(layer, 0), -light), nan=0, posinf=0, neginf=0)
    return negative if negative.any() else None


def _lights(frame: Frame) -> Array | None:
    """The radiance of lights beyond half, NaN elsewhere; None without such lights."""
    if frame.beyond is None:
        return None
    radiance = np.where(frame.beyond, np.float32(HALF_MAX), frame.color)
    mask = frame.beyond.any(axis=-1) & np.isfinite(radiance).all(axis=-1)
    _, labels, sizes, _ = cv2.connectedComponentsWithStats(np.asarray(mask, np.uint8), connectivity=8)
    mask &= sizes[labels, cv2.CC_STAT_AREA] >= _LIGHT
    return np.where(mask[..., None], radiance, np.float32(np.nan)) if mask.any() else None
