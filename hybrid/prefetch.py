"""Reading the next frame and writing the last one while this one is worked on."""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import Executor, Future

from hybrid.files.frame import Frame, Frames
from hybrid.runtime.timing import Timings


class Prefetcher:
    """The frames of a shot, of which one is read ahead in a thread.

    Parameters
    ----------
    shot : Frames
        Where they come from; read in the thread alone.
    thread : Executor
        Of one thread.
    timings : Timings
        Where to count what the thread costs, as "read".
    """

    def __init__(self, shot: Frames, thread: Executor, timings: Timings) -> None:
        self.numbers, self.step = shot.numbers, shot.step
        self.has = shot.has
        self._shot, self._thread, self._timings = shot, thread, timings
        self._expected: list[int] = []
        self._last = -math.inf
        self._begun: dict[int, Future[Frame]] = {}  # one at most

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of every frame."""
        return self._shot.shape

    def expect(self, numbers: Iterable[int]) -> None:
        """Say which frames will be asked for; the first of them after the last one that was asked for is begun."""
        self._expected = sorted(numbers)
        self._begin()

    def read(self, number: int) -> Frame:
        """A frame; the next one that is expected is begun.

        Raises
        ------
        Exception
            What reading it has raised, as if it had been read now.
        """
        wanted = self._begun.pop(number, None) or self._thread.submit(self._read, number)
        frame = wanted.result()
        self._last = max(self._last, number)
        self._begun = {n: begun for n, begun in self._begun.items() if n > number}
        self._begin()
        return frame

    def _begin(self) -> None:
        following = next((n for n in self._expected if n > self._last), None)
        if following is not None and not self._begun:
            self._begun[following] = self._thread.submit(self._read, following)

    def _read(self, number: int) -> Frame:
        with self._timings.background("read"):
            return self._shot.read(number)
