"""Frames from pixels: the layers of a file on the canvas of its shot, scaled and limited as their profile says."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hybrid.files.exr import ExrError, ExrImage, Layer, Part
from hybrid.files.frame import Frame
from hybrid.files.layers import Layers
from hybrid.files.profile import ROLES
from nlm.variance import variance_from_halves

# No light is brighter: the squares of so much, summed over all pixels of the largest frame, still fit float32. One
# pixel of 1e30 made NaN of all frames around it.
LARGEST = 1e14
LIMITED = frozenset({"color", "albedo", "normal", "variance", "half_a", "half_b", "estimate"})


class Window(NamedTuple):
    """First column, first row, last column, last row, relative to the display window."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.bottom - self.top + 1, self.right - self.left + 1


def display_size(part: Part) -> tuple[int, int]:
    """Return width and height of the display window."""
    left, top, right, bottom = part.display_window
    return right - left + 1, bottom - top + 1


def data_window(part: Part) -> Window:
    """Return the data window relative to the display window."""
    x, y = part.display_window[:2]
    left, top, right, bottom = part.data_window
    return Window(left - x, top - y, right - x, bottom - y)


def place(array: np.ndarray, source: Window, target: Window) -> np.ndarray:
    """Move an image (H, W, ...) from one window to another, cut or filled with 0."""
    if source[:2] == target[:2] and array.shape[:2] == target.shape:
        return array
    (height, width), out = target.shape, np.zeros((*target.shape, *array.shape[2:]), array.dtype)
    x, y = source.left - target.left, source.top - target.top
    top, bottom = max(0, y), min(height, y + array.shape[0])
    left, right = max(0, x), min(width, x + array.shape[1])
    if top < bottom and left < right:
        out[top:bottom, left:right] = array[top - y : bottom - y, left - x : right - x]
    return out


def decode_layer(image: ExrImage, layer: Layer, canvas: Window) -> np.ndarray:
    """Return a layer on the canvas, (H, W, C) float32."""
    return place(image.pixels(layer.channels), data_window(image.parts[layer.part]), canvas)


def decode_frame(
    image: ExrImage, layers: Layers, canvas: Window, number: int, sidecars: Mapping[str, ExrImage]
) -> Frame:
    """Make a frame from its file, and other files that hold the layer of a role; ExrError if an AOV has integers."""
    for name, layer in layers.aovs.items():
        if any(image.channel(channel).dtype == np.uint32 for channel in layer.channels):
            raise ExrError(f"{image.path}: aov {name!r} is {layer}, whole numbers, of which averages mean nothing")
    arrays = {
        role: decode_layer(sidecars.get(role, image), layer, canvas)
        for role in ROLES
        if (layer := getattr(layers, role)) is not None
    }
    for role in {"depth", "alpha"} & arrays.keys():
        arrays[role] = np.ascontiguousarray(arrays[role][..., 0])
    if "variance" in arrays and arrays["variance"].shape[2] == 1:
        arrays["variance"] = np.repeat(arrays["variance"], 3, axis=2)
    if "variance" in arrays and layers.variance_scale not in (None, 1):
        arrays["variance"] = arrays["variance"] * np.float32(layers.variance_scale)
    if "estimate" in arrays and layers.estimate_factors is not None:
        arrays["estimate"] = arrays["estimate"] * np.array(layers.estimate_factors, np.float32)
    convention = layers.motion_convention
    motion_next = arrays.pop("motion_next", None)
    if motion_next is not None and convention is not None:
        count = convention.channels // 2
        arrays["motion"] = np.concatenate([arrays["motion"][..., :count], motion_next[..., :count]], axis=-1)
    if convention is not None and convention.premultiplied:
        convention = replace(convention, premultiplied=False)
        if (alpha := arrays.get("alpha")) is not None:
            np.divide(arrays["motion"], alpha[..., None], out=arrays["motion"], where=alpha[..., None] > 0)
    # In float32 +Inf is the result of a division, and as lost as NaN.
    half = all(image.channel(channel).dtype == np.float16 for channel in layers.color.channels)
    beyond = arrays["color"] == np.inf if half else None
    for role in LIMITED & arrays.keys():
        arrays[role] = _limited(arrays[role], LARGEST**2 if role == "variance" else LARGEST)
    halves = arrays.pop("half_a", None), arrays.pop("half_b", None)
    if "variance" not in arrays and halves[0] is not None and halves[1] is not None:
        arrays["variance"] = variance_from_halves(halves[0], halves[1])
    return Frame(
        number=number,
        **arrays,  # type: ignore[arg-type]
        motion_convention=convention,
        resolution=display_size(image.parts[layers.color.part])[::-1],
        aovs={name: decode_layer(image, layer, canvas) for name, layer in layers.aovs.items()},
        pass_colors={name: decode_layer(image, layer, canvas) for name, layer in layers.pass_colors.items()},
        source=image.path,
        samples=layers.samples,
        beyond=None if beyond is None or not beyond.any() else beyond,
    )


def _limited(layer: np.ndarray, largest: float) -> np.ndarray:
    """Set values beyond ±`largest` to NaN: they are as lost as those that are not finite."""
    if -largest <= layer.min() and layer.max() <= largest:  # not so where a value is NaN
        return layer
    beyond = (layer > largest) | (layer < -largest)
    return np.where(beyond, np.float32(np.nan), layer) if beyond.any() else layer
