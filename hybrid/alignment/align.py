"""Windows of frames, aligned to their centre.

`Aligner.align` is the hinge of the toolkit. It runs once per frame; the classical filters and the network
both read the `AlignedWindow` that it returns, and nothing after it warps again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flow.confidence import estimate_confidence, mix_centre
from flow.guide import GuidePair, make_guide, pair_guides
from flow.motion import compose_flow, forward_backward_error
from flow.selection import select_flow
from flow.tvl1 import dense_flow, refine_flow
from flow.warp import warp
from hybrid.alignment.measure import FrameFacts, PairFacts, SmallFrame, measure_frame, measure_pair, shrink
from hybrid.alignment.prepare import ALPHA, PreparedFrame, prepare, rendered_flow
from hybrid.alignment.transfer import demodulate, measure_exposure, remodulate
from hybrid.files.frames import Frame, Frames, Shot
from hybrid.files.layers import Layers
from hybrid.timing import Timings
from nlm.average import average, reject_outliers
from nlm.fireflies import find_fireflies, recurring, replace_fireflies
from nlm.gate import SHARE, color_gate
from nlm.variance import prefilter_guide, smooth_variance, variance_from_window

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Of estimates that agree in color, geometry can take away no more than all but this: outlines, whose albedo and normals
# are mixed anew in each frame, flicker most. Worth 0.1 to 0.2 dB, and 1 dB in time, at 16 to 32 samples; 1 and 2 dB
# at 6 to 10, where more (0.5) would be better yet.
AGREEING = 0.3
# How much of a frame's noise finished pictures may differ by. With the share that estimates have, 0.3, moving shadows
# were averaged; between 0.05 and 0.3 other shots differ by less than 0.05 dB, and by 0.5 dB in time.
FINISHED = 0.1
# With one seed for all frames a neighbour's noise is the centre's until the picture has moved so far, pixels: a
# bilinear sample half a pixel away still shares its noise, one and a half pixels away hardly.
SAME_NOISE, OTHER_NOISE = 0.5, 1.5
# Forward and back again a pixel that is seen in both frames misses its start by less than this, pixels.
HIDDEN = 3.0
# Rows around a part of a frame that its result depends on: 23 for all filters of the classical chain together, then
# what a trunk sees (112) around what the mean is restored in (72). Whole strips of the guided filter (64 rows): it then
# sums in the order it would in the frame.
MARGIN = 192
# Float32 planes that come and go while TV-L1 solves for a flow.
PLANES_REFINING = 45


@dataclass(frozen=True)
class AlignedWindow:
    """A window of 2k + 1 frames, every one warped to the centre; or some rows of it.

    What is measured over a whole frame (`exposure`, `moments`) was measured before: all that is done with a window
    afterwards is local, so that a part of it gives what the whole would have given there.

    Attributes
    ----------
    number : int
        The centre frame's number.
    color : (T, H, W, 3) array
        Irradiance. A missing frame holds the centre's, with confidence 0.
    guides : dict of str to (H, W, 3) array
        The centre's albedo and normal, those that there are.
    window_of : callable
        What gives `albedo` and `normal`.
    confidence : (T, H, W) array
        In [0, 1]; the centre's is 1 wherever its own color was finite.
    modulation : (H, W, 3) array
        What irradiance is multiplied by to give radiance: the centre's prefiltered albedo plus the floor, or 1.
    clean_albedo : (H, W, 3) array or None
        The centre's albedo, prefiltered where the plan has it.
    trust : (T, H, W) array
        Confidence by geometry alone, with which guides are prefiltered.
    rendered_variance : (H, W, 3) array or None
        Of the centre's `color`, where the file tells it.
    estimate : (T, H, W, 3) array or None
        The estimates that were asked for, aligned, as irradiance; the centre's where a frame shows nothing.
    picture : (h, W, 3) array or None
        The centre's estimate, radiance of the whole frame.
    beyond : callable or None
        What gives `residual`.
    aovs : dict of str to (T, H, W, C) array
        Further layers, warped and demodulated like the color, but for those with `tints`.
    repaired : int
        Pixels of the centre frame that were not finite.
    fireflies : int
        Single bright samples that were taken out of the centre frame before anything was made of it.
    removed : float
        Share of the centre's light that went with them, in [0, 1].
    outliers : int
        Pixels of the window, within `inner`, that were rejected as fireflies.
    exposure : float
        Brightness of the centre's irradiance.
    moments : (2, G + 1) array
        Mean and deviation over the whole frame of `guide`'s channels, and of the tone-mapped light.
    inner : slice
        The rows that were asked for. Those around them are there because the result depends on them.
    stages : frozenset of str
        The stages that made it.
    shares : dict of str to float
        On what share of the picture a stage ran that runs only where it is called for, in [0, 1].
    tints : dict of str to (H, W, 3) array
        The centre's color of those of `aovs` that are light without it.
    """

    number: int
    color: Array
    guides: dict[str, Array]
    window_of: Callable[[str], Array]
    confidence: Array
    modulation: Array
    clean_albedo: Array | None
    trust: Array
    rendered_variance: Array | None
    estimate: Array | None
    picture: Array | None
    beyond: Callable[[], Array] | None
    aovs: dict[str, Array]
    repaired: int
    fireflies: int
    removed: float
    outliers: int
    exposure: float
    moments: NDArray[np.float64]
    inner: slice
    stages: frozenset[str]
    shares: dict[str, float] = field(default_factory=dict)
    tints: dict[str, Array] = field(default_factory=dict)

    @property
    def albedo(self) -> Array | None:
        """That of all frames, aligned, (T, H, W, 3): each time that it is asked for, as few ask."""
        return self.window_of("albedo") if "albedo" in self.guides else None

    @property
    def normal(self) -> Array | None:
        """As `albedo`."""
        return self.window_of("normal") if "normal" in self.guides else None

    @cached_property
    def guide(self) -> Array | None:
        """The centre's albedo and normal, prefiltered, (H, W, G).

        Made when asked for: averages of estimates need none.
        """
        clean = [] if self.clean_albedo is None else [self.clean_albedo]
        if "normal" in self.guides:
            clean.append(_clean("normal", self.guides, self.window_of, self.trust, self.stages))
        return np.concatenate(clean, axis=-1) if clean else None

    @cached_property
    def variance(self) -> Array:
        """Of the centre's `color`, smoothed, (H, W, 3). Made when asked for, as the guide is."""
        if self.rendered_variance is None:
            return variance_from_window(self.color, self.confidence)
        return smooth_variance(self.rendered_variance)

    @cached_property
    def residual(self) -> Array | None:
        """What the noisy frames show beyond their estimates, aligned, (T, H, W, 3) irradiance, as `nlm.gather` asks.

        Noisy irradiance − estimate, each in its own place and divided by its own albedo, aligned to the nearest pixel.
        0 where a frame or its estimate is missing. Made when asked for.
        """
        return None if self.beyond is None else self.beyond()

    @property
    def centre(self) -> int:
        """Index of the centre frame."""
        return len(self.color) // 2

    def mixed(self, layer: Array) -> Array:
        """Mix the centre into the side frames of `layer` (T, H, W, C), in inverse proportion to confidence."""
        mixed = np.empty(layer.shape, np.float32)
        for warped, confidence, out in zip(layer, self.confidence, mixed, strict=True):
            mix_centre(warped, layer[self.centre], confidence, out)
        return mixed


