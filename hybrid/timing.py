"""Seconds and peak memory of each stage of a run."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


@dataclass
class Stage:
    """What one stage has cost so far: wall and CPU seconds, calls, and the process's peak memory after it."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    calls: int = 0
    peak_bytes: int = 0


class Timings:
    """Adds up the cost of named stages.

    Stages may not nest: the sum over stages is the time of the run that is accounted for.
    """

    def __init__(self) -> None:
        self.stages: dict[str, Stage] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what happens inside the ``with`` block as stage `name`."""
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            entry = self.stages.setdefault(name, Stage())
            entry.seconds += time.perf_counter() - wall
            entry.cpu_seconds += time.process_time() - cpu
            entry.calls += 1
            entry.peak_bytes = max(entry.peak_bytes, peak_memory())

    def rows(self, pixels: int) -> list[tuple[str, str, str, str]]:
        """Rows (stage, seconds, seconds per megapixel-frame, peak memory) for `pixels` pixels in all frames."""
        megapixels = max(pixels, 1) / 1e6
        return [
            (
                name,
                f"{stage.seconds:.2f}",
                f"{stage.seconds / megapixels:.2f}",
                f"{stage.peak_bytes / 2**20:.0f} MiB",
            )
            for name, stage in self.stages.items()
        ]


def peak_memory() -> int:
    """Return the peak resident memory of this process, in bytes, as the operating system counted it."""
    try:
        # Unlike getrusage's, Linux's own count does not take over that of the process which started this one.
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024  # macOS counts bytes, others KiB
