"""Windows of frames, aligned to their centre.

`Aligner.align` is the hinge of the toolkit. It runs once per frame; the classical filters and the network
both read the `AlignedWindow` that it returns, and nothing after it warps again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flow.tvl1 import refine_flow
from flow.warp import warp
from hybrid.alignment.flows import Flows
from hybrid.alignment.loading import Decide, LoadedFrames
from hybrid.alignment.neighbour import layers_of, novelty_of, trust_geometry, trust_light, warp_layers
from hybrid.alignment.prepare import ALPHA, PreparedFrame
from hybrid.alignment.transfer import remodulate
from hybrid.alignment.window import AlignedWindow, clean_guide, warp_layer, warp_residuals
from hybrid.files.frame import Frame, Frames
from hybrid.files.shots import Shot
from hybrid.runtime.timing import Timings
from nlm.average import average, reject_outliers
from nlm.drift import drift_weights, pull_to_centre
from nlm.gate import color_gate, color_gates
from nlm.relight import relight
from nlm.samples import average_sides

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

# How much of a frame's noise finished pictures may differ by: up to the first as they are, up to the second without
# their mean difference (`nlm.relight`), where the light stands still as far as samples tell (`nlm.drift`). The second
# alone is steadier by 0.2 dB, and averages moving shadows: 2.7 dB of such a shot.
FINISHED = 0.1, 0.5
# How much more finished pictures lose by a drift than estimates do, whose errors are several times as large: 20 and 100
# differ by 0.05 dB, and by 0.25 dB where shadows move.
DRIFTED = 100
# Where the light of a frame drifts nearly everywhere, samples tell it only in places, and the rest drifts too: finished
# pictures count in full where two fifths of the picture stand still, and not at all where less than a fifth does. Of
# nine validation shots one has such light, and gains 0.1 dB; one loses 0.04, the others nothing.
STANDING = 0.2, 0.4
# Rows around a part of a frame that its result depends on: 23 for all filters of the classical chain together, or what
# a trunk sees (112) of what drift is measured in (55) and the gate compares (11). The mean of `gathered` (72) reaches
# beyond, for 2e-7 of the light. Whole strips of the guided filter (64 rows): it then sums in the order it would in the
# frame.
MARGIN = 192


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
        self.frames = LoadedFrames(shot, stages, timings)
        self.flows = Flows(self.frames, refine)
        self.shot = shot
        self.source = estimates
        self.radius = radius
        self.timings = self.frames.timings
        self.estimates: dict[int, Array | None] = {}
        # Of neighbours, some rows of each: where one shows the other, and how far geometry trusts it. Their pictures
        # are compared after both windows.
        self._trusted: dict[tuple[int, int, int, int], tuple[Mask, Array]] = {}
        # Of frames whose pictures are compared later: the weight that the next ones' estimates have by their drift.
        self._drift: dict[int, Array] = {}
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
        numbers = self.frames.around(number, self.radius)
        if self.source is None:
            self.load(numbers)
        else:
            self.source.make(self, numbers)
        self.flows.forget_chains(numbers)
        aligned = self._assemble(number, numbers, rows, given=self.source is not None)
        if rows is None or rows.stop == self.shot.shape[0]:
            # After the last rows: made again for the windows that they serve, and not kept while this one is denoised.
            self.flows.forget_chains(())
        return aligned

    def align_noisy(self, number: int) -> AlignedWindow:
        """Align the window around a frame without estimates; all of its frames are loaded already."""
        return self._assemble(number, self.frames.around(number, self.radius), None, given=False)

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
            The pictures at the centre, in its light; its own where a frame shows or has none.
        confidence : (3, h, W) array
            As `AlignedWindow.confidence`, with the gate asked in any case.
        inner : slice
            The rows that were asked for.
        """
        numbers = self.frames.around(number, 1)
        stages = self.frames.stages_of(numbers) | (self.frames.allowed & {"gate"})
        outer, inner = self._around_rows(rows)
        centre = self.frames[number]
        guides = {name: layer[outer] for name, layer in layers_of(centre).items() if name in ("albedo", "normal")}
        _, confidence, seen = self._gather(number, numbers, guides, outer, stages, passing=guides, again=True)
        window = self._gather_estimates(number, numbers, seen, outer, pictures)
        with self.timings.stage("steady"):
            noisy = centre.irradiance[outer]
            light = window / remodulate(np.ones_like(noisy), guides["albedo"]) if centre.demodulated else window
            exposure = self._lit(number).as_rendered.exposure
            # Outlines are as geometry has them: finished ones are sharp, and their mean over frames is not. On the
            # bundled shot with its chrome that is worth 0.4 dB.
            gates = color_gates(light, noisy, exposure, FINISHED)
            alike, confidence = (trust_light(confidence, seen, gate, stages, agreeing=0.0) for gate in gates)
            still, enough = self._stillness(number)
            still = still[outer]
            confidence = alike + still * (confidence - alike)
            relight(window, alike, confidence, exposure, first_row=outer.start)
            confidence[[0, 2]] *= enough * (1 + still) / 2
        return window, confidence, inner

    def comparable(self, number: int) -> list[int]:
        """Numbers of a frame and those beside it that are there, and have an estimate where estimates are read."""
        given = None if self.source is None else self.source.files
        return [n for n in self.frames.around(number, 1) if self.shot.has(n) and (given is None or given.has(n))]

    def load(self, numbers: Collection[int], seen: Callable[[Frame], None] = lambda frame: None) -> None:
        """Read and prepare these frames, where they are there, and forget all others.

        Parameters
        ----------
        numbers : collection of int
            Of the frames.
        seen : callable
            Called with each frame as it is read.
        """
        kept = {*numbers, *self.hold}
        self._trusted = {pair: known for pair, known in self._trusted.items() if pair[0] in kept}
        self.estimates = {n: estimate for n, estimate in self.estimates.items() if n in kept}
        self._drift = {n: weight for n, weight in self._drift.items() if n in kept}
        self.flows.forget(kept)
        self.frames.load(numbers, seen, self.hold)

    def _assemble(self, number: int, numbers: list[int], rows: slice | None, *, given: bool) -> AlignedWindow:
        self._expect_alike(number, numbers)
        stages = self.frames.stages_of(numbers)
        if given:
            # Estimates are compared in any case, for outlines: that their light is alike costs nothing to ask.
            stages |= self.frames.allowed & {"gate"}
            stages -= {"outliers"}  # what samples show beyond estimates is held where it is averaged
        if not given or self.radius < 2:
            stages -= {"drift"}  # there is nothing to hold against the samples
        centre, (outer, inner) = self.frames[number], self._around_rows(rows)
        light = "gate" in stages and not given
        layers = {name: layer[outer] for name, layer in layers_of(centre, light=light, alpha="alpha" in stages).items()}
        guides = {name: layer for name, layer in layers.items() if name in ("albedo", "normal")}
        # Beside estimates the colors of all frames are asked for by few: they are warped when they are.
        own = layers.pop("color") if given else layers["color"]
        window, confidence, seen = self._gather(number, numbers, layers, outer, stages, passing=guides)
        flows = [None if (link := self._link(number, n)) is None else link[0][0][outer] for n in numbers]
        frames = [self.frames.get(n) for n in numbers]
        window_of = partial(warp_layer, {**guides, "irradiance": own}, frames, flows, outer)
        # Before the estimates, whose place in memory the guide of all frames has until then.
        with self.timings.stage("confidence"):
            clean = clean_guide("albedo", guides, window_of, confidence, stages) if "albedo" in guides else None
        estimates, beyond = None, None
        if given:
            estimates = self._gather_estimates(number, numbers, seen, outer, self.estimates)
            steps = [None if n == number else self.flows.between(number, n) for n in numbers]
            flows = [None if step is None else step[0][outer] for step in steps]
            there = [(self.frames.get(n), self.estimates.get(n)) for n in numbers]
            beyond = partial(warp_residuals, there, flows, outer)
        with self.timings.stage("confidence"):
            aligned = self._finish(
                centre, own, window, guides, clean, window_of, estimates, beyond, confidence, seen, inner, stages
            )
            sides = None
            if "samples" in stages:
                # Before the estimates are pulled to the centre's: the samples stay what they are.
                if beyond is None or estimates is None:
                    sides = average_sides(aligned.color, None, aligned.confidence, aligned.trust, aligned.modulation)
                else:
                    residual = beyond()
                    aligned = replace(aligned, beyond=lambda: residual)
                    sides = average_sides(estimates, residual, aligned.confidence, aligned.trust, aligned.modulation)
            if estimates is not None and "drift" in stages:
                confidence = aligned.confidence
                weight = drift_weights(estimates, aligned.own, confidence, aligned.exposure, first_row=outer.start)
                pull_to_centre(estimates, confidence, weight)
                if "steady" in self.frames.allowed and self._shows_drift(number):
                    whole = self._drift.setdefault(number, np.ones(self.shot.shape, np.float32))
                    whole[outer][inner] = weight[aligned.centre + 1][inner]
        pass_colors = {name: tint[outer] for name, tint in centre.pass_colors.items()}
        return replace(aligned, pass_colors=pass_colors, passes=centre.passes, sides=sides)

    def _around_rows(self, rows: slice | None) -> tuple[slice, slice]:
        """The rows of a frame that these depend on, and where these are among them; all without."""
        height = self.shot.shape[0]
        rows = slice(0, height) if rows is None else rows
        outer = slice(max(rows.start - MARGIN, 0), min(rows.stop + MARGIN, height))
        return outer, slice(rows.start - outer.start, rows.stop - outer.start)

    def _shows_drift(self, number: int) -> bool:
        """Whether two frames on one side show what a frame shows: `nlm.drift` compares them."""
        first, second, _, fourth, fifth = (self._link(number, n) for n in self.frames.around(number, 2))
        return None not in (first, second) or None not in (fourth, fifth)

    def _stillness(self, number: int) -> tuple[Array, np.float32]:
        """How far the light of a frame stands still, (H, W) in [0, 1], and whether enough of it does, in [0, 1].

        Where nothing can tell, 0 and 1.
        """
        if number not in self._drift:
            return np.zeros(self.shot.shape, np.float32), np.float32(1)
        still = np.reciprocal(self._drift[number])  # 1 / (1 + DRIFTED (1 / w − 1)), in place: frames are large
        still *= np.float32(DRIFTED)
        still += np.float32(1 - DRIFTED)
        np.reciprocal(still, out=still)
        least, enough = STANDING
        t = min(max((float(still.mean()) - least) / (enough - least), 0.0), 1.0)
        return still, np.float32(t * t * (3 - 2 * t))

    def _lit(self, number: int) -> PreparedFrame:
        """Of the window around a frame the nearest one to it that shows anything."""
        there = [frame for n in self.frames.around(number, self.radius) if (frame := self.frames.get(n)) is not None]
        return min(there, key=lambda frame: (not frame.valid.any(), abs(frame.number - number)))

    def _expect_alike(self, number: int, numbers: Sequence[int]) -> None:
        """Refuse a window of which one frame has a layer that another lacks: light divided by an albedo is no color."""
        centre = self.frames[number]
        for there in (frame for n in numbers if (frame := self.frames.get(n)) is not None):
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
        again: bool = False,
    ) -> tuple[dict[str, Array], Array, Array]:
        """Warp the neighbours' layers to these rows of the centre, whose own are given.

        Returns them but those that are `passing`, the confidence that geometry has in them, and what it could be at
        most: where they show anything. That is kept of the frames beside the centre, for when it is asked for `again`.
        """
        shape = len(numbers), rows.stop - rows.start, self.shot.shape[1]
        window = {
            name: np.empty((*shape, layer.shape[-1]), np.float32)
            for name, layer in layers.items()
            if name not in passing
        }
        passed = {name: np.empty(layers[name].shape, np.float32) for name in passing}
        confidence, seen = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        for index, neighbour in enumerate(numbers):
            there, links = self.frames.get(neighbour), self._link(number, neighbour)
            if there is None or links is None:
                # The centre itself, or a frame that is missing.
                for name, kept in window.items():
                    kept[index] = layers[name]
                if neighbour == number:
                    confidence[index] = seen[index] = self.frames[number].valid[rows]
                continue
            with self.timings.stage("warp"):
                link, back = links
                flow, pair = link[0][rows], (number, neighbour, rows.start, rows.stop)
                known = self._trusted.pop(pair, None) if again else None
                if known is None:
                    warped = {name: kept[index] for name, kept in window.items()} | passed
                    measured = link[1][rows] & warp_layers(there, flow, rows, warped)
                    known = measured, trust_geometry(layers, warped, flow, measured, back[0], rows.start)
                    if not again and "steady" in self.frames.allowed and abs(neighbour - number) == self.shot.step:
                        self._trusted[pair] = known
                nearer = neighbour + (self.shot.step if neighbour < number else -self.shot.step)
                if self.frames.repeated(neighbour, nearer):  # its samples are there already
                    novelty: Array | np.float32 = np.float32(0)
                else:
                    novelty = novelty_of(flow) if "fixed-noise" in stages else np.float32(1)
                seen[index], confidence[index] = (novelty * part for part in known)
        return window, confidence, seen

    def _link(self, number: int, neighbour: int) -> tuple[tuple[Array, Mask], tuple[Array, Mask]] | None:
        """Flows to a neighbour and back; None for the centre itself, and where one of them is missing."""
        if neighbour == number:
            return None
        link, back = self.flows.between(number, neighbour), self.flows.between(neighbour, number)
        return None if link is None or back is None else (link, back)

    def _gather_estimates(
        self, number: int, numbers: list[int], seen: Array, rows: slice, given: Mapping[int, Array | None]
    ) -> Array:
        """Warp the estimates of a window to these rows; the centre's where a frame shows or has none: not `seen`."""
        alone = given[number]
        if alone is None:
            raise ValueError(f"frame {number} has no estimate, expected one like its neighbours")
        estimates = np.empty((len(numbers), *alone[rows].shape), np.float32)
        for index, neighbour in enumerate(numbers):
            link = None if neighbour == number else self.flows.between(number, neighbour)
            there = None if link is None else given.get(neighbour)
            if link is None or there is None:
                estimates[index] = alone[rows]
                if link is not None:
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

    def _finish(
        self,
        centre: PreparedFrame,
        own: Array,
        window: dict[str, Array],
        guides: dict[str, Array],
        clean: Array | None,
        window_of: Callable[[str], Array],
        estimates: Array | None,
        beyond: Callable[[], Array] | None,
        confidence: Array,
        seen: Array,
        inner: slice,
        stages: frozenset[str],
    ) -> AlignedWindow:
        color = window.pop("color", None)
        middle = len(confidence) // 2
        gone = confidence[middle] == 0
        if gone.any():
            # What the neighbours in space made of it is good for a pixel, not for a block: first those in time.
            own = own.copy()
            own[gone] = average(window_of("irradiance") if color is None else color, confidence)[gone]
            pictures = [layer for name, layer in window.items() if name == "light" or name.startswith("aov ")]
            for layer in (*pictures, *([] if estimates is None else [estimates])):
                layer[middle][gone] = average(layer, confidence)[gone]
        if color is not None:
            color[middle] = own
        lit = self._lit(centre.number)
        bright = lit.as_light if "light" in window else lit.as_rendered
        outliers = 0
        near = {*self.frames.around(centre.number, self.radius)}
        refined = [share for pair, share in self.flows.refined.items() if {*pair} <= near]
        if color is not None and "outliers" in stages:
            color, rejected = reject_outliers(color, confidence)
            own, outliers = color[middle], int(np.count_nonzero(rejected[:, inner]))
        trust = confidence
        modulation = np.ones_like(own)
        if clean is not None and centre.demodulated:
            modulation = remodulate(modulation, clean)
        if estimates is not None:
            # By the centre's albedo and not by each frame's own, which may be noisy as the estimate is not.
            estimates /= modulation
            confidence = trust_light(confidence, seen, color_gate(estimates, own, bright.exposure), stages)
        elif "gate" in stages:
            confidence = confidence * color_gate(window.pop("light"), own, bright.exposure)
        return AlignedWindow(
            number=centre.number,
            own=own,
            aligned_color=color,
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


def _names(frame: PreparedFrame) -> set[str]:
    """The layers that all frames of a window have, or none."""
    given = {"albedo": frame.albedo, "normal": frame.normal, ALPHA: frame.alpha, **frame.aovs}
    return {name for name, layer in given.items() if layer is not None}
