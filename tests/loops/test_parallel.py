"""A loop on all cores is the loop."""

import os
import threading

import numpy as np
import pytest
from numba import njit

import loops.parallel
from loops.parallel import run_bands


@njit(nogil=True)
def _mark(first: int, last: int, seen: np.ndarray, step: int) -> None:
    for y in range(first, last):
        seen[y] += step * (y + 1)


@pytest.mark.parametrize("threads", [1, 2, 3, 16])
@pytest.mark.parametrize("count", [0, 1, 2, 7, 100])
def test_each_step_runs_once(monkeypatch, threads, count):
    monkeypatch.setattr(loops.parallel, "get_num_threads", lambda: threads)
    seen = np.zeros(count, np.int64)
    run_bands(_mark, count, seen, 3)
    np.testing.assert_array_equal(seen, 3 * np.arange(1, count + 1))


def test_it_runs_on_as_many_threads_as_numba_may_use(monkeypatch):
    monkeypatch.setattr(loops.parallel, "get_num_threads", lambda: 2)
    barrier, names = threading.Barrier(2, timeout=60), set()

    def wait_for_the_other(first: int, last: int) -> None:
        names.add(threading.current_thread().name)
        barrier.wait()  # raises if the other band does not run at the same time

    run_bands(wait_for_the_other, 2)
    assert len(names) == 2


@pytest.mark.parametrize("bad", [0, 1, 2])
def test_an_error_in_any_band_comes_back_when_all_have_ended(monkeypatch, bad):
    monkeypatch.setattr(loops.parallel, "get_num_threads", lambda: 3)
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
    monkeypatch.setattr(loops.parallel, "get_num_threads", lambda: 2)
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
