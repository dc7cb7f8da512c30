"""The frames of a shot in memory, and the values computed from each once, while windows slide over them.

`FrameStream` alone owns it: each value is made when first read, and dropped with one of the frames it belongs to.
"""

import math
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, TypeVar, cast

import numpy as np

from flow.reflections import find_reflections
from flow.tvl1 import refine_flow
from hybrid.alignment.align import align, expect_equal_layers
from hybrid.alignment.fade import NO_FADE, Fade, inverse, relit, scaled
from hybrid.alignment.fireflies import REACH, remove_fireflies
from hybrid.alignment.flows import Flow, Link, PairFlows, compose_flows, measure_flows
from hybrid.alignment.guides import GuideFilter
from hybrid.alignment.measure import (
    FrameFacts,
    PairFacts,
    SmallFrame,
    least_outline_noise,
    measure_frame,
    measure_pair,
    shrink,
)
from hybrid.alignment.noise import (
    FIXED_NOISE_ABOVE,
    Correlation,
    correlation_alone,
    fixed_noise,
    near_correlation,
    noise_correlation,
    relative_residual,
    shared_residual,
    without_moving_light,
)
from hybrid.alignment.prepare import PreparedFrame, prepare, prepared_planes, without_filter
from hybrid.alignment.residual import Limited, measure_limited
from hybrid.alignment.transfer import measure_exposure
from hybrid.alignment.unfiltered import find_region, mirror_region
from hybrid.alignment.window import AlignedWindow, Window
from hybrid.denoising.plan import DENOISED, NOISY, RADIUS, Context, Plan, Rules, merge
from hybrid.files.frame import Array, Frame, Frames
from hybrid.files.layers import Layers
from hybrid.files.shots import Shot
from hybrid.runtime.kept import Keeper
from hybrid.runtime.timing import Timings

Value = TypeVar("Value")

# A frame with less than this share of another's light is black beside it: half floats hold no more of it.
FAINT = 1e-6


@dataclass(frozen=True, kw_only=True)
class FirstPass:
    """A source of denoised single frames (`hybrid.denoising.first_pass` has three kinds)."""

    holds: int = 0  # bytes that it takes for itself while it works
    files: Shot | None = None  # the finished sequence that it reads, if it does
    from_noisy: ClassVar[bool] = False  # whether it denoises windows of noisy frames
    reads_frame: ClassVar[bool] = False  # whether it reads `FrameStream.as_read`

    def reach(self, radius: int) -> int:
        """Count the frames on each side of the centre that are read for a window of this radius."""
        return radius

    def make(self, stream: "FrameStream", number: int) -> Array | None:
        """Denoise frame `number` of the stream: radiance (H, W, 3), finite; None where there is nothing to read."""
        raise NotImplementedError


