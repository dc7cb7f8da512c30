"""The result of a frame: its window denoised, averaged with the neighbouring results, and corrected by its samples.

The errors of denoisers change from frame to frame more than the frames do, so results that show the same are averaged.
The samples restore light that few samples carry and detail that looks like noise, as far as they are certain.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from flow.warp import warp
from hybrid.alignment.align import align, align_results, measure_stillness
from hybrid.alignment.guides import GuideFilter
from hybrid.alignment.prepare import ALPHA, PreparedFrame
from hybrid.alignment.transfer import measure_typical_exposure
from hybrid.alignment.unfiltered import as_gray
from hybrid.alignment.window import AlignedWindow, Geometry, Window
from hybrid.checks.validation import find_lost_light, find_nonfinite
from hybrid.denoising.first_pass import Backends
from hybrid.denoising.plan import Plan
from hybrid.denoising.stream import FrameStream
from hybrid.files.frame import Array, Frame
from nlm.average import average, channel_mean
from nlm.fireflies import Highlights, add_highlights
from nlm.moving_lights import CONTENT, LEAST, confirmed_by_neighbour, find_bright, passing_lights, trail_of
from nlm.parts import limit_change
from nlm.samples import SampleMean, beside_lamps, blend_samples, limit_lamps, restore_mean

Mask = NDArray[np.bool_]

# By how much a pixel may change at most where results are averaged; and where samples correct a pixel that has parts,
# which change with it, so that the color is the same with and without them but where it was next to nothing.
MOST, CORRECTED = 2.0, 1e4
# Kinds of layers: the geometry of the frame before, and of the frame after.
NEIGHBOURS = "before", "after"
# Share of a frame's light in its fireflies below which no mean of it depends on them.
_LITTLE = 1e-4


@dataclass(frozen=True)
class Denoised:
    """A denoised frame."""

    color: Array  # (H, W, 3): radiance
    # (H, W, C): other layers that were filtered along, to be written over their own channels
    aovs: Mapping[str, Array] = field(default_factory=dict)
    extra: Mapping[str, Array] = field(default_factory=dict)  # (H, W) or (H, W, C): layers to add to the file
    # those of `aovs` and `extra` that add up to the color, (H, W, 3) each: they change as it does
    parts: frozenset[str] = frozenset()


class WindowDenoiser(Protocol):
    """A denoiser of aligned windows. Callers use nothing else, and never ask for the class."""

    needs_first_pass: ClassVar[bool] = True  # whether windows must hold a first pass
    guided: bool = True  # whether `AlignedWindow.guide` or its confidence by geometry is read where there are no AOVs
    reads_guides: bool = True  # whether windows' guides, or samples beside first passes, are read
    packages: ClassVar[tuple[str, ...]] = ()  # packages that pixels depend on

    @property
    def filter_guides(self) -> GuideFilter | None:
        """Function that filters a frame's albedo and normal, for networks that need them without noise."""
        return None

    @property
    def radius(self) -> int:
        """Frames on each side of the centre."""
        return 2

    @property
    def settings(self) -> Mapping[str, object]:
        """JSON values that pixels depend on; the header of each frame holds them."""
        return {}

    @property
    def devices(self) -> Mapping[str, str]:
        """Library → the device that it computes on."""
        return {}

    @property
    def backends(self) -> Backends:
        """Functions for the first pass."""
        return Backends()

    def memory(self, shape: tuple[int, int]) -> int | None:
        """Bytes that a network takes while it runs on frames of this height and width; None without a network."""
        return None

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        """Denoise the centre of a window."""


class Excess(NamedTuple):
    """By how much a frame as rendered exceeds its picture, where it does so by much."""

    bright: Mask  # (H, W): the bright pixels (`nlm.moving_lights.find_bright`)
    values: Array  # (K,): the excess at these, relative to the picture plus the exposure

    @classmethod
    def of(cls, relative: Array) -> Self:
        """Keep the bright pixels of the excess (H, W): of most frames that is nothing."""
        bright = find_bright(relative)
        return cls(bright, relative[bright])

    @property
    def layers(self) -> tuple[Array, Mask]:
        """The excess (H, W), 0 at pixels that are not bright, and the bright pixels."""
        relative = np.zeros(self.bright.shape, np.float32)
        relative[self.bright] = self.values
        return relative, self.bright


