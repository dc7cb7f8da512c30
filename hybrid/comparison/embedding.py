"""Pictures and maps as text inside a page, small enough and without loss that can be seen."""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.transfer import measure_exposure

Array = NDArray[np.float32]
Codes = NDArray[np.int32]
Box = tuple[int, int, int, int]  # x, y, width, height in pixels

# Radiance is embedded as a logarithm in steps of 1.5 % (finer than 8 bits of sRGB show from mid-grey up), and
# linearly below 1/64 of the shot's mean level. 1023 codes reach 40,000 times that level.
CODES_PER_STOP = 48
CODES = 1024
NOT_FINITE = CODES - 1
MAP_LEVELS = 64  # of a map in [0, 1]; a colour scale shows no more
SMALLEST_CROP = 160  # pixels across; below that frames are left out instead


@dataclass(frozen=True)
class ReportImages:
    """The pictures of one method, read when asked for.

    Attributes
    ----------
    name : str
        That of its `MethodResult`.
    frame : callable
        From a frame number to its (H, W, 3) linear radiance.
    maps : mapping of str to callable
        From a title, such as "FLIP" or "Confidence", to a function from a frame number to an (H, W) map in [0, 1], or
        to None where that frame has none.
    """

    name: str
    frame: Callable[[int], Array]
    maps: Mapping[str, Callable[[int], Array | None]] = field(default_factory=dict)


@dataclass(frozen=True)
class EmbeddedPictures:
    """Pictures encoded for a page.

    Attributes
    ----------
    info : dict
        What the page's script has to know to decode and to name them.
    elements : list of (str, str)
        Of each element that holds a picture or a map: its id and its text.
    """

    info: dict[str, object]
    elements: list[tuple[str, str]]

    @property
    def extent(self) -> str:
        """What is shown of the shot, in words."""
        return str(self.info["extent"])


def embed_pictures(
    images: Sequence[ReportImages],
    labels: Mapping[str, str],
    reference: Callable[[int], Array],
    frames: Sequence[int],
    limit: float,
) -> EmbeddedPictures:
    """Encode pictures and maps of all methods and of the reference.

    Parameters
    ----------
    images : sequence of ReportImages
        In the order of the viewer.
    labels : mapping of str to str
        What the viewer calls each method, by name.
    reference : callable
        From a frame number to (H, W, 3) linear radiance.
    frames : sequence of int
        Numbers of the frames.
    limit : float
        Bytes that the pictures may take. Above it they are cropped around what differs most, then frames are left out.

    Returns
    -------
    EmbeddedPictures

    Raises
    ------
    ValueError
        If pictures differ in shape.
    """
    sources = [ReportImages("reference", reference), *images]
    middle_number = frames[len(frames) // 2]
    middle = reference(middle_number)
    height, width = middle.shape[:2]
    level = measure_exposure(middle)
    box, kept = (0, 0, width, height), list(frames)
    # 4.5 bits a sample is what rendered frames take; where it is not enough the loop shrinks further.
    expected = len(sources) * len(kept) * width * height * 3 * 4.5 / 8 * 4 / 3
    while True:
        if expected > limit:
            busy = _busiest_point(sources, middle_number, level, middle.shape)
            box, kept = _shrink(box, kept, limit / expected, busy)
        elements, row = _encode_all(sources, kept, box, level, middle.shape)
        expected = sum(len(text) for _, text in elements)
        if expected <= limit or (len(kept) == 1 and box[2] <= SMALLEST_CROP):
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
        "extent": _describe_extent(box, kept, (width, height), frames, limit),
        "sources": [{"name": s.name, "label": labels.get(s.name, "Reference"), "maps": list(s.maps)} for s in sources],
    }
    return EmbeddedPictures(info, elements)


def _describe_extent(box: Box, kept: Sequence[int], size: tuple[int, int], frames: Sequence[int], limit: float) -> str:
    """Which frames and pixels are embedded, and why not all."""
    width, height = size
    words = f"Frames {kept[0]} to {kept[-1]}" if len(kept) > 1 else f"Frame {kept[0]}"
    if len(kept) < len(frames):
        words += f" of {frames[0]} to {frames[-1]}"
    words += f", {box[2]} × {box[3]} pixels"
    if box[2:] != size:
        words += f" at ({box[0]}, {box[1]}) of {width} × {height}"
    if len(kept) < len(frames) or box[2:] != size:
        words += f"; the rest is left out to keep the page below {limit / 1e6:.0f} MB. The figures are of everything"
    return words


