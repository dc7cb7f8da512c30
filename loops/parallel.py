"""A compiled loop on all cores.

numba's own ``parallel=True`` makes faster loops by nothing, and takes three to six times as long to compile them: each
``prange`` becomes a function of its own, which goes through the whole compiler again. Here a loop is compiled once, as
the plain loop it is, and threads run it on bands of what it goes over. It has to let go of the interpreter's lock.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from itertools import pairwise

from numba import get_num_threads


def run_bands(loop: Callable[..., None], count: int, *arguments: object) -> None:
    """Run a loop over `count` steps, most often rows, on as many threads as numba may use.

    Parameters
    ----------
    loop : callable
        Compiled with ``nogil=True``; called as ``loop(first, last, *arguments)`` for bands that together are
        ``range(count)``. It writes into its arguments, and no two steps may write to the same place.
    count : int
        How many steps there are.
    *arguments : object
        What else the loop is given.

    Raises
    ------
    Exception
        What the loop raises, after all bands have ended or raised themselves.
    """
    threads = max(min(get_num_threads(), count), 1)
    edges = [count * n // threads for n in range(threads + 1)]
    own, *others = pairwise(edges)
    running = [_threads().submit(loop, *band, *arguments) for band in others]
    try:
        loop(*own, *arguments)
    finally:
        wait(running)
    for other in running:
        other.result()


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="loops")


# The threads stay behind in the process that has forked.
if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(after_in_child=_threads.cache_clear)
