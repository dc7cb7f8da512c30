"""Whole frames of every method at playing speed: small WebP sheets inside the page, movies next to the page."""

import base64
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np

from hybrid.alignment.transfer import measure_exposure
from hybrid.comparison.embedding import Embedded, MethodImages, ShotImages
from hybrid.files.frame import Array
from hybrid.files.movies import write_movie
from hybrid.files.png import Image8, encode_bytes

TALLEST = 16383  # pixels of the longer side of a WebP
QUALITY = 75
LIMIT = 4e6  # bytes of all embedded animations


def mid_exposure(exposure: float, level: float) -> float:
    """Return the stops, in halves, that bring a shot's mean level to middle gray on the tone curve of the metrics."""
    return round(2 * float(np.log2(0.35 / (exposure * level)))) / 2


def embed_animations(images: ShotImages) -> Embedded:
    """Encode the animations of the reference and of every method, each as one WebP with all frames in rows.

    Above `LIMIT` bytes in total they are made smaller. Exposed in half stops so that the shot is a middle gray.
    """
    encode = _encoder(images)
    height, width = images.reference(images.frames[0]).shape[:2]
    side = float(min(480, max(height, width)))  # pixels of the longer side of a frame
    while True:
        scale = side / max(height, width)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        columns = -(-len(images.frames) // (TALLEST // size[1]))
        rows = -(-len(images.frames) // columns)
        sheets = [_sheet(map(encode, map(s.frame, images.frames)), rows, columns, size) for s in images.sources]
        total = sum(len(text) for text in sheets)
        if total <= LIMIT or side <= 96:
            break
        side = max(96, side * min(0.9, (LIMIT / total) ** 0.5))
    info: dict[str, object] = {
        "width": size[0],
        "height": size[1],
        "columns": columns,
        "frames": list(images.frames),
        "sources": [{"name": source.name} for source in images.sources],
    }
    return Embedded(info, [(f"a{i}", text) for i, text in enumerate(sheets)])


def file_name(index: int, name: str) -> str:
    """Return a name for files of a source of the viewer: names of methods may hold any character."""
    return f"{index:02d}_{re.sub(r'[^A-Za-z0-9-]+', '_', name)[:60]}"


def write_movies(folder: Path, images: ShotImages, rate: float) -> dict[str, str]:
    """Write an MP4 of the reference and of every method in their own size; return the file names by method."""
    encode = _encoder(images)

    def write(index: int, source: MethodImages) -> str:
        name = f"{file_name(index, source.name)}.mp4"
        write_movie(folder / name, (encode(source.frame(number)) for number in images.frames), rate)
        return name

    return {source.name: write(index, source) for index, source in enumerate(images.sources)}


def _encoder(images: ShotImages) -> Callable[[Array], Image8]:
    """A function from radiance to 8-bit sRGB on the tone curve of the metrics."""
    level = measure_exposure(images.reference(images.middle))
    gain = np.float32(images.exposure * 2 ** mid_exposure(images.exposure, level))

    def encode(radiance: Array) -> Image8:
        # x / (1 + x), written so that the largest float gives 1; non-finite pixels are black.
        light = 1 + gain * np.maximum(np.nan_to_num(radiance, nan=0.0, posinf=0.0, neginf=0.0), 0)
        return encode_bytes(1 - 1 / light)

    return encode


def _sheet(frames: Iterable[Image8], rows: int, columns: int, size: tuple[int, int]) -> str:
    """All frames in rows, from left to right and down, as a WebP in base64."""
    width, height = size
    sheet = np.zeros((rows * height, columns * width, 3), np.uint8)
    for index, frame in enumerate(frames):
        top, left = index // columns * height, index % columns * width
        small = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
        sheet[top : top + height, left : left + width] = small
    _, data = cv2.imencode(".webp", sheet[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return base64.b64encode(data.tobytes()).decode("ascii")
