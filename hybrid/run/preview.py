"""Previews of noisy and denoised frames side by side: one frame, a movie, a contact sheet."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from hybrid.files.movies import check_movie, write_movie
from hybrid.files.png import Image8, display_exposure, encode_bytes, write_label, write_png
from hybrid.files.shots import Shot, output_path
from nlm.average import replace_nonfinite

LABELLED = 240  # pixels of width from which a preview has labels
SHORTEST = 48  # frames of a movie; shorter shots are repeated
SHEET_FRAMES, SHEET_WIDTH = 24, 320  # frames of a contact sheet at most, and pixels of their width


def check_preview(path: Path) -> None:
    """Raise ValueError if the name does not end in .png, .mp4 or .webp, ImportError if a library is missing for it."""
    if path.suffix.lower() not in (".png", ".mp4", ".webp"):
        raise ValueError(f"preview {path}: expected a name that ends in .png, .mp4 or .webp")
    if path.suffix.lower() != ".png":
        check_movie(path)


def check_png(path: Path, what: str) -> None:
    """Raise ValueError if the name, of the option `what`, does not end in .png."""
    if path.suffix.lower() != ".png":
        raise ValueError(f"{what} {path}: expected a name that ends in .png")


def write_preview(shot: Shot, output: str | Path, path: Path, *, rate: float = 24.0) -> None:
    """Write the middle frame as a .png, noisy left and denoised right, or a .mp4 or .webp with a moving divider.

    Movies play at `rate` frames per second. All frames have one exposure, by `display_exposure` of the middle noisy
    frame, and are sRGB encoded.
    """
    check_preview(path)
    pairs = _Pairs(shot, output)
    if path.suffix.lower() == ".png":
        noisy, denoised = pairs.read_labelled(shot.numbers[len(shot.numbers) // 2])
        write_png(path, np.concatenate([noisy, denoised], axis=1) / 255)
    else:
        write_movie(path, _wipe(pairs, rate), rate)


def write_contact_sheet(shot: Shot, output: str | Path, path: Path) -> None:
    """Write a PNG of at most `SHEET_FRAMES` numbered frames, each noisy left and denoised right, as `write_preview`."""
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
        way = cv2.INTER_AREA if width > size[0] else cv2.INTER_LINEAR
        small: Image8 = np.asarray(cv2.resize(split, size, interpolation=way), np.uint8)
        write_label(small, str(number))
        top, left = index // columns * size[1], index % columns * size[0]
        sheet[top : top + size[1], left : left + size[0]] = small
    write_png(path, sheet / 255)


def divide(left: Image8, right: Image8, position: float) -> Image8:
    """Combine two images with a white divider at a position from 0 (only `right` is visible) to 1."""
    width = left.shape[1]
    column = round(position * width)
    whole = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    if 0 < column < width:
        half = max(1, width // 960)
        whole[:, max(0, column - half) : column + half] = 255
    return whole


class _Pairs:
    """Noisy and denoised frames of a shot at one exposure, sRGB encoded."""

    def __init__(self, shot: Shot, output: str | Path) -> None:
        self.noisy = shot
        self.denoised = shot.reopened({number: output_path(output, shot, number) for number in shot.numbers})
        middle, _ = replace_nonfinite(shot.reader.read_color(shot.numbers[len(shot.numbers) // 2]))
        self._exposure = np.float32(display_exposure(middle))

    def read(self, number: int) -> tuple[Image8, Image8]:
        return self._encoded(self.noisy, number), self._encoded(self.denoised, number)

    def read_labelled(self, number: int) -> tuple[Image8, Image8]:
        """A pair with the names of both in it, where there is room for them."""
        noisy, denoised = self.read(number)
        if noisy.shape[1] >= LABELLED:
            write_label(noisy, "noisy")
            write_label(denoised, "ravg", right=True)
        return noisy, denoised

    def _encoded(self, shot: Shot, number: int) -> Image8:
        color, _ = replace_nonfinite(shot.reader.read_color(number))
        return encode_bytes(color / self._exposure)


def _wipe(pairs: _Pairs, rate: float) -> Iterator[Image8]:
    """The frames of a movie that ends where it begins."""
    numbers = pairs.noisy.numbers
    rounds = max(1, SHORTEST // len(numbers))
    total = rounds * len(numbers)
    sweeps = max(1, round(total / rate / 4))  # the divider's way from left to right and back takes four seconds
    read = cache(pairs.read_labelled) if rounds > 1 else pairs.read_labelled
    for index in range(total):
        noisy, denoised = read(numbers[index % len(numbers)])
        yield divide(noisy, denoised, 0.5 + 0.5 * float(np.sin(2 * np.pi * sweeps * index / total)))
