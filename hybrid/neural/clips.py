"""Training clips: aligned windows at several noise levels, from shots to files."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch

from hybrid.alignment.transfer import measure_exposure
from hybrid.alignment.window import AlignedWindow
from hybrid.denoising.first_pass import OIDN_MODES, Backends, find_first_pass
from hybrid.denoising.plan import Rules
from hybrid.denoising.pseudo_reference import gated_average, pool_and_denoise
from hybrid.denoising.stream import FrameStream
from hybrid.files.frame import Array
from hybrid.files.shots import Shot
from hybrid.neural.network_denoiser import exposure_of
from hybrid.neural.oidn_networks import denoise_bundled, has_oidn_networks, prefilter_guides
from hybrid.neural.tiling import image_of, tensor_of
from hybrid.neural.unet_denoiser import clean_guides, gain_of
from network.training.clips import Clip, importance, important_places, write_shards
from nlm.average import replace_nonfinite
from nlm.samples import FAR
from nlm.variance import gaussian_mean

# Deviation, pixels, of the Gaussian over which targets get the mean of a render: where the noise of 64 samples is a
# fifth of the light, that of 450 pixels is a hundredth.
_SIGMA = 6.0
# This share of the exposure is added to both means: black stays black, and noise in the dark decides nothing.
_DARK = np.float32(0.01)


@dataclass(frozen=True)
class ClipSource:
    """Renders of a shot that clips are made of."""

    name: str  # of the shot; training and validation are split by it
    levels: Mapping[str, Shot]  # independent renders of the same frames
    samples: Sequence[float]  # samples per pixel of each level
    # the same frames clean, or some of them: clips are made of these alone, with the reference as target
    reference: Shot | None = None
    # a further render of the same frames, of more samples: its pseudo-references and itself are the targets
    target: Shot | None = None

    def numbers(self) -> list[int]:
        """Frames that all of the renders have; ValueError if there are none."""
        shots = list(self.levels.values())
        every = [*shots, *(shot for shot in (self.reference, self.target) if shot is not None)]
        numbers = [number for number in shots[0].numbers if all(shot.has(number) for shot in every)]
        if not numbers:
            names = ", ".join(self.levels) + ("" if len(every) == len(shots) else " and their targets")
            raise ValueError(f"levels: expected frames in common, got none in {names} of {self.name}")
        return numbers


def write_clips(
    source: ClipSource,
    folder: Path,
    *,
    radius: int = 2,
    tile: int = 128,
    tiles: int = 4,
    estimate: str = "auto",
    teacher: Callable[[AlignedWindow], Array] | None = None,
    seed: int = 0,
    advance: Callable[[], object] = lambda: None,
) -> list[Path]:
    """Write the training clips of a shot; return the shards (paper, section 6, "Training Data").

    In each frame `importance` places `tiles` clips of `tile` pixels a side (0: the whole frame), with a seed.
    `estimate` is the source of the first passes; not "none". With a `teacher`, a denoiser of windows, the target of a
    level is the mean of the reference and of the teacher's frame, with the local means of the cleanest level. Raises
    ValueError if the levels have no frame in common, frames are smaller than a tile, there is no first pass, or a
    teacher and no reference.
    """
    if teacher is not None and source.reference is None:
        raise ValueError(f"teacher: expected references beside it, got none of {source.name}")
    shots, numbers = list(source.levels.values()), source.numbers()
    rendered = [*shots, *([] if source.target is None else [source.target])]
    backends = Backends(bundled=denoise_bundled)
    first_passes = [find_first_pass(estimate, shot, backends=backends) for shot in rendered]
    filter_guides = prefilter_guides if has_oidn_networks() else None
    streams = [
        FrameStream(
            shot, Rules(off=frozenset({"whiten"})), first_pass.first_pass, radius=radius, filter_guides=filter_guides
        )
        for shot, first_pass in zip(rendered, first_passes, strict=True)
    ]
    # OIDN, if it makes the first passes, is there to denoise the pooled samples too.
    has_oidn = all(first_pass.name in OIDN_MODES for first_pass in first_passes)
    make_target = pool_and_denoise if has_oidn else gated_average

    def targets_of(number: int) -> dict[str, Array]:
        """Targets that all levels of a frame share, if any."""
        if source.reference is not None:
            return {"reference": replace_nonfinite(source.reference.read(number).color)[0]}
        if source.target is None:
            return {}
        render = replace_nonfinite(source.target.read(number).color)[0]
        return {"reference": make_target(streams[-1].align(number)), "rendered": render}

    def clips() -> Iterator[Clip]:
        rng, cleanest = np.random.default_rng(seed), int(np.argmax(source.samples))
        for number in numbers:
            targets = targets_of(number)
            after = number + shots[0].step
            make_own = make_target if not targets else teacher
            levels = [
                _level(shot, stream, number, after, make_own) for shot, stream in zip(shots, streams, strict=False)
            ]
            if teacher is not None:
                reference, render = targets.pop("reference"), image_of(levels[cleanest]["noisy"])
                for level in levels:
                    mean = 0.5 * (reference + image_of(level.pop("pseudo_reference")))
                    level["reference"] = tensor_of(_with_means(mean, render)[None])[:, 0]
            frame = _clip(levels, targets, linked=after in numbers)
            if tile == 0:
                yield frame
            else:
                for y, x in _places(frame, source.samples, tile, tiles, rng):
                    yield frame.crop(y, x, tile)
            advance()

    return write_shards(folder, source.name, source.samples, clips())


def _with_means(image: Array, render: Array) -> Array:
    """Image (H, W, 3) with the local means of a noisy render of the same frame.

    Denoised frames lose light where few pixels carry it: up to 17 % of the light of training shots. The factor between
    both means is at most 2 either way.
    """
    dark = _DARK * measure_exposure(image)
    light = gaussian_mean(image, _SIGMA) + dark
    limited = np.clip(render, 0, FAR * light)
    factor = (gaussian_mean(limited, _SIGMA) + dark) / light
    return np.asarray(image * np.clip(factor, np.float32(0.5), np.float32(2)), np.float32)


def _places(
    frame: Clip, samples: Sequence[float], tile: int, count: int, rng: np.random.Generator
) -> list[tuple[int, int]]:
    """Corners of tiles, by the importance of pixels at the noisiest level."""
    height, width = frame.color.shape[-2:]
    if min(height, width) < tile:
        raise ValueError(f"tile: expected at most the frame's {width}×{height} pixels, got {tile}")
    noisiest = min(range(len(samples)), key=lambda level: samples[level])
    middle, scale = frame.color.shape[1] // 2, frame.exposure[noisiest]
    best = cast(torch.Tensor, frame.pseudo_reference if frame.reference is None else frame.reference)
    weights = importance(
        frame.noisy[noisiest] / scale,
        best[noisiest] / scale,
        frame.albedo[noisiest, middle],
        frame.confidence[noisiest],
    )
    return important_places(weights, tile, count, rng)


def _level(
    shot: Shot,
    stream: FrameStream,
    number: int,
    after: int,
    make_target: Callable[[AlignedWindow], Array] | None,
) -> dict[str, torch.Tensor]:
    """Fields of a clip at one noise level, with L = 1; with its own target if it needs one."""
    aligned = stream.align(number)
    if aligned.first_pass is None or (residual := aligned.residual) is None:
        raise ValueError("estimate: expected one that gives pictures, since clips hold estimates, got none")
    color = aligned.mixed(aligned.color)
    noisy, _ = replace_nonfinite(shot.read(number).color)
    clean = clean_guides(aligned)
    motion = None if stream.radius == 0 else stream.flow(number, after)
    no_motion = np.zeros((*noisy.shape[:2], 2), np.float32)
    to_next = no_motion if motion is None else motion.vectors * motion.valid[..., None]
    windows = {
        "color": color,
        "albedo": np.zeros_like(color) if aligned.albedo is None else aligned.mixed(aligned.albedo),
        "normal": np.zeros_like(color) if aligned.normal is None else aligned.mixed(aligned.normal),
        "estimate": aligned.first_pass,
        "residual": residual,
        "confidence": aligned.confidence[..., None],
    }
    images = {
        "modulation": aligned.modulation,
        "clean_albedo": clean.get("albedo", np.zeros_like(noisy)),
        "clean_normal": clean.get("normal", np.zeros_like(noisy)),
        "noisy": noisy,
        "to_next": to_next,
        **({} if make_target is None else {"pseudo_reference": make_target(aligned)}),
    }
    return {
        **{name: tensor_of(window) for name, window in windows.items()},
        **{name: tensor_of(image[None])[:, 0] for name, image in images.items()},
        "exposure": exposure_of(aligned),
        "gain": gain_of(aligned),
        "linked": torch.tensor([float(motion is not None)]),
    }


def _clip(levels: list[dict[str, torch.Tensor]], targets: Mapping[str, Array], *, linked: bool) -> Clip:
    values = {name: torch.cat([level[name] for level in levels]) for name in levels[0]}
    values["linked"] = values["linked"].min().expand(len(levels)) * linked
    for name, image in targets.items():
        values[name] = tensor_of(image[None])[:, 0].expand_as(values["noisy"])
    return Clip(**values)
