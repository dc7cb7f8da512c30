"""The picture of a frame: its window denoised, averaged with the pictures beside it, and corrected by its samples.

The errors of denoisers change from frame to frame more than the frames do, so pictures of neighbours that show the same
are averaged. Denoisers and averages lose light that few samples carry, and detail that looks like noise: the samples
bring both back last, as far as they are certain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.align import Aligner
from hybrid.alignment.measure import FrameFacts, PairFacts
from hybrid.alignment.prepare import PreparedFrame
from hybrid.alignment.transfer import measure_exposure
from hybrid.alignment.unfiltered import as_gray
from hybrid.alignment.window import AlignedWindow
from hybrid.validation import find_lost_light, find_nonfinite
from nlm.average import average
from nlm.fireflies import Lights, add_lights
from nlm.moving_lights import find_bright, witnessed
from nlm.samples import SampleMean, blend_samples, restore_mean

Array = NDArray[np.float32]

# By how much a pixel may change at most where pictures are averaged; and where samples correct a pixel that has parts,
# which change with it, so that the color is the same with and without them but where it was next to nothing.
MOST, CORRECTED = 2.0, 1e4
# Where this share of a frame's bright pixels move together, the others are content too: hidden, or leaving the frame.
CONTENT = 0.6


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
    parts : frozenset of str
        Those of `aovs` and `extra` that add up to the color, (H, W, 3) each: they change as it does.
    """

    color: Array
    aovs: Mapping[str, Array] = field(default_factory=dict)
    extra: Mapping[str, Array] = field(default_factory=dict)
    parts: frozenset[str] = frozenset()


DenoiseWindow = Callable[[AlignedWindow], Denoised]


@dataclass(frozen=True)
class Counts:
    """What there is to say of a picture.

    Attributes
    ----------
    repaired, fireflies, outliers, stages, shares
        As `AlignedWindow` has them, over all parts of the frame.
    facts : tuple
        What its window was planned by (`LoadedFrames.facts_of`).
    beside : tuple of int
        The frames whose pictures were there to be averaged, itself among them.
    beyond : int
        Values that half cannot hold.
    """

    repaired: int
    fireflies: int
    outliers: int
    stages: frozenset[str]
    shares: dict[str, float]
    facts: tuple[Sequence[FrameFacts], Sequence[PairFacts]]
    beside: tuple[int, ...] = ()
    beyond: int = 0


