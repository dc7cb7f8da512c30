"""Denoise a shot: align each window, estimate its centre, write the frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybrid.files import replace_file
from hybrid.frames import Shot, open_shot, output_path
from hybrid.plan import Plan
from hybrid.pseudo_reference import AlignedWindow, Aligner, Estimate
from hybrid.timing import Timings
from hybrid.transfer import measure_exposure
from nlm.average import replace_nonfinite

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
    pixels: int
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
    estimate: Estimate = None,
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
    estimate : function or Preset, optional
        Where the estimates of single frames come from (`hybrid.estimates`).
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
    aligner = Aligner(
        shot, plan.effects, radius=radius, interpolation=interpolation, estimate=estimate, timings=timings
    )
    paths = {number: output_path(output, shot, number) for number in shot.numbers}
    for folder in {path.parent for path in paths.values()}:
        folder.mkdir(parents=True, exist_ok=True)
    for number, path in paths.items():
        aligned = aligner.align(number)
        denoised = estimator(aligned)
        with timings.stage("write"):
            images = {"color": denoised.color, **denoised.aovs}
            clamped = shot.write(path, number, images, denoised.extra, attributes)
        finished = Finished(number, path, denoised.color[..., 0].size, aligned.repaired, aligned.outliers, clamped)
        del aligned, denoised  # or they would still be there while the next window is made
        yield finished


def write_preview(shot: Shot, output: str | Path, path: Path) -> None:
    """Write a PNG of the middle frame, noisy on the left and denoised on the right.

    Parameters
    ----------
    shot : Shot
        The input.
    output : str or Path
        Where `denoise_shot` has written.
    path : Path
        Of the PNG. Both halves are exposed alike, to a mean of 0.18 of the noisy frame, and sRGB encoded.
    """
    number = shot.numbers[len(shot.numbers) // 2]
    noisy, _ = replace_nonfinite(shot.read(number).color)
    finished = open_shot(output_path(output, shot, number))
    denoised = finished.read(finished.numbers[0]).color
    exposure = measure_exposure(noisy) / 0.18
    pair = np.concatenate([noisy, denoised], axis=1) / np.float32(exposure)
    pair = np.clip(pair, 0, 1)
    encoded = np.where(pair <= 0.0031308, 12.92 * pair, 1.055 * pair ** (1 / 2.4) - 0.055)
    _, data = cv2.imencode(".png", np.round(encoded[..., ::-1] * 255).astype(np.uint8))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary:
        temporary.write_bytes(data.tobytes())
