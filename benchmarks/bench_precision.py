"""What is computed less exactly to be faster: how much error it adds, and how much time it saves.

    python benchmarks/bench_precision.py [--frames 2] [--json OUT]

Each row compares a shortcut with the exact way on frames of the bundled shot: the RMS and the largest difference of the
two pictures, both relative to the mean radiance; the PSNR against the reference that each has, on x / (1 + x); and the
CPU time of the shortcut as a share of the exact way's. Single-threaded, so that the times compare.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

os.environ.update(NUMBA_NUM_THREADS="1", OMP_NUM_THREADS="1", MKL_NUM_THREADS="1")

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from hybrid.alignment.align import Aligner
from hybrid.alignment.transfer import measure_exposure
from hybrid.alignment.window import AlignedWindow
from hybrid.comparison.metrics import psnr
from hybrid.estimates import choose_estimate
from hybrid.files.frames import open_shot
from hybrid.neural.denoiser import Denoiser
from hybrid.plan import plan_shot
from hybrid.pseudo_reference import FINAL, filter_window
from network.checkpoint import shipped_weights
from nlm.guided import guided_filter

Array = NDArray[np.float32]
SHOT = Path(__file__).parent.parent / "examples" / "shot"


@dataclass
class Row:
    """One shortcut: its name, what it is compared with, errors, PSNR of both in dB, share of the time."""

    shortcut: str
    exact: str
    rms: float
    largest: float
    psnr: float
    psnr_exact: float
    time: float


def timed(make: Callable[[], Array]) -> tuple[Array, float]:
    """The picture, and the least CPU time of three."""
    make()
    times = []
    for _ in range(3):
        start = time.process_time()
        image = make()
        times.append(time.process_time() - start)
    return image, min(times)


def half(window: AlignedWindow) -> AlignedWindow:
    """The window as it is stored in half floats (training clips are)."""
    return replace(window, aligned_color=window.color.astype(np.float16).astype(np.float32))


def in_bands(shot: object, stages: frozenset[str], number: int, rows: int) -> Array:
    """The classical estimate, so many rows at a time."""
    aligner = Aligner(shot, stages)  # type: ignore[arg-type]
    parts = []
    height = shot.shape[0]  # type: ignore[attr-defined]
    for top in range(0, height, rows):
        aligned = aligner.align(number, slice(top, min(top + rows, height)))
        parts.append(filter_window(aligned, FINAL)[aligned.inner])
    return np.concatenate(parts)


def measure(number: int) -> list[Row]:
    """All rows for one frame."""
    shot = open_shot(SHOT / "noisy.####.exr")
    reference = open_shot(SHOT / "reference.####.exr").read(number).color
    exposure = 1 / measure_exposure(reference)
    stages = plan_shot(shot).stages
    window = Aligner(shot, stages).align(number)
    given = Aligner(shot, stages, estimates=choose_estimate("nlm", shot).estimates).align(number)
    rows = []

    def add(shortcut: str, exact: str, fast: Callable[[], Array], slow: Callable[[], Array]) -> None:
        (image, quick), (plain, full) = timed(fast), timed(slow)
        error = (image - plain) / plain.mean()
        decibels = (psnr(x, reference, exposure=exposure) for x in (image, plain))
        rms = float(np.sqrt(np.mean(error**2)))
        rows.append(Row(shortcut, exact, rms, float(np.abs(error).max()), *decibels, quick / full))

    weights = shipped_weights("fast")
    whole = Denoiser(weights, precision="float32", tile=1024)
    add("network in bfloat16", "in float32", lambda: Denoiser(weights, precision="bfloat16", tile=1024)(given).color,
        lambda: whole(given).color)  # fmt: skip
    for tile in (64, 128, 256):
        denoiser = Denoiser(weights, precision="float32", tile=tile)
        add(f"network in tiles of {tile}", "in one", lambda d=denoiser: d(given).color, lambda: whole(given).color)
    add(
        "window stored in float16",
        "in float32",
        lambda: filter_window(half(window), FINAL),
        lambda: filter_window(window, FINAL),
    )
    picture = filter_window(window, FINAL)
    add(
        "picture written as half (saves space, not time)",
        "as float",
        lambda: picture.astype(np.float16).astype(np.float32),
        lambda: +picture,
    )
    light = window.color[2]
    for subsample in (2, 4):
        # as the first estimates of single frames are made (radius 5)
        add(f"guided filter at 1/{subsample} of the resolution", "at full resolution",
            lambda s=subsample: guided(window, light, s), lambda: guided(window, light, 1))  # fmt: skip
    for height in (64, 128):
        parts = partial(in_bands, shot, stages, number)
        add(f"bands of {height} rows (--max-memory)", "whole frame", partial(parts, height), partial(parts, 10**6))
    return rows


def guided(window: AlignedWindow, light: Array, subsample: int) -> Array:
    """The guided filter of one noisy frame."""
    guide = window.guide if window.guide is not None else light
    return guided_filter(light, guide, radius=5, eps=1e-3, subsample=subsample) * window.modulation


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=2, help="how many of the bundled shot's seven")
    parser.add_argument("--json", type=Path, help="write the rows there too")
    options = parser.parse_args(argv)
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
    tables = [measure(number) for number in (11, 10, 12, 9, 13, 8, 14)[: options.frames]]
    print("| shortcut | instead of | RMS difference | largest | PSNR, dB | time |\n|---|---|---|---|---|---|")
    means = []
    for rows in zip(*tables, strict=True):
        first = rows[0]
        mean = {
            name: float(np.mean([asdict(row)[name] for row in rows])) for name in ("rms", "psnr", "psnr_exact", "time")
        }
        mean["largest"] = max(row.largest for row in rows)
        means.append({"shortcut": first.shortcut, "exact": first.exact, **mean})
        print(
            f"| {first.shortcut} | {first.exact} | {mean['rms']:.1e} | {mean['largest']:.1e} "
            f"| {mean['psnr']:.2f} (exact: {mean['psnr_exact']:.2f}) | {mean['time']:.2f} × |"
        )
    if options.json is not None:
        options.json.write_text(json.dumps(means, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