class Pictures:
    """Makes the pictures of a shot, one after the other.

    Parameters
    ----------
    aligner : Aligner
        Of the shot.
    denoise : callable
        From `AlignedWindow` to `Denoised`.
    rows : int, optional
        How many rows of a frame to work on at a time; all without. The result is the same.
    keep_going : bool
        Where a frame beside cannot be made, do without it.

    Notes
    -----
    With d the denoised frames, W the warp to the frame t, R what puts them into its light (`nlm.relight`) and c the
    confidence of their comparison (`Aligner.align_pictures`), 1 for the frame itself, the picture of t is
    Σ c_s R W d_s / Σ c_s over s = t − 1, t, t + 1, corrected by the samples (`nlm.samples`). Where light drifts
    (`nlm.drift`), or where nothing could tell (windows of three frames, or without estimates), nothing is put into
    another light, and c is a half at most. Where the light of a whole frame drifts nothing is averaged: c is multiplied
    by how much of it stands still, from 0 (a fifth) to 1 (two fifths).
    """

    def __init__(
        self, aligner: Aligner, denoise: DenoiseWindow, *, rows: int | None = None, keep_going: bool = False
    ) -> None:
        self.aligner = aligner
        self.denoise = denoise
        self.rows = rows or aligner.shot.shape[0]
        self.keep_going = keep_going
        self._made: dict[int, tuple[Denoised, Counts, SampleMean | None]] = {}

    def make(self, number: int) -> tuple[Denoised, Counts]:
        """Make the picture of frame `number`; its window's counts.

        Raises
        ------
        ValueError, OSError
            If the frame, or one beside it, cannot be made, or its light is not that of the noisy frame
            (`hybrid.validation.find_lost_light`).
        """
        beside = self.beside(number)
        self._made = {n: made for n, made in self._made.items() if n in beside}
        self.aligner.hold = frozenset(beside)
        for n in beside:
            if n not in self._made:
                try:
                    self._made[n] = self._denoise(n)
                except (ValueError, OSError):
                    if n == number or not self.keep_going:
                        raise
        denoised, counts, sides = self._made[number]
        if "steady" in counts.stages and len(self._made) > 1:
            denoised = self._steady(number, denoised, {n: made.color for n, (made, _, _) in self._made.items()})
        if (frame := self.aligner.frames.get(number)) is not None:
            self._check_light(denoised.color, frame)
            denoised = self._correct(denoised, frame, sides, counts.stages)
            if "samples" in counts.stages:
                denoised = self._with_moving_lights(denoised, frame)
            if frame.highlights is not None:
                denoised = _with_highlights(denoised, frame.highlights)
            denoised, counts = _with_unfiltered(denoised, frame), replace(counts, beyond=frame.unfiltered.count)
        return denoised, replace(counts, beside=tuple(sorted(self._made)))

    def beside(self, number: int) -> list[int]:
        """The frame and those beside it, whose pictures it is averaged with if they can be made."""
        return self.aligner.comparable(number) if "steady" in self.aligner.frames.allowed else [number]

    def _denoise(self, number: int) -> tuple[Denoised, Counts, SampleMean | None]:
        """Denoise a frame's own window, and average the samples of the frames beside it."""
        height, width = self.aligner.shot.shape
        whole: dict[tuple[str, str], Array] = {}
        outliers = 0
        for band in self._bands():
            aligned = self.aligner.align(number, band)
            part = self.denoise(aligned)
            outliers += aligned.outliers
            facts = self.aligner.frames.facts_of(self.aligner.frames.around(number, self.aligner.radius))
            counts = Counts(aligned.repaired, aligned.fireflies, outliers, aligned.stages, aligned.shares, facts)
            parts = part.parts
            named = {("color", ""): part.color}
            named |= {("aovs", name): layer for name, layer in part.aovs.items()}
            named |= {("extra", name): layer for name, layer in part.extra.items()}
            if aligned.sides is not None:
                named |= {("sides", name): layer for name, layer in vars(aligned.sides).items()}
            for name, layer in named.items():
                if self.rows >= height:
                    whole[name] = layer
                    continue
                if name not in whole:
                    whole[name] = np.empty((height, width, *layer.shape[2:]), np.float32)
                whole[name][band] = layer[aligned.inner]
            del aligned, part, named
        aovs, extra, sides = (
            {name: layer for (kind, name), layer in whole.items() if kind == wanted}
            for wanted in ("aovs", "extra", "sides")
        )
        return Denoised(whole["color", ""], aovs, extra, parts), counts, SampleMean(**sides) if sides else None

    def _check_light(self, color: Array, frame: PreparedFrame) -> None:
        """Raise ValueError for a picture that cannot be right, before its samples hide that."""
        frames = self.aligner.frames

        def around() -> float:
            near = (frames.get(n) for n in frames.around(frame.number, self.aligner.radius))
            return max(other.mean for other in near if other is not None)

        with self.aligner.timings.stage("check"):
            if find_nonfinite(color):
                return  # nothing is corrected by it: the pipeline refuses it
            if fault := find_lost_light(color, frame.radiance, frame.valid, around):
                raise ValueError(f"frame {frame.number}: {fault}; it was not written")

    def _correct(
        self, denoised: Denoised, frame: PreparedFrame, sides: SampleMean | None, stages: frozenset[str]
    ) -> Denoised:
        """The denoised frame with the means of its samples, and with the samples where they are certain."""
        color = denoised.color
        exposure = measure_exposure(color)
        if "mean" in stages:
            with self.aligner.timings.stage("mean"):
                # First without fireflies: a mean of few bright samples is not known, that of all others is.
                for noisy in (frame.radiance, *([frame.rendered] if frame.removed_samples else [])):
                    color = restore_mean(color, _where_rendered(frame, noisy, color), exposure)
        if sides is not None:
            with self.aligner.timings.stage("samples"):
                noisy = _where_rendered(frame, frame.radiance, color)
                color = blend_samples(color, noisy, sides, exposure, frame.radiance_variance)
        return _changed(denoised, color, CORRECTED)

    def _with_moving_lights(self, denoised: Denoised, frame: PreparedFrame) -> Denoised:
        """The denoised frame with bright pixels as rendered that the pictures beside it show to move together."""
        step = self.aligner.shot.step
        others = [n for n in (frame.number - step, frame.number + step) if n in self._made]
        with self.aligner.timings.stage("samples"):
            own = _excess(frame, self._made[frame.number][0].color)
            bright = find_bright(own)
            if not (others and bright.any()):
                return denoised
            seen = np.zeros_like(bright)
            for n in others:
                other = _excess(self.aligner.frames[n], self._made[n][0].color)
                link = self.aligner.flows.between(frame.number, n)
                seen |= witnessed(own, bright, other, find_bright(other), None if link is None else link[0])
            if np.count_nonzero(seen) >= CONTENT * np.count_nonzero(bright):
                seen = bright
            color = np.where(seen[..., None], frame.rendered, denoised.color)
        return _changed(denoised, color, CORRECTED)

    def _steady(self, number: int, denoised: Denoised, pictures: Mapping[int, Array]) -> Denoised:
        """The denoised frame averaged with those beside it, and its parts changed alike."""
        color = np.empty_like(denoised.color)
        for band in self._bands():
            window, confidence, inner = self.aligner.align_pictures(number, pictures, band)
            with self.aligner.timings.stage("steady"):
                color[band] = average(window, confidence)[inner]
        with self.aligner.timings.stage("steady"):
            return _changed(denoised, color)

    def _bands(self) -> list[slice]:
        height = self.aligner.shot.shape[0]
        return [slice(top, min(top + self.rows, height)) for top in range(0, height, self.rows)]


