"""The boundary to torch: layout, tiles, precision; kernels go in, images come out.

The only module outside `network` that imports torch. Here HWC becomes NCHW, and nowhere else at run time.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray

import network
from hybrid.breakdown import Breakdown, layers_of
from hybrid.estimates import choose_estimate
from hybrid.frames import Shot
from hybrid.pipeline import Denoised
from hybrid.plan import plan_shot
from hybrid.pseudo_reference import ALPHA, AlignedWindow, Aligner, gated_average
from hybrid.timing import Timings
from network.checkpoint import load_model
from network.clips import (
    Clip,
    SamplerConfig,
    importance,
    important_places,
    open_clips,
    split_by_shot,
    write_shards,
)
from network.inputs import window_exposure
from network.models import PRESETS, denoise_tile, for_inference, window_length
from network.stabilizer import Stabilizer
from network.train import TrainConfig, train
from nlm.average import replace_nonfinite

Array = NDArray[np.float32]

# Pixels of context around a tile: what a network sees beyond them changes a picture by less than 1e-5 of its mean. The
# coarsest shares of a `Stabilizer`, of 32 pixels, see farthest.
HALO, HALO_OF_SHARES = 48, 128
# Sides of a tile: halos take half as much again at 1920×1080 with the first, and the second needs half of the memory.
TILE, SMALL_TILE = 640, 384
PRECISIONS = ("auto", "float32", "bfloat16")


def shipped_weights(preset: str) -> Path:
    """Path of the weights that come with the package.

    Raises
    ------
    ValueError
        If there is no such preset; names those there are.
    """
    folder = Path(network.__file__).parent / "weights"
    path = folder / f"{preset}.safetensors"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.safetensors"))) or "none"
        raise ValueError(f"preset is {preset!r}, expected one of: {known}")
    return path


def has_bfloat16() -> bool:
    """Whether this processor computes in bfloat16 faster than in float32 (AVX-512 bf16 or AMX)."""
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


class Denoiser:
    """Runs a Robust Average network on aligned windows; an estimator for `hybrid.pipeline.denoise_shot`.

    Parameters
    ----------
    weights : Path
        A file written by training.
    tile : int
        Side of the squares that the network sees at once, pixels; a halo is added around each.
    precision : str
        One of `PRECISIONS`; "auto" takes bfloat16 where the processor has it.
    threshold : float, optional
        t·K of the kernels, in [0, 1); higher stays closer to the input. Without: what it was trained with.
    breakdown : Breakdown, optional
        Where to count the weights of the frames; each frame's contribution and weight then come as extra layers.
    timings : Timings, optional
        Where to count the stages of the estimate, and "network".

    Raises
    ------
    ValueError
        A bad option, or a file that holds no such model.
    """

    def __init__(
        self,
        weights: Path,
        *,
        tile: int = TILE,
        precision: str = "auto",
        threshold: float | None = None,
        breakdown: Breakdown | None = None,
        timings: Timings | None = None,
    ) -> None:
        if precision not in PRECISIONS:
            raise ValueError(f"precision is {precision!r}, expected one of {', '.join(PRECISIONS)}")
        if tile < 16:
            raise ValueError(f"tile is {tile}, expected at least 16 pixels")
        if threshold is not None and not 0 <= threshold < 1:
            raise ValueError(f"threshold is {threshold}, expected 0 <= threshold < 1, in units of 1/K")
        half = precision == "bfloat16" or (precision == "auto" and has_bfloat16())
        self.precision = "bfloat16" if half else "float32"
        self.model = for_inference(load_model(weights), half)
        self.tile = tile
        self.threshold = threshold
        self.breakdown = breakdown
        self.timings = timings or Timings()

    @property
    def takes_estimate(self) -> bool:
        """Whether the network works beside per-frame estimates."""
        return isinstance(self.model, Stabilizer)

    @property
    def halo(self) -> int:
        """Pixels of context around a tile."""
        return HALO_OF_SHARES if self.takes_estimate else HALO

    @property
    def radius(self) -> int:
        """Frames on each side that the network looks at."""
        return window_length(self.model) // 2

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        """Denoise the centre of an aligned window."""
        with self.timings.stage("network"):
            return self._run(aligned)

    def _run(self, aligned: AlignedWindow) -> Denoised:
        color = aligned.mixed(aligned.color)
        height, width = color.shape[1:3]
        layers = {"color": color, "confidence": aligned.confidence[..., None]}
        if aligned.albedo is not None:
            layers["albedo"] = aligned.mixed(aligned.albedo)
        if aligned.normal is not None:
            layers["normal"] = aligned.mixed(aligned.normal)
        if aligned.estimate is not None:
            layers["estimate"] = aligned.estimate
        if aligned.aovs:
            layers["aovs"] = np.concatenate([aligned.mixed(layer) for layer in aligned.aovs.values()], axis=-1)
        exposure = torch.tensor([aligned.exposure], dtype=torch.float32)
        irradiance = np.empty(color.shape[1:], np.float32)
        channels = sum(layer.shape[-1] for layer in aligned.aovs.values())
        filtered = np.empty((height, width, channels), np.float32)
        parts = np.zeros((*color.shape[:3], 4), np.float32) if self.breakdown is not None else None
        for inner, outer, offset in _tiles(aligned.inner, height, width, self.tile, self.halo, self.model.multiple):
            # Where nothing varies in time nor in space, not even by rounding, the mean is the pixel.
            if "skip" in aligned.effects and not aligned.variance[outer].any():
                irradiance[inner] = color[aligned.centre][inner]
                if filtered.size:
                    filtered[inner] = layers["aovs"][aligned.centre][inner]
                if parts is not None:
                    parts[aligned.centre][inner] = np.dstack(
                        [irradiance[inner], np.ones_like(irradiance[inner][..., :1])]
                    )
                continue
            cut = {name: _tensor(_pad(layer[:, *outer], self.model.multiple)) for name, layer in layers.items()}
            others = cut.pop("aovs", None)
            out, sums, aovs = denoise_tile(
                self.model, {**cut, "exposure": exposure}, threshold=self.threshold, aovs=others
            )
            irradiance[inner] = _image(out)[offset]
            if aovs is not None:
                filtered[inner] = _image(aovs)[offset]
            if parts is not None:
                tile = torch.cat(sums.parts(), 2)[0].permute(0, 2, 3, 1).numpy()
                parts[:, *inner] = tile[:, *offset]
        aovs_out, start = {}, 0
        for name, layer in aligned.aovs.items():
            stop = start + layer.shape[-1]
            light = filtered[..., start:stop]
            if name == ALPHA:
                aovs_out[name] = light
            elif stop - start == 3:
                aovs_out[name] = light * aligned.modulation
            else:
                aovs_out[name] = light * aligned.modulation.mean(axis=-1, keepdims=True)
            start = stop
        extra = {}
        if parts is not None and self.breakdown is not None:
            self.breakdown.add(parts[..., 3])
            extra = layers_of(parts[..., :3] * aligned.modulation, parts[..., 3])
        return Denoised(irradiance * aligned.modulation, aovs_out, extra)


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
        Clips of each frame, placed by `network.clips.importance`.
    estimate : str
        Where the estimates come from (`hybrid.estimates.choose_estimate`); not "none".
    reference : Shot, optional
        The same frames clean, or some of them: clips are made of these alone, and trained towards them.
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
        If the levels have no frame in common, frames are smaller than a tile, or there are no estimates.

    References
    ----------
    Kalojanov and Thurston 2023, section 6, "Training Data".
    """
    shots = list(levels.values())
    every = shots if reference is None else [*shots, reference]
    numbers = [number for number in shots[0].numbers if all(shot.has(number) for shot in every)]
    if not numbers:
        what = ", ".join(levels) + ("" if reference is None else " and the reference")
        raise ValueError(f"levels: expected frames in common, got none in {what} of {name}")
    aligners = [
        Aligner(shot, plan_shot(shot).effects, radius=radius, estimate=choose_estimate(estimate, shot).estimate)
        for shot in shots
    ]

    def make() -> Iterator[Clip]:
        rng = np.random.default_rng(seed)
        for number in numbers:
            whole = _clip([_level(shot, aligner, number) for shot, aligner in zip(shots, aligners, strict=True)])
            if reference is not None:
                clean = _tensor(replace_nonfinite(reference.read(number).color)[0][None])[:, 0]
                whole = replace(whole, reference=clean.expand_as(whole.noisy))
            if tile == 0:
                yield whole
            else:
                if min(whole.color.shape[-2:]) < tile:
                    height, width = whole.color.shape[-2:]
                    raise ValueError(f"tile: expected at most the frame's {width}×{height} pixels, got {tile}")
                noisiest = min(range(len(samples)), key=lambda level: samples[level])
                middle, scale = whole.color.shape[1] // 2, whole.exposure[noisiest]
                weights = importance(
                    whole.noisy[noisiest] / scale,
                    whole.pseudo_reference[noisiest] / scale,
                    whole.albedo[noisiest, middle],
                    whole.confidence[noisiest],
                )
                for y, x in important_places(weights, tile, tiles, rng):
                    yield whole.crop(y, x, tile)
            advance()

    return write_shards(folder, name, samples, make())


