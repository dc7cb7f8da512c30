"""Timed runs of methods over a shot, in turns, each in a process of its own for a peak memory of its own."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children
from typing import NamedTuple, ParamSpec, TypeVar

import numpy as np

from hybrid.comparison.methods import Method
from hybrid.comparison.store import FrameStore
from hybrid.files.frame import Frames, cut_middle
from hybrid.runtime.allocator import reuse_freed_memory
from hybrid.runtime.system import start_context
from hybrid.runtime.threads import let_waiting_threads_sleep
from hybrid.runtime.timing import Stage, Timings

OnStep = Callable[[str], None]  # gets a description of each step as it starts
P = ParamSpec("P")
T = TypeVar("T")

ENOUGH = 5.0  # seconds in total after which a method is not run again: disturbances average out within a long run
# Pixels per side of the warm-up crop: covers the whole frame of test shots, and a fourteenth of 1920×1080.
WARM_UP = 384


class RunCost(NamedTuple):
    """Cost of one run over all frames; seconds exclude reading of files."""

    megapixels: float
    seconds: float
    cpu_seconds: float
    peak_bytes: int


class Seconds(NamedTuple):
    """Seconds per megapixel over runs: median, least and most wall time, and median CPU time."""

    median: float
    least: float
    most: float
    cpu: float


def run_in_process(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a module-level function in a fresh process with a peak memory of its own; BrokenProcessPool if it dies."""
    let_waiting_threads_sleep()  # libraries read the setting when the new process first uses them
    with ProcessPoolExecutor(1, mp_context=start_context(__name__), initializer=reuse_freed_memory) as pool:
        try:
            return pool.submit(function, *args, **kwargs).result()
        except KeyboardInterrupt:
            for process in active_children():  # the pool would wait for its work
                process.terminate()
            raise


class _TimedFrames:
    """The frames of a shot; reading them is the stage "read"."""

    def __init__(self, shot: Frames, timings: Timings) -> None:
        self.numbers, self.step, self.shape, self.has = shot.numbers, shot.step, shot.shape, shot.has
        self.read = timings.stage("read")(shot.read)


def run_method(method: Method, shot: Frames, name: str = "", store: FrameStore | None = None) -> RunCost:
    """Run a method over a shot in this process; a store receives the frames under the method's name.

    A crop of the first frame is denoised before the clock starts, which excludes compilation and loading of weights.
    """
    next(method.run(cut_middle(shot, WARM_UP)), None)
    pixels, timings = 0, Timings()
    frames = method.run(_TimedFrames(shot, timings))
    while True:
        with timings.stage("run"):
            done = next(frames, None)
        if done is None:
            break
        number, image = done
        pixels += image.shape[0] * image.shape[1]
        if store is not None:
            store.save(name, number, image)
    run, read = timings.stages["run"], timings.stages.get("read", Stage())
    return RunCost(pixels / 1e6, run.seconds - read.seconds, run.cpu_seconds - read.cpu_seconds, run.peak_bytes)


class TimedRuns(NamedTuple):
    """Runs of each method that ran, round by round, and the reasons why the others are absent."""

    runs: Mapping[str, Sequence[RunCost]]
    absent: Mapping[str, str]


def time_methods(
    methods: Mapping[str, Method],
    shot: Frames,
    rounds: int,
    store: FrameStore | None = None,
    on_step: OnStep = lambda what: None,
) -> TimedRuns:
    """Run the methods in turns, so that other load of the machine affects all of them.

    A method runs `rounds` times, fewer once its runs have taken `ENOUGH` seconds; a store receives the frames of the
    first.
    """
    runs: dict[str, list[RunCost]] = {}
    absent: dict[str, str] = {}
    names = list(methods)
    for turn in range(rounds):
        # Each round starts at another method, so that no method always follows the same one.
        start = turn * len(names) // rounds
        for name in names[start:] + names[:start]:
            on_step(f"run {name}")
            if name in absent or (turn and methods[name].cost != "measured"):
                continue
            if sum(run.seconds for run in runs.get(name, [])) >= ENOUGH:
                continue
            try:
                run = run_in_process(run_method, methods[name], shot, name, None if turn else store)
            except ImportError as error:
                absent[name] = str(error)
            except BrokenProcessPool:
                absent[name] = "its process died, possibly out of memory"
            else:
                runs.setdefault(name, []).append(run)
    return TimedRuns({name: runs[name] for name in names if name in runs and name not in absent}, absent)


def summarize_runs(runs: Sequence[RunCost]) -> Seconds:
    """Reduce the runs of a method to seconds per megapixel: the median, which more rounds make more repeatable.

    Normalizing by the load of a round (measured over all methods), or of a run (by a fixed piece of work between its
    frames), did not, on a machine under eight times its load, which changes within seconds.
    """
    wall = np.array([run.seconds / run.megapixels for run in runs])
    cpu = np.array([run.cpu_seconds / run.megapixels for run in runs])
    return Seconds(float(np.median(wall)), float(wall.min()), float(wall.max()), float(np.median(cpu)))
