"""What part of `ravg denoise` runs on one core, and what more cores would bring by that count.

    python benchmarks/count_serial.py "shot.####.exr" [--frames 10-11] [--preset fast]

Nothing is timed by the clock: with two threads, work that is shared evenly costs the main thread half of its CPU
time, and work that is not costs it all. So of a stage's CPU seconds T, of which the main thread has spent M,
2 M − T are serial. What is read and written beside the work is neither.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

# The libraries read their numbers of threads when they are imported.
os.environ.update(NUMBA_NUM_THREADS="2", OMP_NUM_THREADS="2", MKL_NUM_THREADS="2")

import cv2

from hybrid.cli import main as ravg
from hybrid.timing import Timings

CORES = (1, 2, 4, 8, 16)


class Counted(Timings):
    """Stages, and what of them the main thread has spent; of all that there are."""

    spent: ClassVar[Counter[str]] = Counter()
    seconds: ClassVar[dict[str, float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.thread_time()
        try:
            with super().stage(name):
                yield
        finally:
            self.spent[name] += time.thread_time() - start
            self.seconds.update({name: stage.cpu_seconds for name, stage in self.stages.items()})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("shot")
    parser.add_argument("--frames", default="10-11")
    parser.add_argument("--preset", default="fast")
    options = parser.parse_args()
    cv2.setNumThreads(2)
    import hybrid.timing

    hybrid.timing.Timings = Counted
    with tempfile.TemporaryDirectory() as out:
        words = ["denoise", options.shot, "-o", out, "--frames", options.frames, "--preset", options.preset, "-q"]
        if code := ravg(words):
            return code
    total, serial = 0.0, 0.0
    print("| stage | CPU-s | of it serial |\n| --- | --- | --- |")
    for name, cpu in Counted.seconds.items():
        beside = name in ("read", "write")
        alone = 0.0 if beside else min(max(2 * Counted.spent[name] - cpu, 0.0), cpu)
        print(f"| {name} | {cpu:.1f} | {'beside the work' if beside else f'{alone / cpu:.0%}'} |")
        if not beside:
            total, serial = total + cpu, serial + alone
    print(f"\nserial: {serial:.1f} of {total:.1f} CPU-s, {serial / total:.0%}")
    for cores in CORES:
        print(f"{cores} cores: {total / (serial + (total - serial) / cores):.1f} times as fast as one")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
