"""Training clips: aligned windows at several noise levels, from shots to files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray

from hybrid.alignment.window import AlignedWindow
from hybrid.files.shots import Shot
from hybrid.first_pass import OIDN_MODES, find_first_pass
from hybrid.neural.denoiser import clean_guides, exposure_of, gain_of
from hybrid.neural.tiling import tensor_of
from hybrid.plan import Rules
from hybrid.pseudo_reference import gated_average, gather_and_denoise
from hybrid.stream import FrameStream
from network.training.clips import Clip, importance, important_places, write_shards
from nlm.average import replace_nonfinite


def write_clips(
    levels: Mapping[str, Shot],
    samples: Sequence[float],
    folder: Path,
    name: str,
    *,
    radius: int = 2,
    tile: int = 128,
    tiles: int = 4,
    estimate: str = "auto",
    reference: Shot | None = None,
    target: Shot | None = None,
    seed: int = 0,
    advance: Callable[[], object] = lambda: None,
) -> list[Path]:
    """Write the training clips of a shot.

    Parameters
    ----------
    levels : mapping of str to Shot
        Independent renders of the same frames.
    samples : sequence of float
        Samples per pixel of each.
    folder : Path
        Where the shards are written.
    name : str
        Of the shot; sets are split by it.
    radius : int
        Frames on each side of the centre.
    tile : int
        Side of a clip, pixels; 0 for whole frames.
    tiles : int
        Clips of each frame, placed by `network.training.clips.importance`.
    estimate : str
        Where the estimates come from (`hybrid.first_pass.find_first_pass`); not "none".
    reference : Shot, optional
        The same frames clean, or some of them: clips are made of these alone, and trained towards them.
    target : Shot, optional
        A further render of the same frames, of more samples: clips are trained towards its pseudo-references, or
        towards itself.
    seed : int
        Of the places.
    advance : callable
        Called after each frame.

    Returns
    -------
    list of Path
        The shards.

    Raises
    ------
    ValueError
        If the levels have no frame in common, frames are smaller than a tile, there are no estimates, or both a
        reference and a target.

    References
    ----------
    Kalojanov and Thurston 2023, section 6, "Training Data".
    """
    if reference is not None and target is not None:
        raise ValueError("target: expected none beside a reference, which is the target")
    shots = list(levels.values())
    every = [*shots, *(shot for shot in (reference, target) if shot is not None)]
    numbers = [number for number in shots[0].numbers if all(shot.has(number) for shot in every)]
    if not numbers:
        what = ", ".join(levels) + ("" if len(every) == len(shots) else " and what they are trained towards")
        raise ValueError(f"levels: expected frames in common, got none in {what} of {name}")
    sources = [find_first_pass(estimate, shot) for shot in every if shot is not reference]
    aligners = [
        FrameStream(shot, Rules(), source.first_pass, radius=radius)
        for shot, source in zip((*shots, *([] if target is None else [target])), sources, strict=True)
    ]
    # Beside estimates by OIDN it is there for a second look as well.
    make_target = gather_and_denoise if all(source.name in OIDN_MODES for source in sources) else gated_average

    def towards(number: int) -> dict[str, NDArray[np.float32]]:
        """The pictures that all levels of a frame are trained towards, if there are any."""
        if reference is not None:
            return {"reference": replace_nonfinite(reference.read(number).color)[0]}
        if target is None:
            return {}
        rendered = replace_nonfinite(target.read(number).color)[0]
        return {"reference": make_target(aligners[-1].align(number)), "rendered": rendered}

    def make() -> Iterator[Clip]:
        rng = np.random.default_rng(seed)
        for number in numbers:
            found = towards(number)
            own = None if found else make_target
            after = number + shots[0].step
            levels_here = zip(shots, aligners, strict=False)
            parts = [_level(shot, aligner, number, after, own) for shot, aligner in levels_here]
            whole = _clip(parts, found, linked=after in numbers)
            if tile == 0:
                yield whole
            else:
                if min(whole.color.shape[-2:]) < tile:
                    height, width = whole.color.shape[-2:]
                    raise ValueError(f"tile: expected at most the frame's {width}×{height} pixels, got {tile}")
                noisiest = min(range(len(samples)), key=lambda level: samples[level])
                middle, scale = whole.color.shape[1] // 2, whole.exposure[noisiest]
                best = cast(torch.Tensor, whole.reference if found else whole.pseudo_reference)
                weights = importance(
                    whole.noisy[noisiest] / scale,
                    best[noisiest] / scale,
                    whole.albedo[noisiest, middle],
                    whole.confidence[noisiest],
                )
                for y, x in important_places(weights, tile, tiles, rng):
                    yield whole.crop(y, x, tile)
            advance()

    return write_shards(folder, name, samples, make())


def _level(
    shot: Shot,
    aligner: FrameStream,
    number: int,
    after: int,
    make_target: Callable[[AlignedWindow], NDArray[np.float32]] | None,
) -> dict[str, torch.Tensor]:
    """What a clip holds of one noise level, with N = 1 in front; its own target where it needs one.

    Without the flow to the frame after, if it has one, there is none of ``to_next``.
    """
    aligned = aligner.align(number)
    if aligned.first_pass is None or aligned.residual is None:
        raise ValueError("estimate: expected one that gives pictures, since clips hold estimates, got none")
    color = aligned.mixed(aligned.color)
    noisy, _ = replace_nonfinite(shot.read(number).color)
    clean = clean_guides(aligned)
    motion = None if aligner.radius == 0 else aligner.flow(number, after)
    to_next = (
        np.zeros((*noisy.shape[:2], 2), np.float32) if motion is None else motion.vectors * motion.valid[..., None]
    )
    targets = {} if make_target is None else {"pseudo_reference": tensor_of(make_target(aligned)[None])[:, 0]}
    return targets | {
        "color": tensor_of(color),
        "albedo": tensor_of(np.zeros_like(color) if aligned.albedo is None else aligned.mixed(aligned.albedo)),
        "normal": tensor_of(np.zeros_like(color) if aligned.normal is None else aligned.mixed(aligned.normal)),
        "estimate": tensor_of(aligned.first_pass),
        "residual": tensor_of(aligned.residual),
        "confidence": tensor_of(aligned.confidence[..., None]),
        "modulation": tensor_of(aligned.modulation[None])[:, 0],
        "clean_albedo": tensor_of(clean.get("albedo", np.zeros_like(noisy))[None])[:, 0],
        "clean_normal": tensor_of(clean.get("normal", np.zeros_like(noisy))[None])[:, 0],
        "noisy": tensor_of(noisy[None])[:, 0],
        "exposure": exposure_of(aligned),
        "gain": gain_of(aligned),
        "to_next": tensor_of(to_next[None])[:, 0],
        "linked": torch.tensor([float(motion is not None)]),
    }


def _clip(levels: list[dict[str, torch.Tensor]], towards: Mapping[str, NDArray[np.float32]], *, linked: bool) -> Clip:
    """A clip of its levels, with the pictures that all of them are trained towards."""
    values = {name: torch.cat([level[name] for level in levels]) for name in levels[0]}
    values["linked"] = values["linked"].min().expand(len(levels)) * linked
    for name, picture in towards.items():
        values[name] = tensor_of(picture[None])[:, 0].expand_as(values["noisy"])
    return Clip(**values)
