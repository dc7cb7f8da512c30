"""A loop on all cores is the loop."""

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numba import njit

import loops.parallel
from loops.parallel import limit_loops, run_bands


@njit(nogil=True)
def _mark(first: int, last: int, seen: np.ndarray, step: int) -> None:
    for y in range(first, last):
        seen[y] += step * (y + 1)


@pytest.mark.parametrize("threads", [1, 2, 3, 16])
@pytest.mark.parametrize("count", [0, 1, 2, 7, 100])
def test_each_step_runs_once(monkeypatch, threads, count):
    monkeypatch.setattr(loops.parallel, "thread_count", lambda: threads)
    seen = np.zeros(count, np.int64)
    run_bands(_mark, count, seen, 3)
    np.testing.assert_array_equal(seen, 3 * np.arange(1, count + 1))


def test_it_runs_on_all_threads_at_once(monkeypatch):
    monkeypatch.setattr(loops.parallel, "thread_count", lambda: 2)
    barrier, names = threading.Barrier(2, timeout=60), set()

    def wait_for_the_other(first: int, last: int) -> None:
        names.add(threading.current_thread().name)
        barrier.wait()  # raises if the other band does not run at the same time

    run_bands(wait_for_the_other, 2)
    assert len(names) == 2


def test_a_limit_counts_for_loops_of_all_threads(monkeypatch):
    """numba's own limit counts only for the thread that sets it: the reading thread's loops took all cores."""
    monkeypatch.setattr(loops.parallel, "_count", 4)
    limit_loops(2)
    bands = []
    with ThreadPoolExecutor(1) as reader:
        reader.submit(run_bands, lambda first, last: bands.append((first, last)), 8).result()
    assert sorted(bands) == [(0, 4), (4, 8)]


COUNT = """
import sys
from loops.parallel import run_bands, thread_count
import hybrid.alignment.align, nlm.average, flow.tvl1, network.paper.kernels
run_bands(lambda first, last: None, 100)
print(thread_count(), "numba.np.ufunc.omppool" in sys.modules)
"""


def test_numba_starts_no_threads_of_its_own():
    """They are OpenMP's, as torch's are: two copies of OpenMP in a process end it on a Mac."""
    environment = os.environ | {"NUMBA_NUM_THREADS": "3"}
    done = subprocess.run([sys.executable, "-c", COUNT], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.split() == ["3", "False"]


@pytest.mark.parametrize("bad", [0, 1, 2])
def test_an_error_in_any_band_comes_back_when_all_have_ended(monkeypatch, bad):
    monkeypatch.setattr(loops.parallel, "thread_count", lambda: 3)
    ended = []

    def run(first: int, last: int) -> None:
        if first == bad:
            raise ValueError(f"band {first}")
        ended.append(first)

    with pytest.raises(ValueError, match=f"band {bad}"):
        run_bands(run, 3)
    assert sorted(ended) == sorted({0, 1, 2} - {bad})


@pytest.mark.posix
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_process_that_was_forked_has_threads_of_its_own(monkeypatch):
    monkeypatch.setattr(loops.parallel, "thread_count", lambda: 2)
    seen = np.zeros(4, np.int64)
    run_bands(_mark, 4, seen, 1)
    child = os.fork()
    if child == 0:
        signal_after(60)
        run_bands(_mark, 4, seen, 1)
        os._exit(0 if seen.sum() == 20 else 1)
    assert os.waitpid(child, 0)[1] == 0


def signal_after(seconds: int) -> None:
    """A child that hangs ends with a signal."""
    import signal

    signal.alarm(seconds)