def _level(shot: Shot, aligner: Aligner, number: int) -> dict[str, torch.Tensor]:
    """What a clip holds of one noise level, with N = 1 in front."""
    aligned = aligner.align(number)
    if aligned.estimate is None:
        raise ValueError("estimate: expected one that gives pictures, since clips hold estimates, got none")
    color = aligned.mixed(aligned.color)
    noisy, _ = replace_nonfinite(shot.read(number).color)
    return {
        "color": _tensor(color),
        "albedo": _tensor(np.zeros_like(color) if aligned.albedo is None else aligned.mixed(aligned.albedo)),
        "normal": _tensor(np.zeros_like(color) if aligned.normal is None else aligned.mixed(aligned.normal)),
        "estimate": _tensor(aligned.estimate),
        "confidence": _tensor(aligned.confidence[..., None]),
        "modulation": _tensor(aligned.modulation[None])[:, 0],
        "noisy": _tensor(noisy[None])[:, 0],
        "pseudo_reference": _tensor(gated_average(aligned)[None])[:, 0],
        "exposure": window_exposure(_tensor(color)),
    }


def _clip(levels: list[dict[str, torch.Tensor]]) -> Clip:
    """A clip of its levels."""
    return Clip(**{name: torch.cat([level[name] for level in levels]) for name in levels[0]})


