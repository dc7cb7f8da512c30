"""Read the next frame of a shot in a thread while the current one is worked on."""

import math
from collections.abc import Iterable
from concurrent.futures import Executor, Future

from hybrid.files.frame import Frame, Frames
from hybrid.runtime.timing import Timings


class Prefetcher:
    """The frames of a shot, one of them read ahead in the one thread of an executor, where time counts as "read"."""

    def __init__(self, shot: Frames, thread: Executor, timings: Timings) -> None:
        self.numbers, self.step = shot.numbers, shot.step
        self.has = shot.has
        self._shot, self._thread = shot, thread
        self._read = timings.background("read")(shot.read)
        self._expected: list[int] = []
        self._last = -math.inf
        self._begun: dict[int, Future[Frame]] = {}  # one at most

    @property
    def shape(self) -> tuple[int, int]:
        return self._shot.shape

    def expect(self, numbers: Iterable[int]) -> None:
        """Set the frames that will be read, and begin the first of them beyond the last one read."""
        self._expected = sorted(numbers)
        self._begin()

    def read(self, number: int) -> Frame:
        """Return a frame, and begin the next expected one; raises the error of reading it."""
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
