"""Denoise a shot: align each window, estimate its centre, write the frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid.exr import Layer, write_exr
from hybrid.frames import Shot
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
    paths = {number: shot.output_path(str(output), number) for number in shot.numbers}
    for folder in {path.parent for path in paths.values()}:
        folder.mkdir(parents=True, exist_ok=True)
    for number, path in paths.items():
        aligned = aligner.align(number)
        denoised = estimator(aligned)
        with timings.stage("write"):
            clamped = write_frame(shot, number, path, denoised, attributes)
        yield Finished(number, path, aligned.repaired, aligned.outliers, clamped)


def write_frame(
    shot: Shot, number: int, path: Path, denoised: Denoised, attributes: Mapping[str, str] | None = None
) -> int:
    """Write one frame: its input with the denoised channels replaced; return how many values a half cut off."""
    layers = shot.layers(number)
    # Where the renderer has denoised already, its picture is what the user looks at; the noisy one stays as it is.
    target = layers.estimate or layers.color
    replaced = _channels(target, denoised.color)
    for name, image in denoised.aovs.items():
        replaced |= _channels(shot.source(number).layer(name), image)
    return write_exr(path, shot.source(number), replaced, denoised.extra, attributes)


def _channels(layer: Layer, image: Array) -> dict[str, Array]:
    return {name: image[..., index] for index, name in enumerate(layer.channels[: image.shape[-1]])}
