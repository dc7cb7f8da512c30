"""Measure what judging the layers of a shot costs, beside denoising ten frames of it; JSON on standard output.

    python benchmarks/bench_judging.py [SHOT]

Without a shot the bundled one is tiled to 1920×1080. CPU seconds of one process, after a warm-up: the median of the
judgements, with the renderer's convention as it is stated, with nothing stated and with a wrong one, and one run of
`ravg denoise --preset fast` of all frames, reckoned for ten.
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

from benchmarks.bench_shot import tile_shot
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
    parser.add_argument("shot", nargs="?")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        if options.shot is None:
            tile_shot(Path(folder), 8)
        print(json.dumps(measure_shot(options.shot or folder, options.repeats), indent=1))
    return 0


def measure_shot(spec: str, repeats: int) -> dict[str, object]:
    noisy = open_shot(spec, keep=0)
    motions = {"stated": None, "nothing stated": "auto", "y stated wrong": "previous,pixels,y-down"}
    judged = {
        name: measure(partial(judge_layers, open_shot(spec, keep=0, motion=motion)), repeats)
        for name, motion in motions.items()
    }
    with tempfile.TemporaryDirectory() as folder:

        def denoise(*more: str) -> None:
            if ravg(["denoise", spec, "-o", f"{folder}/out", "--preset", "fast", *more]):
                raise RuntimeError("denoise failed")

        denoise("--frames", str(noisy.numbers[0]))  # compiles
        start = time.process_time()
        denoise()
        # What does not depend on the length is small beside a frame of film size.
        whole = (time.process_time() - start) / len(noisy) * FRAMES
    shares = {name: seconds / whole for name, seconds in judged.items()}
    return {"size": noisy.shape, "cpu_seconds": {**judged, "ten frames": whole}, "shares": shares}


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
