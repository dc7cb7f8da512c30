"""Denoise the frames of a shot, and write each to its file."""

import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from hybrid.alignment.fireflies import REACH
from hybrid.checks.validation import find_nonfinite
from hybrid.denoising.denoisers import open_stream
from hybrid.denoising.plan import Plan, Rules
from hybrid.denoising.stabilize import FrameDenoiser, FrameResult, WindowDenoiser
from hybrid.denoising.stream import FirstPass, reach_of
from hybrid.files.prefetch import Prefetcher
from hybrid.files.replace import remove_leftovers
from hybrid.files.shots import Shot, output_path
from hybrid.files.sources import MADE_FROM, Source, describe_sources, why_stale
from hybrid.run.memory import MemoryPlan
from hybrid.runtime.kept import Keeper
from hybrid.runtime.timing import Timings

BESIDE = "ravg/beside"  # in a header: the frames whose pictures were averaged with this one's
# From a frame's number to the files that it was made from, by their kinds.
SourcesOf = Callable[[int], dict[str, Source]]


@dataclass(frozen=True)
class Failed:
    """A frame that could not be denoised or written, and why."""

    number: int
    error: Exception


@dataclass(frozen=True)
class Finished:
    """A frame that has been written, with figures of it."""

    number: int
    path: Path
    pixels: int = 0
    repaired: int = 0
    fireflies: int = 0
    mean: float = 0.0  # radiance of the noisy frame without its fireflies
    removed_radiance: float = 0.0  # mean radiance that went with them
    outliers: int = 0
    clamped: int = 0
    plan: Plan | None = None  # which stages ran, and why
    resumed: bool = False  # it was there already
    again: str = ""  # why it was made again, if it was there and an earlier run was to be resumed
    lost: tuple[Failed, ...] = ()  # frames near it that could not be read, and that it was made without
    seconds: float = 0.0  # that it took, but for what was read and written beside the work


class View(NamedTuple):
    """A picture of the files of a shot, with the first pass of its frames."""

    shot: Shot
    first_pass: FirstPass | None = None


@dataclass(frozen=True)
class RunSettings:
    """How frames are read, denoised and written; none of it changes a pixel."""

    memory: MemoryPlan = field(default_factory=MemoryPlan)
    # leave frames alone that are there, whole, and would be the same: with these attributes, of the same files
    resume: bool = False
    # where a frame cannot be read, denoised or written, go on with the next; one that cannot be read counts as missing
    keep_going: bool = False
    attributes: Mapping[str, str] = field(default_factory=dict)  # written to the header of each file
    # the files that the frames of the shot were made from by an earlier pass (`sources_of`)
    sources: SourcesOf | None = None


def denoise_frames(
    views: Sequence[View],
    output: str | Path,
    denoise: WindowDenoiser,
    rules: Rules,
    settings: RunSettings = RunSettings(),
    *,
    strength: float = 1.0,
    timings: Timings | None = None,
) -> Iterator[Finished | Failed]:
    """Denoise every frame of a shot and write it; yield `Finished`, or `Failed` with `keep_going`, in their order.

    Most often a frame is yielded when the next one has been denoised. The views are the shot and further pictures of
    the same files, each with a window of its own; a file is written once. While a frame is denoised, one thread writes
    the frame before it. After that, another thread reads the next frame that is needed; not earlier, because memory use
    is greatest while a denoiser runs. Files that earlier processes have left half written are removed.

    Raises ValueError if a frame would be written over its own input, or its result cannot be right: it is not finite,
    or its light is not that of the noisy frame (`hybrid.checks.validation.find_lost_light`).
    """
    timings = timings or Timings()
    shot = views[0].shot
    paths = {number: output_path(output, shot, number) for number in shot.numbers}
    for folder in {path.parent for path in paths.values()}:
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder)
    with ExitStack() as threads:
        reader = threads.enter_context(ThreadPoolExecutor(1, "read"))
        writer = _Writer(threads.enter_context(ThreadPoolExecutor(1, "write")), settings.keep_going, timings)
        frames = _ShotDenoiser(views, denoise, rules, settings, strength, reader, timings)
        following = dict(pairwise(shot.numbers))
        for number, path in paths.items():
            result: Finished | Failed | Callable[[], Finished]
            try:
                result = frames.make(number, path, following.get(number))
            except (Exception, KeyboardInterrupt) as error:
                if not settings.keep_going or not isinstance(error, ValueError | OSError):
                    yield from writer.finish()  # the frame before is complete all the same
                    raise
                result = Failed(number, error)
            done = writer.finish()
            if callable(result):
                writer.start(number, result)
            else:
                done.append(result)
            del result  # or the result would still be there while the next window is denoised
            yield from done if settings.memory.background else (*done, *writer.finish())
        yield from writer.finish()