@dataclass(frozen=True)
class WindowResult:
    """A denoised window, with the figures for averaging it with neighbouring results."""

    denoised: Denoised  # the centre
    plan: Plan  # the stages that ran on the window
    # the samples of the other frames at the centre's pixels; with the stage "blend-samples"
    neighbour_samples: SampleMean | None
    geometry: tuple[Geometry | None, ...]  # of the frames before and after; empty of `as_neighbour`
    drift_weight: Array | None  # (H, W): as `hybrid.alignment.window.Neighbours.drift_weight`
    reflections: Array | None  # (H, W, 2): as `hybrid.alignment.window.Window.reflections`
    exposure: float  # of the centre's irradiance as rendered, or of the nearest frame with light
    brightest: float  # the greatest mean radiance of the frames of the window
    excess: Excess | None  # of the centre; with "blend-samples"
    passing: Excess | None  # the same over the neighbours' samples, where these are darker than the picture
    outliers: int  # rejected in the window

    def as_neighbour(self) -> Self:
        """The result without the fields that only the average of its own frame reads."""
        alone = Denoised(self.denoised.color)
        return replace(self, denoised=alone, neighbour_samples=None, geometry=(), drift_weight=None, reflections=None)


@dataclass(frozen=True)
class FrameResult:
    """The finished frame, and figures of it."""

    denoised: Denoised  # the frame
    plan: Plan  # the stages that ran on its window
    averaged: tuple[int, ...]  # the frames whose results were there to be averaged, itself among them
    # mean radiance of the noisy frame without its fireflies, and the mean radiance of these
    mean: float
    removed_radiance: float
    repaired: int  # pixels that were not finite
    fireflies: int  # single bright samples that were removed
    outliers: int  # samples of the window that were rejected as fireflies
    beyond: int  # values beyond the range of half floats