class FrameStream:
    """The frames of a shot, read lazily, and the values computed from each, once; `refine` as `refine_flow`.

    `filter_guides` maps a frame's albedo and normal to the same without noise, for denoisers that need them; without
    `reads_guides` the denoiser averages first passes and reads no guides.
    """

    def __init__(
        self,
        shot: Frames,
        rules: Rules,
        first_pass: FirstPass | None = None,
        *,
        radius: int = RADIUS,
        refine: Callable[..., Array] = refine_flow,
        filter_guides: GuideFilter | None = None,
        reads_guides: bool = True,
        timings: Timings | None = None,
        keeper: Keeper | None = None,
    ) -> None:
        self.shot = shot
        self.rules = rules
        self.source = first_pass
        self.radius = radius
        self.timings = timings or Timings()
        self.keeper = keeper or Keeper()
        self._refine, self._filter_guides, self._reads_guides = refine, filter_guides, reads_guides
        # Kind of a value and the frames it belongs to → the value.
        self._cache: dict[tuple[str, tuple[int, ...]], object] = {}

    def keep(self, numbers: Collection[int]) -> None:
        """Drop the values of other frames; those with fireflies stay as long as fireflies of later ones are removed."""
        kept = {*numbers}
        loaded = [frames[0] for kind, frames in self._cache if kind == "frame" and frames[0] in kept]
        first = max(loaded, default=min(kept)) - (REACH - 1) * self.shot.step
        last = max(kept) + REACH * self.shot.step

        def is_kept(kind: str, frames: tuple[int, ...]) -> bool:
            if kind == "raw":  # the noise of a frame is compared with that of the next one, and then no more
                return max(loaded, default=first) <= frames[0] <= last
            beyond = kind in ("read", "rendered", "residual", "correlation", "same noise")
            return first <= frames[0] <= last if beyond else kept.issuperset(frames)

        self._cache = {key: value for key, value in self._cache.items() if is_kept(*key)}

    def around(self, number: int, radius: int | None = None) -> list[int]:
        """Numbers of the window around a frame, ascending, whether or not these frames are there."""
        radius, step = self.radius if radius is None else radius, self.shot.step
        return list(range(number - radius * step, number + radius * step + 1, step))

    def neighbours(self, number: int) -> list[int]:
        """The frame and its neighbours that exist; where the first pass is read from files, those with a picture."""
        files = None if self.source is None else self.source.files
        return [n for n in self.around(number, 1) if self.shot.has(n) and (files is None or files.has(n))]

    # Values of a frame, or of a pair of frames.

    def frame(self, number: int) -> PreparedFrame | None:
        """A frame, prepared and without fireflies; None where the shot has none."""
        return self._cached("frame", (number,), self._load) if self.shot.has(number) else None

    def as_read(self, number: int) -> Frame:
        """A frame as read from its file, but without fireflies. Dropped once its first pass is made."""
        prepared = self._there(number)
        if ("read", (number,)) not in self._cache:
            self._read(number)
        frame = cast(Frame, self._cache["read", (number,)])
        if prepared.spread is not None:
            estimate = None if frame.estimate is None else prepared.spread.undo(frame.estimate)
            frame = replace(frame, albedo=prepared.albedo, normal=prepared.normal, estimate=estimate)
        elif prepared is self.rendered(number):
            return frame
        return replace(frame, color=prepared.radiance)

    def denoised(self, number: int) -> Array | None:
        """The first pass of a frame, radiance (H, W, 3); None where there is none."""
        source = self.source
        if source is None or self.frame(number) is None:
            return None

        def make(number: int) -> Array | None:
            self.keeper.trim()
            picture, spread = source.make(self, number), self._there(number).spread
            if picture is None or spread is None or source.files is None:
                return picture
            return np.maximum(spread.undo(picture), 0)  # all others are made of frames without the filter

        denoised = self._cached("first pass", (number,), make)
        self._cache.pop(("read", (number,)), None)
        return denoised

    def measurements(self, numbers: Sequence[int]) -> tuple[list[FrameFacts], list[PairFacts]]:
        """Measure the frames of these that exist, and their neighbouring pairs."""
        present = [n for n in numbers if self.shot.has(n)]
        pairs = [(a, b) for a, b in pairwise(present) if b - a == self.shot.step]
        return [self._facts(n) for n in present], [self._pair_facts(a, b) for a, b in pairs]

    def plan(self, numbers: Sequence[int], context: Context = NOISY) -> Plan:
        """Decide which stages run on these frames."""
        return self._cached(
            f"plan {context}", tuple(numbers), lambda *n: self.rules.decide(*self.measurements(n), context)
        )

    def context(self, number: int, first_pass: bool, radius: int) -> Context:
        """Describe the window of a frame to `plan`."""
        reads_guides = self._reads_guides or bool(self._there(number).aovs)
        return Context(first_pass, radius, self._filter_guides is not None, reads_guides)

    def flow(self, start: int, end: int) -> Flow | None:
        """Flow between neighbouring frames; None at a gap or a cut."""
        earlier, later = sorted((start, end))
        if not (self.shot.has(earlier) and self.shot.has(later)):
            return None
        flows = self._cached("flows", (earlier, later), self._measure_flows)
        return flows.to_later if start < end else flows.to_earlier

    # Windows.

    def window(self, number: int, *, noisy: bool = False) -> Window:
        """Collect the window around a frame; `noisy` without the first pass.

        Raises ValueError or OSError if a frame cannot be read, or does not fit the others.
        """
        numbers = self.around(number)
        with_first_pass = not noisy and self.source is not None
        # Frame by frame, as a first pass may need the frame as read, which is dropped then.
        pairs = [(self.frame(n), self.denoised(n) if with_first_pass else None) for n in numbers]
        frames, denoised = zip(*pairs, strict=True)
        window = self._collect(number, numbers, frames, denoised if with_first_pass else None)
        if not with_first_pass:
            return window
        limits = [(self._limited(n), np.mean(self._fade(n, number, window.stages), dtype=np.float32)) for n in numbers]
        limited = (part and part._replace(exposure=part.exposure * fade) for part, fade in limits)
        window = replace(window, limited=tuple(limited), filtered_guides=self._filtered(numbers, window.stages))
        return window if "reflections" not in window.stages else self._with_reflections(window)

    def _with_reflections(self, window: Window) -> Window:
        """The window with the motion of reflections, which its first passes show."""
        pictures = window.first_pass
        if pictures is None or (middle := pictures[len(pictures) // 2]) is None:
            return window
        flows = [None if link is None else link.forward.vectors for link in window.links]
        with self.timings.stage("reflections"):
            motion = find_reflections(pictures, flows, measure_exposure(middle))
        return window if motion is None else replace(window, reflections=self.keeper.keep(motion))

    def window_of_results(self, number: int, results: dict[int, Array]) -> Window:
        """The window of a frame and its two neighbours, with these results (H, W, 3) in the place of a first pass."""
        numbers = self.around(number, 1)
        frames = tuple(self.frame(n) if n in results else None for n in numbers)
        return self._collect(number, numbers, frames, tuple(results.get(n) for n in numbers))

    def align(self, number: int, rows: slice | None = None) -> AlignedWindow:
        """Align the window around a frame (`hybrid.alignment.align.align`), keeping no frame but its own."""
        self.keep(self.around(number, self.support))
        return align(self.window(number), rows, timings=self.timings)

    @property
    def support(self) -> int:
        """Frames on each side of the centre that are prepared for a window."""
        return reach_of(self.source, self.radius)

    def _collect(
        self,
        number: int,
        numbers: list[int],
        frames: tuple[PreparedFrame | None, ...],
        denoised: tuple[Array | None, ...] | None,
    ) -> Window:
        expect_equal_layers(frames)  # before anything compares them
        middle = len(numbers) // 2
        plan = self.plan(numbers, self.context(number, denoised is not None, middle))
        forth: dict[int, Flow | None] = {}
        back: dict[int, Flow | None] = {}
        samples, own_samples = {number: 1.0}, {number: 1.0}
        for side in (numbers[middle + 1 :], numbers[:middle][::-1]):
            before = number
            for n in side:
                forth[n] = self._composed(forth, number, before, n)
                back[n] = self._composed(back, number, before, n, reverse=True)
                samples[n] = samples[before] * self._samples_beside(before, n)
                # Squared: frames of fewer samples have lost the same detail, and their errors do not average out. By
                # the ratio itself one frame of 512 samples among frames of 8 lost 0.7 dB (`fast`).
                own_samples[n] = 0.0 if self._repeats(before, n) else min(samples[n], 1.0) ** 2
                before = n
        links = tuple(_link(forth.get(n), back.get(n)) for n in numbers)
        steps = [self._cache.get(("flows", pair)) for pair in pairwise(numbers)]
        refined = [share for step in steps if step is not None for share in cast(PairFlows, step).refined]
        fades = [self._fade(n, number, plan.stages) for n in numbers]
        centre = self._there(number)
        frames = tuple(
            frame if frame is None or fade == NO_FADE else self.keeper.keep(relit(frame, fade, centre))
            for frame, fade in zip(frames, fades, strict=True)
        )
        denoised = denoised and tuple(
            picture if picture is None or fade == NO_FADE else self.keeper.keep(picture * np.array(fade, np.float32))
            for picture, fade in zip(denoised, fades, strict=True)
        )
        noise = least_outline_noise(self.measurements(numbers)[1]) or (0.0, 0.0)
        return Window(
            frames,
            links,
            denoised,
            plan.stages,
            tuple(np.float32(own_samples[n]) for n in numbers),
            tuple(refined),
            noise,
            release=self.keeper.release,
        )

    def _composed(
        self, flows: dict[int, Flow | None], centre: int, before: int, number: int, *, reverse: bool = False
    ) -> Flow | None:
        """Extend the flows between the centre and `before` to the next frame."""
        step = self.flow(number, before) if reverse else self.flow(before, number)
        if before == centre:
            return step
        with self.timings.stage("flow"):
            composed = compose_flows(step, flows[before]) if reverse else compose_flows(flows[before], step)
        return self.keeper.keep(composed)

    def _samples_beside(self, before: int, number: int) -> float:
        """Ratio of the samples of a frame to those of its neighbour; 1 where one of them is missing."""
        earlier, later = sorted((before, number))
        if not (self.shot.has(earlier) and self.shot.has(later)):
            return 1.0
        ratio = self._pair_facts(earlier, later).samples
        return ratio if before == earlier else 1 / ratio

    # How each value is made.

    def _cached(self, kind: str, frames: tuple[int, ...], make: Callable[..., Value]) -> Value:
        if (kind, frames) not in self._cache:
            self._cache[kind, frames] = self.keeper.keep(make(*frames))
        return cast(Value, self._cache[kind, frames])

    def _load(self, number: int) -> PreparedFrame:
        """Read and prepare a frame, and remove its fireflies."""
        rendered = self.rendered(number)
        assert rendered is not None
        if self.source is None or not self.source.reads_frame:
            self._cache.pop(("read", (number,)), None)
        if "fireflies" not in self.rules.allowed:
            return rendered

        def other(distance: int) -> int:
            return number + distance * self.shot.step

        def repeats_noise(distance: int) -> bool:
            pair = sorted((other(distance - 1 if distance > 0 else distance + 1), other(distance)))
            return max(self.same_noise(*pair), self._shared_residual(*pair)) > FIXED_NOISE_ABOVE

        return remove_fireflies(rendered, lambda k: self.rendered(other(k)), repeats_noise, self.timings)

    def rendered(self, number: int) -> PreparedFrame | None:
        """A frame with its fireflies; None where the shot has none."""
        return self._cached("rendered", (number,), self._without_filter) if self.shot.has(number) else None

    def _without_filter(self, number: int) -> PreparedFrame:
        """A frame, in which the pixel filter of its noise is undone if the stage runs."""
        frame, (correlation, alone) = self._raw(number), self._correlation(number)
        if correlation is None or not self.rules.whitens(correlation, alone):
            return frame
        with self.timings.stage("whiten"):
            return without_filter(frame, correlation)

    def _raw(self, number: int) -> PreparedFrame:
        return self._cached("raw", (number,), self._read)

    def _correlation(self, number: int) -> tuple[Correlation | None, float | None]:
        """The correlation of a frame's noise by its difference to the frame before; without one, to the one after.

        Light that moves adds to it, and detail of the light to that of `correlation_alone`: where the first shows a
        filter, the second has to show it too. Without both it is that of the frame alone, with its lower quartile.
        """
        if "whiten" not in self.rules.allowed:
            return None, None
        before, _, after = self.around(number, 1)
        found: Correlation | None = None
        for pair in ((before, number), (number, after)):
            if found is None and all(map(self.shot.has, pair)):
                found = self._cached("correlation", pair, self._measure_correlation)
        if found is not None and not self.rules.whitens(found):
            return found, None
        alone = self._cached("correlation alone", (number,), self._measure_alone)
        if found is None:
            return (None, None) if alone is None else alone
        if alone is None:
            return found, None
        lesser = min(found, alone[0], key=near_correlation)
        return without_moving_light(found, alone[0]) if self.rules.whitens(lesser) else lesser, None

    def _measure_alone(self, number: int) -> tuple[Correlation, float] | None:
        frame = self._raw(number)
        with self.timings.stage("plan"):
            return correlation_alone(frame)

    def _measure_correlation(self, a: int, b: int) -> Correlation | None:
        try:
            first, second = self._raw(a), self._raw(b)
        except (ValueError, OSError):  # of the other frame, whose own turn it is to fail
            return None
        with self.timings.stage("plan"):
            return noise_correlation(first, second)

    def same_noise(self, a: int, b: int) -> float:
        """The share of the noise of two neighbouring frames, ascending, that is the same at equal pixels."""

        def measure(*pair: int) -> float | None:
            first, second = map(self.rendered, pair)
            return None if first is None or second is None else fixed_noise(first, second, moves=False)

        def search(*_: int) -> float:
            found = measure(a, b)
            # Slow motion reaches other pixels in more frames.
            for distance in range(2 * self.shot.step, (REACH + 2) * self.shot.step, self.shot.step):
                for pair in ((a, a + distance), (b - distance, b)):
                    if found is None:
                        with suppress(ValueError, OSError):  # of the other frame, whose own turn it is to fail
                            found = measure(*pair)
            return found or 0.0

        return self._cached("same noise", (a, b), search)

    def _shared_residual(self, a: int, b: int) -> float:
        """The share of the noise of two neighbouring frames that is the same, by the pictures in their files, or 0."""
        for number in (a, b):
            if ("residual", (number,)) not in self._cache:
                self._read(number)
        first, second = (cast(Array | None, self._cache["residual", (number,)]) for number in (a, b))
        return shared_residual(first, second)

    def _read(self, number: int) -> PreparedFrame:
        with self.timings.stage("read"):
            frame = self.shot.read(number)
        with self.timings.stage("prepare"):
            region = find_region(frame.color)
            frame = frame if region is None else mirror_region(frame, region)
            prepared = prepare(frame, demodulated="demodulate" in self.rules.allowed)
            if region is not None:
                inside = np.zeros_like(prepared.valid)
                inside[region] = prepared.valid[region]
                prepared = replace(prepared, unfiltered=replace(prepared.unfiltered, region=region), valid=inside)
            residual = None if frame.estimate is None else relative_residual(frame.color, frame.estimate)
            self._cache["residual", (number,)] = residual
        # A first pass reads no more of it.
        kept = ("number", "color", "albedo", "normal", "estimate", "source")
        read = Frame(**{name: getattr(frame, name) for name in kept})
        prepared, self._cache["read", (number,)] = self.keeper.keep((prepared, read))  # they share layers
        return prepared

    def _small(self, number: int) -> SmallFrame:
        return self._cached("small", (number,), lambda n: shrink(self._there(n)))

    def _facts(self, number: int) -> FrameFacts:
        frame = self._there(number)

        def measure(n: int) -> FrameFacts:
            correlation, alone = self._correlation(n)
            with self.timings.stage("plan"):
                facts = measure_frame(frame, self._small(n))
                return replace(facts, noise_correlation=correlation, noise_correlation_alone=alone)

        return self._cached("frame facts", (number,), measure)

    def _pair_facts(self, a: int, b: int) -> PairFacts:
        first, second = self._there(a), self._there(b)

        def measure(*_: int) -> PairFacts:
            with self.timings.stage("plan"):
                facts = measure_pair(first, second, (self._small(a), self._small(b)))
            fixed = self.same_noise(a, b) if facts.fixed_noise is None else facts.fixed_noise
            return replace(facts, fixed_noise=fixed, shared_noise=self._shared_residual(a, b))

        return self._cached("pair facts", (a, b), measure)

    def _filtered(self, numbers: Sequence[int], stages: Collection[str]) -> tuple[dict[str, Array] | None, ...] | None:
        """The filtered guides of frames, (H, W, 3) in half precision; None without the stage, or the filter."""
        run = self._filter_guides
        if run is None or "clean-guides" not in stages:
            return None

        def make(number: int) -> dict[str, Array] | None:
            frame = self.frame(number)
            given = {} if frame is None else {"albedo": frame.albedo, "normal": frame.normal}
            guides = {name: guide for name, guide in given.items() if guide is not None}
            self.keeper.trim()
            with self.timings.stage("clean-guides"):
                return {n: g.astype(np.float16) for n, g in run(guides).items()} if guides else None

        filtered = tuple(self._cached("filtered guides", (n,), make) for n in numbers)
        return None if filtered[len(filtered) // 2] is None else filtered

    def _limited(self, number: int) -> Limited | None:
        """The light that the limit of residuals takes from a frame; None if that is little, or without a first pass."""
        frame, denoised = self.frame(number), self.denoised(number)
        if frame is None or denoised is None:
            return None

        def measure(_: int) -> Limited | None:
            with self.timings.stage("plan"):
                albedo = frame.albedo if frame.demodulated else None
                return measure_limited(frame.irradiance, denoised, albedo, frame.as_rendered.exposure)

        return self._cached("limited", (number,), measure)

    def _repeats(self, a: int, b: int) -> bool:
        """Whether one of two neighbouring frames is the other once more."""
        first, second = sorted((a, b))
        return self.shot.has(first) and self.shot.has(second) and self._pair_facts(first, second).repeated

    def _fade(self, number: int, centre: int, stages: Collection[str]) -> Fade:
        """Factors of light from a frame of a window to its centre, with the stage "fade"; else 1."""
        if "fade" not in stages:
            return NO_FADE
        first, last = sorted((number, centre))
        pairs = self.measurements(range(first, last + 1, self.shot.step))[1]
        red, green, blue = (math.prod(pair.fade[c] for pair in pairs) for c in range(3))
        fade = (red, green, blue) if number < centre else inverse((red, green, blue))
        return fade if min(fade) > FAINT and max(fade) < 1 / FAINT else NO_FADE

    def _measure_flows(self, earlier: int, later: int) -> PairFlows:
        # Windows of noisy frames, of which some first passes are made, have the same flows.
        denoised = self.source is not None and not self.source.from_noisy
        plan = self.plan([earlier, later], DENOISED if denoised else NOISY)
        facts = self._pair_facts(earlier, later)
        if facts.cut:
            return PairFlows(None, None)
        stages = plan.stages - {"warp"} if facts.repeated else plan.stages
        first, fade = self._there(earlier), self._fade(later, earlier, stages)
        second = self._there(later)
        second = second if fade == NO_FADE else scaled(second, fade)
        with self.timings.stage("flow"):
            return measure_flows(first, second, stages, self._refine)

    def _there(self, number: int) -> PreparedFrame:
        frame = self.frame(number)
        assert frame is not None
        return frame


def reach_of(first_pass: FirstPass | None, radius: int) -> int:
    """Count the frames on each side of the centre that a window of this radius and its first pass are made of."""
    return radius if first_pass is None else first_pass.reach(radius)


def kept_planes(
    shot: Shot, stages: Collection[str], first_pass: FirstPass | None, radius: int, *, filters_guides: bool = False
) -> float:
    """Count the float32 planes that are kept while windows slide: frames, flows and results."""
    layers = shot.layers(shot.numbers[0])
    guides = 1.5 * ((layers.albedo is not None) + (layers.normal is not None))  # in half precision
    filtered = guides if filters_guides and "clean-guides" in stages else 0.0
    support = reach_of(first_pass, radius)
    # Fireflies are looked for in frames beyond the window, whose noise is compared with that of the next one.
    beyond = (REACH if "fireflies" in stages else 0) + ("whiten" in stages)
    frames = min(2 * support + 1 + beyond, len(shot.files))
    results = 2 if "stabilize" in stages else 1
    # With the neighbours' samples, trust, drift and excess; of a third result the color is left.
    written = 3 + layers.aov_channels + 10
    pictures = results * written + 4 * (results - 1)
    return frames * (prepared_planes(layers) + filtered) + _flow_planes(layers, stages, frames, radius) + pictures


def _flow_planes(layers: Layers, stages: Collection[str], frames: int, radius: int) -> float:
    """Count the planes of flows: two of vectors, and a byte of validity, for each pair and each composed flow."""
    if "warp" not in stages:
        return 0.0
    kept = can_refine(stages) or layers.one_way
    steps = 2 * (frames - 1) if kept else 0  # the renderer's own are kept with the frames
    composed = 2 * (radius + 1) * max(radius - 1, 0)
    reflections = 4.0 if "reflections" in stages else 0.0  # the motion of a window, and that of its result
    return (2 + 0.25) * (composed + steps) + reflections


def can_refine(stages: Collection[str]) -> bool:
    """Whether TV-L1 may run."""
    return bool({"refine", "dense-flow"} & {*stages})


def _link(forward: Flow | None, backward: Flow | None) -> Link | None:
    """Both flows, or None where one is missing."""
    return None if forward is None or backward is None else Link(forward, backward)


def plan_shot(
    shot: Frames,
    rules: Rules | None = None,
    *,
    context: Context = DENOISED,
    advance: Callable[[], object] = lambda: None,
) -> Plan:
    """Plan every frame of a shot: each decision has the figure that calls for it most, and the frames where it runs."""
    stream = FrameStream(shot, rules or Rules(), radius=context.radius)
    plans = {}
    for number in shot.numbers:
        window = stream.around(number)
        stream.keep(window)
        plans[number] = stream.plan(window, context)
        advance()
    return merge(plans)