class Estimates(Protocol):
    """Where the estimates of single frames come from; `hybrid.estimates` has the three kinds.

    Attributes
    ----------
    holds : int
        Bytes that the denoiser takes for itself while it works.
    files : Shot or None
        The finished sequence that they are read from, if they are.
    from_noisy : bool
        Whether they are made from windows of noisy frames, for which the gate needs the light of each
        (`PreparedFrame.light`); else the gate compares the estimates.
    """

    @property
    def holds(self) -> int:
        """Bytes that the denoiser takes for itself."""

    @property
    def files(self) -> Shot | None:
        """The finished sequence that they are read from, if they are."""

    @property
    def from_noisy(self) -> bool:
        """Whether frames are prepared with their light."""

    def reach(self, radius: int) -> int:
        """How many frames on each side of the centre are read, for windows of `radius` frames on each side."""

    def make(self, aligner: Aligner, numbers: Sequence[int]) -> None:
        """Load these frames (`Aligner.load`), and put an estimate of each that is there into `Aligner.estimates`."""


class Decide(Protocol):
    """What decides which stages run on a window (`hybrid.plan.Rules`).

    Attributes
    ----------
    allowed : frozenset of str
        The stages that may run at all.
    """

    @property
    def allowed(self) -> frozenset[str]:
        """The stages that may run at all."""

    def __call__(self, frames: Sequence[FrameFacts], pairs: Sequence[PairFacts], /) -> Collection[str]:
        """Say which stages frames call for that show this, with these pairs of neighbours among them."""


