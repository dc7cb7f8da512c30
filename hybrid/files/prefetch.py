"""Read the next frame of a shot in a thread while the current one is worked on."""

import math
from collections.abc import Container, Iterable
from concurrent.futures import Executor, Future

from hybrid.files.frame import Frame, Frames
from hybrid.runtime.timing import Timings


class Prefetcher:
    """The frames of a shot, one of them read ahead in the one thread of an executor, where time counts as "read".

    Frames that are `lost` count as missing; `failed` are those that could not be read, with their errors.
    """

    def __init__(self, shot: Frames, thread: Executor, timings: Timings, lost: Container[int] = ()) -> None:
        self.numbers, self.step = shot.numbers, shot.step
        self.failed: dict[int, Exception] = {}
        self._shot, self._thread, self._lost = shot, thread, lost
        self._read = timings.background("read")(shot.read)
        self._expected: list[int] = []
        self._last = -math.inf
        self._begun: dict[int, Future[Frame]] = {}  # one at most

    @property
    def shape(self) -> tuple[int, int]:
        return self._shot.shape

    def has(self, number: int) -> bool:
        return self._shot.has(number) and number not in self._lost

    def expect(self, numbers: Iterable[int]) -> None:
        """Set the frames that will be read, and begin the first of them beyond the last one read."""
        self._expected = sorted(filter(self.has, numbers))
        self._begin()

    def read(self, number: int) -> Frame:
        """Return a frame, and begin the next expected one; raises the error of reading it."""
        wanted = self._begun.pop(number, None) or self._thread.submit(self._read, number)
        try:
            frame = wanted.result()
        except (ValueError, OSError) as error:
            self.failed[number] = error
            raise
        self._last = max(self._last, number)
        self._begun = {n: begun for n, begun in self._begun.items() if n > number}
        self._begin()
        return frame

    def _begin(self) -> None:
        following = next((n for n in self._expected if n > self._last), None)
        if following is not None and not self._begun:
            self._begun[following] = self._thread.submit(self._read, following)
