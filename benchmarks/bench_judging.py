"""Measure what judging the layers of a shot costs, beside denoising ten frames of it; JSON on standard output.

    python benchmarks/bench_judging.py "examples/shot/noisy.####.exr"

CPU seconds of one process, after a warm-up: the median of the judgements, with the renderer's convention as it is
stated and with nothing stated, and one run of `ravg denoise --preset fast` of all frames, reckoned for ten.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.cli import main as ravg
from hybrid.files.frames import open_shot
from hybrid.plausibility import judge_layers

FRAMES = 10


def measure(function: Callable[[], object], repeats: int) -> float:
    function()
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        seconds.append(time.process_time() - start)
    return statistics.median(seconds)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("shot")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(argv)
    noisy = open_shot(options.shot, keep=0)
    shots = open_shot(options.shot, keep=0), open_shot(options.shot, keep=0, motion="auto")
    stated, unknown = (measure(partial(judge_layers, shot), options.repeats) for shot in shots)
    with tempfile.TemporaryDirectory() as folder:

        def denoise(*more: str) -> None:
            if ravg(["denoise", options.shot, "-o", f"{folder}/out", "--preset", "fast", *more]):
                raise RuntimeError("denoise failed")

        denoise("--frames", str(noisy.numbers[0]))  # compiles
        start = time.process_time()
        denoise()
        # What does not depend on the length is small beside a frame of film size.
        whole = (time.process_time() - start) / len(noisy) * FRAMES
    figures = {"judging": stated, "judging, nothing stated": unknown, "ten frames": whole}
    shares = {"share": stated / whole, "share, nothing stated": unknown / whole}
    print(json.dumps({"size": noisy.shape, "cpu_seconds": figures, **shares}, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