def _encode_all(
    sources: Sequence[ReportImages], frames: Sequence[int], box: Box, level: float, shape: tuple[int, ...]
) -> tuple[list[tuple[str, str]], int]:
    """Ids and texts of every picture and map, and the row in which the methods flicker most."""
    elements = []
    flicker = np.zeros(box[3])
    truth: list[Codes] = []
    for i, source in enumerate(sources):
        before = None
        for k, number in enumerate(frames):
            codes = to_codes(_cut(source.frame(number), box, shape, source.name), level)
            elements.append((f"p{i}-{k}", compress(codes, CODES)))
            if i == 0:
                truth.append(codes)
            error = codes - truth[k]
            if before is not None:
                flicker += np.abs(error - before).mean(axis=(1, 2))
            before = error
            for j, (title, read) in enumerate(source.maps.items()):
                whole = read(number)
                if whole is None:
                    continue
                values = _cut(whole, box, shape[:2], f"{source.name}, {title}")
                levels = np.rint(np.clip(np.nan_to_num(values), 0, 1) * (MAP_LEVELS - 1)).astype(np.int32)
                elements.append((f"m{i}-{j}-{k}", compress(levels[..., None], MAP_LEVELS)))
    return elements, int(np.argmax(flicker))


def _cut(image: Array, box: Box, shape: tuple[int, ...], name: str) -> Array:
    if image.shape != shape:
        raise ValueError(f"pictures must be alike: {name} has the shape {image.shape}, expected {shape}")
    x, y, width, height = box
    return image[y : y + height, x : x + width]


def to_codes(image: Array, level: float) -> Codes:
    """Encode radiance as integers, evenly spaced in log(1 + x / black); the last one means "not finite".

    Parameters
    ----------
    image : (H, W, 3) array
        Linear radiance; negative values count as 0.
    level : float
        The shot's mean level; black is 1/64 of it.

    Returns
    -------
    (H, W, 3) array of int32
        In [0, `CODES`).
    """
    finite = np.isfinite(image)
    scaled = np.maximum(np.where(finite, image, 0), 0) / (level / 64)
    codes = np.minimum(np.rint(np.log2(1 + scaled) * CODES_PER_STOP), NOT_FINITE - 1)
    return np.where(finite, codes, NOT_FINITE).astype(np.int32)


def _busiest_point(
    sources: Sequence[ReportImages], number: int, level: float, shape: tuple[int, ...]
) -> tuple[int, int]:
    """The pixel (x, y) around which the methods differ most from each other in one frame."""
    height, width = shape[:2]
    total, squares = np.zeros((2, height, width), np.float32)
    for source in sources:
        picture = _cut(source.frame(number), (0, 0, width, height), shape, source.name)
        codes = to_codes(picture, level).mean(axis=-1).astype(np.float32)
        total += codes
        squares += codes**2
    spread = np.maximum(squares / len(sources) - (total / len(sources)) ** 2, 0)
    y, x = np.unravel_index(np.argmax(cv2.boxFilter(spread, -1, (width // 4 + 1, height // 4 + 1))), spread.shape)
    return int(x), int(y)


def _shrink(box: Box, frames: list[int], ratio: float, towards: tuple[int, int]) -> tuple[Box, list[int]]:
    """Leave out pixels around the busy point, and frames where the crop is the smallest."""
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
    """Compress integers without loss.

    Parameters
    ----------
    codes : (H, W, C) array of int32
        In [0, levels).
    levels : int
        A power of two.

    Returns
    -------
    str
        Base64, which `pictures.js` decodes.

    Notes
    -----
    Red and blue are stored as differences to green, each plane as differences to a prediction from the pixels left,
    above and above left (the median predictor of JPEG-LS, Weinberger et al. 2000, doi:10.1109/83.855427), all
    modulo `levels`, signs folded so that small differences are small numbers; then low bytes, high bytes, and
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
