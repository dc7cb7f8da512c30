"""Memory allocator: whether freed memory is reused or returned to the system."""

import ctypes
import sys

# Parameters of glibc's malloc.h. Blocks up to KEPT, and as much at the end of the heap, stay with the process. Larger
# blocks are allocated once a frame, as OIDN's own 400 MiB, and seldom fit into free memory: with them kept, peak memory
# grew with every frame. Features of a strip of all frames, allocated tens of times a frame, are no larger.
M_MMAP_THRESHOLD, M_TRIM_THRESHOLD, M_ARENA_MAX = -3, -1, -8
KEPT = 3 * 2**26
RETURNED = 2**22  # blocks of at least so many bytes are returned in a run with a limit: planes of a 1280×720 frame


def reuse_freed_memory() -> None:
    """Let this process reuse the memory it frees, if its C library is glibc.

    glibc returns blocks above 32 MiB to the kernel at once, which zeroes pages one by one when the next block is
    written: a sixth of the CPU time of `denoise` at 1280×720 and at 1920×1080. Peak memory grows by a tenth and a
    quarter there. All threads share one heap: a second one, for the thread that reads, took 0.2 GiB more at 1920×1080.
    Returning free memory between two stages saved 0.1 GiB, and cost a tenth of the CPU time.
    """
    _adjust(M_MMAP_THRESHOLD, KEPT)
    _adjust(M_TRIM_THRESHOLD, KEPT)
    _adjust(M_ARENA_MAX, 1)


def return_freed_memory() -> None:
    """Let this process return the memory it frees to the system, if its C library is glibc.

    By default glibc raises the size above which it does so to 32 MiB, as blocks are freed: free memory is then
    fragmented, and peak memory of `denoise` at 960×540 in bands of rows is a tenth higher. This costs a fifth of the
    CPU time.
    """
    _adjust(M_MMAP_THRESHOLD, RETURNED)
    _adjust(M_ARENA_MAX, 1)


def _adjust(parameter: int, value: int) -> None:
    adjust = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if adjust is not None:
        adjust(parameter, value)