class FrameDenoiser:
    """Denoises the frames of a shot, one after the other.

    With `rows` only so many rows of a frame are worked on at a time, with the same result. With `keep_going` a
    neighbouring frame that cannot be denoised is left out of the average. `strength` is the share of the noise that is
    removed, in [0, 1].

    With d the denoised windows, W the warp to the frame t, R the relighting to its light (`nlm.relight`) and c the
    confidence of their comparison (`hybrid.alignment.align.align_results`), 1 for the frame itself, the result of t is
    Σ c_s R W d_s / Σ c_s over s = t − 1, t, t + 1, corrected by the samples (`nlm.samples`). The result of t therefore
    depends on the window of t + 1. Where light drifts (`nlm.drift`), or drift cannot be measured (windows of three
    frames, or without a first pass), nothing is relit, and c is a half at most. Where the light of a whole frame drifts
    nothing is averaged: c is multiplied by the share of it that stands still, from 0 (a fifth) to 1 (two fifths).
    """

    def __init__(
        self,
        stream: FrameStream,
        denoise: WindowDenoiser,
        *,
        rows: int | None = None,
        keep_going: bool = False,
        strength: float = 1.0,
    ) -> None:
        self.stream = stream
        self.denoise = denoise
        self.rows = rows or stream.shot.shape[0]
        self.keep_going = keep_going
        self.strength = strength
        self._results: dict[int, WindowResult] = {}

    def make(self, number: int) -> FrameResult:
        """Denoise a frame; ValueError or OSError if it, or a neighbour, fails, or its light is not the samples'."""
        averaged = self.neighbours(number)  # the next frame among them: its window is denoised first
        # The result of the frame before keeps only the fields that the average reads.
        self._results = {n: _needed(result, n >= number) for n, result in self._results.items() if n in averaged}
        for n in averaged:
            if n not in self._results or (n == number and not self._results[n].geometry):
                self.stream.keep({*self.stream.around(n, self.stream.support), *averaged})
                try:
                    self._results[n] = self.stream.keeper.keep(_needed(self._denoise_window(n), n >= number))
                except (ValueError, OSError):
                    if n == number or not self.keep_going:
                        raise
        result, frame = self._results[number], self.stream.frame(number)
        assert frame is not None
        denoised = result.denoised
        if "stabilize" in result.plan.stages and len(self._results) > 1:
            denoised = self._stabilize(number)
        if frame.valid.any() and not frame.radiance.any():
            # Light that leaks into a black frame between lit ones is a small error, and no fault.
            denoised = _changed(denoised, np.zeros_like(denoised.color), CORRECTED)
        self._check_light(denoised.color, frame, result.brightest)
        moving = self._moving_lights(frame) if "blend-samples" in result.plan.stages else None
        denoised = self._correct(denoised, frame, result, moving)
        if frame.highlights is not None:
            denoised = _with_highlights(denoised, frame.highlights)
        if frame.spread is not None:
            denoised = _with_filter(denoised, frame)
        denoised = _with_unfiltered(denoised, frame)
        if self.strength < 1:
            denoised = _with_noise(denoised, self.stream.shot.read(number), 1 - self.strength)
        return FrameResult(
            denoised,
            result.plan,
            tuple(sorted(self._results)),
            frame.mean,
            frame.removed_radiance,
            frame.repaired,
            frame.fireflies,
            result.outliers,
            frame.unfiltered.count,
        )

    def neighbours(self, number: int) -> list[int]:
        """The frame, and the neighbours whose results are averaged with it."""
        return self.stream.neighbours(number) if "stabilize" in self.stream.rules.allowed else [number]

    def _denoise_window(self, number: int) -> WindowResult:
        """Denoise a frame's own window, band by band."""
        stream, numbers = self.stream, self.stream.around(number)
        window: Window | None = stream.window(number)
        assert window is not None
        if not window.centre.valid.any():
            raise ValueError(f"frame {number}: no pixel of color is finite, expected a rendered frame")
        plan = stream.plan(numbers, stream.context(number, window.first_pass is not None, stream.radius))
        brightest = 0.0
        for frame in window.frames:
            brightest = brightest if frame is None else max(brightest, frame.mean)
            stream.keeper.release()  # a mean reads the whole frame
        exposure, reflections, bands = window.lit.as_rendered.exposure, window.reflections, self._bands()
        shares = {"refine": float(np.mean(window.refined))} if window.refined else {}
        if window.reflecting is not None:
            shares["reflections"] = float(window.reflecting.mean())
        layers = _Layers(stream.shot.shape, stream.keeper.empty)
        outliers = 0
        stream.keeper.trim()
        for band in bands:
            assert window is not None
            aligned = [align(window, band, guided=self.denoise.guided, timings=stream.timings)]
            if band is bands[-1]:
                window = None  # frees its composed flows while the denoiser runs
            stream.keeper.trim()
            outliers += aligned[0].outliers
            neighbours, inner = aligned[0].neighbours, aligned[0].inner
            # No reference stays here: a network frees what it has read before it runs.
            # By name: a call of the object itself would hold the window until it returns.
            denoised = self.denoise.__call__(aligned.pop())
            named: dict[tuple[str, str], NDArray[Any] | None]
            named = {("color", ""): denoised.color, ("drift", ""): neighbours.drift_weight}
            named |= {("aovs", name): layer for name, layer in denoised.aovs.items()}
            named |= {("extra", name): layer for name, layer in denoised.extra.items()}
            groups = neighbours.samples, *neighbours.geometry
            for kind, group in zip(("sides", *NEIGHBOURS), groups, strict=True):
                named |= {} if group is None else {(kind, name): layer for name, layer in group._asdict().items()}
            layers.add(band, inner, named)
            parts = denoised.parts
            del neighbours, denoised, named  # before the next band is aligned
            stream.keeper.trim()
        samples = layers.named("sides")
        color = layers.named("color")[""]
        frame, excess, passing = stream.frame(number), None, None
        if "blend-samples" in plan.stages:
            assert frame is not None
            with stream.timings.stage("blend-samples"):
                excess, passing = _excess(frame, color, SampleMean(**samples) if samples else None)
        return WindowResult(
            Denoised(color, layers.named("aovs"), layers.named("extra"), parts),
            replace(plan, shares=shares),
            SampleMean(**samples) if samples else None,
            tuple(Geometry(**geometry) if (geometry := layers.named(side)) else None for side in NEIGHBOURS),
            layers.named("drift").get(""),
            reflections,
            exposure,
            brightest,
            excess,
            passing,
            outliers,
        )

    def _stabilize(self, number: int) -> Denoised:
        """The denoised frame averaged with its neighbours, and its parts changed alike."""
        result, timings = self._results[number], self.stream.timings
        geometry, exposure = result.geometry, result.exposure
        colors = {n: other.denoised.color for n, other in self._results.items()}
        self.stream.keeper.trim()
        window = replace(self.stream.window_of_results(number, colors), reflections=result.reflections)
        color = np.empty_like(result.denoised.color)
        with timings.stage("stabilize"):
            stillness = measure_stillness(result.drift_weight, color.shape[:2])
        for band in self._bands():
            aligned, confidence = align_results(window, geometry, stillness, exposure, band, timings=timings)
            with timings.stage("stabilize"):
                color[band] = average(aligned, confidence)
            self.stream.keeper.release()
        with timings.stage("stabilize"):
            return _changed(result.denoised, color)

    def _check_light(self, color: Array, frame: PreparedFrame, brightest: float) -> None:
        """Raise ValueError for a result that cannot be right, before its samples hide that."""
        with self.stream.timings.stage("check"):
            if find_nonfinite(color):
                return  # nothing is corrected by it: the pipeline refuses it
            if fault := find_lost_light(color, frame.radiance, frame.valid, lambda: brightest):
                raise ValueError(f"frame {frame.number}: {fault}; it was not written")

    def _correct(
        self, denoised: Denoised, frame: PreparedFrame, result: WindowResult, moving: tuple[Mask, Mask] | None
    ) -> Denoised:
        """The denoised frame with its samples' means, and samples where they are certain, as in moving lights."""
        color, timings = denoised.color, self.stream.timings
        exposure, sides, rendered = measure_typical_exposure(color), result.neighbour_samples, frame.rendered
        radiance = frame.radiance if frame.removed_samples else rendered
        self.stream.keeper.release()  # the frame's own layers, of which this is made
        shown = [rendered] if sides is None else [rendered, sides.mean]
        color = limit_lamps(color, shown, exposure)
        counted = frame.valid if moving is None else frame.valid & ~moving[0]
        if "restore-mean" in result.plan.stages:
            with timings.stage("restore-mean"):
                # An error beside a lamp stays there: spread over a room, a halo of 60 pixels darkened it by 1 %.
                far = counted & ~beside_lamps(color, exposure)
                # First without fireflies: the mean of few bright samples is uncertain, that of all others is not.
                removed = frame.removed_radiance > _LITTLE * frame.mean
                for noisy in (radiance, rendered) if removed else (rendered,):
                    color = restore_mean(color, _where(far, noisy, color), exposure)
        if sides is not None:
            with timings.stage("blend-samples"):
                noisy = _where(counted, radiance, color)
                if not counted.all():
                    fresh = counted if moving is None else counted & ~moving[1]
                    sides = sides._replace(nearest=sides.nearest * fresh)
                # Noise that the albedo shares with the color is none of their quotient.
                albedo = frame.albedo if frame.demodulated and not result.plan.noisy_guides else None
                color = blend_samples(color, noisy, sides, exposure, frame.radiance_variance, albedo)
        color = limit_lamps(color, shown, exposure)
        if moving is not None:
            color = _where(~moving[0], color, rendered)
        return _changed(denoised, color, CORRECTED)

    def _moving_lights(self, frame: PreparedFrame) -> tuple[Mask, Mask] | None:
        """The bright pixels (H, W) that neighbours show to move together, or to pass when aligned, if any."""
        number, step = frame.number, self.stream.shot.step
        others = [n for n in (number - step, number + step) if self.stream.shot.has(n)]
        with self.stream.timings.stage("blend-samples"):
            seen, trail = self._lights_beyond_picture(number, others), np.zeros(self.stream.shot.shape, bool)
            own, passing = self._results[number].passing, {}
            for time in (-1, 1):
                excess = self._passing_of(number + time * step, number)
                if excess is not None:
                    passing[time] = excess.layers, self._vectors(number, number + time * step)
            if own is not None and passing:
                lights, (down, right) = passing_lights(*own.layers, passing)
                seen = seen | lights
                for time, ((_, bright), flow) in passing.items() if lights.any() else ():
                    trail |= trail_of(bright, (time * down, time * right), flow, self.stream.radius)
        return (seen, trail) if seen.any() else None

    def _lights_beyond_picture(self, number: int, others: Sequence[int]) -> Mask:
        """The bright pixels (H, W) that the picture lacks."""
        excess = self._results[number].excess
        assert excess is not None
        shown = [np.zeros_like(excess.bright)]
        for n in others if excess.bright.any() else ():
            if (other := self._excess_of(n, number)) is not None:
                shown.append(confirmed_by_neighbour(*excess.layers, *other.layers, self._vectors(number, n)))
        if "stabilize" in self.stream.rules.allowed:
            seen = np.logical_or.reduce(shown)
        else:
            # One picture beside all frames lets parts of a reflection pass for lights, 0.4 dB of a shot.
            seen = np.logical_and.reduce(shown[1:] or shown)
            seen &= np.count_nonzero(seen) >= LEAST
        return excess.bright if np.count_nonzero(seen) >= CONTENT * np.count_nonzero(excess.bright) else seen

    def _vectors(self, number: int, to: int) -> Array | None:
        flow = self.stream.flow(number, to)
        return None if flow is None else flow.vectors

    def _excess_of(self, number: int, beside: int) -> Excess | None:
        """The excess of a neighbour: over the frame's own result where a classical preset has no other."""
        if "stabilize" in self.stream.rules.allowed:
            return self._results[number].excess if number in self._results else None
        neighbour, flow = self.stream.frame(number), self.stream.flow(number, beside)
        if neighbour is None or flow is None:
            return None
        picture, shown = warp(self._results[beside].denoised.color, flow.vectors)
        return _excess(neighbour, picture, inside=shown)[0]

    def _passing_of(self, number: int, beside: int) -> Excess | None:
        """The excess of a neighbour over its neighbours' samples too, or else as `_excess_of`."""
        if "stabilize" in self.stream.rules.allowed:
            return self._results[number].passing if number in self._results else None
        return self._excess_of(number, beside) if self.stream.shot.has(number) else None

    def _bands(self) -> list[slice]:
        height = self.stream.shot.shape[0]
        return [slice(top, min(top + self.rows, height)) for top in range(0, height, self.rows)]