class Aligner:
    """Aligns the windows of one shot, keeping what neighbouring windows share while they slide.

    Parameters
    ----------
    shot : Frames
        Read lazily.
    stages : collection of str, or callable
        Which stages run, on all frames; or what decides it for a window by what its frames show (`hybrid.plan.Rules`).
    radius : int
        Frames on each side of the centre; the window has 2 · radius + 1.
    estimates : Estimates, optional
        Where the estimates of single frames come from (`hybrid.estimates`); each is made once.
    refine : callable
        What corrects vectors, `flow.tvl1.refine_flow` with other settings perhaps.
    timings : Timings, optional
        Where to count the stages "read", "prepare", "estimate", "flow", "warp", "confidence" and "steady".

    Attributes
    ----------
    hold : collection of int
        Frames that are not forgotten though the next window is without them.
    """

    def __init__(
        self,
        shot: Frames,
        stages: Collection[str] | Decide,
        *,
        radius: int = 2,
        estimates: Estimates | None = None,
        refine: Callable[..., Array] = refine_flow,
        timings: Timings | None = None,
    ) -> None:
        self.shot = shot
        self._decide = stages if callable(stages) else _Always(frozenset(stages))
        self.source = estimates
        self.radius = radius
        self.refine = refine
        self.timings = timings or Timings()
        self._read: dict[int, tuple[Frame | None, PreparedFrame]] = {}
        self._frames: dict[int, PreparedFrame] = {}
        self._small: dict[int, SmallFrame] = {}
        self.frame_facts: dict[int, FrameFacts] = {}
        self.pair_facts: dict[tuple[int, int], PairFacts] = {}
        self.estimates: dict[int, Array | None] = {}
        self._flows: dict[tuple[int, int], tuple[Array, Mask] | None] = {}
        self._refined: dict[tuple[int, int], float] = {}  # on what share of the picture
        self._chains: dict[tuple[int, int], tuple[Array, Mask]] = {}
        # Of neighbours, some rows of each: where one shows the other, and how far geometry trusts it. Their pictures
        # are compared after both windows.
        self._trusted: dict[tuple[int, int, int, int], tuple[Mask, Array]] = {}
        self.hold: Collection[int] = ()

    def align(self, number: int, rows: slice | None = None) -> AlignedWindow:
        """Align the window around frame `number`.

        Parameters
        ----------
        number : int
            A frame of the shot.
        rows : slice, optional
            Only these rows, and `MARGIN` around them; the whole frame without.

        Returns
        -------
        AlignedWindow
            The first and the last frames of a shot have neighbours of confidence 0.
        """
        numbers = self.around(number, self.radius)
        if self.source is None:
            self.load(numbers)
        else:
            self.source.make(self, numbers)
        # Those of this window serve the later ones, which see the same pairs from the other side.
        self._chains = {ab: chain for ab, chain in self._chains.items() if set(ab) <= set(numbers)}
        return self._assemble(number, numbers, rows, given=self.source is not None)

    @property
    def allowed(self) -> frozenset[str]:
        """The stages that may run on some window."""
        return self._decide.allowed

    def comparable(self, number: int) -> list[int]:
        """Numbers of a frame and those beside it that are there, and have an estimate where estimates are read."""
        given = None if self.source is None else self.source.files
        return [n for n in self.around(number, 1) if self.shot.has(n) and (given is None or given.has(n))]

    def align_pictures(
        self, number: int, pictures: Mapping[int, Array], rows: slice | None = None
    ) -> tuple[Array, Array, slice]:
        """Align finished pictures of a frame and of those beside it, which are loaded, and compare them.

        Parameters
        ----------
        number : int
            The centre.
        pictures : mapping of int to (H, W, 3) array
            Radiance, finite, by frame; the centre's among them.
        rows : slice, optional
            Only these rows, and `MARGIN` around them; the whole frame without.

        Returns
        -------
        window : (3, h, W, 3) array
            The pictures at the centre; its own where a frame shows or has none.
        confidence : (3, h, W) array
            As `AlignedWindow.confidence`, with the gate asked in any case.
        inner : slice
            The rows that were asked for.
        """
        numbers = self.around(number, 1)
        stages = self.stages_of(numbers) | (self._decide.allowed & {"gate"})
        outer, inner = self._around_rows(rows)
        centre = self._frames[number]
        layers = {name: layer[outer] for name, layer in _layers(centre).items() if not name.startswith("aov ")}
        _, confidence, seen = self._gather(number, numbers, layers, outer, stages, passing=layers)
        window = self._gather_estimates(number, numbers, seen, outer, pictures)
        with self.timings.stage("steady"):
            one = np.ones_like(layers["color"])
            light = window / remodulate(one, layers["albedo"]) if centre.demodulated else window
            exposure = self._lit(number).as_rendered.exposure
            noisy = layers["color"]
            # Outlines are as geometry has them: finished ones are sharp, and their mean over frames is not. On the
            # bundled shot with its chrome that is worth 0.4 dB.
            confidence = _agree(confidence, seen, light, noisy, exposure, stages, agreeing=0.0, share=FINISHED)
        return window, confidence, inner

    def _lit(self, number: int) -> PreparedFrame:
        """Of the window around a frame the nearest one to it that shows anything."""
        there = [frame for n in self.around(number, self.radius) if (frame := self.frame(n)) is not None]
        return min(there, key=lambda frame: (not frame.valid.any(), abs(frame.number - number)))

    def align_noisy(self, number: int) -> AlignedWindow:
        """Align the window around a frame without estimates; all of its frames are loaded already."""
        return self._assemble(number, self.around(number, self.radius), None, given=False)

    def around(self, number: int, radius: int) -> list[int]:
        """Numbers of the window around a frame, ascending, whether or not these frames are there."""
        step = self.shot.step
        return list(range(number - radius * step, number + radius * step + 1, step))

    def load(self, numbers: Collection[int], seen: Callable[[Frame], None] = lambda frame: None) -> None:
        """Read and prepare these frames, where they are there, and forget all others.

        Parameters
        ----------
        numbers : collection of int
            Of the frames.
        seen : callable
            Called with each frame as it is read.
        """
        # What no window from here on needs is dropped, so that memory does not grow with the shot.
        kept = {*numbers, *self.hold}
        near = {n + k * self.shot.step for n in numbers for k in (-1, 0, 1)}
        self._read = {n: pair for n, pair in self._read.items() if n in near}
        self._frames = {n: frame for n, frame in self._frames.items() if n in kept}
        self._small = {n: small for n, small in self._small.items() if n in kept}
        self._trusted = {pair: known for pair, known in self._trusted.items() if pair[0] in kept}
        self._flows = {ab: flow for ab, flow in self._flows.items() if set(ab) <= set(self._frames)}
        self._refined = {ab: share for ab, share in self._refined.items() if ab in self._flows}
        self.estimates = {n: estimate for n, estimate in self.estimates.items() if n in kept}
        for n in numbers:
            if n not in self._frames and self.shot.has(n):
                frame, prepared = self._read_once(n)
                if "fireflies" in self._decide.allowed:
                    frame, prepared = self._without_fireflies(frame, prepared)
                self._frames[n] = prepared
                self._read[n] = None, self._read[n][1]
                if frame is not None:
                    seen(frame)
        # As they were before fireflies were taken out, frames are asked only by those after them.
        last = max(self._frames, default=0)
        self._read = {n: pair for n, pair in self._read.items() if n >= last}

    def stages_of(self, numbers: Sequence[int]) -> frozenset[str]:
        """Decide which stages these frames call for; they are loaded, where they are there."""
        if isinstance(self._decide, _Always):  # nothing has to be measured
            return self._decide.allowed
        return frozenset(self._decide(*self.facts_of(numbers)))

    def facts_of(self, numbers: Sequence[int]) -> tuple[list[FrameFacts], list[PairFacts]]:
        """Return what those of these frames show that are there, and their pairs of neighbours; they are loaded."""
        there = [n for n in numbers if n in self._frames]
        pairs = [(a, b) for a, b in pairwise(there) if b - a == self.shot.step]
        return [self._facts_of(n) for n in there], [self._facts_of_pair(a, b) for a, b in pairs]

    def _facts_of(self, number: int) -> FrameFacts:
        if number not in self.frame_facts:
            with self.timings.stage("plan"):
                self.frame_facts[number] = measure_frame(self._frames[number], self._shrunk(number))
        return self.frame_facts[number]

    def _facts_of_pair(self, a: int, b: int) -> PairFacts:
        if (a, b) not in self.pair_facts:
            with self.timings.stage("plan"):
                smalls = self._shrunk(a), self._shrunk(b)
                self.pair_facts[a, b] = measure_pair(self._frames[a], self._frames[b], smalls)
        return self.pair_facts[a, b]

    def _shrunk(self, number: int) -> SmallFrame:
        if number not in self._small:
            self._small[number] = shrink(self._frames[number])
        return self._small[number]

    def _read_once(self, number: int) -> tuple[Frame | None, PreparedFrame]:
        if number not in self._read:
            with self.timings.stage("read"):
                frame = self.shot.read(number)
            with self.timings.stage("prepare"):
                self._read[number] = frame, prepare(frame, demodulated="demodulate" in self._decide.allowed)
        return self._read[number]

    def _without_fireflies(self, frame: Frame | None, prepared: PreparedFrame) -> tuple[Frame | None, PreparedFrame]:
        """Take out the single bright samples that neither neighbour shows: before anything is made of the frame."""
        with self.timings.stage("prepare"):
            places = find_fireflies(prepared.irradiance)
        if not len(places):
            return frame, prepared
        # A lamp shines in every frame; noise, where there is much of it, now and then in two.
        known, everywhere = np.zeros(len(places), bool), np.ones(len(places), bool)
        for neighbour in (prepared.number - self.shot.step, prepared.number + self.shot.step):
            if self.shot.has(neighbour):
                _, there = self._read_once(neighbour)
                flow, valid = rendered_flow(prepared, there) or (None, None)
                shown = recurring(places, prepared.irradiance, there.irradiance, flow, valid)
                known, everywhere = known | shown, everywhere & shown
        lasting = places[known & everywhere]
        lamps = replace_fireflies(prepared.irradiance, lasting)[1] if len(lasting) else None
        places = places[~known]
        clean, replaced, _ = replace_fireflies(prepared.irradiance, places)
        rendered, where = prepared.mean, np.nonzero(replaced)
        taken = (where, prepared.irradiance[where]) if len(places) else None
        prepared = replace(prepared, irradiance=clean, fireflies=len(places), lamps=lamps, taken=taken)
        prepared = replace(prepared, burnt=max(rendered - prepared.mean, 0.0))
        return None if frame is None else replace(frame, color=prepared.radiance), prepared

    def frame(self, number: int) -> PreparedFrame | None:
        """Frame `number` of the window loaded last, or None where the shot has no such frame."""
        return self._frames.get(number)

    def flow(self, start: int, end: int) -> tuple[Array, Mask] | None:
        """Flow from frame `start` to frame `end`, chained over the frames between; None beyond a gap or a cut."""
        step = self.shot.step if end > start else -self.shot.step
        if end == start + step:
            return self._step(start, end)
        if (start, end) not in self._chains:
            first, last = self.flow(start, end - step), self._step(end - step, end)
            if first is None or last is None:
                return None
            with self.timings.stage("flow"):
                chain = compose_flow(first[0], last[0], first_valid=first[1], second_valid=last[1])
            self._chains[start, end] = chain
        return self._chains[start, end]

    def _step(self, a: int, b: int) -> tuple[Array, Mask] | None:
        """Flow between neighbouring frames, computed once."""
        if (a, b) not in self._flows:
            here, there = self.frame(a), self.frame(b)
            if here is None or there is None:
                return None
            with self.timings.stage("flow"):
                self._flows[a, b], self._flows[b, a] = self._measure_steps(here, there)
        return self._flows[a, b]

    def _measure_steps(
        self, here: PreparedFrame, there: PreparedFrame
    ) -> tuple[tuple[Array, Mask] | None, tuple[Array, Mask] | None]:
        """Flows between neighbouring frames, there and back."""
        # What a pair calls for is decided from the pair alone: its flow is the same in every window.
        numbers = sorted((here.number, there.number))
        stages = self.stages_of(numbers)
        shape = here.irradiance.shape[:2]
        if not isinstance(self._decide, _Always) and self._facts_of_pair(*numbers).cut:
            return None, None
        if "warp" not in stages:
            still = np.zeros((*shape, 2), np.float32), np.ones(shape, bool)
            return still, still
        dense = "dense-flow" in stages
        forth, back = (None, None) if dense else (rendered_flow(here, there), rendered_flow(there, here))
        if not dense and not ("refine" in stages and (forth or back)):
            return forth, back  # where there are none, something moves, and nobody is to say where to
        # Of the earlier frame, so that it is the same from whichever side the pair is seen.
        exposure = measure_exposure(min(here, there, key=lambda frame: frame.number).radiance)
        guides = pair_guides(*(make_guide(frame.radiance, frame.albedo, exposure=exposure) for frame in (here, there)))
        reverse = guides._replace(centre=guides.neighbour, neighbour=guides.centre)
        if dense:
            ones = np.ones(shape, bool)
            return (dense_flow(guides), ones), (dense_flow(reverse), ones)
        pair = here.number, there.number
        return self._correct(pair, guides, forth, back), self._correct(pair[::-1], reverse, back, forth)

    def _correct(
        self,
        pair: tuple[int, int],
        guides: GuidePair,
        given: tuple[Array, Mask] | None,
        back: tuple[Array, Mask] | None,
    ) -> tuple[Array, Mask] | None:
        """Correct the renderer's flow where the pictures say that it is wrong."""
        if given is None:
            return None
        flow, valid = given
        # Hidden in the other frame: whatever matches there is another surface.
        visible = None if back is None else forward_backward_error(flow, back[0]) < HIDDEN
        refined = self.refine(guides, flow)
        self._refined[pair] = float(np.mean((refined != flow).any(axis=-1)))
        return select_flow([flow, refined], guides, visible=visible)[0], valid

    def _assemble(self, number: int, numbers: list[int], rows: slice | None, *, given: bool) -> AlignedWindow:
        self._expect_alike(number, numbers)
        stages = self.stages_of(numbers)
        if given:
            # Estimates are compared in any case, for outlines: that their light is alike costs nothing to ask.
            stages |= self._decide.allowed & {"gate"}
        centre, (outer, inner) = self._frames[number], self._around_rows(rows)
        light = "gate" in stages and not given
        layers = {name: layer[outer] for name, layer in _layers(centre, light=light, alpha="alpha" in stages).items()}
        guides = {name: layer for name, layer in layers.items() if name in ("albedo", "normal")}
        window, confidence, seen = self._gather(number, numbers, layers, outer, stages, passing=guides)
        flows = [None if (link := self._link(number, n)) is None else link[0][0][outer] for n in numbers]
        frames = [self._frames.get(n) for n in numbers]
        window_of = partial(_warp_guide, guides, frames, flows, outer)
        estimates, beyond = None, None
        if given:
            estimates = self._gather_estimates(number, numbers, seen, outer, self.estimates)
            steps = [None if n == number else self.flow(number, n) for n in numbers]
            flows = [None if step is None else step[0][outer] for step in steps]
            there = [(self._frames.get(n), self.estimates.get(n)) for n in numbers]
            beyond = partial(_warp_residuals, there, flows, outer)
        with self.timings.stage("confidence"):
            aligned = self._finish(
                centre, window, guides, window_of, estimates, beyond, confidence, seen, inner, stages
            )
        return replace(aligned, tints={name: tint[outer] for name, tint in centre.tints.items()})

    def _around_rows(self, rows: slice | None) -> tuple[slice, slice]:
        """The rows of a frame that these depend on, and where these are among them; all without."""
        height = self.shot.shape[0]
        rows = slice(0, height) if rows is None else rows
        outer = slice(max(rows.start - MARGIN, 0), min(rows.stop + MARGIN, height))
        return outer, slice(rows.start - outer.start, rows.stop - outer.start)

    def _expect_alike(self, number: int, numbers: Sequence[int]) -> None:
        """Refuse a window of which one frame has a layer that another lacks: light divided by an albedo is no color."""
        centre = self._frames[number]
        for there in (self._frames[n] for n in numbers if n in self._frames):
            if different := sorted(_names(centre) ^ _names(there)):
                has, lacks = (there, centre) if different[0] in _names(there) else (centre, there)
                raise ValueError(
                    f"frame {lacks.number} has no {different[0]}, which frame {has.number} has, expected one in both"
                )

    def _gather(
        self,
        number: int,
        numbers: Sequence[int],
        layers: dict[str, Array],
        rows: slice,
        stages: frozenset[str],
        passing: Collection[str],
    ) -> tuple[dict[str, Array], Array, Array]:
        """Warp the neighbours' layers to these rows of the centre, whose own are given.

        Returns them but those that are `passing`, the confidence that geometry has in them, and what it could be at
        most: where they show anything.
        """
        shape = len(numbers), *layers["color"].shape[:2]
        window = {
            name: np.empty((*shape, layer.shape[-1]), np.float32)
            for name, layer in layers.items()
            if name not in passing
        }
        passed = {name: np.empty(layers[name].shape, np.float32) for name in passing}
        confidence, seen = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        for index, neighbour in enumerate(numbers):
            there, links = self.frame(neighbour), self._link(number, neighbour)
            if there is None or links is None:
                # The centre itself, or a frame that is missing.
                for name, kept in window.items():
                    kept[index] = layers[name]
                if neighbour == number:
                    confidence[index] = seen[index] = self._frames[number].valid[rows]
                continue
            with self.timings.stage("warp"):
                link, back = links
                flow, pair = link[0][rows], (number, neighbour, rows.start, rows.stop)
                known = None if window else self._trusted.pop(pair, None)
                if known is None:
                    warped = {name: kept[index] for name, kept in window.items()} | passed
                    measured = link[1][rows] & self._warp(there, flow, rows, warped)
                    known = measured, self._trust(layers, warped, flow, measured, back[0], rows.start)
                    if window and "steady" in self.allowed and abs(neighbour - number) == self.shot.step:
                        self._trusted[pair] = known
                novelty = _novelty(flow) if "fixed-noise" in stages else 1.0
                seen[index], confidence[index] = (novelty * part for part in known)
        return window, confidence, seen

    def _link(self, number: int, neighbour: int) -> tuple[tuple[Array, Mask], tuple[Array, Mask]] | None:
        """Flows to a neighbour and back; None for the centre itself, and where one of them is missing."""
        if neighbour == number:
            return None
        link, back = self.flow(number, neighbour), self.flow(neighbour, number)
        return None if link is None or back is None else (link, back)

    def _gather_estimates(
        self, number: int, numbers: list[int], seen: Array, rows: slice, given: Mapping[int, Array | None]
    ) -> Array:
        """Warp the estimates of a window to these rows; the centre's where a frame shows or has none: not `seen`."""
        alone = given[number]
        if alone is None:
            raise ValueError(f"frame {number} has no estimate, expected one like its neighbours")
        estimates = np.repeat(alone[None, rows], len(numbers), axis=0)
        for index, neighbour in enumerate(numbers):
            link = None if neighbour == number else self.flow(number, neighbour)
            if link is None:
                continue
            there = given.get(neighbour)
            if there is None:
                seen[index] = 0
                continue
            with self.timings.stage("warp"):
                # Estimates have no noise that interpolation could average, only detail to lose: bicubic is worth up to
                # 0.5 dB here.
                if link[0].any():
                    flow = link[0][rows]
                    warp(there, flow, interpolation="bicubic", first_row=rows.start, out=estimates[index])
                else:
                    estimates[index] = there[rows]
                np.copyto(estimates[index], alone[rows], where=seen[index, ..., None] == 0)
        return estimates

    def _warp(self, there: PreparedFrame, flow: Array, rows: slice, warped: dict[str, Array]) -> Mask:
        """Warp a neighbour's layers to these rows of the centre, into `warped`; say where they show its color."""
        layers = _layers(there, light="light" in warped, alpha=f"aov {ALPHA}" in warped)
        if not flow.any():
            for name, out in warped.items():
                out[...] = layers[name][rows]
            return there.valid[rows]
        for name, out in warped.items():
            _, inside = warp(layers[name], flow, first_row=rows.start, out=out)
        if there.valid.all():
            return inside
        # The share of finite color in the mix of each warped pixel: less than all of it is no measurement.
        share, _ = warp(there.valid.astype(np.float32), flow, first_row=rows.start)
        return np.asarray(inside & (share > 0.999))

    def _trust(
        self,
        centre: dict[str, Array],
        warped: dict[str, Array],
        flow: Array,
        measured: Mask,
        back: Array,
        first_row: int,
    ) -> Array:
        """Confidence in a warped neighbour, from geometry."""
        return estimate_confidence(
            flow,
            inside=measured,
            reverse=back if flow.any() or back.any() else None,
            albedo=centre.get("albedo"),
            warped_albedo=warped.get("albedo"),
            normal=centre.get("normal"),
            warped_normal=warped.get("normal"),
            first_row=first_row,
        )

    def _finish(
        self,
        centre: PreparedFrame,
        window: dict[str, Array],
        guides: dict[str, Array],
        window_of: Callable[[str], Array],
        estimates: Array | None,
        beyond: Callable[[], Array] | None,
        confidence: Array,
        seen: Array,
        inner: slice,
        stages: frozenset[str],
    ) -> AlignedWindow:
        color = window.pop("color")
        middle = len(color) // 2
        gone = confidence[middle] == 0
        if gone.any():
            # What the neighbours in space made of it is good for a pixel, not for a block: first those in time.
            pictures = [layer for name, layer in window.items() if name == "light" or name.startswith("aov ")]
            for layer in (color, *pictures, *([] if estimates is None else [estimates])):
                layer[middle][gone] = average(layer, confidence)[gone]
        lit = self._lit(centre.number)
        bright = lit.as_light if "light" in window else lit.as_rendered
        outliers = 0
        near = {*self.around(centre.number, self.radius)}
        refined = [share for pair, share in self._refined.items() if {*pair} <= near]
        if "outliers" in stages:
            color, rejected = reject_outliers(color, confidence)
            outliers = int(np.count_nonzero(rejected[:, inner]))
        trust = confidence
        clean = _clean("albedo", guides, window_of, trust, stages) if "albedo" in guides else None
        modulation = np.ones_like(color[0])
        if clean is not None and centre.demodulated:
            modulation = remodulate(modulation, clean)
        if estimates is not None:
            # By the centre's albedo and not by each frame's own, which may be noisy as the estimate is not.
            estimates /= modulation
            confidence = _agree(confidence, seen, estimates, color[middle], bright.exposure, stages)
        elif "gate" in stages:
            confidence = confidence * color_gate(window.pop("light"), color[middle], bright.exposure)
        return AlignedWindow(
            number=centre.number,
            color=color,
            guides=guides,
            window_of=window_of,
            confidence=confidence,
            modulation=modulation,
            clean_albedo=clean,
            trust=trust,
            rendered_variance=centre.variance,
            estimate=estimates,
            picture=self.estimates.get(centre.number),
            beyond=beyond,
            aovs={name.removeprefix("aov "): layer for name, layer in window.items() if name.startswith("aov ")},
            repaired=centre.repaired,
            outliers=outliers,
            fireflies=centre.fireflies,
            removed=centre.removed,
            exposure=bright.exposure,
            moments=bright.moments,
            inner=inner,
            stages=stages,
            shares={"refine": float(np.mean(refined))} if refined else {},
        )


