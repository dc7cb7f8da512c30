"""Training clips: aligned windows at several noise levels, in shards on disk, and the samples drawn from them.

A shard is a safetensors file that holds clips of one shot, stacked. Any slice of a memory-mapped safetensors file
can be read by itself: a sample costs what it reads (one clip, one level), no shard is loaded, and the order is free.
"""

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple, get_type_hints

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.utils.data import Dataset

from network.checkpoint import new_partial, write_tensors
from network.paper.kernels import mean_of
from network.training import losses
from network.training.config import SamplerConfig

FORMAT = "ravg-clips"
VERSION = "4"
#: Radiance is stored over the clip's exposure, in float16: normal numbers from 6e-5 to this, to which brighter values
#: (fireflies only) are clipped.
HALF_MAX = torch.finfo(torch.float16).max
RENDERS = ("noisy", "rendered")  # kinds of targets that are renders, whose noise is independent of the input's
SHARD_BYTES = 1 << 28  # bytes after which a shard is full: small enough to copy about, large enough that files are few


# A level of fewer samples per pixel than this is drawn in proportion to them, but at least a quarter as often as
# others: shots are rendered with four and more, and drawn evenly half of the crops had at most seven.
_FEW = 8


class Layout(NamedTuple):
    """Axes of a field of a clip behind its levels, and how it is stored and varied.

    Kinds: "radiance" and "irradiance" (stored over the exposure; colors), "color" (without unit), "normal", "motion",
    "share" (unchanged), "exposure" and "gain" (numbers, float32), "flag" (a number).
    """

    kind: str
    channels: int = 3  # 0: one number
    window: bool = False  # whether there is one for each frame of the window

    @property
    def is_number(self) -> bool:
        return self.channels == 0

    def shape(self, levels: int, frames: int, height: int, width: int) -> tuple[int, ...]:
        if self.is_number:
            return (levels,)
        return (levels, *((frames,) if self.window else ()), self.channels, height, width)


@dataclass(frozen=True)
class Clip:
    """A frame of a shot, or a tile of it, at L noise levels, each with its aligned window of T frames.

    Windows are ``(L, T, C, H, W)``, images of the centre ``(L, C, H, W)``, numbers ``(L,)``. A clip without an
    independent reference has a pseudo-reference. Raises ValueError if shapes do not fit together, or a value is not
    finite.
    """

    # aligned, side frames mixed with the centre where not trusted
    color: Annotated[Tensor, Layout("irradiance", window=True)]
    albedo: Annotated[Tensor, Layout("color", window=True)]  # aligned likewise; zeros where the renderer gave none
    normal: Annotated[Tensor, Layout("normal", window=True)]
    # first passes of the frames, made from these noisy frames
    estimate: Annotated[Tensor, Layout("irradiance", window=True)]
    # noisy frames minus their first passes (`nlm.pooling`)
    residual: Annotated[Tensor, Layout("irradiance", window=True)]
    confidence: Annotated[Tensor, Layout("share", 1, window=True)]  # in [0, 1]
    modulation: Annotated[Tensor, Layout("color")]  # radiance is irradiance times modulation
    clean_albedo: Annotated[Tensor, Layout("color")]  # without noise: for networks that rely on their guides
    clean_normal: Annotated[Tensor, Layout("normal")]
    noisy: Annotated[Tensor, Layout("radiance")]  # as rendered
    # of the windows of whole frames, as given to the network when it runs
    exposure: Annotated[Tensor, Layout("exposure", 0)]
    # OIDN's exposure of the whole image (`hybrid.alignment.transfer.measure_gain`)
    gain: Annotated[Tensor, Layout("gain", 0)]
    # pixels, from each pixel to its place in the next frame; 0 where unknown
    to_next: Annotated[Tensor, Layout("motion", 2)]
    linked: Annotated[Tensor, Layout("flag", 0)]  # 1 where the next clip is the same place of the next frame, else 0
    pseudo_reference: Annotated[Tensor | None, Layout("radiance")] = None  # estimated from the level's own window
    reference: Annotated[Tensor | None, Layout("radiance")] = None  # clean: the target wherever there is one
    # An independent render of more samples: a second target beside a reference estimated from that render's window.
    rendered: Annotated[Tensor | None, Layout("radiance")] = None

    def __post_init__(self) -> None:
        levels, frames, _, height, width = self.color.shape
        for name, value in self.values().items():
            expected = FIELDS[name].shape(levels, frames, height, width)
            if tuple(value.shape) != expected:
                raise ValueError(f"{name}: expected shape {expected}, got {tuple(value.shape)}")
            if not bool(torch.isfinite(value).all()):
                raise ValueError(f"{name}: expected finite values, got NaN or infinity")

    def values(self) -> dict[str, Tensor]:
        """The fields that are there, by name."""
        values = {name: getattr(self, name) for name in FIELDS}
        return {name: value for name, value in values.items() if value is not None}

    def crop(self, y: int, x: int, size: int) -> "Clip":
        """Cut out a square tile by its corner; linked to no other clip, as the next frame's tiles lie elsewhere."""
        part = np.s_[..., y : y + size, x : x + size]
        tile = {n: v if FIELDS[n].is_number else v[part] for n, v in self.values().items()}
        return replace(Clip(**tile), linked=torch.zeros_like(self.linked))