class _Writer:
    """Writes one frame at a time in a thread."""

    def __init__(self, thread: ThreadPoolExecutor, keep_going: bool, timings: Timings) -> None:
        self._thread, self._keep_going, self._timings = thread, keep_going, timings
        self._written: tuple[int, Future[Finished]] | None = None

    def start(self, number: int, write: Callable[[], Finished]) -> None:
        """Begin to write a frame; the one before is finished."""
        self._written = number, self._thread.submit(write)

    def finish(self) -> list[Finished | Failed]:
        """Wait for the frame that is being written, if one is."""
        if self._written is None:
            return []
        (number, future), self._written = self._written, None
        try:
            with self._timings.stage("write"):
                return [future.result()]
        except (ValueError, OSError) as error:
            if not self._keep_going:
                raise
            return [Failed(number, error)]


class _ShotDenoiser:
    """Denoises frames of all views of a shot, and prepares them to be written."""

    def __init__(
        self,
        views: Sequence[View],
        denoise: WindowDenoiser,
        rules: Rules,
        settings: RunSettings,
        strength: float,
        thread: ThreadPoolExecutor,
        timings: Timings,
    ) -> None:
        self.views, self.settings, self.timings = views, settings, timings
        self.shot = views[0].shot
        self.support = temporal_support(views[0].first_pass, denoise.radius, rules)
        self.ahead = self.support - REACH - ("whiten" in rules.allowed)
        self.lost: dict[int, Exception] = {}  # frames that could not be read, which count as missing
        self.sources = sources_of(views, denoise.radius, rules, settings.sources, self.lost)
        keeper = Keeper(in_files=settings.memory.in_files)

        def follow(view: View) -> tuple[Prefetcher, FrameDenoiser]:
            reader = Prefetcher(view.shot, thread, timings, self.lost)
            stream = open_stream(reader, rules, view.first_pass, denoise, timings=timings, keeper=keeper)
            going = settings.keep_going
            rows = settings.memory.rows
            return reader, FrameDenoiser(stream, denoise, rows=rows, keep_going=going, strength=strength)

        self._follow = follow
        self._begin()

    def _begin(self) -> None:
        """Begin anew, with nothing read."""
        self.readers, self.denoisers = [], []  # first, or two windows would be in memory
        for reader, denoiser in map(self._follow, self.views):
            self.readers.append(reader)
            self.denoisers.append(denoiser)

    def make(self, number: int, path: Path, following: int | None) -> Finished | Callable[[], Finished]:
        """Denoise a frame, as `_make`; with `keep_going`, without the frames that cannot be read."""
        if not self.settings.keep_going:
            return self._make(number, path, following)
        if number in self.lost:
            raise self.lost[number]
        made, failure = None, None
        try:
            made = self._make(number, path, following)
        except (ValueError, OSError) as error:
            failure = error
        # Without tracebacks, which would keep the window in memory.
        failed = {n: error.with_traceback(None) for reader in self.readers for n, error in reader.failed.items()}
        if failed:
            made = failure = None
            self.lost |= failed
            self._begin()
            return self.make(number, path, following)
        if made is None:
            assert failure is not None
            raise failure
        return made

    def _make(self, number: int, path: Path, following: int | None) -> Finished | Callable[[], Finished]:
        """Denoise a frame and return the function that writes it; or the frame, if it is there already.

        Then begin to read the first frame that the `following` one needs beyond this one's.
        """
        started, attributes = time.perf_counter(), self.settings.attributes
        near = self.shot.neighbours(number, self.support)
        read_as = [view.shot.reader.layer_summary(number) for view in self.views]
        # With its number: in a shot that one window holds, all frames are made from the same files.
        made_from = describe_sources(self.sources(number), frame=number, layers=read_as, size=list(self.shot.shape))
        planned = {**attributes, BESIDE: _others(number, self.denoisers[0].neighbours(number)), MADE_FROM: made_from}
        again = why_stale(path, planned) if self.settings.resume else ""
        if again is None:
            return Finished(number, path, resumed=True, seconds=time.perf_counter() - started)
        self._expect(number)
        results = [denoiser.make(number) for denoiser in self.denoisers]
        # No sooner: while a denoiser runs, memory is at its fullest.
        self._expect(number if following is None else following)
        with self.timings.stage("check"):
            for result in results:
                for name, layer in {"color": result.denoised.color, **result.denoised.aovs}.items():
                    if fault := find_nonfinite(layer):
                        raise ValueError(f"frame {number}, {name}: {fault}; it was not written")
        averaged = _others(number, set.intersection(*({*result.averaged} for result in results)))
        stages = " ".join(sorted(results[0].plan.stages))
        header = {**attributes, "ravg/stages": stages, BESIDE: averaged, MADE_FROM: made_from}
        finished = Finished(
            number=number,
            path=path,
            pixels=self.shot.shape[0] * self.shot.shape[1] * len(results),
            repaired=sum(result.repaired for result in results),
            fireflies=sum(result.fireflies for result in results),
            mean=results[0].mean,
            removed_radiance=results[0].removed_radiance,
            outliers=sum(result.outliers for result in results),
            plan=results[0].plan,
            again=again,
            lost=tuple(Failed(n, self.lost[n]) for n in near if n in self.lost),
            seconds=time.perf_counter() - started,
        )
        return partial(self._write, finished, results, header)

    def _expect(self, number: int) -> None:
        """Read ahead the frames that the result of a frame needs."""
        # The outermost are read only where something shines in the one beside them, or by a later window, and the one
        # whose noise is compared has been read before.
        near = self.shot.neighbours(number, self.ahead) if self.settings.memory.background else ()
        for reader in self.readers:
            reader.expect(near)

    def _write(self, finished: Finished, results: Sequence[FrameResult], header: Mapping[str, str]) -> Finished:
        number = finished.number
        with self.timings.background("write"):
            for read in (self.shot, *(view.first_pass.files for view in self.views if view.first_pass is not None)):
                if read is not None:
                    near = (n for n in self.shot.neighbours(number, self.support) if n not in self.lost)
                    read.reader.check_unchanged(filter(read.has, near))
            first, *others = ({"color": r.denoised.color, **r.denoised.aovs} for r in results)
            pictures = [
                (view.shot, layers, result.denoised.extra)
                for view, layers, result in zip(self.views[1:], others, results[1:], strict=True)
            ]
            extra = results[0].denoised.extra
            clamped = self.shot.write(finished.path, number, first, extra, header, pictures)
        return replace(finished, clamped=clamped + sum(result.beyond for result in results))