def _agree(
    confidence: Array,
    seen: Array,
    light: Array,
    noisy: Array,
    exposure: float,
    stages: Collection[str],
    *,
    agreeing: float = AGREEING,
    share: float = SHARE,
) -> Array:
    """Confidence in aligned estimates, by geometry, by whether they show the same light, and by that alone."""
    gate = color_gate(light, noisy, exposure, share=share)
    floor = np.minimum(seen, agreeing) * gate
    return np.maximum(confidence * gate if "gate" in stages else confidence, floor) * (seen > 0)


def _warp_residuals(
    there: Sequence[tuple[PreparedFrame | None, Array | None]], flows: Sequence[Array | None], rows: slice
) -> Array:
    """See `AlignedWindow.residual`; a frame without a flow is the centre, or missing."""
    shape = next(
        frame.irradiance[rows].shape for frame, estimate in there if frame is not None and estimate is not None
    )
    residuals = np.empty((len(there), *shape), np.float32)
    for (frame, estimate), flow, out in zip(there, flows, residuals, strict=True):
        if frame is None or estimate is None:
            out[:] = 0
            continue
        own = demodulate(estimate, frame.albedo) if frame.demodulated and frame.albedo is not None else estimate
        left = frame.irradiance - own
        if flow is None or not flow.any():
            out[:] = left[rows]
        else:
            warp(left, flow, interpolation="nearest", first_row=rows.start, out=out)
    return residuals


