"""Time and peak memory of each stage of a run."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

from hybrid.runtime.system import peak_memory, thread_clock


@dataclass
class Stage:
    """Wall and CPU seconds and calls of one stage, and the process's peak memory after it.

    Background work (`Timings.background`) costs CPU seconds, and wall seconds only while it is waited for.
    """

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    calls: int = 0
    peak_bytes: int = 0


class Timings:
    """Adds up the cost of named stages; a stage within another counts in both."""

    def __init__(self) -> None:
        self.stages: dict[str, Stage] = {}
        self._lock = threading.Lock()
        # CPU seconds of background work that has ended, and the clocks of work that has not.
        self._ended = 0.0
        self._running: dict[int, tuple[Callable[[], float], float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the ``with`` block as stage `name`, without background work."""
        wall, cpu = time.perf_counter(), self._cpu_time()
        try:
            yield
        finally:
            self._add(name, time.perf_counter() - wall, self._cpu_time() - cpu, calls=1)

    @contextmanager
    def background(self, name: str) -> Iterator[None]:
        """Count the CPU time of a background thread's block, not of threads that libraries start in it, as a stage."""
        thread, start, clock = threading.get_ident(), time.thread_time(), thread_clock()
        with self._lock:
            self._running[thread] = clock, start
        try:
            yield
        finally:
            with self._lock:
                self._running.pop(thread, None)
                spent = time.thread_time() - start
                self._ended += spent
            self._add(name, 0.0, spent, calls=0)

    def figures(self) -> dict[str, dict[str, float]]:
        """Return the fields of each stage, by its name."""
        return {name: asdict(stage) for name, stage in self.stages.items()}

    def _cpu_time(self) -> float:
        """CPU seconds of the process without background work."""
        with self._lock:
            running = sum(clock() - start for clock, start in self._running.values())
            return time.process_time() - self._ended - running

    def _add(self, name: str, wall: float, cpu: float, *, calls: int) -> None:
        with self._lock:
            entry = self.stages.setdefault(name, Stage())
            entry.seconds += wall
            entry.cpu_seconds += cpu
            entry.calls += calls
            entry.peak_bytes = max(entry.peak_bytes, peak_memory())

    def table(self, pixels: int) -> str:
        """Return a line of seconds and memory for each stage; `pixels` is the number in all frames."""
        lines = [f"{'stage':<12}{'seconds':>10}{'s per megapixel-frame':>24}{'peak memory':>14}"]
        for name, stage in self.stages.items():
            each, peak = stage.seconds / max(pixels, 1) * 1e6, f"{stage.peak_bytes / 2**20:.0f} MiB"
            lines.append(f"{name:<12}{stage.seconds:>10.2f}{each:>24.2f}{peak:>14}")
        return "\n".join(lines)
