"""Find where the light is that a denoised picture lacks: in highlights, in rare samples, or everywhere.

    python benchmarks/missing_light.py "out/####.exr" "noisy.####.exr" --reference "a.####.exr" --second "b.####.exr"

Two independent references tell rare bright samples from the rest: where they differ, not even they have enough of them.
Printed are differences to the mean of the two in percent of all light: of the whole picture, of its brightest pixels,
of those at most 2 px from where the references differ, and of all others; and, of medians of 16×16 blocks, by how much
their mean differs: what single pixels do does not count there.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.files.frames import open_shot
from nlm.average import replace_nonfinite

BRIGHTEST = 1e-3  # part of the pixels
DIFFERENT = 0.3  # of the mean of the two references
DARK = 0.05  # times the mean of the picture: below this a difference is of no weight
BLOCK = 16

Array = NDArray[np.float32]


def luminance(path: str, numbers: list[int]) -> list[Array]:
    """Mean of the channels of some frames."""
    shot = open_shot(path, keep=1)
    return [replace_nonfinite(shot.read(number).color)[0].mean(axis=-1) for number in numbers]


def block_medians(image: Array) -> NDArray[np.floating]:
    """Median of each whole block."""
    rows, columns = (length // BLOCK for length in image.shape)
    blocks = image[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
    return np.asarray(np.median(blocks, axis=(1, 3)))


def missing(image: Array, first: Array, second: Array) -> list[float]:
    """The printed figures of a frame, as parts of all light."""
    clean = (first + second) / 2
    bright = clean >= np.quantile(clean, 1 - BRIGHTEST)
    differ = np.abs(first - second) > DIFFERENT * (clean + DARK * clean.mean())
    rare = cv2.dilate(differ.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    parts = [np.ones_like(bright), bright, rare & ~bright, ~rare & ~bright]
    medians, clean_medians = block_medians(image), block_medians(clean)
    found = [float((image - clean)[part].sum() / clean.sum()) for part in parts]
    return [*found, float(medians.mean() / clean_medians.mean() - 1)]


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("pictures", nargs="+")
    parser.add_argument("--reference", required=True)
    parser.add_argument("--second", required=True, help="independent of the first")
    options = parser.parse_args(argv)
    shots = [open_shot(path, keep=1) for path in (*options.pictures, options.reference, options.second)]
    numbers = [number for number in shots[-1].numbers if all(shot.has(number) for shot in shots)]
    first, second = (luminance(path, numbers) for path in (options.reference, options.second))
    print(f"{'':40s}{'all':>10s}{'brightest':>10s}{'rare':>10s}{'others':>10s}{'medians':>10s}")
    for name, images in (("second reference", second), *((p, luminance(p, numbers)) for p in options.pictures)):
        figures = np.mean([missing(*frames) for frames in zip(images, first, second, strict=True)], axis=0)
        print(f"{name[-40:]:40s}" + "".join(f"{100 * figure:+9.2f}%" for figure in figures))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
