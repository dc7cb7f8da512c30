"""Measure OIDN's networks in torch beside OIDN itself, and what bfloat16 changes; JSON on standard output.

    OMP_WAIT_POLICY=PASSIVE python benchmarks/bench_trunk.py --threads 1

A frame of the bundled shot, repeated to 960×540. CPU seconds of the process after a warm-up: OIDN, float32 and bfloat16
one after the other, and the median over the rounds of each one's ratio to OIDN. Accuracy is PSNR on x/(1+x) against
OIDN's picture, and the ratio of the means.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.alignment.transfer import autoexposure
from hybrid.files.shots import open_shot
from hybrid.oidn import denoise_oidn
from hybrid.runtime.allocator import reuse_freed_memory
from network.bfloat16 import round_unet
from network.oidn_weights import load_oidn
from network.unet import denoise_color

# Of OIDN's weights: its quality, and whether it is told that guides are clean.
MODES = {
    "rt_hdr_alb_nrm_small": ("fast", False),
    "rt_hdr_alb_nrm": ("high", False),
    "rt_hdr_calb_cnrm": ("balanced", True),
    "rt_hdr_calb_cnrm_large": ("high", True),
}


def seconds(function: Callable[[], object]) -> float:
    start = time.process_time()
    function()
    return time.process_time() - start


def decibels(a: Tensor, b: Tensor) -> float:
    return float(-10 * torch.log10(torch.mean((a / (1 + a) - b / (1 + b)).double() ** 2)))


def compare(name: str, images: list[np.ndarray], rounds: int) -> dict[str, object]:
    quality, clean = MODES[name]
    layers = [torch.from_numpy(image).permute(2, 0, 1)[None] for image in images]
    exact = load_oidn(name)
    rounded = round_unet(exact)
    runs: dict[str, Callable[[], Any]] = {
        "oidn": lambda: denoise_oidn(*images, quality=quality, clean=clean),
        "float32": lambda: denoise_color(exact, *layers, exposure=autoexposure(images[0])),
        "bfloat16": lambda: denoise_color(rounded, *layers, exposure=autoexposure(images[0])),
    }
    wanted = torch.from_numpy(runs["oidn"]()).permute(2, 0, 1)[None]
    accuracy = {}
    for kind in ("float32", "bfloat16"):
        picture = runs[kind]()
        accuracy[kind] = {"dB": decibels(picture, wanted), "mean": float(picture.mean() / wanted.mean())}
    taken = [{kind: seconds(run) for kind, run in runs.items()} for _ in range(rounds)]
    ratios = {kind: statistics.median(t[kind] / t["oidn"] for t in taken) for kind in runs}
    medians = {kind: statistics.median(t[kind] for t in taken) for kind in runs}
    return {"cpu_seconds": medians, "ratio": ratios, "accuracy": accuracy}


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--size", default="960x540")
    options = parser.parse_args(argv)
    reuse_freed_memory()  # as the commands do
    torch.set_num_threads(options.threads)
    os.environ["OIDN_NUM_THREADS"] = str(options.threads)
    width, height = map(int, options.size.split("x"))
    shot = Path(__file__).resolve().parent.parent / "examples" / "shot"
    frame = open_shot(str(shot / "noisy.####.exr")).read(11)
    rows, columns = (np.arange(length) % side for length, side in zip((height, width), frame.color.shape, strict=False))
    images = [layer[np.ix_(rows, columns)] for layer in (frame.color, frame.albedo, frame.normal)]
    figures = {name: compare(name, images, options.rounds) for name in MODES}
    settings = {"size": options.size, "threads": options.threads, "torch": torch.__version__}
    json.dump({**settings, **figures}, sys.stdout, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
