"""Denoise a shot: align each window, estimate its centre, write the frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid.frames import Shot, output_path
from hybrid.plan import Plan
from hybrid.pseudo_reference import AlignedWindow, Aligner
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


Estimator = Callable[[AlignedWindow], Denoised]


@dataclass(frozen=True)
class Finished:
    """A frame that has been written, and what there is to say of it."""

    number: int
    path: Path
    repaired: int
    outliers: int
    clamped: int


def denoise_shot(
    shot: Shot,
    output: str | Path,
    estimator: Estimator,
    plan: Plan,
    *,
    radius: int = 2,
    interpolation: str = "bilinear",
    attributes: Mapping[str, str] | None = None,
    timings: Timings | None = None,
) -> Iterator[Finished]:
    """Denoise every frame of a shot and write it, one after the other.

    Parameters
    ----------
    shot : Shot
        What to denoise.
    output : str or Path
        Where to write: a pattern with a placeholder for the frame number, or a folder.
    estimator : callable
        From `AlignedWindow` to `Denoised`.
    plan : Plan
        Which stages to run.
    radius : int
        Frames on each side of the centre.
    interpolation : str
        Of the warp.
    attributes : mapping of str to str, optional
        Written to the header of each file.
    timings : Timings, optional
        Where to count the stages.

    Yields
    ------
    Finished
        After each frame has been written as a whole.

    Raises
    ------
    ValueError
        If a frame would be written over its own input.
    """
    timings = timings or Timings()
    aligner = Aligner(shot, plan.effects, radius=radius, interpolation=interpolation, timings=timings)
    paths = {number: output_path(output, shot, number) for number in shot.numbers}
    for folder in {path.parent for path in paths.values()}:
        folder.mkdir(parents=True, exist_ok=True)
    for number, path in paths.items():
        aligned = aligner.align(number)
        denoised = estimator(aligned)
        with timings.stage("write"):
            images = {"color": denoised.color, **denoised.aovs}
            clamped = shot.write(path, number, images, denoised.extra, attributes)
        yield Finished(number, path, aligned.repaired, aligned.outliers, clamped)
