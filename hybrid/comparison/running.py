"""Methods run over a shot, in turns, each in a process of its own, so that its peak memory is its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ParamSpec, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from hybrid.comparison.methods import Method
from hybrid.comparison.store import FrameStore
from hybrid.files.frame import Frame, MappedShot
from hybrid.files.shots import Shot
from hybrid.runtime.allocator import reuse_freed_memory
from hybrid.runtime.system import peak_memory, start_context
from hybrid.runtime.threads import let_waiting_threads_sleep, limit_threads

Progress = Callable[[str, int, int], None]  # what is being done, steps done, steps in all
P = ParamSpec("P")
T = TypeVar("T")

#: A method whose runs have taken so long together is not run again, seconds: what meets a short run by chance is
#: spread over a long one.
ENOUGH = 5.0
# Pixels on a side of what methods warm up with: frames of shots for tests are warmed up with as a whole, and of one of
# 1920×1080 it is a fourteenth.
WARM_UP = 384


@dataclass(frozen=True)
class Run:
    """What a method has cost: its frames together, seconds without the reading of files, peak bytes."""

    megapixels: float
    seconds: float
    cpu_seconds: float
    peak_bytes: int


@dataclass(frozen=True)
class Seconds:
    """Seconds per megapixel of a method's runs: median, least and most by the wall clock, and the median CPU time."""

    median: float
    least: float
    most: float
    cpu: float


def run_apart(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a module's function in a fresh process.

    The process is not forked from this one, whose peak memory Linux would count as its own.

    Parameters
    ----------
    function : callable
        Of a module, so that it can travel.
    *args, **kwargs : object
        Its own.

    Returns
    -------
    object
        What it returns.

    Raises
    ------
    BrokenProcessPool
        If the process dies.
    """
    let_waiting_threads_sleep()  # the libraries read it when the forked process first uses them
    with ProcessPoolExecutor(1, mp_context=start_context(__name__), initializer=reuse_freed_memory) as pool:
        return pool.submit(function, *args, **kwargs).result()


class _Clock:
    """Adds up the wall and the CPU seconds of ``with`` blocks."""

    def __init__(self) -> None:
        self.seconds = self.cpu_seconds = 0.0

    def __enter__(self) -> Self:
        self._start = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        wall, cpu = self._start
        self.seconds += time.perf_counter() - wall
        self.cpu_seconds += time.process_time() - cpu


@contextmanager
def _clock_reading(shot: Shot) -> Iterator[_Clock]:
    """Count the time that `shot.read` takes, whoever calls it."""
    owner: Any = getattr(shot, "reader", shot)  # frames in memory have no reader
    clock = _Clock()
    read: Callable[[int], Frame] = owner.read

    def clocked(number: int) -> Frame:
        with clock:
            return read(number)

    owner.read = clocked
    try:
        yield clock
    finally:
        del owner.read


def _middle_of(shot: Shot) -> Shot:
    """The middle of every frame, at most `WARM_UP` pixels on a side, as a shot for a method to warm up with."""
    height, width = (min(size, WARM_UP) for size in shot.shape)

    def cut(frame: Frame) -> Frame:
        whole = frame.color.shape[:2]
        top, left = (whole[0] - height) // 2, (whole[1] - width) // 2

        def part(array: NDArray[Any]) -> NDArray[Any]:
            return np.ascontiguousarray(array[top : top + height, left : left + width])

        cuts: dict[str, Any] = {
            name: part(value) for name, value in vars(frame).items() if isinstance(value, np.ndarray)
        }
        cuts |= {name: {key: part(a) for key, a in getattr(frame, name).items()} for name in ("aovs", "pass_colors")}
        return replace(frame, **cuts, resolution=frame.resolution or whole)

    return cast("Shot", MappedShot(shot, cut, shape=(height, width)))  # of a shot methods ask for frames alone


def run_method(method: Method, shot: Shot, name: str = "", store: FrameStore | None = None) -> Run:
    """Run a method over a shot in this process.

    The middle of the first frame is made before the clock starts: compilation and weights are paid for there.

    Parameters
    ----------
    method : Method
        What to run.
    shot : Shot
        What to denoise.
    name : str
        Of the method, for the store.
    store : FrameStore, optional
        Where its frames are kept.

    Returns
    -------
    Run
        What it has cost.
    """
    if method.threads:
        limit_threads(method.threads)
    next(method.run(_middle_of(shot)), None)
    clock, pixels = _Clock(), 0
    with _clock_reading(shot) as reading:
        frames = method.run(shot)
        while True:
            with clock:
                done = next(frames, None)
            if done is None:
                break
            number, image = done
            pixels += image.shape[0] * image.shape[1]
            if store is not None:
                store.save(name, number, image)
    return Run(pixels / 1e6, clock.seconds - reading.seconds, clock.cpu_seconds - reading.cpu_seconds, peak_memory())


def time_methods(
    methods: Mapping[str, Method],
    shot: Shot,
    rounds: int,
    store: FrameStore | None = None,
    progress: Progress | None = None,
) -> tuple[dict[str, list[Run]], dict[str, str]]:
    """Run the methods in turns, so that whatever else the machine does meets all of them.

    Parameters
    ----------
    methods : mapping of str to Method
        By name.
    shot : Shot
        What to denoise.
    rounds : int
        How often each method runs; fewer times once its runs have taken `ENOUGH`.
    store : FrameStore, optional
        Where the frames of the first round are kept.
    progress : callable, optional
        Is told what is being done.

    Returns
    -------
    runs : dict of str to list of Run
        Those of each method, a round after the other.
    absent : dict of str to str
        Why the others have none.
    """
    runs: dict[str, list[Run]] = {}
    absent: dict[str, str] = {}
    names = list(methods)
    for turn in range(rounds):
        # Each round starts elsewhere, so that no method always follows the same one.
        start = turn * len(names) // rounds
        for done, name in enumerate(names[start:] + names[:start]):
            if progress is not None:
                progress(f"run {name}", turn * len(names) + done, rounds * len(names))
            if name in absent or (turn and not methods[name].timed):
                continue
            if sum(run.seconds for run in runs.get(name, [])) >= ENOUGH:
                continue
            try:
                run = run_apart(run_method, methods[name], shot, name, None if turn else store)
            except ImportError as error:
                absent[name] = str(error)
            except BrokenProcessPool:
                absent[name] = "its process died, out of memory perhaps"
            else:
                runs.setdefault(name, []).append(run)
    return {name: runs[name] for name in names if name in runs and name not in absent}, absent


def summarize_runs(runs: Sequence[Run]) -> Seconds:
    """Reduce the runs of a method to seconds per megapixel.

    Notes
    -----
    The median alone. Dividing out the load of a round (as all methods felt it), or of a run (by a fixed piece of work
    between its frames), made ratios repeat no better on a machine under eight times its load: that changes
    within seconds. More rounds do help.
    """
    wall = np.array([run.seconds / run.megapixels for run in runs])
    cpu = np.array([run.cpu_seconds / run.megapixels for run in runs])
    return Seconds(float(np.median(wall)), float(wall.min()), float(wall.max()), float(np.median(cpu)))