def _warp_guide(
    centre: dict[str, Array],
    there: Sequence[PreparedFrame | None],
    flows: Sequence[Array | None],
    rows: slice,
    name: str,
) -> Array:
    """A guide of all frames, aligned to the centre's; that of the centre where a frame has no flow."""
    own = centre[name]
    window = np.empty((len(there), *own.shape), np.float32)
    for frame, flow, out in zip(there, flows, window, strict=True):
        if frame is None or flow is None:
            out[...] = own
        elif flow.any():
            warp(getattr(frame, name), flow, first_row=rows.start, out=out)
        else:
            out[...] = getattr(frame, name)[rows]
    return window


def _clean(
    name: str, guides: dict[str, Array], window_of: Callable[[str], Array], trust: Array, stages: Collection[str]
) -> Array:
    """The centre's guide of this name, prefiltered if the plan has it."""
    return prefilter_guide(window_of(name), trust) if "prefilter" in stages else guides[name]


@dataclass(frozen=True)
class _Always:
    """The same stages on all frames, whatever they show."""

    allowed: frozenset[str]

    def __call__(self, frames: Sequence[FrameFacts], pairs: Sequence[PairFacts], /) -> frozenset[str]:
        return self.allowed


def _novelty(flow: Array) -> Array:
    """How much of a neighbour's noise is its own where one seed makes the noise of all frames, in [0, 1]."""
    distance = np.hypot(flow[..., 0], flow[..., 1])
    return np.clip((distance - SAME_NOISE) / (OTHER_NOISE - SAME_NOISE), 0, 1)


