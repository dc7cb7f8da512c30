"""Denoise a shot: align each window, estimate its centre, write the frame."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.align import Aligner, Estimates
from hybrid.alignment.loading import REACH
from hybrid.alignment.window import AlignedWindow
from hybrid.beside import ReadAhead
from hybrid.estimates import OIDN_MODES, EstimateSource
from hybrid.files.replace import check_outputs, remove_leftovers
from hybrid.files.shots import Shot, output_path
from hybrid.files.sources import MADE_FROM, PACKAGES, Source, describe_sources, versions, why_stale
from hybrid.plan import Plan, Rules, as_run
from hybrid.runtime.timing import Timings
from hybrid.steady import Denoised, DenoiseWindow, Pictures
from hybrid.validation import find_nonfinite

Array = NDArray[np.float32]


# In a header: the frames whose pictures were averaged with this one's.
BESIDE = "ravg/beside"
# From a frame's number to the files that it was made from, by what they are.
SourcesOf = Callable[[int], dict[str, Source]]


@dataclass(frozen=True)
class Failed:
    """A frame that could not be made, and why."""

    number: int
    error: Exception


@dataclass(frozen=True)
class Finished:
    """A frame that has been written, and what there is to say of it."""

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
    seconds: float = 0.0  # that it took, but for what was read and written beside the work


def check_written(
    shot: Shot,
    output: str | Path,
    sources: Sequence[EstimateSource],
    inputs: Mapping[str, str | Path | None],
    others: Mapping[str, Path | None],
) -> None:
    """Refuse a run that would write over anything it reads, or over a file that is somebody else's.

    Parameters
    ----------
    shot : Shot
        What is denoised.
    output : str or Path
        As for `denoise_frames`.
    sources : sequence of EstimateSource
        Whose files are read, or kept.
    inputs, others : mapping of str to Path or None
        What else is read, and what else is written: what it is called → where.

    Raises
    ------
    ValueError, OSError
        As `hybrid.files.replace.check_outputs`.
    """
    written = [("output", output_path(output, shot, number)) for number in shot.numbers]
    written += [("keep-estimates", path) for source in sources for path in source.kept]
    written += [(what, path) for what, path in others.items() if path is not None]
    read = [("frame", path) for number in shot.files for path in shot.paths(number)]
    read += [("estimate", path) for source in sources if source.files for path in source.files.files.values()]
    read += [(what, Path(path)) for what, path in inputs.items() if path is not None]
    check_outputs(written, read)


def describe_run(
    command: str,
    preset: str,
    source: EstimateSource,
    rules: Rules,
    settings: Mapping[str, object],
    *,
    neural: bool = False,
) -> dict[str, str]:
    """Describe how the frames of a run are made: where that differs, they may be others.

    Parameters
    ----------
    command, preset : str
        What makes them.
    source : EstimateSource
        Where their estimates come from.
    rules : Rules
        What the user has forced.
    settings : mapping of str to object
        All other options that pixels depend on, as JSON has them.
    neural : bool
        Whether there is a network.

    Returns
    -------
    dict of str to str
        Attributes of their headers.
    """
    packages = [*PACKAGES, *(["torch"] if neural else []), *(["pyoidn"] if source.name in OIDN_MODES else [])]
    return {
        "ravg/command": command,
        "ravg/preset": preset,
        "ravg/estimate": source.name,
        "ravg/forced": rules.forced,
        "ravg/settings": json.dumps(settings, sort_keys=True),
        "ravg/versions": json.dumps(versions(*packages), sort_keys=True),
    }


def denoise_frames(
    shot: Shot,
    output: str | Path,
    denoise: DenoiseWindow,
    rules: Rules,
    *,
    radius: int = 2,
    estimates: Estimates | None = None,
    others: Sequence[tuple[Shot, Estimates | None]] = (),
    attributes: Mapping[str, str] | None = None,
    rows: int | None = None,
    beside: bool = True,
    resume: bool = False,
    keep_going: bool = False,
    timings: Timings | None = None,
    before: SourcesOf | None = None,
) -> Iterator[Finished | Failed]:
    """Denoise every frame of a shot and write it, one after the other.

    While a frame is made, the one before it is written in one thread; once it is denoised, the next one that its
    successor needs is read in another.

    Parameters
    ----------
    shot : Shot
        What to denoise.
    output : str or Path
        Where to write: a pattern with a placeholder for the frame number, or a folder.
    denoise : callable
        From `AlignedWindow` to `Denoised`.
    rules : Rules
        What decides which stages run on a frame.
    radius : int
        Frames on each side of the centre.
    estimates : Estimates, optional
        Where the estimates of single frames come from (`hybrid.estimates`).
    others : sequence of (Shot, Estimates or None)
        Further pictures of the same files (`Shot.views`), each with a window of its own. A file is written once.
    attributes : mapping of str to str, optional
        Written to the header of each file.
    rows : int, optional
        How many rows of a frame to work on at a time (`hybrid.memory.plan_rows`); all without. The result is the same.
    beside : bool
        Whether to read and write beside the work, which takes the memory of a frame that is read and one that is
        written.
    resume : bool
        Leave frames alone that are there, whole, and would be made the same: with these attributes, of the same files.
    keep_going : bool
        Where a frame cannot be made, or read, or written, go on with those after it.
    timings : Timings, optional
        Where to count the stages.
    before : callable, optional
        What the frames of the shot were made from themselves (`sources_of`), by a pass before this one.

    Yields
    ------
    Finished or Failed
        In the order of the frames, each after it has been written as a whole, or with `keep_going`, given up; most
        often when the next one has been made.

    Raises
    ------
    ValueError
        If a frame would be written over its own input, or its picture cannot be right: it is not finite, or its light
        is not that of the noisy frame (`hybrid.validation.find_lost_light`).

    Notes
    -----
    Whatever ends the process, a frame is there as a whole or not at all (`hybrid.files.replace.replace_file`). What
    earlier processes have left half written is removed.
    """
    timings = timings or Timings()
    all_pictures = ((shot, estimates), *others)
    paths = {number: output_path(output, shot, number) for number in shot.numbers}
    for folder in {path.parent for path in paths.values()}:
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder)
    sources = sources_of(all_pictures, radius, rules, before)
    reach = reach_of(estimates, radius, rules)
    with ThreadPoolExecutor(1, "read") as reader, ThreadPoolExecutor(1, "write") as writer:
        readers = [ReadAhead(picture, reader, timings) for picture, _ in all_pictures]
        aligners = [
            Aligner(frames, rules, radius=radius, estimates=theirs, timings=timings)
            for frames, (_, theirs) in zip(readers, all_pictures, strict=True)
        ]
        after = dict(pairwise(shot.numbers))
        making = shot.numbers[0]

        def expect(number: int) -> None:
            """Have the frames read ahead that the picture of a frame needs."""
            # The outermost are read only where something shines in the one beside them, or by a later window.
            near = shot.neighbours(number, reach - REACH) if beside else ()
            for frames in readers:
                frames.expect(near)

        def denoise_window(aligned: AlignedWindow) -> Denoised:
            denoised = denoise(aligned)
            # No sooner: while a picture is denoised, memory is at its fullest.
            expect(after.get(making, making))
            return denoised

        makers = [Pictures(aligner, denoise_window, rows=rows, keep_going=keep_going) for aligner in aligners]

        def make(number: int) -> Finished | Callable[[], Finished]:
            """Make a frame; give what writes it, or what there is to say of one that is there."""
            nonlocal making
            making = number
            started, path = time.perf_counter(), paths[number]
            read_as = [picture.layer_summary(number) for picture, _ in all_pictures]
            # With its number: in a shot that one window holds, all frames are made from the same files.
            made_from = describe_sources(sources(number), frame=number, layers=read_as, size=list(shot.shape))
            planned = {**(attributes or {}), BESIDE: _others(number, makers[0].beside(number)), MADE_FROM: made_from}
            again = why_stale(path, planned) if resume else ""
            if again is None:
                return Finished(number, path, resumed=True, seconds=time.perf_counter() - started)
            expect(number)
            made = [maker.make(number) for maker in makers]
            counted = [counts for _, counts in made]
            plan = as_run(rules.plan(*counted[0].facts), counted[0].stages, counted[0].shares)
            layers = [{"color": denoised.color, **denoised.aovs} for denoised, _ in made]
            with timings.stage("check"):
                for images in layers:
                    _check_finite(images, number)
            others_there = _others(number, set.intersection(*({*counts.beside} for counts in counted)))
            own = {
                "ravg/stages": " ".join(sorted(plan.stages)),
                BESIDE: others_there,
                MADE_FROM: made_from,
            }
            pictures = [
                (picture, images, denoised.extra)
                for (picture, _), images, (denoised, _) in zip(others, layers[1:], made[1:], strict=True)
            ]
            extra, centre = made[0][0].extra, aligners[0].frames.get(number)
            finished = Finished(
                number=number,
                path=path,
                pixels=layers[0]["color"][..., 0].size * len(counted),
                repaired=sum(counts.repaired for counts in counted),
                fireflies=sum(counts.fireflies for counts in counted),
                mean=0.0 if centre is None else centre.mean,
                removed_radiance=0.0 if centre is None else centre.removed_radiance,
                outliers=sum(counts.outliers for counts in counted),
                plan=plan,
                again=again,
                seconds=time.perf_counter() - started,
            )

            def write() -> Finished:
                with timings.beside("write"):
                    for read in (shot, *(theirs.files for _, theirs in all_pictures if theirs is not None)):
                        if read is not None:
                            read.check_unchanged(n for n in shot.neighbours(number, reach) if read.has(n))
                    headed = {**(attributes or {}), **own}
                    clamped = shot.write(path, number, layers[0], extra, headed, pictures)
                    return replace(finished, clamped=clamped + sum(counts.beyond for counts in counted))

            return write

        written: tuple[int, Future[Finished]] | None = None

        def settle() -> list[Finished | Failed]:
            """What became of the frame that was being written, if one was."""
            nonlocal written
            if written is None:
                return []
            (number, waited), written = written, None
            try:
                with timings.stage("write"):
                    return [waited.result()]
            except (ValueError, OSError) as error:
                if not keep_going:
                    raise
                return [Failed(number, error)]

        for number in paths:
            outcome: Finished | Failed | Callable[[], Finished]
            try:
                outcome = make(number)
            except (Exception, KeyboardInterrupt) as error:
                if not keep_going or not isinstance(error, ValueError | OSError):
                    yield from settle()  # the frame before has been made all the same
                    raise
                outcome = Failed(number, error)
            told = settle()
            if isinstance(outcome, Finished | Failed):
                told.append(outcome)
            else:
                written = number, writer.submit(outcome)
            del outcome  # or the pictures would still be there while the next window is made
            yield from told if beside else (*told, *settle())
        yield from settle()


def _others(number: int, numbers: Iterable[int]) -> str:
    return " ".join(str(n) for n in sorted(numbers) if n != number)


def _check_finite(images: Mapping[str, Array], number: int) -> None:
    """Raise ValueError for a picture that is not finite: no file is better than this one."""
    for name, layer in images.items():
        if fault := find_nonfinite(layer):
            raise ValueError(f"frame {number}, {name}: {fault}; it was not written")


def reach_of(estimates: Estimates | None, radius: int, rules: Rules) -> int:
    """Count the frames on each side of one that it depends on.

    Its window, two for what shines in a frame alone, and one for the pictures beside it, which have windows too.

    Parameters
    ----------
    estimates : Estimates or None
        Where the estimates of single frames come from.
    radius : int
        Frames on each side of the centre of a window.
    rules : Rules
        What decides which stages run.
    """
    return REACH + ("steady" in rules.allowed) + (radius if estimates is None else estimates.reach(radius))


def sources_of(
    pictures: Sequence[tuple[Shot, Estimates | None]], radius: int, rules: Rules, before: SourcesOf | None = None
) -> SourcesOf:
    """Tell of each frame which files it is made from.

    Parameters
    ----------
    pictures : sequence of (Shot, Estimates or None)
        As `denoise_frames` has them, the shot first.
    radius : int
        Frames on each side of the centre.
    rules : Rules
        What decides which stages run.
    before : callable, optional
        What tells it of the frames of the shot, where they are themselves made.

    Returns
    -------
    callable
        From a frame's number to all files that its window reaches, or that these were made from.
    """
    shot, reach = pictures[0][0], reach_of(pictures[0][1], radius, rules)

    def sources(number: int) -> dict[str, Source]:
        near = shot.neighbours(number, reach)
        if before is not None:
            return {what: source for n in near for what, source in before(n).items()}
        files = shot.sources(near)
        for _, estimates in pictures:
            if estimates is not None and (given := estimates.files) is not None:
                files |= given.sources((n for n in near if given.has(n)), "estimate")
        return files

    return sources
