"""What a run costs before and around its work: one frame of the bundled shot, whole process.

    python benchmarks/bench_start.py [--presets fast] [--runs 3]

Each run is a fresh process. *Fresh* has an empty folder for compiled loops, as on a machine that has never run it;
*warm* has the folder that a run before has left.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

SHOT = Path(__file__).parent.parent / "examples" / "shot" / "noisy.####.exr"


def run(preset: str, cache: Path) -> tuple[float, float]:
    """CPU and wall seconds of a process that denoises one frame."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with tempfile.TemporaryDirectory() as out:
        words = ["denoise", str(SHOT), "--frames", "8", "-o", out, "--preset", preset, "-q"]
        subprocess.run([sys.executable, "-m", "hybrid.cli", *words], check=True, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--presets", nargs="+", default=["fast", "balanced", "quality"])
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    print("| preset | loops | CPU-s | s |\n| --- | --- | --- | --- |")
    for preset in options.presets:
        pairs = []
        for _ in range(options.runs):
            with tempfile.TemporaryDirectory() as cache:
                pairs.append((run(preset, Path(cache)), run(preset, Path(cache))))
        for name, runs in zip(("fresh", "warm"), zip(*pairs, strict=True), strict=True):
            cpu, wall = (median(values) for values in zip(*runs, strict=True))
            print(f"| {preset} | {name} | {cpu:.1f} | {wall:.1f} |", flush=True)


if __name__ == "__main__":
    main()