class _Layers:
    """Layers of a frame, put together from bands of rows; a single band is taken as it is."""

    def __init__(self, shape: tuple[int, int], empty: Callable[[tuple[int, ...], np.dtype[Any]], NDArray[Any]]) -> None:
        self._shape, self._empty = shape, empty
        self._layers: dict[tuple[str, str], NDArray[Any]] = {}

    def add(self, band: slice, inner: slice, layers: Mapping[tuple[str, str], NDArray[Any] | None]) -> None:
        """Write a band's rows, which are the rows `inner` of these layers."""
        for key, layer in layers.items():
            if layer is None:
                continue
            if band.stop - band.start == self._shape[0]:
                self._layers[key] = layer
                continue
            if key not in self._layers:
                self._layers[key] = self._empty((*self._shape, *layer.shape[2:]), layer.dtype)
            self._layers[key][band] = layer[inner]

    def named(self, kind: str) -> dict[str, Any]:
        """The layers of a kind."""
        return {name: layer for (other, name), layer in self._layers.items() if other == kind}


def _needed(result: WindowResult, whole: bool) -> WindowResult:
    """The whole result, or the part that the average with another frame reads."""
    return result if whole else result.as_neighbour()


def _excess(
    frame: PreparedFrame, picture: Array, neighbours: SampleMean | None = None, inside: Mask | None = None
) -> tuple[Excess, Excess | None]:
    """By how much a frame as rendered exceeds its picture, and also its neighbours' samples where these are darker.

    0 where it is not `inside` (H, W).
    """
    shown, rendered = channel_mean(picture), channel_mean(frame.rendered)
    exposure = np.float32(measure_typical_exposure(picture))

    def exceed(shown: Array) -> Excess:
        counted = frame.valid if inside is None else frame.valid & inside
        return Excess.of(np.asarray((rendered - shown) / (np.maximum(shown, 0) + exposure) * counted, np.float32))

    if neighbours is None:
        return exceed(shown), None
    darker = np.where(neighbours.trust < 1, shown, np.minimum(shown, channel_mean(neighbours.mean)))
    return exceed(shown), exceed(darker)


