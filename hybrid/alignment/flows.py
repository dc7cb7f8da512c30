"""Where the pixels of one frame are in another: flows between neighbours, corrected, and chained over those between."""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np
from numpy.typing import NDArray

from flow.guide import GuidePair, make_guide, pair_guides
from flow.motion import compose_flow, forward_backward_error
from flow.selection import select_flow
from flow.tvl1 import dense_flow
from hybrid.alignment.loading import LoadedFrames
from hybrid.alignment.prepare import PreparedFrame, rendered_flow
from hybrid.alignment.transfer import measure_exposure

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Forward and back again a pixel that is seen in both frames misses its start by less than this, pixels.
HIDDEN = 3.0


class Flows:
    """The flows between the frames that are loaded, each made once for all windows that see it.

    Parameters
    ----------
    frames : LoadedFrames
        Between which they are.
    refine : callable
        What corrects vectors, as `flow.tvl1.refine_flow` does.

    Attributes
    ----------
    refined : dict of (int, int) to float
        Of pairs whose vectors were corrected: on what share of the picture, in [0, 1].
    """

    def __init__(self, frames: LoadedFrames, refine: Callable[..., Array]) -> None:
        self.frames = frames
        self.refine = refine
        self._steps: dict[tuple[int, int], tuple[Array, Mask] | None] = {}
        self.refined: dict[tuple[int, int], float] = {}
        self._chains: dict[tuple[int, int], tuple[Array, Mask]] = {}

    def between(self, start: int, end: int) -> tuple[Array, Mask] | None:
        """Flow from frame `start` to frame `end`, chained over the frames between; None beyond a gap or a cut."""
        step = self.frames.shot.step if end > start else -self.frames.shot.step
        if end == start + step:
            return self._step(start, end)
        if (start, end) not in self._chains:
            first, last = self.between(start, end - step), self._step(end - step, end)
            if first is None or last is None:
                return None
            with self.frames.timings.stage("flow"):
                chain = compose_flow(first[0], last[0], first_valid=first[1], second_valid=last[1])
            self._chains[start, end] = chain
        return self._chains[start, end]

    def forget(self, kept: Collection[int]) -> None:
        """Forget the flows of all frames but these."""
        self._steps = {ab: flow for ab, flow in self._steps.items() if {*ab} <= {*kept}}
        self.refined = {ab: share for ab, share in self.refined.items() if ab in self._steps}

    def forget_chains(self, kept: Collection[int]) -> None:
        """Forget the flows over several frames but those within this window.

        They serve the later ones, which see the same pairs from the other side.
        """
        self._chains = {ab: chain for ab, chain in self._chains.items() if {*ab} <= {*kept}}

    def _step(self, a: int, b: int) -> tuple[Array, Mask] | None:
        """Flow between neighbouring frames, computed once."""
        if (a, b) not in self._steps:
            here, there = self.frames.get(a), self.frames.get(b)
            if here is None or there is None:
                return None
            with self.frames.timings.stage("flow"):
                self._steps[a, b], self._steps[b, a] = self._measure_steps(here, there)
        return self._steps[a, b]

    def _measure_steps(
        self, here: PreparedFrame, there: PreparedFrame
    ) -> tuple[tuple[Array, Mask] | None, tuple[Array, Mask] | None]:
        """Flows between neighbouring frames, there and back."""
        # What a pair calls for is decided from the pair alone: its flow is the same in every window.
        numbers = sorted((here.number, there.number))
        stages = self.frames.stages_of(numbers)
        shape = here.irradiance.shape[:2]
        if self.frames.cut(*numbers):
            return None, None
        if "warp" not in stages or self.frames.repeated(*numbers):
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
        self.refined[pair] = float(np.mean((refined[..., 0] != flow[..., 0]) | (refined[..., 1] != flow[..., 1])))
        return select_flow([flow, refined], guides, visible=visible)[0], valid
