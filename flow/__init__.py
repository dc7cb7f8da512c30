"""Motion between frames: convert motion vectors, refine them by TV-L1, warp, and measure confidence.

Flows are (H, W, 2) float32, pixels, x right then y down, from the centre to a neighbour. Functions raise ValueError,
with what came and what was expected, where shapes do not agree or a parameter is out of its range.
"""

from flow.confidence import estimate_confidence, mix_centre
from flow.convention import Choice, choose_convention
from flow.guide import Guide, GuidePair, make_guide, median_luminance, pair_guides, tone_map
from flow.motion import (
    Motion,
    MotionConvention,
    Vectors,
    compose_flow,
    forward_backward_error,
    invert_flow,
    normalize_motion,
)
from flow.patches import FramePair, Patches
from flow.reflections import find_reflections
from flow.selection import select_flow
from flow.tvl1 import dense_flow, refine_flow, rough_flow
from flow.warp import warp

__all__ = [
    "Choice", "FramePair", "Guide", "GuidePair", "Motion", "MotionConvention", "Patches", "Vectors",
    "choose_convention", "compose_flow", "dense_flow", "estimate_confidence", "find_reflections",
    "forward_backward_error", "invert_flow", "make_guide", "median_luminance", "mix_centre", "normalize_motion",
    "pair_guides", "refine_flow", "rough_flow", "select_flow", "tone_map", "warp",
]  # fmt: skip
