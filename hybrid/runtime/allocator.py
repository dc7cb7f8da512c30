"""What becomes of memory that is freed: it is kept for what comes next."""

from __future__ import annotations

import ctypes
import sys

# Of glibc's malloc.h; blocks up to KEPT, and as much at the end of the heap, stay with the process. What is greater
# comes once a frame, as OIDN's own 400 MiB, and seldom fits into what is free: peak memory grew with every frame.
# Features of a strip of all frames, which come and go tens of times, are no greater.
M_MMAP_THRESHOLD, M_TRIM_THRESHOLD, M_ARENA_MAX = -3, -1, -8
KEPT = 3 * 2**26


def reuse_freed_memory() -> None:
    """Let this process keep the memory it frees, where its C library is glibc; elsewhere do nothing.

    glibc gives blocks above 32 MiB back to the kernel at once, which hands out zeroed pages one by one when the next is
    written: a sixth of the CPU time of `denoise` at 1280×720 and at 1920×1080. Peak memory grows, by a tenth and a
    quarter there, as what is free is in pieces (`benchmarks/bench_memory.py --limits 1T` compares). All threads take
    from one heap: with one of its own for the thread that reads, `fast` took 0.2 GiB more at 1920×1080. To give back
    what is free between two stages saved 0.1 GiB, and cost a tenth of the CPU time.
    """
    adjust = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if adjust is not None:
        for parameter in (M_MMAP_THRESHOLD, M_TRIM_THRESHOLD):
            adjust(parameter, KEPT)
        adjust(M_ARENA_MAX, 1)
