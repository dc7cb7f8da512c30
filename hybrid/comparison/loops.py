"""The shot as it plays: whole frames of every method, small enough to lie in a page, or as movies beside it."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.transfer import measure_exposure
from hybrid.comparison.embedding import ReportImages
from hybrid.files.movies import write_movie
from hybrid.files.png import encode_bytes

Array = NDArray[np.float32]
Picture = NDArray[np.uint8]

# Pixels of a loop's longer side, at most and at least, and a WebP's.
LARGEST, SMALLEST, TALLEST = 480, 96, 16383
QUALITY = 75


@dataclass(frozen=True)
class Loops:
    """Loops for a page.

    Attributes
    ----------
    info : dict
        What the page's script has to know: size of a frame, frames in a row of a sheet, names, the rate.
    elements : list of (str, str)
        Of each element that holds a sheet of frames: its id, and a WebP in base64.
    """

    info: dict[str, object]
    elements: list[tuple[str, str]]


def mid_exposure(exposure: float, level: float) -> float:
    """Stops, in halves, that bring a shot's mean level to a comfortable middle gray on the tone curve of the metrics.

    Parameters
    ----------
    exposure : float
        Of the curve e·x / (1 + e·x).
    level : float
        Radiance.
    """
    return round(2 * float(np.log2(0.35 / (exposure * level)))) / 2


def embed_loops(
    images: Sequence[ReportImages],
    labels: Mapping[str, str],
    reference: Callable[[int], Array],
    frames: Sequence[int],
    *,
    exposure: float,
    rate: float,
    limit: float,
) -> Loops:
    """Make a loop of every method and of the reference.

    Parameters
    ----------
    images, labels, reference, frames : sequence, mapping, callable, sequence
        As for `hybrid.comparison.embedding.embed_pictures`.
    exposure : float
        Of the tone curve of the metrics; brightened by whole and half stops until the shot is a middle gray.
    rate : float
        Frames per second.
    limit : float
        Bytes that all loops may take; above it they get smaller.

    Returns
    -------
    Loops
        Each is one WebP with all frames in rows, so that any two play frame by frame together.
    """
    sources = [ReportImages("reference", reference), *images]
    shown = _shown(reference, frames, exposure)
    height, width = reference(frames[0]).shape[:2]
    side = float(min(LARGEST, max(height, width)))
    while True:
        scale = side / max(height, width)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        columns = -(-len(frames) // (TALLEST // size[1]))
        elements = [(f"l{i}", _sheet(s.frame, frames, shown, size, columns)) for i, s in enumerate(sources)]
        total = sum(len(text) for _, text in elements)
        if total <= limit or side <= SMALLEST:
            break
        side = max(SMALLEST, side * min(0.9, (limit / total) ** 0.5))
    info: dict[str, object] = {
        "width": size[0],
        "height": size[1],
        "columns": columns,
        "frames": list(frames),
        "rate": rate,
        "sources": [{"name": s.name, "label": labels.get(s.name, "Reference")} for s in sources],
    }
    return Loops(info, elements)


def write_loops(
    folder: Path,
    images: Sequence[ReportImages],
    reference: Callable[[int], Array],
    frames: Sequence[int],
    *,
    exposure: float,
    rate: float,
) -> dict[str, str]:
    """Write a movie of every method and of the reference, in their own size.

    Parameters
    ----------
    folder : Path
        Of the movies; is made.
    images, reference, frames, exposure, rate : sequence, callable, sequence, float, float
        As for `embed_loops`.

    Returns
    -------
    dict of str to str
        Name of the method → name of the file.

    Raises
    ------
    ImportError
        As `hybrid.files.movies.check_movie`.
    """
    shown = _shown(reference, frames, exposure)
    names = {}
    for index, source in enumerate([ReportImages("reference", reference), *images]):
        # Names of methods may be anything.
        name = f"{index:02d}_{re.sub(r'[^A-Za-z0-9-]+', '_', source.name)[:60]}.mp4"
        write_movie(folder / name, (shown(source.frame(number)) for number in frames), rate)
        names[source.name] = name
    return names


def _shown(reference: Callable[[int], Array], frames: Sequence[int], exposure: float) -> Callable[[Array], Picture]:
    """What turns radiance into what is seen: the curve of the metrics, and sRGB."""
    level = measure_exposure(reference(frames[len(frames) // 2]))
    gain = np.float32(exposure * 2 ** mid_exposure(exposure, level))

    def show(radiance: Array) -> Picture:
        # x / (1 + x), so that the largest float is 1; what is not finite is black.
        light = 1 + gain * np.maximum(np.nan_to_num(radiance, nan=0.0, posinf=0.0, neginf=0.0), 0)
        return encode_bytes(1 - 1 / light)

    return show


def _sheet(
    read: Callable[[int], Array],
    frames: Sequence[int],
    shown: Callable[[Array], Picture],
    size: tuple[int, int],
    columns: int,
) -> str:
    """All frames in rows, from left to right and down, as a WebP."""
    width, height = size
    sheet = np.zeros((-(-len(frames) // columns) * height, columns * width, 3), np.uint8)
    for index, number in enumerate(frames):
        top, left = index // columns * height, index % columns * width
        small = cv2.resize(shown(read(number)), size, interpolation=cv2.INTER_AREA)
        sheet[top : top + height, left : left + width] = small
    _, data = cv2.imencode(".webp", sheet[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return base64.b64encode(data.tobytes()).decode("ascii")
