"""Flows between neighbouring frames: the renderer's, corrected or estimated by TV-L1, and their composition."""

from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np

from flow.guide import GuidePair, make_guide, pair_guides, tone_map
from flow.motion import compose_flow, forward_backward_error
from flow.selection import select_flow
from flow.tvl1 import dense_flow, rough_flow
from hybrid.alignment.prepare import PreparedFrame, rendered_flow
from hybrid.alignment.transfer import measure_exposure
from hybrid.files.frame import Array
from loops.parallel import Mask

# A pixel that is visible in both frames misses its start by less than this after its flow there and back, pixels.
HIDDEN = 3.0


class Flow(NamedTuple):
    """Where each pixel of a frame is in another one."""

    vectors: Array  # (H, W, 2): pixels, x and y
    valid: Mask  # (H, W): where they are defined


class Link(NamedTuple):
    """Flows from the centre of a window to a neighbour, and back."""

    forward: Flow
    backward: Flow


class PairFlows(NamedTuple):
    """Flows between two neighbouring frames."""

    # None where there is none
    to_later: Flow | None
    to_earlier: Flow | None
    # the mean share of the picture, in [0, 1], on which TV-L1 corrected the renderer's vectors; None where it did not
    # run
    refined: tuple[float, ...] = ()


def measure_flows(
    earlier: PreparedFrame, later: PreparedFrame, stages: Collection[str], refine: Callable[..., Array]
) -> PairFlows:
    """Find the flows between two neighbouring frames, by the pair's own stages; `refine` as `flow.tvl1.refine_flow`."""
    shape = earlier.irradiance.shape[:2]
    if "warp" not in stages:
        still = Flow(np.zeros((*shape, 2), np.float32), np.ones(shape, bool))
        return PairFlows(still, still)
    dense = "dense-flow" in stages
    forth, back = (None, None) if dense else (rendered_flow(earlier, later), rendered_flow(later, earlier))
    if not dense and not ("refine" in stages and (forth or back)):
        # Without vectors and without a search for them, the pair has no flow.
        return PairFlows(forth and Flow(*forth), back and Flow(*back))
    exposure = measure_exposure(earlier.radiance, later.radiance)
    guides = pair_guides(*(make_guide(frame.radiance, frame.albedo, exposure=exposure) for frame in (earlier, later)))
    reverse = guides._replace(centre=guides.neighbour, neighbour=guides.centre)
    if dense:
        ones = np.ones(shape, bool)
        return PairFlows(Flow(dense_flow(guides), ones), Flow(dense_flow(reverse), ones))
    corrected = _correct(guides, forth, back, refine), _correct(reverse, back, forth, refine)
    (to_later, first), (to_earlier, second) = corrected
    return PairFlows(to_later, to_earlier, (*first, *second))


def _correct(
    guides: GuidePair, given: tuple[Array, Mask] | None, back: tuple[Array, Mask] | None, refine: Callable[..., Array]
) -> tuple[Flow | None, tuple[float, ...]]:
    """Correct the renderer's flow where the pictures contradict it; with the corrected share of the picture."""
    if given is None:
        return None, ()
    flow, valid = given
    # A pixel hidden in the other frame has no match there: whatever matches is another surface.
    visible = None if back is None else forward_backward_error(flow, back[0]) < HIDDEN
    refined = refine(guides, flow)
    share = float(np.mean((refined[..., 0] != flow[..., 0]) | (refined[..., 1] != flow[..., 1])))
    return Flow(select_flow([flow, refined], guides, visible=visible)[0], valid), (share,)


def compose_flows(first: Flow | None, second: Flow | None) -> Flow | None:
    """Compose the flows from a frame to the next, and from that one on; None where one is missing."""
    if first is None or second is None:
        return None
    return Flow(*compose_flow(first.vectors, second.vectors, first_valid=first.valid, second_valid=second.valid))


def search_flow(picture: Array, other: Array) -> tuple[Array, Mask]:
    """Return a rough optical flow between two pictures (H, W, 3), valid everywhere."""
    exposure = measure_exposure(picture, other)
    flow = rough_flow(tone_map(other, exposure), tone_map(picture, exposure))
    return flow, np.ones(flow.shape[:2], bool)