#: Layout of each field of a `Clip`.
FIELDS: dict[str, Layout] = {
    name: hint.__metadata__[0] for name, hint in get_type_hints(Clip, include_extras=True).items()
}


class Sample(NamedTuple):
    """One level of a clip with a target, float32: fields of `Clip` without L, or batches of them with N in front.

    The target is ``(3, H, W)`` radiance. The error, ``()``, is the loss of the best input of the whole clip
    (`input_error`); 1 in validation.
    """

    color: Tensor
    albedo: Tensor
    normal: Tensor
    estimate: Tensor
    residual: Tensor
    confidence: Tensor
    modulation: Tensor
    clean_albedo: Tensor
    clean_normal: Tensor
    exposure: Tensor
    gain: Tensor
    to_next: Tensor
    target: Tensor
    error: Tensor


INPUTS = Sample._fields[:-2]  # fields of a clip that samples have


def noise_pairs(samples: Sequence[float]) -> list[list[tuple[int, str]]]:
    """For each noise level its possible targets, (level, "noisy" or "pseudo_reference"), cleanest first.

    Targets have no more noise than the input, never the other way; levels, given by samples per pixel, must be
    independent renders. A level without an independent one of no more noise gets its own pseudo-reference: the network
    can then learn no more than that contains. Kalojanov and Thurston 2023, section 6; Lehtinen et al. 2018,
    Noise2Noise, arXiv:1803.04189.
    """
    order = sorted(range(len(samples)), key=lambda level: -samples[level])
    pairs = []
    for level, count in enumerate(samples):
        others = [other for other in order if other != level and samples[other] >= count]
        both = [(other, kind) for other in others for kind in ("noisy", "pseudo_reference")]
        pairs.append(both or [(level, "pseudo_reference")])
    return pairs


def importance(noisy: Tensor, estimate: Tensor, albedo: Tensor, confidence: Tensor) -> Tensor:
    """Importance (H, W) of each pixel for training: noise, detail, and motion that could not be followed.

    Images are (3, H, W), confidence (T, 1, H, W). The sum, on x/(1+x), of |noisy − estimate|, |∇ estimate|, |∇ albedo|,
    and of a tenth of the lack of confidence, which would otherwise outweigh all else where an object passes.
    """
    noisy, estimate = (image.clamp_min(0) / (1 + image.clamp_min(0)) for image in (noisy.float(), estimate.float()))
    result = (noisy - estimate).abs().mean(0) + 0.1 * (1 - confidence.float()).mean((0, 1))
    for guide in (estimate, albedo.float()):
        result[1:] += guide.diff(dim=1).abs().mean(0)
        result[:, 1:] += guide.diff(dim=2).abs().mean(0)
    return result


