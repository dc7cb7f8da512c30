"""Frames and maps as text inside the page: compact, without visible loss."""

import base64
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.transfer import measure_exposure
from hybrid.files.frame import Array

Codes = NDArray[np.int32]
Box = tuple[int, int, int, int]  # x, y, width, height in pixels

# Radiance is stored as a logarithm in steps of 1.5 % (finer than 8 bits of sRGB from mid-gray up), and linearly below
# 1/64 of the shot's mean level. 1023 codes reach 40,000 times that level.
CODES_PER_STOP = 48
CODES = 1024
NOT_FINITE = CODES - 1
MAP_LEVELS = 64  # of a map in [0, 1]; a color scale shows no more
LIMIT = 24e6  # bytes of all pictures and maps
SMALLEST_CROP = 160  # pixels across; below that frames are left out instead


@dataclass(frozen=True)
class MethodImages:
    """Images of one method, read on demand."""

    name: str  # name of its `MethodResult`
    frame: Callable[[int], Array]  # from a frame number to (H, W, 3) linear radiance
    # from a title, such as "FLIP", to a function from a frame number to an (H, W) map in [0, 1], or to None
    maps: Mapping[str, Callable[[int], Array | None]] = field(default_factory=dict)


@dataclass(frozen=True)
class ShotImages:
    """Images of all methods in the order of the viewer, the reference, and the numbers of consecutive frames."""

    methods: Sequence[MethodImages]
    reference: Callable[[int], Array]
    frames: Sequence[int]
    exposure: float = 1.0  # factor e of the tone curve e·x / (1 + e·x) of the metrics
    reference_maps: Mapping[str, Callable[[int], Array | None]] = field(default_factory=dict)  # as of a method

    @property
    def sources(self) -> list[MethodImages]:
        return [MethodImages("reference", self.reference, self.reference_maps), *self.methods]

    @property
    def middle(self) -> int:
        return self.frames[len(self.frames) // 2]


class Embedded(NamedTuple):
    """Data for the page: `info` for its script, and (id, text) of the elements that hold the encoded images."""

    info: Mapping[str, object]
    elements: Sequence[tuple[str, str]]


def embed_pictures(images: ShotImages) -> Embedded:
    """Encode frames and maps of all sources; above `LIMIT` bytes cropped around the largest differences, then fewer."""
    middle = images.reference(images.middle)
    height, width = middle.shape[:2]
    level = measure_exposure(middle)
    box, kept = (0, 0, width, height), list(images.frames)
    # 4.5 bits per sample are typical of rendered frames; the loop shrinks further where they need more.
    expected = len(images.sources) * len(kept) * width * height * 3 * 4.5 / 8 * 4 / 3
    while True:
        if expected > LIMIT:
            box, kept = _shrink(box, kept, LIMIT / expected, _point_of_differences(images, level))
        elements, row = _encode_all(images.sources, kept, box, level)
        expected = sum(len(text) for _, text in elements)
        if expected <= LIMIT or (len(kept) == 1 and box[2] <= SMALLEST_CROP):
            break
    info = {
        "width": box[2],
        "height": box[3],
        "origin": box[:2],
        "frames": kept,
        "codes": CODES,
        "codesPerStop": CODES_PER_STOP,
        "black": level / 64,
        "mapLevels": MAP_LEVELS,
        "row": row,
        "extent": _describe_extent(box, kept, (width, height), images.frames),
        "sources": [{"name": source.name, "maps": list(source.maps)} for source in images.sources],
    }
    return Embedded(info, elements)


def _describe_extent(box: Box, kept: Sequence[int], size: tuple[int, int], frames: Sequence[int]) -> str:
    """Which frames and pixels are embedded, and why not all."""
    width, height = size
    words = f"Frames {kept[0]} to {kept[-1]}" if len(kept) > 1 else f"Frame {kept[0]}"
    if len(kept) < len(frames):
        words += f" of {frames[0]} to {frames[-1]}"
    words += f", {box[2]} × {box[3]} pixels"
    if box[2:] != size:
        words += f" at ({box[0]}, {box[1]}) of {width} × {height}"
    if len(kept) < len(frames) or box[2:] != size:
        words += f"; the rest is left out to keep the page below {LIMIT / 1e6:.0f} MB. The figures include everything"
    return words


def _encode_all(
    sources: Sequence[MethodImages], frames: Sequence[int], box: Box, level: float
) -> tuple[list[tuple[str, str]], int]:
    """Ids and texts of all images, and the row with the strongest flicker of the methods."""
    elements = []
    flicker = np.zeros(box[3])
    reference: list[Codes] = []
    for i, source in enumerate(sources):
        previous_error = None
        for k, number in enumerate(frames):
            codes = to_codes(_cut(source.frame(number), box), level)
            elements.append((f"p{i}-{k}", compress(codes, CODES)))
            if i == 0:
                reference.append(codes)
            error = codes - reference[k]
            if previous_error is not None:
                flicker += np.abs(error - previous_error).mean(axis=(1, 2))
            previous_error = error
            for j, read in enumerate(source.maps.values()):
                whole = read(number)
                if whole is None:
                    continue
                levels = np.rint(np.clip(np.nan_to_num(_cut(whole, box)), 0, 1) * (MAP_LEVELS - 1)).astype(np.int32)
                elements.append((f"m{i}-{j}-{k}", compress(levels[..., None], MAP_LEVELS)))
    return elements, int(np.argmax(flicker))


def _cut(image: Array, box: Box) -> Array:
    x, y, width, height = box
    return image[y : y + height, x : x + width]


def to_codes(image: Array, level: float) -> Codes:
    """Encode radiance in [0, `CODES`) by log(1 + x / black), black 1/64 of the mean level; else `NOT_FINITE`."""
    finite = np.isfinite(image)
    scaled = np.maximum(np.where(finite, image, 0), 0) / (level / 64)
    codes = np.minimum(np.rint(np.log2(1 + scaled) * CODES_PER_STOP), NOT_FINITE - 1)
    return np.where(finite, codes, NOT_FINITE).astype(np.int32)


def _point_of_differences(images: ShotImages, level: float) -> tuple[int, int]:
    """The pixel (x, y) around which the methods differ most in the middle frame."""
    height, width = images.reference(images.middle).shape[:2]
    total, squares = np.zeros((2, height, width), np.float32)
    for source in images.sources:
        codes = to_codes(source.frame(images.middle), level).mean(axis=-1).astype(np.float32)
        total += codes
        squares += codes**2
    spread = np.maximum(squares / len(images.sources) - (total / len(images.sources)) ** 2, 0)
    y, x = np.unravel_index(np.argmax(cv2.boxFilter(spread, -1, (width // 4 + 1, height // 4 + 1))), spread.shape)
    return int(x), int(y)


def _shrink(box: Box, frames: list[int], ratio: float, towards: tuple[int, int]) -> tuple[Box, list[int]]:
    """Crop around a pixel to a fraction of the size; below the smallest crop leave out frames."""
    x, y, width, height = box
    ratio *= 0.97
    if width > SMALLEST_CROP:
        side = max(math.sqrt(ratio), SMALLEST_CROP / width)
        ratio /= side**2
        w, h = max(int(width * side), 1), max(int(height * side), 1)
        x = min(max(towards[0] - w // 2, x), x + width - w)
        y = min(max(towards[1] - h // 2, y), y + height - h)
        width, height = w, h
    if ratio < 0.97:
        keep = max(1, int(len(frames) * ratio))
        start = (len(frames) - keep) // 2
        frames = frames[start : start + keep]
    return (x, y, width, height), frames


def compress(codes: Codes, levels: int) -> str:
    """Compress integers in [0, levels), (H, W, C), without loss to base64, which `pictures.js` decodes.

    Red and blue are stored as differences to green, each plane as differences to a prediction from the pixels left,
    above and above left (the median predictor of JPEG-LS, Weinberger et al. 2000, doi:10.1109/83.855427), all modulo
    `levels`, a power of two, signs folded so that small differences are small numbers; then low bytes, high bytes, and
    zlib. A PNG would reach the page's script with 8 bits per channel only.
    """
    half = levels // 2
    planes = np.moveaxis(codes, -1, 0)
    if len(planes) == 3:
        red, green, blue = planes
        planes = np.stack([green, (red - green + half) % levels, (blue - green + half) % levels])
    above = np.pad(planes[:, :-1], ((0, 0), (1, 0), (0, 0)))
    left = np.concatenate([above[:, :, :1], planes[:, :, :-1]], axis=2)
    corner = np.concatenate([np.pad(above[:, :-1, :1], ((0, 0), (1, 0), (0, 0))), above[:, :, :-1]], axis=2)
    small, large = np.minimum(left, above), np.maximum(left, above)
    guess = np.where(corner >= large, small, np.where(corner <= small, large, left + above - corner))
    rest = (planes - guess + half) % levels - half
    folded = np.where(rest < 0, -2 * rest - 1, 2 * rest).astype(np.uint16)
    raw = (folded & 255).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()
    # Noise has runs and no repetitions: this strategy is a tenth smaller and seven times faster than the default.
    packer = zlib.compressobj(strategy=zlib.Z_RLE)
    return base64.b64encode(packer.compress(raw) + packer.flush()).decode("ascii")
