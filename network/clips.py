"""Training clips: one aligned window with its target per file, and random batches of crops from them."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from network.inputs import window_exposure

Array = npt.NDArray[Any]

#: Largest finite half: brighter radiance (fireflies only) is stored as this.
HALF_MAX = 65504.0


@dataclass(frozen=True)
class Clip:
    """An aligned window of one noise level, and the radiance its centre should have.

    Parameters
    ----------
    color : ndarray
        ``(T, H, W, 3)`` aligned irradiance, side frames mixed with the centre where not trusted.
    albedo, normal : ndarray
        ``(T, H, W, 3)`` aligned likewise; zeros where the renderer gave none.
    confidence : ndarray
        ``(T, H, W)`` in [0, 1].
    modulation : ndarray
        ``(H, W, 3)``; radiance is irradiance times modulation.
    estimate : ndarray
        ``(T, H, W, 3)`` aligned estimates of the frames, irradiance, made from the same noisy frames and nothing else.
    target : ndarray
        ``(H, W, 3)`` radiance of the centre, of noise independent of color's.
    target_kind : str
        What it is, "noisy" or "pseudo_reference" for example.
    shot : str
        Sets are split by it.

    Raises
    ------
    ValueError
        If shapes do not fit together or a value is not finite.

    Notes
    -----
    Stored as float16: normal numbers from 6e-5 to 65504; brighter values become 65504.
    """

    color: Array
    albedo: Array
    normal: Array
    confidence: Array
    modulation: Array
    estimate: Array
    target: Array
    target_kind: str
    shot: str

    def __post_init__(self) -> None:
        if self.color.ndim != 4 or self.color.shape[0] % 2 == 0 or self.color.shape[3] != 3:
            raise ValueError(f"color: expected shape (T, H, W, 3) with T odd, got {self.color.shape}")
        window, image = self.color.shape, self.color.shape[1:]
        expected = {
            "color": window,
            "albedo": window,
            "normal": window,
            "confidence": window[:3],
            "modulation": image,
            "estimate": window,
            "target": image,
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"{name}: expected finite values, got NaN or infinity")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write as .npz of float16 (not compressed: noise does not compress); the file appears whole."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                values[name] = np.clip(value, -HALF_MAX, HALF_MAX).astype(np.float16)
        path = Path(path)
        partial = path.with_name(path.name + ".part")
        try:
            with open(partial, "wb") as file:
                np.savez(file, **values)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Clip:
        """Read a clip.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            If it is no clip, or cut short.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                values = {item.name: file[item.name] for item in fields(cls)}
        except (KeyError, EOFError, OSError, ValueError, zipfile.BadZipFile) as error:
            if isinstance(error, FileNotFoundError):
                raise FileNotFoundError(f"clip: no file {os.fspath(path)!r}") from error
            raise ValueError(f"clip {os.fspath(path)!r}: no clip, or cut short ({error})") from error
        values["target_kind"], values["shot"] = str(values["target_kind"]), str(values["shot"])
        return cls(**values)


def load_clips(folder: str | os.PathLike[str]) -> list[Clip]:
    """All clips (``*.npz``) of a folder, in the order of their names.

    Raises
    ------
    FileNotFoundError
        If there are none.
    """
    paths = sorted(Path(folder).glob("*.npz"))
    if not paths:
        raise FileNotFoundError(f"clips: no *.npz in {os.fspath(folder)!r}")
    return [Clip.load(path) for path in paths]


def split_by_shot(clips: Sequence[Clip], validation: Sequence[str]) -> tuple[list[Clip], list[Clip]]:
    """Training and validation clips; no shot is in both.

    Parameters
    ----------
    clips : sequence of Clip
        All clips.
    validation : sequence of str
        Names of the shots to keep out of training.

    Raises
    ------
    ValueError
        If a name is not among the shots, or no clip is left to train on.
    """
    shots = sorted({clip.shot for clip in clips})
    unknown = sorted(set(validation) - set(shots))
    if unknown:
        raise ValueError(f"validation: expected shots among {shots}, got {unknown}")
    training = [clip for clip in clips if clip.shot not in validation]
    if not training:
        raise ValueError(f"validation: expected a shot left to train on, got all of {shots}")
    return training, [clip for clip in clips if clip.shot in validation]