def _where(counted: Mask, noisy: Array, picture: Array) -> Array:
    """The noisy frame at the pixels that count, and the picture elsewhere."""
    return noisy if counted.all() else np.where(counted[..., None], noisy, picture)


def _changed(denoised: Denoised, color: Array, most: float = MOST) -> Denoised:
    """The picture with another color, and its parts, if any, changed alike: by a factor of `most` at most."""
    own = denoised.color
    if most > MOST and not denoised.parts:
        return replace(denoised, color=color)
    color, change = limit_change(own, color, most, with_factor=bool(denoised.parts))
    return _with_parts(denoised, color, change)


def _with_parts(denoised: Denoised, color: Array, factor: Array) -> Denoised:
    """The picture with another color, and its parts times a factor."""
    aovs, extra = (
        {name: layer * factor if name in denoised.parts else layer for name, layer in layers.items()}
        for layers in (denoised.aovs, denoised.extra)
    )
    return replace(denoised, color=color, aovs=aovs, extra=extra)


def _with_highlights(denoised: Denoised, highlights: Highlights) -> Denoised:
    """Add persistent highlights to the picture, and scale its parts alike."""
    color = add_highlights(denoised.color, highlights)
    ratio = np.divide(color, denoised.color, out=np.ones_like(color), where=denoised.color > 0)
    return _with_parts(denoised, color, ratio)


