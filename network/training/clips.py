"""Training clips: aligned windows at several noise levels, in shards on disk, and the samples drawn from them.

A shard is a safetensors file that holds clips of one shot, stacked. Of a memory-mapped safetensors file any slice can
be read by itself: a sample costs what it reads (one clip, one level), no shard is ever loaded, and the order is free.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.utils.data import Dataset

from network.checkpoint import new_partial, write_tensors
from network.paper.kernels import mean_of
from network.training import losses
from network.training.config import SamplerConfig
from network.training.losses import ImageLoss

FORMAT = "ravg-clips"
VERSION = "4"
#: Radiance is stored over the clip's exposure, in float16: normal numbers from 6e-5 to this; what is brighter
#: (fireflies only) becomes this.
HALF_MAX = 65504.0
#: The fields of a clip that are one number for each level.
FIGURES = ("exposure", "gain")
#: Kinds of targets that are renders, whose noise is independent of the input's.
RENDERS = ("noisy", "rendered")
#: Bytes after which a shard is full: small enough to copy about, large enough that files are few.
SHARD_BYTES = 1 << 28


@dataclass(frozen=True)
class Clip:
    """A frame of a shot, or a tile of it, at L noise levels, each with its aligned window.

    Parameters
    ----------
    color : Tensor
        ``(L, T, 3, H, W)`` aligned irradiance, side frames mixed with the centre where not trusted.
    albedo, normal : Tensor
        ``(L, T, 3, H, W)`` aligned likewise; zeros where the renderer gave none.
    estimate : Tensor
        ``(L, T, 3, H, W)`` aligned estimates of the frames, irradiance, made from the same noisy frames alone.
    residual : Tensor
        ``(L, T, 3, H, W)`` what the noisy frames show beyond them, aligned to the nearest pixel (`nlm.pooling`).
    confidence : Tensor
        ``(L, T, 1, H, W)`` in [0, 1].
    modulation : Tensor
        ``(L, 3, H, W)``; radiance is irradiance times modulation.
    clean_albedo, clean_normal : Tensor
        ``(L, 3, H, W)`` of the centre, without noise: for networks that rely on their guides.
    noisy : Tensor
        ``(L, 3, H, W)`` radiance of the centre, as rendered.
    exposure : Tensor
        ``(L,)``, of the windows of whole frames: what the network is told when it runs.
    gain : Tensor
        ``(L,)``, OIDN's exposure of the whole picture (`network.unet.autoexposure`).
    to_next : Tensor
        ``(L, 2, H, W)``, pixels: from each pixel of the centre to where it is in the next frame; 0 where unknown.
    linked : Tensor
        ``(L,)``: 1 where the next clip is the same place of the next frame, else 0.
    pseudo_reference : Tensor, optional
        ``(L, 3, H, W)`` radiance of the centre, as estimated from the level's own window. There where no reference is.
    reference : Tensor, optional
        ``(L, 3, H, W)`` radiance of the centre, clean: the target wherever there is one.
    rendered : Tensor, optional
        ``(L, 3, H, W)`` radiance of the centre in an independent render of more samples: a second target beside
        a reference that was estimated from that render's window.

    Raises
    ------
    ValueError
        If shapes do not fit together, a value is not finite, or there is neither pseudo-reference nor reference.
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
    noisy: Tensor
    exposure: Tensor
    gain: Tensor
    to_next: Tensor
    linked: Tensor
    pseudo_reference: Tensor | None = None
    reference: Tensor | None = None
    rendered: Tensor | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.color.shape)
        if len(shape) != 5 or shape[1] % 2 == 0 or shape[2] != 3:
            raise ValueError(f"color: expected shape (L, T, 3, H, W) with T odd, got {shape}")
        image = (shape[0], *shape[2:])
        if self.pseudo_reference is None and self.reference is None:
            raise ValueError("reference: expected one where there is no pseudo-reference, got none")
        expected = {
            **dict.fromkeys(("color", "albedo", "normal", "estimate", "residual"), shape),
            **dict.fromkeys(("modulation", "clean_albedo", "clean_normal", "noisy", "pseudo_reference"), image),
            "confidence": (*shape[:2], 1, *shape[3:]),
            **dict.fromkeys((*FIGURES, "linked"), shape[:1]),
            **dict.fromkeys(("reference", "rendered"), image),
            "to_next": (shape[0], 2, *shape[3:]),
        }
        for name, value in _values(self).items():
            wanted = expected[name]
            if tuple(value.shape) != wanted:
                raise ValueError(f"{name}: expected shape {wanted}, got {tuple(value.shape)}")
            if not bool(torch.isfinite(value).all()):
                raise ValueError(f"{name}: expected finite values, got NaN or infinity")

    def crop(self, y: int, x: int, size: int) -> Clip:
        """Cut a square tile out of the clip.

        Parameters
        ----------
        y, x : int
            Row and column of its corner.
        size : int
            Of its sides, pixels.

        Returns
        -------
        Clip
            With the exposures of the whole frame. It is linked to no other, as the next frame's tiles lie elsewhere.
        """
        here = np.s_[..., y : y + size, x : x + size]
        whole = (*FIGURES, "linked")
        cut = Clip(**{n: v if n in whole else v[here] for n, v in _values(self).items()})
        return replace(cut, linked=torch.zeros_like(self.linked))


