"""Denoise a shot: align each window, estimate its centre, write the frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.align import AlignedWindow, Aligner, Estimates
from hybrid.estimates import EstimateSource
from hybrid.files.frames import Shot, output_path
from hybrid.files.replace import check_outputs, remove_leftovers
from hybrid.files.sources import MADE_FROM, Source, describe_sources, why_stale
from hybrid.plan import Plan, Rules, as_run
from hybrid.plausibility import find_lost_light, find_nonfinite
from hybrid.timing import Timings

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Denoised:
    """What came out for one frame.

    Attributes
    ----------
    color : (H, W, 3) array
        Radiance.
    aovs : dict of str to (H, W, C) array
        Other layers that were filtered along, to be written over their own channels.
    extra : dict of str to (H, W) or (H, W, C) array
        Layers to be added to the file.
    """

    color: Array
    aovs: Mapping[str, Array] = field(default_factory=dict)
    extra: Mapping[str, Array] = field(default_factory=dict)


DenoiseWindow = Callable[[AlignedWindow], Denoised]
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
    removed: float = 0.0  # share of the frame's light that went with the fireflies
    outliers: int = 0
    clamped: int = 0
    plan: Plan | None = None  # which stages ran, and why
    resumed: bool = False  # it was there already
    again: str = ""  # why it was made again, if it was there and an earlier run was to be resumed


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
    resume: bool = False,
    keep_going: bool = False,
    timings: Timings | None = None,
    before: SourcesOf | None = None,
) -> Iterator[Finished | Failed]:
    """Denoise every frame of a shot and write it, one after the other.

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
        Further pictures of the same files (`Shot.pictures`), each with a window of its own. A file is written once.
    attributes : mapping of str to str, optional
        Written to the header of each file.
    rows : int, optional
        How many rows of a frame to work on at a time (`hybrid.memory.plan_rows`); all without. The result is the same.
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
        After each frame has been written as a whole; or with `keep_going`, when it is given up.

    Raises
    ------
    ValueError
        If a frame would be written over its own input, or its picture cannot be right: it is not finite, or its light
        is not that of the noisy frame (`hybrid.plausibility.find_lost_light`).

    Notes
    -----
    Whatever ends the process, a frame is there as a whole or not at all (`hybrid.files.replace.replace_file`). What
    earlier processes have left half written is removed.
    """
    timings = timings or Timings()
    all_pictures = ((shot, estimates), *others)
    aligner, *beside = (
        Aligner(picture, rules, radius=radius, estimates=theirs, timings=timings) for picture, theirs in all_pictures
    )
    paths = {number: output_path(output, shot, number) for number in shot.numbers}
    for folder in {path.parent for path in paths.values()}:
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder)
    sources = sources_of(all_pictures, radius, before)
    reach = reach_of(estimates, radius)
    for number, path in paths.items():
        try:
            read_as = [picture.taken(number) for picture, _ in all_pictures]
            made_from = describe_sources(sources(number), layers=read_as, size=list(shot.shape))
            again = why_stale(path, {**(attributes or {}), MADE_FROM: made_from}) if resume else ""
            if again is None:
                yield Finished(number, path, resumed=True)
                continue
            denoised, aligned = _denoise_frame(aligner, number, denoise, rows or shot.shape[0])
            counted, pictures = [aligned], []
            for (picture, _), other in zip(others, beside, strict=True):
                theirs, counts = _denoise_frame(other, number, denoise, rows or shot.shape[0])
                pictures.append((picture, {"color": theirs.color, **theirs.aovs}, theirs.extra))
                counted.append(counts)
            plan = as_run(rules.plan(*aligner.facts_of(aligner.around(number, radius))), aligned.stages)
            with timings.stage("check"):
                images = {"color": denoised.color, **denoised.aovs}
                _check_picture(images, aligner, number)
                for (_, layers, _), other in zip(pictures, beside, strict=True):
                    _check_picture(layers, other, number)
            with timings.stage("write"):
                own = {"ravg/stages": " ".join(sorted(plan.stages)), MADE_FROM: made_from}
                for read in (shot, *(theirs.files for _, theirs in all_pictures if theirs is not None)):
                    if read is not None:
                        read.check_unchanged(n for n in shot.near(number, reach) if read.has(n))
                clamped = shot.write(path, number, images, denoised.extra, {**(attributes or {}), **own}, pictures)
            finished = Finished(
                number=number,
                path=path,
                pixels=denoised.color[..., 0].size * len(counted),
                repaired=sum(counts.repaired for counts in counted),
                fireflies=sum(counts.fireflies for counts in counted),
                removed=max(counts.removed for counts in counted),
                outliers=sum(counts.outliers for counts in counted),
                clamped=clamped,
                plan=plan,
                again=again,
            )
            del denoised, aligned, pictures  # or they would still be there while the next window is made
        except (ValueError, OSError) as error:
            if not keep_going:
                raise
            yield Failed(number, error)
        else:
            yield finished


@dataclass(frozen=True)
class _Counts:
    """What there is to say of a window: as `AlignedWindow` has it, over all parts of the frame."""

    repaired: int
    fireflies: int
    removed: float
    outliers: int
    stages: frozenset[str]


def _denoise_frame(aligner: Aligner, number: int, denoise: DenoiseWindow, rows: int) -> tuple[Denoised, _Counts]:
    """Denoise a frame, so many rows at a time."""
    height, width = aligner.shot.shape
    whole: dict[tuple[str, str], Array] = {}
    outliers = 0
    for top in range(0, height, rows):
        band = slice(top, min(top + rows, height))
        aligned = aligner.align(number, band)
        part = denoise(aligned)
        outliers += aligned.outliers
        counts = _Counts(aligned.repaired, aligned.fireflies, aligned.removed, outliers, aligned.stages)
        named = {("color", ""): part.color}
        named |= {("aovs", name): layer for name, layer in part.aovs.items()}
        named |= {("extra", name): layer for name, layer in part.extra.items()}
        for name, layer in named.items():
            if rows >= height:
                whole[name] = layer
                continue
            if name not in whole:
                whole[name] = np.empty((height, width, *layer.shape[2:]), np.float32)
            whole[name][band] = layer[aligned.inner]
        del aligned, part, named
    kinds = {kind: {name: layer for (k, name), layer in whole.items() if k == kind} for kind in ("aovs", "extra")}
    return Denoised(whole["color", ""], kinds["aovs"], kinds["extra"]), counts


def _check_picture(images: Mapping[str, Array], aligner: Aligner, number: int) -> None:
    """Raise ValueError for a picture that cannot be right: whatever made it so, no file is better than this one."""
    for name, layer in images.items():
        if fault := find_nonfinite(layer):
            raise ValueError(f"frame {number}, {name}: {fault}; it was not written")
    frame = aligner.frame(number)
    if frame is None:
        return

    def around() -> float:
        near = (aligner.frame(n) for n in aligner.around(number, aligner.radius))
        return max(float(other.radiance.mean(dtype=np.float64)) for other in near if other is not None)

    if fault := find_lost_light(images["color"], frame.radiance, frame.valid, around):
        raise ValueError(f"frame {number}: {fault}; it was not written")


def reach_of(estimates: Estimates | None, radius: int) -> int:
    """Count the frames on each side of one that it depends on: its window, and one for what shines in a frame alone.

    Parameters
    ----------
    estimates : Estimates or None
        Where the estimates of single frames come from.
    radius : int
        Frames on each side of the centre of a window.
    """
    return 1 + (radius if estimates is None else estimates.reach(radius))


def sources_of(
    pictures: Sequence[tuple[Shot, Estimates | None]], radius: int, before: SourcesOf | None = None
) -> SourcesOf:
    """Tell of each frame which files it is made from.

    Parameters
    ----------
    pictures : sequence of (Shot, Estimates or None)
        As `denoise_frames` has them, the shot first.
    radius : int
        Frames on each side of the centre.
    before : callable, optional
        What tells it of the frames of the shot, where they are themselves made.

    Returns
    -------
    callable
        From a frame's number to all files that its window reaches, or that these were made from.
    """
    shot, reach = pictures[0][0], reach_of(pictures[0][1], radius)

    def sources(number: int) -> dict[str, Source]:
        near = shot.near(number, reach)
        if before is not None:
            return {what: source for n in near for what, source in before(n).items()}
        files = shot.states(near)
        for _, estimates in pictures:
            if estimates is not None and (given := estimates.files) is not None:
                files |= given.states((n for n in near if given.has(n)), "estimate")
        return files

    return sources