def _others(number: int, numbers: Iterable[int]) -> str:
    return " ".join(str(n) for n in sorted(numbers) if n != number)


def temporal_support(first_pass: FirstPass | None, radius: int, rules: Rules) -> int:
    """Count the frames on each side that a frame depends on.

    Those of its window, two for fireflies, one to average results, and one whose noise is compared.
    """
    more = ("stabilize" in rules.allowed) + ("whiten" in rules.allowed)
    return REACH + more + reach_of(first_pass, radius)


def sources_of(
    views: Sequence[View],
    radius: int,
    rules: Rules,
    earlier: SourcesOf | None = None,
    lost: Container[int] = (),
) -> SourcesOf:
    """Return a function from a frame to all files of its temporal support, or those of an `earlier` pass.

    Frames that are `lost` by then are none of them.
    """
    shot, support = views[0].shot, temporal_support(views[0].first_pass, radius, rules)

    def sources(number: int) -> dict[str, Source]:
        near = [n for n in shot.neighbours(number, support) if n not in lost]
        if earlier is not None:
            return {name: source for n in near for name, source in earlier(n).items()}
        files = shot.reader.sources(near)
        for view in views:
            if view.first_pass is not None and (given := view.first_pass.files) is not None:
                files |= given.reader.sources((n for n in near if given.has(n)), "estimate")
        return files

    return sources