def _with_filter(denoised: Denoised, frame: PreparedFrame) -> Denoised:
    """The picture, its parts and all other light as the renderer's pixel filter makes it."""
    aovs = {name: layer if name == ALPHA else frame.with_filter(layer) for name, layer in denoised.aovs.items()}
    extra = {n: frame.with_filter(layer) if n in denoised.parts else layer for n, layer in denoised.extra.items()}
    return replace(denoised, color=frame.with_filter(denoised.color), aovs=aovs, extra=extra)


def _with_unfiltered(denoised: Denoised, frame: PreparedFrame) -> Denoised:
    """Restore the unfiltered light in the picture and its parts (`hybrid.alignment.unfiltered`)."""
    unfiltered, aovs = frame.unfiltered, dict(denoised.aovs)
    for name in aovs.keys() & unfiltered.gray:
        # Parts of a colored light add up to it, with the tint that their shares of it have.
        if name not in denoised.parts or "color" in unfiltered.gray:
            aovs[name] = as_gray(aovs[name])
    for name in aovs.keys() & unfiltered.negative.keys() & denoised.parts:
        # Shared out of the picture, which had no negative light, parts have none.
        aovs[name] = np.maximum(aovs[name], 0) + unfiltered.smooth_negative(name, denoised.color, frame.guide)
    aovs = {name: unfiltered.without_outside(layer) for name, layer in aovs.items()}
    aovs |= {name: unfiltered.without_empty(aovs[name]) for name in aovs.keys() & denoised.parts}
    guide = frame.guide if unfiltered.negative else None
    return replace(denoised, color=unfiltered.restore(denoised.color, guide), aovs=aovs)


def _with_noise(denoised: Denoised, rendered: Frame, share: float) -> Denoised:
    """Blend a share of the frame's noise into the layers; not where the frame is not finite."""

    def blend(layer: Array, noisy: Array) -> Array:
        noisy = noisy.reshape(layer.shape)
        with np.errstate(invalid="ignore", over="ignore"):  # infinities less infinities
            blended = layer + np.float32(share) * (noisy - layer)
        return np.where(np.isfinite(blended), blended, layer)

    named = {**rendered.aovs} if rendered.alpha is None else {**rendered.aovs, ALPHA: rendered.alpha}
    aovs = {name: blend(layer, named[name]) if name in named else layer for name, layer in denoised.aovs.items()}
    return replace(denoised, color=blend(denoised.color, rendered.color), aovs=aovs)