@dataclass(frozen=True)
class SamplerConfig:
    """How crops are drawn and varied. Probabilities are per sample."""

    crop: int = 128  # height and width; smaller clips are used whole, if square
    drop_estimate: float = 0.1  # the model must also work without one
    drop_frames: float = 0.1  # a side frame loses its confidence and becomes the centre, as at a shot's ends
    fireflies: float = 0.1  # a few noisy pixels become 10 to 1000 times brighter
    exposure_stops: float = 1.0  # the exposure the network is told is off by up to this, either way

    def __post_init__(self) -> None:
        if self.crop < 1:
            raise ValueError(f"crop: expected a positive size, got {self.crop}")
        for name in ("drop_estimate", "drop_frames", "fireflies"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected a probability, got {getattr(self, name)}")


class Sampler:
    """Random batches of crops from clips held in memory.

    Parameters
    ----------
    clips : sequence of Clip
        At least one, each at least crop pixels high and wide, all of one window length.
    config : SamplerConfig
        Crops and variations.
    seed : int
        Of the generator, `rng`, whose state is all the state there is.

    Raises
    ------
    ValueError
        If there are no clips, or one is too small or of another window length.

    Notes
    -----
    Shots are drawn evenly, then a clip of the shot, then the crop, in proportion to its importance: half the mean
    over all crops, half the local error of the noisy centre against the target on x/(1+x), plus the detail of
    estimate and albedo. Important places thus come up more often and no place never.

    Variations: flips, transposition (with flips: quarter turns), permutations of the color channels, signed
    permutations of the normal's axes (normals may be in any fixed space, so none is turned with the image),
    and those of `SamplerConfig`.
    """

    def __init__(self, clips: Sequence[Clip], config: SamplerConfig, seed: int) -> None:
        if not clips:
            raise ValueError("clips: expected at least one, got none")
        for clip in clips:
            if min(clip.color.shape[1:3]) < config.crop or clip.color.shape[0] != clips[0].color.shape[0]:
                raise ValueError(
                    f"clips: expected {clips[0].color.shape[0]} frames of at least {config.crop} pixels each way, "
                    f"got {clip.color.shape[:3]} (shot {clip.shot!r})"
                )
        self.clips = list(clips)
        self.config = config
        self.rng = np.random.default_rng(seed)
        shots: dict[str, list[int]] = {}
        for index, clip in enumerate(clips):
            shots.setdefault(clip.shot, []).append(index)
        self._shots = list(shots.values())
        self._exposures = [float(window_exposure(_frames_to_torch(clip.color)[None])) for clip in clips]
        self._corners, self._chances = zip(*(_crop_chances(clip, config.crop) for clip in clips), strict=True)

    def batch(self, size: int) -> dict[str, Tensor]:
        """Draw a batch.

        Parameters
        ----------
        size : int
            N.

        Returns
        -------
        dict of Tensor
            float32: ``color``, ``albedo``, ``normal`` ``(N, T, 3, H, W)``, ``confidence`` ``(N, T, 1, H, W)``,
            ``estimate`` ``(N, T, 3, H, W)``, ``modulation``, ``target`` ``(N, 3, H, W)``, ``present`` ``(N,)`` (1 where
            the estimate may be used), ``exposure`` ``(N,)``.
        """
        samples = [self._sample() for _ in range(size)]
        return {name: torch.stack([sample[name] for sample in samples]) for name in samples[0]}

    def _sample(self) -> dict[str, Tensor]:
        rng, config = self.rng, self.config
        shot = self._shots[rng.integers(len(self._shots))]
        index = shot[rng.integers(len(shot))]
        clip = self.clips[index]
        y, x = self._corners[index][rng.choice(len(self._chances[index]), p=self._chances[index])]
        here = np.s_[..., y : y + config.crop, x : x + config.crop, :]
        flip_y, flip_x, transpose = rng.random(3) < 0.5
        channels = rng.permutation(3)

        def crop(image: Array, order: npt.NDArray[np.int64] | None = None) -> Array:
            image = image[here] if order is None else image[here][..., order]
            image = image[..., ::-1, :, :] if flip_y else image
            image = image[..., ::-1, :] if flip_x else image
            return (np.swapaxes(image, -3, -2) if transpose else image).astype(np.float32)

        color, albedo, estimate = (crop(window, channels) for window in (clip.color, clip.albedo, clip.estimate))
        normal = crop(clip.normal, rng.permutation(3)) * rng.choice((-1, 1), 3).astype(np.float32)
        confidence = crop(clip.confidence[..., None])
        centre = len(color) // 2
        if len(color) > 1 and rng.random() < config.drop_frames:
            dropped = rng.random(len(color)) < 0.5
            dropped[centre] = False
            for window in (color, albedo, normal, estimate):
                window[dropped] = window[centre]
            confidence[dropped] = 0
        if rng.random() < config.fireflies:
            count = rng.integers(1, 9)
            rows, columns = rng.integers(config.crop, size=(2, count))
            gain = 10 ** rng.uniform(1, 3, (count, 1))
            # Not black where it was black: a firefly comes from a path, not from the pixel it lands in.
            color[rng.integers(len(color)), rows, columns] += gain * self._exposures[index]
        exposure = self._exposures[index] * 2 ** rng.uniform(-config.exposure_stops, config.exposure_stops)
        return {
            "color": _frames_to_torch(color),
            "albedo": _frames_to_torch(albedo),
            "normal": _frames_to_torch(normal),
            "confidence": _frames_to_torch(confidence),
            "modulation": _frames_to_torch(crop(clip.modulation, channels)),
            "target": _frames_to_torch(crop(clip.target, channels)),
            "estimate": _frames_to_torch(estimate),
            "present": torch.tensor(float(rng.random() >= config.drop_estimate)),
            "exposure": torch.tensor(exposure, dtype=torch.float32),
        }


def whole_frame(clip: Clip, multiple: int) -> dict[str, Tensor]:
    """A whole clip as a batch of one, unvaried, cropped at the right and the bottom to a multiple.

    Parameters
    ----------
    clip : Clip
        The clip.
    multiple : int
        Of height and width; the model's.

    Returns
    -------
    dict of Tensor
        As from `Sampler.batch`.
    """
    height, width = (length // multiple * multiple for length in clip.color.shape[1:3])
    batch = {
        name: _frames_to_torch(getattr(clip, name)[..., :height, :width, :])[None]
        for name in ("color", "albedo", "normal", "estimate", "modulation", "target")
    }
    batch["confidence"] = _frames_to_torch(clip.confidence[:, :height, :width, None])[None]
    batch["present"] = torch.ones(1)
    batch["exposure"] = window_exposure(_frames_to_torch(clip.color)[None])
    return batch


def _frames_to_torch(image: Array) -> Tensor:
    """``(..., H, W, C)`` to float32 ``(..., C, H, W)``: the one change of layout in training."""
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(image, -1, -3), dtype=np.float32))


