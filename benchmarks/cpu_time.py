"""How long a call takes, in CPU seconds: what the other work of the machine leaves alone."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def measure(function: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median, least and most CPU seconds of a call, after one to warm up."""
    function()
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        seconds.append(time.process_time() - start)
    return {"median": statistics.median(seconds), "min": min(seconds), "max": max(seconds)}
