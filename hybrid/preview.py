"""A shot to look at, noisy beside denoised: one frame, the shot as it plays, a sheet of frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.transfer import measure_exposure
from hybrid.files.movies import check_movie, write_movie
from hybrid.files.png import encode_bytes, write_png
from hybrid.files.shots import Shot, output_path
from nlm.average import replace_nonfinite

Picture = NDArray[np.uint8]

# Frames a second that a movie plays without --fps: what film and Blender have.
RATE = 24.0
# Seconds that the divider takes from the left to the right and back.
SWEEP = 4.0
# A shorter shot is shown several times, as long as this many frames last.
SHORTEST = 48
# Of a sheet: how many frames at most, and how wide each of them.
SHEET_FRAMES, SHEET_WIDTH = 24, 320


def check_preview(path: Path) -> None:
    """Refuse what `write_preview` could not write, before any work is done.

    Raises
    ------
    ValueError
        If the name does not end in .png, .mp4 or .webp.
    ImportError
        If it needs a library that is not installed.
    """
    if path.suffix.lower() not in (".png", ".mp4", ".webp"):
        raise ValueError(f"preview {path}: expected a name that ends in .png, .mp4 or .webp")
    if path.suffix.lower() != ".png":
        check_movie(path)


def check_png(path: Path, what: str) -> None:
    """Refuse, before any work is done, a picture that would not be what its name says.

    Parameters
    ----------
    path : Path
        Of a PNG that is to be written.
    what : str
        What an error calls it.

    Raises
    ------
    ValueError
        If the name does not end in .png.
    """
    if path.suffix.lower() != ".png":
        raise ValueError(f"{what} {path}: expected a name that ends in .png")


def write_preview(shot: Shot, output: str | Path, path: Path, *, rate: float = RATE) -> None:
    """Write a picture of the middle frame, or a movie of the shot, by the suffix of its name.

    Parameters
    ----------
    shot : Shot
        The input.
    output : str or Path
        Where its denoised frames are (`hybrid.pipeline.denoise_frames`).
    path : Path
        A .png has the middle frame, noisy on the left and denoised on the right. A .mp4 or .webp plays the shot with a
        divider that moves: noisy to the left of it, denoised to the right. Both sides of all frames are exposed alike,
        so that the middle noisy frame has a mean of 0.18, and sRGB encoded.
    rate : float
        Frames per second of a movie.

    Raises
    ------
    ValueError, ImportError
        As `check_preview`.
    FileNotFoundError
        If a denoised frame is not there.
    """
    check_preview(path)
    pairs = _Pairs(shot, output)
    if path.suffix.lower() == ".png":
        noisy, denoised = pairs.read(shot.numbers[len(shot.numbers) // 2])
        write_png(path, np.concatenate([noisy, denoised], axis=1) / 255)
    else:
        write_movie(path, _wipe(pairs, rate), rate)


def write_contact_sheet(shot: Shot, output: str | Path, path: Path) -> None:
    """Write a PNG with frames from all over the shot, the left half of each noisy and the right half denoised.

    Parameters
    ----------
    shot : Shot
        As for `write_preview`, exposed as there.
    output : str or Path
        The same.
    path : Path
        Of the PNG: at most `SHEET_FRAMES` frames with their numbers, row by row, from the first to the last.

    Raises
    ------
    ValueError
        As `check_png`.
    FileNotFoundError
        If a denoised frame is not there.
    """
    check_png(path, "contact")
    pairs = _Pairs(shot, output)
    count = min(len(shot.numbers), SHEET_FRAMES)
    chosen = [shot.numbers[round(i * (len(shot.numbers) - 1) / max(count - 1, 1))] for i in range(count)]
    height, width = shot.shape
    size = SHEET_WIDTH, max(1, round(height * SHEET_WIDTH / width))
    columns = int(np.ceil(np.sqrt(count)))
    sheet = np.full((-(-count // columns) * size[1], columns * size[0], 3), 255, np.uint8)
    for index, number in enumerate(chosen):
        noisy, denoised = pairs.read(number)
        split = divide(noisy, denoised, 0.5)
        small = cv2.resize(split, size, interpolation=cv2.INTER_AREA if width > size[0] else cv2.INTER_LINEAR)
        for thickness, gray in ((3, 0), (1, 255)):  # white on black is read on any picture
            at, font = (6, size[1] - 8), cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(small, str(number), at, font, 0.45, (gray, gray, gray), thickness, cv2.LINE_AA)
        top, left = index // columns * size[1], index % columns * size[0]
        sheet[top : top + size[1], left : left + size[0]] = small
    write_png(path, sheet / 255)


def divide(left: Picture, right: Picture, position: float) -> Picture:
    """Put two pictures together, with a white divider between.

    Parameters
    ----------
    left, right : (H, W, 3) array
        Pictures, alike.
    position : float
        Of the divider, from 0, where only `right` is seen, to 1.

    Returns
    -------
    (H, W, 3) array
    """
    width = left.shape[1]
    column = round(position * width)
    whole = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    if 0 < column < width:
        half = max(1, width // 960)
        whole[:, max(0, column - half) : column + half] = 255
    return whole


class _Pairs:
    """The frames of a shot, noisy and denoised, exposed alike and sRGB encoded."""

    def __init__(self, shot: Shot, output: str | Path) -> None:
        self.noisy = shot
        self.denoised = shot.reopened({number: output_path(output, shot, number) for number in shot.numbers})
        middle, _ = replace_nonfinite(shot.read_color(shot.numbers[len(shot.numbers) // 2]))
        self._exposure = np.float32(measure_exposure(middle) / 0.18)

    def read(self, number: int) -> tuple[Picture, Picture]:
        """One frame: noisy and denoised, (H, W, 3) each."""
        return self._encoded(self.noisy, number), self._encoded(self.denoised, number)

    def _encoded(self, shot: Shot, number: int) -> Picture:
        color, _ = replace_nonfinite(shot.read_color(number))
        return encode_bytes(color / self._exposure)


def _wipe(pairs: _Pairs, rate: float) -> Iterator[Picture]:
    """The pictures of a movie, which ends where it begins."""
    numbers = pairs.noisy.numbers
    rounds = max(1, SHORTEST // len(numbers))
    total = rounds * len(numbers)
    sweeps = max(1, round(total / rate / SWEEP))
    kept: dict[int, tuple[Picture, Picture]] = {}
    for index in range(total):
        number = numbers[index % len(numbers)]
        if number in kept:
            noisy, denoised = kept[number]
        else:
            noisy, denoised = pairs.read(number)
            if rounds > 1:
                kept[number] = noisy, denoised
        yield divide(noisy, denoised, 0.5 + 0.5 * float(np.sin(2 * np.pi * sweeps * index / total)))