def _excess(frame: PreparedFrame, picture: Array) -> Array:
    """By how much a frame as rendered exceeds its picture, relative to the picture plus the exposure (H, W)."""
    light = picture.mean(axis=-1) + np.float32(measure_exposure(picture))
    return np.asarray((frame.rendered - picture).mean(axis=-1) / light * frame.valid, np.float32)


def _where_rendered(frame: PreparedFrame, noisy: Array, picture: Array) -> Array:
    """The noisy frame, with the picture in the place of pixels that were not finite."""
    return noisy if frame.valid.all() else np.where(frame.valid[..., None], noisy, picture)


def _changed(denoised: Denoised, color: Array, most: float = MOST) -> Denoised:
    """The picture with another color, and its parts, if any, changed alike: by a factor of `most` at most."""
    own, factor = denoised.color, np.float32(most)
    if most > MOST and not denoised.parts:
        return replace(denoised, color=color)
    bounded = np.clip(color, own / factor, own * factor)  # before the division, which may exceed float32
    change = np.divide(bounded, own, out=np.ones_like(own), where=own > 0)
    within = (own <= 0) | (bounded == color)
    aovs, extra = (
        {name: layer * change if name in denoised.parts else layer for name, layer in layers.items()}
        for layers in (denoised.aovs, denoised.extra)
    )
    return replace(denoised, color=np.where(within, color, own * change), aovs=aovs, extra=extra)


def _with_highlights(denoised: Denoised, highlights: Lights) -> Denoised:
    """Add persistent highlights to the picture, and scale its parts alike."""
    color = add_lights(denoised.color, highlights)
    ratio = np.divide(color, denoised.color, out=np.ones_like(color), where=denoised.color > 0)
    aovs, extra = (
        {name: layer * ratio if name in denoised.parts else layer for name, layer in layers.items()}
        for layers in (denoised.aovs, denoised.extra)
    )
    return replace(denoised, color=color, aovs=aovs, extra=extra)


def _with_unfiltered(denoised: Denoised, frame: PreparedFrame) -> Denoised:
    """The picture and its parts with what no filter took (`hybrid.alignment.unfiltered`)."""
    unfiltered, aovs = frame.unfiltered, dict(denoised.aovs)
    for name in aovs.keys() & unfiltered.gray:
        aovs[name] = as_gray(aovs[name])
    for name in aovs.keys() & unfiltered.negative.keys() & denoised.parts:
        # Shared out of the picture, which had no negative light, parts have none.
        aovs[name] = np.maximum(aovs[name], 0) + unfiltered.smooth_negative(name, denoised.color, frame.guide)
    aovs = {name: unfiltered.without_outside(layer) for name, layer in aovs.items()}
    return replace(denoised, color=unfiltered.restore(denoised.color, frame.guide), aovs=aovs)