def _names(frame: PreparedFrame) -> set[str]:
    """The layers that all frames of a window have, or none."""
    given = {"albedo": frame.albedo, "normal": frame.normal, ALPHA: frame.alpha, **frame.aovs}
    return {name for name, layer in given.items() if layer is not None}


def _layers(frame: PreparedFrame, *, light: bool = False, alpha: bool = False) -> dict[str, Array]:
    """All layers of a frame that are warped."""
    named = {
        "color": frame.irradiance,
        "light": frame.light if light else None,
        "albedo": frame.albedo,
        "normal": frame.normal,
        **{f"aov {name}": layer for name, layer in frame.aovs.items()},
        f"aov {ALPHA}": frame.alpha if alpha else None,
    }
    return {name: layer for name, layer in named.items() if layer is not None}


def planes_aligned(layers: Layers) -> float:
    """Count the float32 planes that each frame of an `AlignedWindow` of these layers takes, with its estimate."""
    guides = 3 * (layers.albedo is not None) + 3 * (layers.normal is not None)
    return 3 + 3 + guides + planes_written(layers) - 3 + 1


def planes_written(layers: Layers) -> float:
    """Count the float32 planes that are made of a window: the color, and what is filtered along."""
    aovs = sum(len(layer.channels) for layer in layers.aovs.values())
    return 3 + aovs + (layers.alpha is not None)


def planes_of_flows(layers: Layers, stages: Collection[str], frames: int, radius: int) -> float:
    """Count the float32 planes of the flows that an `Aligner` keeps.

    Parameters
    ----------
    layers : Layers
        Of the shot: whether they have vectors.
    stages : collection of str
        That may run.
    frames : int
        Over which windows slide.
    radius : int
        Of the windows.

    Returns
    -------
    float
        Planes of the size of a frame, of four bytes a pixel.
    """
    if "warp" not in stages:
        return 0.0
    made = can_refine(stages) or (layers.motion_convention is not None and not layers.motion_convention.pair)
    steps = 2 * (frames - 1) if made else 0  # the renderer's own are kept with the frames
    chains = 2 * (radius + 1) * max(radius - 1, 0)
    return (2 + 0.25) * (chains + steps)


def can_refine(stages: Collection[str]) -> bool:
    """Whether flow may be solved for."""
    return bool({"refine", "dense-flow"} & {*stages})