def _values(clip: Clip) -> dict[str, Tensor]:
    values = {item.name: getattr(clip, item.name) for item in fields(clip)}
    return {name: value for name, value in values.items() if value is not None}


def noise_pairs(samples: Sequence[float]) -> list[list[tuple[int, str]]]:
    """For each noise level what it may be trained towards: other levels of no more noise, never the other way.

    Parameters
    ----------
    samples : sequence of float
        Samples per pixel of each level. The levels must be independent renders.

    Returns
    -------
    list of list of (int, str)
        For each level the levels and kinds of targets, "noisy" and "pseudo_reference", cleanest first. A level
        without an independent one of no more noise gets its own pseudo-reference: the network can then learn no more
        than the estimate knows.

    References
    ----------
    Kalojanov and Thurston 2023, section 6; Lehtinen et al. 2018, Noise2Noise, arXiv:1803.04189.
    """
    order = sorted(range(len(samples)), key=lambda level: -samples[level])
    pairs = []
    for level, own in enumerate(samples):
        others = [other for other in order if other != level and samples[other] >= own]
        both = [(other, kind) for other in others for kind in ("noisy", "pseudo_reference")]
        pairs.append(both or [(level, "pseudo_reference")])
    return pairs


def importance(noisy: Tensor, estimate: Tensor, albedo: Tensor, confidence: Tensor) -> Tensor:
    """How much a network can learn at each pixel: noise, detail, and motion that could not be followed.

    Parameters
    ----------
    noisy, estimate : Tensor
        ``(3, H, W)`` radiance of the centre over the exposure.
    albedo : Tensor
        ``(3, H, W)`` of the centre.
    confidence : Tensor
        ``(T, 1, H, W)``.

    Returns
    -------
    Tensor
        ``(H, W)``, 0 where a flat sky is. Differences on x/(1+x): |noisy − estimate|, |∇ estimate|, |∇ albedo|; and a
        tenth of the mistrust of the frames, which would otherwise outweigh all else where an object passes.
    """
    noisy, estimate = (image.clamp_min(0) / (1 + image.clamp_min(0)) for image in (noisy.float(), estimate.float()))
    found = (noisy - estimate).abs().mean(0) + 0.1 * (1 - confidence.float()).mean((0, 1))
    for guide in (estimate, albedo.float()):
        found[1:] += guide.diff(dim=1).abs().mean(0)
        found[:, 1:] += guide.diff(dim=2).abs().mean(0)
    return found