def train_network(
    clips: Path,
    output: Path,
    *,
    preset: str = "fast",
    init: str | None = None,
    validation: Sequence[str] = (),
    threads: int | None = None,
    resume: bool = False,
    log: Callable[[int, dict[str, float]], None] = lambda step, values: None,
    crop: int = 128,
    sets: int = 10,
    seed: int = 0,
    **settings: Any,
) -> list[float]:
    """Train a preset, or weights there are, on the clips of a folder.

    Parameters
    ----------
    clips : Path
        From `write_clips`.
    output : Path
        Weights to write.
    preset : str
        Of `network.models.PRESETS`; not looked at with init.
    init : str, optional
        Weights to start from: a file, or a preset that ships.
    validation : sequence of str
        Shots kept out of training.
    threads : int, optional
        Of torch and numba.
    resume, log
        As for `network.train.train`.
    crop, sets
        Of `network.clips.SamplerConfig`.
    seed : int
        Of initial weights and samples.
    **settings
        Further fields of `network.train.TrainConfig`.

    Returns
    -------
    list of float
        The losses.

    Raises
    ------
    ValueError
        If settings, clips and model do not fit together.

    Notes
    -----
    Under ``torchrun``, which sets WORLD_SIZE, the processes train together, over nccl with GPUs and gloo without.
    """
    config = TrainConfig(seed=seed, sampler=SamplerConfig(crop=crop, sets=sets), **settings)
    if threads is not None:
        torch.set_num_threads(threads)
        numba.set_num_threads(min(threads, numba.get_num_threads()))
    training, kept_out = split_by_shot(open_clips(clips), validation)
    if init is None:
        if preset not in PRESETS:
            raise ValueError(f"preset is {preset!r}, expected one of {', '.join(PRESETS)}")
        model = PRESETS[preset](frames=training.frames, seed=seed)
    else:
        path = Path(init) if Path(init).suffix else shipped_weights(init)
        model = load_model(path)
        if window_length(model) != training.frames:
            raise ValueError(
                f"clips: expected windows of {window_length(model)} frames as {init} has, got {training.frames}"
            )
    output.parent.mkdir(parents=True, exist_ok=True)
    together = int(os.environ.get("WORLD_SIZE", "1")) > 1
    if together:
        torch.distributed.init_process_group()
    try:
        return train(training, kept_out, model, config, output, resume=resume, log=log)
    finally:
        if together:
            torch.distributed.destroy_process_group()


def _tensor(window: Array) -> torch.Tensor:
    """(T, H, W, C) to (1, T, C, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(window.transpose(0, 3, 1, 2)))[None]


def _image(tensor: torch.Tensor) -> Array:
    """(1, C, H, W) to (H, W, C)."""
    return tensor[0].permute(1, 2, 0).float().numpy()


def _pad(window: Array, multiple: int) -> Array:
    """Repeat the last row and column until height and width are what the network needs."""
    bottom, right = (-window.shape[1] % multiple, -window.shape[2] % multiple)
    return np.pad(window, ((0, 0), (0, bottom), (0, right), (0, 0)), mode="edge") if bottom or right else window


Block = tuple[slice, slice]


def _tiles(
    rows: slice, height: int, width: int, tile: int, halo: int, multiple: int
) -> Iterator[tuple[Block, Block, Block]]:
    """Cover some rows: where each tile's result goes, what it is computed from, and where in that the result is."""
    # The halo starts on a multiple, so that every tile samples its coarse scales where the whole image would.
    halo = -(-halo // multiple) * multiple
    tile = -(-tile // multiple) * multiple
    for top in range(rows.start, rows.stop, tile):
        for left in range(0, width, tile):
            inner, outer, offset = [], [], []
            for start, end, size in ((top, rows.stop, height), (left, width, width)):
                stop = min(start + tile, end)
                first, last = max(start - halo, 0), min(stop + halo, size)
                inner.append(slice(start, stop))
                outer.append(slice(first, last))
                offset.append(slice(start - first, stop - first))
            yield (inner[0], inner[1]), (outer[0], outer[1]), (offset[0], offset[1])
