"""How long calls take, in CPU seconds: what the other work of the machine leaves alone."""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from importlib.metadata import version

import cv2
import numba

from hybrid.runtime.allocator import reuse_freed_memory

PACKAGES = ("numpy", "numba", "opencv-contrib-python-headless", "scikit-image", "torch")


def measure(function: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median, least and most CPU seconds of a call, after one to warm up (which compiles)."""
    function()
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        seconds.append(time.process_time() - start)
    return {"median": statistics.median(seconds), "min": min(seconds), "max": max(seconds)}


def arguments(description: str | None) -> argparse.ArgumentParser:
    """The arguments that all benchmarks of functions have."""
    parser = argparse.ArgumentParser(description=str(description).split("\n")[0])
    parser.add_argument("--size", default="1920x1080", help="WIDTHxHEIGHT of a frame")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5, help="measured runs of each")
    return parser


def size_of(options: argparse.Namespace) -> tuple[int, int]:
    """Width and height."""
    width, height = map(int, options.size.split("x"))
    return width, height


def report(options: argparse.Namespace, calls: Iterable[tuple[str, Callable[[], object]]]) -> int:
    """Measure named calls in so many threads, and print JSON."""
    reuse_freed_memory()  # as the commands do
    cv2.setNumThreads(options.threads)
    numba.set_num_threads(min(options.threads, numba.get_num_threads()))
    results = {}
    for name, call in calls:
        results[name] = measure(call, options.repeats)
        print(f"{name:44} {results[name]['median']:8.3f} CPU-s", file=sys.stderr)
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    machine = {"machine": platform.processor() or platform.machine(), "python": platform.python_version()}
    facts = {**vars(options), "commit": commit, **machine, **{name: version(name) for name in PACKAGES}}
    print(json.dumps({**facts, "cpu_seconds": results}, indent=2))
    return 0