def place_chances(importance: Tensor, size: int) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Chances of the possible tiles of a picture, half even, half by importance.

    Parameters
    ----------
    importance : Tensor
        ``(H, W)``, at least 0, from `importance`.
    size : int
        Of the sides of a tile, pixels; at most H and W.

    Returns
    -------
    corners : list of (int, int)
        Row and column of each, every 8 pixels.
    chances : numpy.ndarray
        One for each corner; they sum to 1.
    """
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
    """Draw tiles by importance, none closer to another than half a tile both ways.

    Parameters
    ----------
    importance : Tensor
        ``(H, W)``, at least 0, from `importance`.
    size : int
        Of the sides of a tile, pixels.
    count : int
        How many at most.
    rng : numpy.random.Generator
        What they are drawn with.

    Returns
    -------
    list of (int, int)
        Row and column of the corners, fewer than `count` where no more fit.
    """
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
    """Write the clips of a shot as ``SHOT.0000.safetensors``, ``SHOT.0001.safetensors`` and so on.

    Parameters
    ----------
    folder : path
        Where to.
    shot : str
        Name; training and validation are split by it.
    samples : sequence of float
        Samples per pixel of each level.
    clips : iterable of Clip
        At least one, all of one shape; drawn from as they are written.

    Returns
    -------
    list of Path
        The shards. They appear together when the last is done.

    Raises
    ------
    ValueError
        If there are no clips, or they are not alike.
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
            if waiting and packed["color"].shape != waiting[0]["color"].shape:
                found, wanted = (tuple(values["color"].shape) for values in (packed, waiting[0]))
                raise ValueError(f"clips: expected color of shape {wanted} as in those before, got {found}")
            waiting.append(packed)
            if len(waiting) * sum(value.nbytes for value in packed.values()) > SHARD_BYTES:
                flush()
        if waiting:
            flush()
        if not partial:
            raise ValueError(f"clips: expected at least one of shot {shot!r}, got none")
        done = [path.with_suffix("") for path in partial]
        for path, final in zip(partial, done, strict=True):
            os.replace(path, final)
        return done
    finally:
        for path in partial:
            path.unlink(missing_ok=True)


def _pack(clip: Clip) -> dict[str, Tensor]:
    """Values as they are stored: radiance and irradiance over the exposure of the last level, float16."""
    scale = clip.exposure[-1]
    packed = {"exposure": (clip.exposure / scale).float(), "gain": (clip.gain * scale).float()}
    for name, value in _values(clip).items():
        if name in ("color", "estimate", "residual", "noisy", "pseudo_reference", "reference", "rendered"):
            value = (value / scale).clamp(-HALF_MAX, HALF_MAX)
        if name not in FIGURES:
            packed[name] = value.to(torch.float16).contiguous()
    return packed


@dataclass(frozen=True)
class _Shard:
    """What is known of a shard without reading its clips."""

    path: Path
    shot: str
    samples: tuple[float, ...]
    shape: tuple[int, ...]  # of color: clips, levels, frames, 3, height, width
    targets: tuple[str, ...]  # references, and renders beside them: none where levels are trained towards each other
    linked: tuple[bool, ...]  # of each clip, whether the next is the same place of the next frame


class Clips:
    """Clips in shards, by number.

    Parameters
    ----------
    shards : sequence
        From `open_clips`.
    frames : int, optional
        Length of the windows, odd: the middle frames of those that are stored. All without.

    Raises
    ------
    ValueError
        If the length is even, or more than is stored.
    """

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
        """Names of the shots, sorted."""
        return sorted({shard.shot for shard in self._shards})

    @property
    def size(self) -> int:
        """Least height or width of a clip."""
        return min(min(shard.shape[4:]) for shard in self._shards)

    def of(self, shots: Sequence[str]) -> Clips:
        """Those of some shots.

        Parameters
        ----------
        shots : sequence of str
            Names.

        Returns
        -------
        Clips
            In the order they have here.
        """
        found = [shard for shard in self._shards if shard.shot in shots]
        return Clips(found, self.frames if found else None)

    def pairs(self, index: int) -> list[list[tuple[int, str]]]:
        """What each noise level of a clip may be trained towards.

        Parameters
        ----------
        index : int
            Of the clip.

        Returns
        -------
        list of list of (int, str)
            For each level its targets: the reference where there is one, and a render beside it, else its
            `noise_pairs`.
        """
        shard = self._find(index)[0]
        if shard.targets:
            return [[(level, kind) for kind in shard.targets] for level in range(len(shard.samples))]
        return noise_pairs(shard.samples)

    def neighbours(self, index: int) -> tuple[int, int] | None:
        """Two clips of successive frames at the same place, the one given among them.

        Parameters
        ----------
        index : int
            Of the clip.

        Returns
        -------
        (int, int) or None
            The earlier first; None where there is no such other.
        """
        for first in (index, index - 1):
            if first >= 0:
                shard, number = self._find(first)
                if shard.linked[number]:
                    return first, first + 1
        return None

    def read(self, index: int, level: int, target: tuple[int, str]) -> dict[str, Tensor]:
        """Read one level of a clip with a target.

        Parameters
        ----------
        index : int
            Of the clip.
        level : int
            Of the noise.
        target : (int, str)
            Level and kind, one of `pairs`.

        Returns
        -------
        dict of Tensor
            The fields of `Clip` that are inputs, without L, and ``target``, float16; the exposure float32. Radiance and
            irradiance are over the exposure of the clip's last level.

        Raises
        ------
        ValueError
            If the file is cut short.
        """
        shard, number = self._find(index)
        windows = ("color", "albedo", "normal", "estimate", "residual", "confidence")
        names = ("modulation", "clean_albedo", "clean_normal", "to_next", *FIGURES)
        outer = (shard.shape[2] - self.frames) // 2
        middle = slice(outer, outer + self.frames)
        try:
            with safe_open(shard.path, framework="pt") as file:
                values = {name: file.get_slice(name)[number, level, middle] for name in windows}
                values |= {name: file.get_slice(name)[number, level] for name in names}
                values["target"] = file.get_slice(target[1])[number, target[0]]
        except (SafetensorError, OSError) as error:
            raise ValueError(f"clips {os.fspath(shard.path)!r}: cut short ({error})") from error
        return values

    def _find(self, index: int) -> tuple[_Shard, int]:
        shard = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self._shards[shard], index - int(self._starts[shard])