def place_chances(importance: Tensor, size: int) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Corners of an image's possible tiles, every 8 pixels, and their chances: half uniform, half by importance."""
    height, width = importance.shape
    sums = np.zeros((height + 1, width + 1))
    sums[1:, 1:] = importance.double().numpy().cumsum(0).cumsum(1)
    starts = [sorted({*range(0, length - size, 8), length - size}) for length in (height, width)]
    corners = [(y, x) for y in starts[0] for x in starts[1]]
    means = np.array(
        [sums[y + size, x + size] - sums[y, x + size] - sums[y + size, x] + sums[y, x] for y, x in corners]
    )
    # A noise-free clip without any detail has no important place: all are alike.
    chances = means + means.mean() if means.mean() > 0 else np.ones(len(means))
    return corners, chances / chances.sum()


def important_places(importance: Tensor, size: int, count: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Draw corners of at most `count` tiles by importance, none closer to another than half a tile both ways."""
    corners, chances = place_chances(importance, size)
    places: list[tuple[int, int]] = []
    while len(places) < count and chances.sum() > 0:
        y, x = corners[rng.choice(len(corners), p=chances / chances.sum())]
        places.append((y, x))
        near = [abs(v - y) < size / 2 and abs(u - x) < size / 2 for v, u in corners]
        chances = np.where(near, 0.0, chances)
    return places


def write_shards(
    folder: str | os.PathLike[str], shot: str, samples: Sequence[float], clips: Iterable[Clip]
) -> list[Path]:
    """Write the clips of a shot, all of one shape, as ``SHOT.0000.safetensors``, ``SHOT.0001.safetensors`` and so on.

    `samples` are the samples per pixel of each level; clips are drawn from as they are written. The shards appear
    together when the last is finished.
    """
    folder = Path(folder)
    partial: list[Path] = []
    waiting: list[dict[str, Tensor]] = []

    def flush() -> None:
        path = new_partial(folder / f"{shot}.{len(partial):04d}.safetensors")
        metadata = {"format": FORMAT, "version": VERSION, "shot": shot, "samples": json.dumps(list(samples))}
        write_tensors(path, {name: torch.stack([clip[name] for clip in waiting]) for name in waiting[0]}, metadata)
        partial.append(path)
        waiting.clear()

    try:
        for clip in clips:
            packed = _pack(clip)
            waiting.append(packed)
            if len(waiting) * sum(value.nbytes for value in packed.values()) > SHARD_BYTES:
                flush()
        if waiting:
            flush()
        finished = [path.with_suffix("") for path in partial]
        for path, final in zip(partial, finished, strict=True):
            os.replace(path, final)
        return finished
    finally:
        for path in partial:
            path.unlink(missing_ok=True)


def _pack(clip: Clip) -> dict[str, Tensor]:
    """Values as they are stored: radiance and irradiance over the exposure of the last level, float16."""
    scale = clip.exposure[-1]
    packed = {}
    for name, value in clip.values().items():
        layout = FIELDS[name]
        if layout.kind in ("radiance", "irradiance"):
            value = (value / scale).clamp(-HALF_MAX, HALF_MAX)
        numbers = {"exposure": value / scale, "gain": value * scale}
        packed[name] = numbers[name].float() if name in numbers else value.to(torch.float16).contiguous()
    return packed


class _Shard(NamedTuple):
    path: Path
    shot: str
    samples: tuple[float, ...]
    shape: tuple[int, ...]  # of color: clips, levels, frames, 3, height, width
    targets: tuple[str, ...]  # references, and renders beside them: none where levels are trained towards each other
    linked: tuple[bool, ...]  # of each clip, whether the next is the same place of the next frame


class Clips:
    """Clips in shards, by number. `frames`: the middle frames of the stored windows, an odd number; all by default."""

    def __init__(self, shards: Sequence[_Shard], frames: int | None = None) -> None:
        self._shards = list(shards)
        stored = shards[0].shape[2] if shards else 1
        #: Length of the windows, T.
        self.frames = stored if frames is None else frames
        if not 0 < self.frames <= stored or self.frames % 2 == 0:
            raise ValueError(f"window: expected an odd number of frames up to the clips' {stored}, got {self.frames}")
        self._starts = np.cumsum([0, *(shard.shape[0] for shard in shards)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    @property
    def shots(self) -> list[str]:
        return sorted({shard.shot for shard in self._shards})

    @property
    def size(self) -> int:
        """Least height or width of a clip."""
        return min(min(shard.shape[4:]) for shard in self._shards)

    def of(self, shots: Sequence[str]) -> "Clips":
        found = [shard for shard in self._shards if shard.shot in shots]
        return Clips(found, self.frames if found else None)

    def pairs(self, index: int) -> list[list[tuple[int, str]]]:
        """Possible targets, (level, kind), of each level: reference and render beside it, else `noise_pairs`."""
        shard = self._find(index)[0]
        if shard.targets:
            return [[(level, kind) for kind in shard.targets] for level in range(len(shard.samples))]
        return noise_pairs(shard.samples)

    def samples(self, index: int) -> tuple[float, ...]:
        """Samples per pixel of each level."""
        return self._find(index)[0].samples

    def neighbours(self, index: int) -> tuple[int, int] | None:
        """Two clips of successive frames at the same place, the given one among them, the earlier first, if any."""
        for first in (index, index - 1):
            if first >= 0:
                shard, number = self._find(first)
                if shard.linked[number]:
                    return first, first + 1
        return None

    def read(self, index: int, level: int, target: tuple[int, str]) -> Sample:
        """Read one level of a clip with a target, one of `pairs`.

        Values are as stored: float16, radiance and irradiance over the exposure of the clip's last level; exposure and
        gain float32; error 1. Raises ValueError if the file is cut short.
        """
        shard, number = self._find(index)
        outer = (shard.shape[2] - self.frames) // 2
        middle = slice(outer, outer + self.frames)
        try:
            with safe_open(shard.path, framework="pt") as file:
                places = {name: (number, level, *([middle] if FIELDS[name].window else [])) for name in INPUTS}
                values = {name: file.get_slice(name)[place] for name, place in places.items()}
                stored_target = file.get_slice(target[1])[number, target[0]]
        except (SafetensorError, OSError) as error:
            raise ValueError(f"clips {os.fspath(shard.path)!r}: cut short ({error})") from error
        return Sample(**values, target=stored_target, error=torch.ones(()))

    def _find(self, index: int) -> tuple[_Shard, int]:
        shard = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self._shards[shard], index - int(self._starts[shard])


def open_clips(folder: str | os.PathLike[str], frames: int | None = None) -> Clips:
    """Open all shards of a folder and its subfolders, in the order of their paths; `frames` as for `Clips`.

    Raises FileNotFoundError if there are none; ValueError if one is no shard of clips, or of another version, or their
    windows differ in length, or are shorter.
    """
    paths = sorted(Path(folder).rglob("*.safetensors"))
    if not paths:
        where = os.fspath(folder)
        raise FileNotFoundError(f"clips: no *.safetensors in {where!r}; expected what ravg make-clips writes")
    shards = []
    for path in paths:
        where = f"clips {os.fspath(path)!r}"
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                names = set(file.keys())
                shape = tuple(file.get_slice("color").get_shape()) if "color" in names else ()
                linked = tuple((file.get_tensor("linked")[:, 0] > 0).tolist()) if "linked" in names else ()
        except SafetensorError as error:
            raise ValueError(f"{where}: no safetensors file, or cut short ({error})") from error
        for key, expected in (("format", FORMAT), ("version", VERSION)):
            if metadata.get(key) != expected:
                raise ValueError(f"{where}: expected {key} {expected!r}, got {metadata.get(key)!r}")
        targets = tuple(name for name in ("reference", "rendered") if name in names)
        shards.append(_Shard(path, metadata["shot"], tuple(json.loads(metadata["samples"])), shape, targets, linked))
        if shards[-1].shape[2] != shards[0].shape[2]:
            raise ValueError(f"{where}: expected windows of {shards[0].shape[2]} frames, got {shards[-1].shape[2]}")
    return Clips(shards, frames)


def split_by_shot(clips: Clips, validation: Sequence[str]) -> tuple[Clips, Clips]:
    """Split clips into training and validation; ValueError for an unknown shot, or if none is left to train on."""
    unknown = sorted(set(validation) - set(clips.shots))
    if unknown:
        raise ValueError(f"validation: expected shots among {clips.shots}, got {unknown}")
    training = [shot for shot in clips.shots if shot not in validation]
    if not training:
        raise ValueError(f"validation: expected a shot left to train on, got all of {clips.shots}")
    return clips.of(training), clips.of(validation)


class _Variation(NamedTuple):
    """How a sample varies: flips, transposition, permuted channels; normals, of any space, get a signed permutation."""

    flips: tuple[int, ...]
    transpose: bool
    channels: Tensor
    axes: Tensor
    signs: Tensor
    stops: float

    @classmethod
    def draw(cls, rng: np.random.Generator, exposure_stops: float) -> "_Variation":
        across, down, transpose = rng.random(3) < 0.5
        channels = torch.from_numpy(rng.permutation(3))
        axes, signs = torch.from_numpy(rng.permutation(3)), torch.from_numpy(rng.choice((-1.0, 1.0), (3, 1, 1))).float()
        flips = tuple(axis for axis, flipped in ((-1, across), (-2, down)) if flipped)
        return cls(flips, bool(transpose), channels, axes, signs, rng.uniform(-exposure_stops, exposure_stops))

    def apply(self, value: Tensor, kind: str) -> Tensor:
        """Vary a layer of a kind, ``(..., C, H, W)``, or a number."""
        if kind in ("exposure", "gain"):
            return value * 2 ** (self.stops if kind == "exposure" else -self.stops)
        value = value.flip(self.flips)
        value = value.transpose(-2, -1) if self.transpose else value
        if kind == "normal":
            value = value[..., self.axes, :, :] * self.signs
        elif kind == "motion":
            signs = [-1.0 if axis in self.flips else 1.0 for axis in (-1, -2)]
            value = value * torch.tensor(signs)[:, None, None]
            value = value.flip(0) if self.transpose else value
        elif kind != "share":
            value = value[..., self.channels, :, :]
        return value.contiguous()


class Samples(Dataset[Sample]):
    """The samples of a training, by number: each is a function of the seed and its number alone, in any process.

    With `neighbours` each sample is two, of successive frames, at the same place and varied alike; clips without a
    neighbour, as at a cut, are left out. The clips are split at random into disjoint sets, one per epoch. An epoch
    takes each clip of its set once, in random order, at a noise level and towards a target drawn from `noise_pairs`;
    after the last set the first comes again.
    """

    def __init__(
        self,
        clips: Clips,
        config: SamplerConfig,
        seed: int,
        loss: losses.ImageLoss = losses.relmse,
        *,
        neighbours: bool = False,
    ) -> None:
        if clips.size < config.crop:
            raise ValueError(f"clips: expected at least {config.crop} pixels each way, got {clips.size}")
        self.clips, self.config, self.seed, self.loss = clips, config, seed, loss
        self.neighbours = neighbours
        usable = [index for index in range(len(clips)) if not neighbours or clips.neighbours(index) is not None]
        if not usable:
            raise ValueError(
                "clips: expected neighbouring frames, as whole frames have (ravg make-clips --tile 0), got none"
            )
        order = np.random.default_rng((seed, 0)).permutation(usable)
        self._sets = [order[first :: config.sets] for first in range(config.sets)]
        self._cycle: tuple[int, np.ndarray] | None = None

    def clip_of(self, number: int) -> int:
        cycle, place = divmod(number, sum(map(len, self._sets)))
        if self._cycle is None or self._cycle[0] != cycle:
            rng = np.random.default_rng((self.seed, 1, cycle))
            self._cycle = cycle, np.concatenate([rng.permutation(part) for part in self._sets])
        return int(self._cycle[1][place])

    def __getitem__(self, number: int) -> Sample:
        config, rng, index = self.config, np.random.default_rng((self.seed, 2, number)), self.clip_of(number)
        pairs = self.clips.pairs(index)
        odds = np.clip(np.array(self.clips.samples(index)) / _FEW, 0.25, 1)
        level = int(rng.choice(len(pairs), p=odds / odds.sum()))
        target = self._target(pairs[level], rng)
        members = self.clips.neighbours(index) if self.neighbours else (index,)
        assert members is not None  # clips without neighbours are left out
        clips = [self.clips.read(member, level, target) for member in members]
        y, x = self._place(clips[0], rng)
        variation = _Variation.draw(rng, config.exposure_stops)
        samples = [self._varied(clip, y, x, variation) for clip in clips]
        if rng.random() < config.fireflies:
            count = rng.integers(1, 9)
            rows, columns = rng.integers(config.crop, size=(2, count))
            # Not black where it was black: a firefly comes from a path, not from the pixel it lands in.
            burst = torch.from_numpy(10 ** rng.uniform(1, 3, count)).float() * clips[0].exposure.float()
            frame = rng.integers(len(clips[0].color))
            for layer in (samples[0].color, samples[0].residual):
                layer[frame, :, rows, columns] += burst
        return Sample(*map(torch.stack, zip(*samples, strict=True))) if self.neighbours else samples[0]

    def _varied(self, clip: Sample, y: int, x: int, variation: _Variation) -> Sample:
        """Crop and vary a clip, with the error of the whole clip."""
        part = np.s_[..., y : y + self.config.crop, x : x + self.config.crop]
        values = {}
        for name in (*INPUTS, "target"):
            value, layout = getattr(clip, name), FIELDS.get(name, Layout("radiance"))
            values[name] = variation.apply((value if layout.is_number else value[part]).float(), layout.kind)
        whole = Sample(*(value[None].float() for value in clip))
        return Sample(**values, error=input_error(whole, self.loss)[0])

    def _target(self, targets: list[tuple[int, str]], rng: np.random.Generator) -> tuple[int, str]:
        """One of the targets of a level: a render or a pseudo-reference first, then the level."""
        renders = [target for target in targets if target[1] in RENDERS]
        estimated = [target for target in targets if target[1] not in RENDERS]
        kind = estimated if not renders or (estimated and rng.random() < self.config.pseudo) else renders
        return kind[rng.integers(len(kind))]

    def _place(self, clip: Sample, rng: np.random.Generator) -> tuple[int, int]:
        """Corner of the crop: the clip's own if that is as large, else drawn by importance."""
        if clip.target.shape[-2:] == (self.config.crop, self.config.crop):
            return 0, 0
        centre = len(clip.color) // 2
        color, estimate = (layer[centre] * clip.modulation for layer in (clip.color, clip.estimate))
        weights = importance(color, estimate, clip.albedo[centre], clip.confidence)
        corners, chances = place_chances(weights, self.config.crop)
        return corners[rng.choice(len(corners), p=chances)]


def input_error(batch: Sample, loss: losses.ImageLoss) -> Tensor:
    """Loss (N,), ≥ 1e-6, of the best input: the noisy frames' mean by confidence, or the centre's first pass."""
    centre = batch.color.shape[1] // 2
    mean = mean_of(batch.color * batch.confidence, batch.confidence, batch.color[:, centre])
    scale = losses.scale_of_radiance(batch.exposure, batch.modulation)
    images = mean, batch.estimate[:, centre]
    errors = [loss(image * batch.modulation, batch.target, scale) for image in images]
    # The floor matters only where the input equals the target, as in a synthetic or an empty clip.
    return torch.minimum(*errors).clamp_min(1e-6)


def whole_frames(clips: Clips, index: int, multiple: int) -> list[Sample]:
    """A clip at each level, towards the cleanest target, as batches of one, cropped to multiples of a number."""
    batches = []
    for level, targets in enumerate(clips.pairs(index)):
        sample = clips.read(index, level, targets[0])
        height, width = (length // multiple * multiple for length in sample.target.shape[-2:])
        batches.append(Sample(*(v[None, ..., :height, :width].float() if v.ndim else v[None].float() for v in sample)))
    return batches
