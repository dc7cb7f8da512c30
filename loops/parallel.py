"""Run a compiled loop on all cores: a plain loop, compiled once, which threads run on bands of rows.

numba's own ``parallel=True`` makes loops no faster, and takes three to six times as long to compile: each ``prange``
becomes a function of its own, which passes the whole compiler again. Its threads, of OpenMP, wait for each other
without sleeping: beside a renderer that keeps two cores busy TV-L1 took 4.4 s in place of 0.04. Asking numba for its
number of threads would start those threads, so the number is stored here.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numba.core import config
from numpy.typing import NDArray

# Arrays that compiled loops read and write.
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Places = NDArray[np.intp]

# Rows that are processed at a time, which stay in the caches of a processor; running sums begin anew with each strip.
STRIP = 64

# Threads of a loop, for all callers; numba's own limit counts only for the thread that sets it.
_count: int = config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]


def thread_count() -> int:
    """Return the number of threads of a loop: at first `NUMBA_NUM_THREADS`, or the cores that this process may use."""
    return _count


def limit_loops(count: int) -> None:
    """Run loops on `count` threads from now on, whichever thread calls them."""
    global _count
    _count = count


def run_bands(loop: Callable[..., None], count: int, *arguments: object) -> None:
    """Run a loop over `count` steps, most often rows, on `thread_count` threads.

    The loop, compiled with ``nogil=True``, is called as ``loop(first, last, *arguments)`` for bands that together are
    ``range(count)``. It writes into its arguments; no two steps may write to the same place. An error in a band is
    raised after all bands have ended.
    """
    threads = max(min(thread_count(), count), 1)
    edges = [count * n // threads for n in range(threads + 1)]
    first_band, *other_bands = pairwise(edges)
    running = [_threads().submit(loop, *band, *arguments) for band in other_bands]
    try:
        loop(*first_band, *arguments)
    finally:
        for band in running:
            band.exception()  # waits, in less time than `concurrent.futures.wait`
    for band in running:
        band.result()


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="loops")


# A forked process has none of its parent's threads.
if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(after_in_child=_threads.cache_clear)
