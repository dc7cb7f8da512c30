import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from hybrid.files.frame import Frame
from hybrid.files.prefetch import Prefetcher
from hybrid.runtime.timing import Timings


class Told:
    """Frames in memory that tell which were read, and can be waited for."""

    numbers, step, shape = tuple(range(1, 9)), 1, (2, 2)

    def __init__(self, damaged=()):
        self.damaged = damaged
        self.read_so_far = []
        self.begun = {number: threading.Event() for number in self.numbers}

    def has(self, number):
        return number in self.numbers

    def read(self, number):
        self.read_so_far.append(number)
        self.begun[number].set()
        if number in self.damaged:
            raise ValueError(f"frame {number} is damaged")
        return Frame(number, np.zeros((2, 2, 3), np.float32))


@pytest.fixture
def thread():
    with ThreadPoolExecutor(1) as thread:
        yield thread


def test_the_next_one_is_read_without_being_asked_for_and_no_further(thread):
    told = Told()
    frames = Prefetcher(told, thread, Timings())
    frames.expect([1, 2, 3, 4])
    assert frames.read(1).number == 1
    assert told.begun[2].wait(60)
    thread.submit(lambda: None).result()  # all that was begun has ended
    assert told.read_so_far == [1, 2]
    assert [frames.read(number).number for number in (2, 3, 4, 5)] == [2, 3, 4, 5]
    thread.submit(lambda: None).result()
    assert told.read_so_far == [1, 2, 3, 4, 5]  # each once, and 6 was not expected


def test_what_was_asked_for_before_is_not_read_ahead_again(thread):
    told = Told()
    frames = Prefetcher(told, thread, Timings())
    frames.expect([1, 2, 3])
    for number in (1, 2, 3):
        frames.read(number)
    frames.expect([1, 2, 3])
    frames.read(2)  # asked for again, it is read again
    thread.submit(lambda: None).result()
    assert told.read_so_far == [1, 2, 3, 2]


def test_one_before_it_leaves_what_was_read_ahead(thread):
    """Fireflies of a frame are told by the one before it too."""
    told = Told()
    frames = Prefetcher(told, thread, Timings())
    frames.expect([3, 4])
    assert [frames.read(number).number for number in (3, 2, 4)] == [3, 2, 4]
    assert told.read_so_far == [3, 4, 2]


def test_what_was_read_for_nothing_is_let_go(thread):
    told = Told()
    frames = Prefetcher(told, thread, Timings())
    frames.expect([1, 2])
    frames.read(1)
    assert frames.read(6).number == 6
    frames.expect([7])
    frames.read(6)
    assert told.begun[7].wait(60)
    assert frames.read(7).number == 7


def test_an_error_comes_when_the_frame_is_asked_for_and_each_time(thread):
    frames = Prefetcher(Told(damaged={2}), thread, Timings())
    frames.expect([1, 2, 3])
    assert frames.read(1).number == 1
    for _ in range(2):
        with pytest.raises(ValueError, match="frame 2 is damaged"):
            frames.read(2)
    assert frames.read(3).number == 3
    assert [*frames.failed] == [2]


def test_a_frame_that_is_lost_is_missing_and_not_read_ahead(thread):
    told = Told(damaged={2})
    frames = Prefetcher(told, thread, Timings(), {2: ValueError()})
    frames.expect([1, 2, 3])
    assert [frames.has(number) for number in (1, 2, 3)] == [True, False, True]
    assert [frames.read(number).number for number in (1, 3)] == [1, 3]
    thread.submit(lambda: None).result()
    assert told.read_so_far == [1, 3]


def test_it_is_the_shot_otherwise_and_says_what_it_costs(thread):
    timings = Timings()
    frames = Prefetcher(Told(), thread, timings)
    assert (frames.numbers, frames.step, frames.shape) == (Told.numbers, 1, (2, 2))
    assert frames.has(8)
    assert not frames.has(9)
    frames.read(1)
    assert timings.stages["read"].cpu_seconds > 0 or sys.platform == "win32"  # counted in 64ths of a second there