def open_clips(folder: str | os.PathLike[str], frames: int | None = None) -> Clips:
    """Open all shards of a folder and of those in it.

    Parameters
    ----------
    folder : path
        Where `write_shards` has written.
    frames : int, optional
        Length of the windows, as for `Clips`.

    Returns
    -------
    Clips
        In the order of the shards' paths.

    Raises
    ------
    FileNotFoundError
        If there are none.
    ValueError
        If one is no shard of clips, or of another version, or their windows differ in length, or are shorter.
    """
    paths = sorted(Path(folder).rglob("*.safetensors"))
    if not paths:
        raise FileNotFoundError(f"clips: no *.safetensors in {os.fspath(folder)!r}; expected what ravg prepare writes")
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
        for key, wanted in (("format", FORMAT), ("version", VERSION)):
            if metadata.get(key) != wanted:
                raise ValueError(f"{where}: expected {key} {wanted!r}, got {metadata.get(key)!r}")
        targets = tuple(name for name in ("reference", "rendered") if name in names)
        shards.append(_Shard(path, metadata["shot"], tuple(json.loads(metadata["samples"])), shape, targets, linked))
        if shards[-1].shape[2] != shards[0].shape[2]:
            raise ValueError(f"{where}: expected windows of {shards[0].shape[2]} frames, got {shards[-1].shape[2]}")
    return Clips(shards, frames)


def split_by_shot(clips: Clips, validation: Sequence[str]) -> tuple[Clips, Clips]:
    """Training and validation clips; no shot is in both.

    Parameters
    ----------
    clips : Clips
        All clips.
    validation : sequence of str
        Names of the shots to keep out of training.

    Returns
    -------
    training, validation : Clips
        The rest, and those named.

    Raises
    ------
    ValueError
        If a name is not among the shots, or no clip is left to train on.
    """
    unknown = sorted(set(validation) - set(clips.shots))
    if unknown:
        raise ValueError(f"validation: expected shots among {clips.shots}, got {unknown}")
    training = [shot for shot in clips.shots if shot not in validation]
    if not training:
        raise ValueError(f"validation: expected a shot left to train on, got all of {clips.shots}")
    return clips.of(training), clips.of(validation)