def _crop_chances(clip: Clip, crop: int) -> tuple[list[tuple[int, int]], npt.NDArray[np.float64]]:
    """Corners of the possible crops, every 8 pixels, and the chance of each."""
    middle = len(clip.color) // 2
    modulation = clip.modulation.astype(np.float32)
    noisy, target, estimate = (
        np.maximum(image.astype(np.float32), 0)
        for image in (clip.color[middle] * modulation, clip.target, clip.estimate[middle] * modulation)
    )
    noisy, target, estimate = (image / (1 + image) for image in (noisy, target, estimate))
    importance = np.abs(noisy - target).mean(2)
    for guide in (estimate, clip.albedo[middle].astype(np.float32)):
        importance[1:] += np.abs(np.diff(guide, axis=0)).mean(2)
        importance[:, 1:] += np.abs(np.diff(guide, axis=1)).mean(2)
    sums = np.zeros((importance.shape[0] + 1, importance.shape[1] + 1))
    sums[1:, 1:] = importance.cumsum(0).cumsum(1)
    corners = [(y, x) for y in _starts(importance.shape[0], crop) for x in _starts(importance.shape[1], crop)]
    means = np.array(
        [sums[y + crop, x + crop] - sums[y, x + crop] - sums[y + crop, x] + sums[y, x] for y, x in corners]
    )
    # A noise-free clip without any detail has no important place: all are alike.
    chances = means + means.mean() if means.mean() > 0 else np.ones(len(means))
    return corners, chances / chances.sum()


def _starts(length: int, crop: int) -> list[int]:
    """Every eighth start of a crop, and the last one."""
    return sorted({*range(0, length - crop, 8), length - crop})
