"""Run a compiled loop on all cores: a plain loop, compiled once, which threads run on bands of rows.

numba's own ``parallel=True`` makes loops no faster, and takes three to six times as long to compile: each ``prange``
becomes a function of its own, which passes the whole compiler again. Its threads, of OpenMP, wait for each other
without sleeping: beside a renderer that keeps two cores busy TV-L1 took 4.4 s in place of 0.04.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

# Arrays that compiled loops read and write.
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Places = NDArray[np.intp]


def run_bands(loop: Callable[..., None], count: int, *arguments: object) -> None:
    """Run a loop over `count` steps, most often rows, on as many threads as numba may use.

    The loop, compiled with ``nogil=True``, is called as ``loop(first, last, *arguments)`` for bands that together are
    ``range(count)``. It writes into its arguments; no two steps may write to the same place. An error in a band is
    raised after all bands have ended.
    """
    threads = max(min(get_num_threads(), count), 1)
    edges = [count * n // threads for n in range(threads + 1)]
    first_band, *other_bands = pairwise(edges)
    running = [_threads().submit(loop, *band, *arguments) for band in other_bands]
    try:
        loop(*first_band, *arguments)
    finally:
        wait(running)
    for band in running:
        band.result()


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="loops")


# A forked process has none of its parent's threads.
if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(after_in_child=_threads.cache_clear)