class Samples(Dataset[dict[str, Tensor]]):
    """The samples of a training, by number: each is a function of the seed and its number alone.

    So the state of the sampling is one number, any process may make any sample, and a training that is resumed or
    spread over processes sees the same ones.

    Parameters
    ----------
    clips : Clips
        At least one, each at least crop pixels high and wide.
    config : SamplerConfig
        Crops and variations.
    seed : int
        Of everything random.
    loss : ImageLoss
        What ``error`` is measured with.
    neighbours : bool
        Whether each sample is two: of successive frames, at the same place and varied alike. Of clips that have none,
        as beyond a cut, no samples are made.

    Raises
    ------
    ValueError
        If there are no clips, one is too small, or neighbours are asked for and none has one.

    Notes
    -----
    The clips are split at random into disjoint sets, one per epoch. An epoch takes each clip of its set once, in random
    order, at a noise level and towards a target drawn from `noise_pairs`; after the last set the first comes again.

    Variations: flips, transposition (with flips: quarter turns), permutations of the color channels, signed
    permutations of the normal's axes (normals may be in any fixed space, so none is turned with the image), and those
    of `SamplerConfig`.
    """

    def __init__(
        self,
        clips: Clips,
        config: SamplerConfig,
        seed: int,
        loss: ImageLoss = losses.relmse,
        *,
        neighbours: bool = False,
    ) -> None:
        if len(clips) == 0:
            raise ValueError("clips: expected at least one, got none")
        if clips.size < config.crop:
            raise ValueError(f"clips: expected at least {config.crop} pixels each way, got {clips.size}")
        self.clips, self.config, self.seed, self.loss = clips, config, seed, loss
        self.neighbours = neighbours
        usable = [index for index in range(len(clips)) if not neighbours or clips.neighbours(index) is not None]
        if not usable:
            raise ValueError(
                "clips: expected neighbouring frames, as whole frames have (ravg prepare --tile 0), got none"
            )
        order = np.random.default_rng((seed, 0)).permutation(usable)
        self._sets = [order[first :: config.sets] for first in range(config.sets)]
        self._cycle: tuple[int, np.ndarray] | None = None

    def clip_of(self, number: int) -> int:
        """The clip that a sample is made of.

        Parameters
        ----------
        number : int
            Of the sample.

        Returns
        -------
        int
            Index of the clip.
        """
        cycle, place = divmod(number, sum(map(len, self._sets)))
        if self._cycle is None or self._cycle[0] != cycle:
            rng = np.random.default_rng((self.seed, 1, cycle))
            self._cycle = cycle, np.concatenate([rng.permutation(part) for part in self._sets])
        return int(self._cycle[1][place])

    def __getitem__(self, number: int) -> dict[str, Tensor]:
        """Make a sample.

        Returns
        -------
        dict of Tensor
            float32: ``color``, ``albedo``, ``normal``, ``estimate``, ``residual`` ``(T, 3, H, W)``, ``confidence``
            ``(T, 1, H, W)``, ``modulation``, ``clean_albedo``, ``clean_normal``, ``target`` ``(3, H, W)``, ``to_next``
            ``(2, H, W)``, ``exposure``, ``gain`` and ``error`` ``()`` (the loss of the clip's best input). With
            neighbours there is a 2 in front of each shape. A `torch.utils.data.DataLoader` stacks them.
        """
        config, rng, index = self.config, np.random.default_rng((self.seed, 2, number)), self.clip_of(number)
        pairs = self.clips.pairs(index)
        level = int(rng.integers(len(pairs)))
        target = self._target(pairs[level], rng)
        members = self.clips.neighbours(index) if self.neighbours else (index,)
        assert members is not None  # as was looked at in the beginning
        clips = [self.clips.read(member, level, target) for member in members]
        frames = len(clips[0]["color"])
        y, x = self._place(clips[0], rng)
        across, down, transpose = rng.random(3) < 0.5
        channels = torch.from_numpy(rng.permutation(3))
        axes, signs = torch.from_numpy(rng.permutation(3)), torch.from_numpy(rng.choice((-1.0, 1.0), (3, 1, 1))).float()
        stops = rng.uniform(-config.exposure_stops, config.exposure_stops)

        def vary(values: dict[str, Tensor]) -> dict[str, Tensor]:
            """Crop and turn what was read, the same way for both clips."""
            whole = {name: value[None].float() for name, value in values.items()}
            sample = {"error": input_error(whole, self.loss)[0]}
            for name, value in values.items():
                if name in FIGURES:
                    sample[name] = value.float() * 2 ** (stops if name == "exposure" else -stops)
                    continue
                value = value[..., y : y + config.crop, x : x + config.crop].float()
                value = value.flip([axis for axis, flipped in ((-1, across), (-2, down)) if flipped])
                value = value.transpose(-2, -1) if transpose else value
                if name in ("normal", "clean_normal"):
                    value = value[..., axes, :, :] * signs
                elif name == "to_next":
                    value = value * torch.tensor([-1.0 if across else 1.0, -1.0 if down else 1.0])[:, None, None]
                    value = value.flip(0) if transpose else value
                elif name != "confidence":
                    value = value[..., channels, :, :]
                sample[name] = value.contiguous()
            return sample

        samples = [vary(values) for values in clips]
        if frames > 1 and rng.random() < config.drop_frames:
            dropped = torch.from_numpy(rng.random(frames) < 0.5)
            dropped[frames // 2] = False
            for sample in samples:
                for name in ("color", "albedo", "normal", "estimate", "residual"):
                    sample[name][dropped] = sample[name][frames // 2].clone()
                sample["confidence"][dropped] = 0
        if rng.random() < config.fireflies:
            count = rng.integers(1, 9)
            rows, columns = rng.integers(config.crop, size=(2, count))
            # Not black where it was black: a firefly comes from a path, not from the pixel it lands in.
            burst = torch.from_numpy(10 ** rng.uniform(1, 3, count)).float() * clips[0]["exposure"].float()
            frame = rng.integers(frames)
            for name in ("color", "residual"):
                samples[0][name][frame, :, rows, columns] += burst
        return {n: torch.stack([s[n] for s in samples]) for n in samples[0]} if self.neighbours else samples[0]

    def _target(self, targets: list[tuple[int, str]], rng: np.random.Generator) -> tuple[int, str]:
        """One of the targets of a level: a render or a pseudo-reference first, then whose."""
        renders = [target for target in targets if target[1] in RENDERS]
        estimated = [target for target in targets if target[1] not in RENDERS]
        kind = estimated if not renders or (estimated and rng.random() < self.config.pseudo) else renders
        return kind[rng.integers(len(kind))]

    def _place(self, values: dict[str, Tensor], rng: np.random.Generator) -> tuple[int, int]:
        """Corner of the crop: the clip's own if that is as large, else drawn by importance."""
        if values["target"].shape[-2:] == (self.config.crop, self.config.crop):
            return 0, 0
        centre = len(values["color"]) // 2
        modulation = values["modulation"]
        corners, chances = place_chances(
            importance(
                values["color"][centre] * modulation,
                values["estimate"][centre] * modulation,
                values["albedo"][centre],
                values["confidence"],
            ),
            self.config.crop,
        )
        return corners[rng.choice(len(corners), p=chances)]


def input_error(batch: dict[str, Tensor], loss: ImageLoss) -> Tensor:
    """Loss of the best input: the noisy frames' mean weighted by confidence, or the centre's estimate.

    Parameters
    ----------
    batch : dict of Tensor
        As from `Samples`, with N in front: ``color``, ``estimate``, ``confidence``, ``modulation``, ``exposure`` and
        ``target``.
    loss : ImageLoss
        What it is measured with.

    Returns
    -------
    Tensor
        ``(N,)``, at least 1e-6.
    """
    color, confidence, modulation = batch["color"], batch["confidence"], batch["modulation"]
    centre = color.shape[1] // 2
    mean = mean_of(color * confidence, confidence, color[:, centre])
    scale = batch["exposure"] * modulation.mean((1, 2, 3)).clamp_min(1e-3)
    errors = [loss(image * modulation, batch["target"], scale) for image in (mean, batch["estimate"][:, centre])]
    # The floor matters only where the input equals the target, as in a synthetic or an empty clip.
    return torch.minimum(*errors).clamp_min(1e-6)


def whole_frames(clips: Clips, index: int, multiple: int) -> list[dict[str, Tensor]]:
    """A clip at each of its levels, towards the cleanest target, as batches of one, unvaried.

    Parameters
    ----------
    clips : Clips
        The clips.
    index : int
        Which.
    multiple : int
        Of height and width; the model's. The rest is left off at the right and the bottom.

    Returns
    -------
    list of dict of Tensor
        As from `Samples`, with N = 1 in front.
    """
    batches = []
    for level, targets in enumerate(clips.pairs(index)):
        values = clips.read(index, level, targets[0])
        height, width = (length // multiple * multiple for length in values["target"].shape[-2:])
        batch = {n: v[None].float() for n, v in values.items() if n in FIGURES}
        batch |= {n: v[None, ..., :height, :width].float() for n, v in values.items() if n not in FIGURES}
        batches.append(batch)
    return batches
