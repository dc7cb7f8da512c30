"""Measure what each stage of `flow` costs; JSON on standard output.

    python benchmarks/bench_flow.py --size 1920x1080 --threads 1

CPU seconds of the process, after a warm-up: median, least and greatest of the repeats.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.cpu_time import arguments, report, size_of
from flow.confidence import estimate_confidence, mix_centre
from flow.guide import make_guide, pair_guides
from flow.motion import CYCLES, compose_flow, forward_backward_error, invert_flow, normalize_motion
from flow.selection import select_flow
from flow.tvl1 import dense_flow, refine_flow
from flow.warp import warp


def make_pair(width: int, height: int) -> dict[str, np.ndarray]:
    """A textured frame, its neighbour under a smooth motion of a few pixels, and noise on both."""
    rng = np.random.default_rng(0)
    texture = sum(
        cv2.GaussianBlur(rng.normal(size=(height, width, 3)).astype(np.float32), (0, 0), s) * s for s in (1, 3, 9)
    )
    albedo = np.clip(0.5 + 0.3 * texture, 0, 1).astype(np.float32)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    flow = np.stack([3 + 0.002 * (x - width / 2), -2 + 0.002 * (y - height / 2)], axis=-1)
    neighbour = warp(albedo, -flow)[0]
    color, neighbour_color = (a * rng.gamma(4, 0.25, a.shape).astype(np.float32) for a in (albedo, neighbour))
    normal = np.dstack([np.zeros_like(albedo[..., :2]), np.ones_like(x)])
    return {"color": color, "neighbour_color": neighbour_color, "albedo": albedo, "neighbour_albedo": neighbour,
            "normal": normal, "flow": flow, "vectors": np.dstack([-flow * [1, -1], flow * [-1, 1]])}  # fmt: skip


def main(argv: list[str]) -> int:
    options = arguments(__doc__).parse_args(argv)
    pair = make_pair(*size_of(options))
    flow, color, albedo, normal = (pair[name] for name in ("flow", "color", "albedo", "normal"))
    neighbour_color, neighbour_albedo = pair["neighbour_color"], pair["neighbour_albedo"]
    guides = pair_guides(
        make_guide(color, albedo, exposure=0.5), make_guide(neighbour_color, neighbour_albedo, exposure=0.5)
    )
    luminance = pair_guides(make_guide(color, exposure=0.5), make_guide(neighbour_color, exposure=0.5))
    rng = np.random.default_rng(1)
    start = flow + rng.normal(size=flow.shape).astype(np.float32)
    stack = np.dstack([color, albedo, normal, color[..., :1]])
    warped, inside = warp(albedo, flow)
    light = {"scales": 2, "warps": 2, "iterations": 15}
    stages = {
        "normalize_motion": lambda: normalize_motion(pair["vectors"], CYCLES),
        "compose_flow": lambda: compose_flow(flow, flow),
        "invert_flow": lambda: invert_flow(flow),
        "forward_backward_error": lambda: forward_backward_error(flow, -flow),
        "warp bilinear 3": lambda: warp(color, flow),
        "warp bilinear 10": lambda: warp(stack, flow),
        "warp bicubic 10": lambda: warp(stack, flow, interpolation="bicubic"),
        "make_guide": lambda: make_guide(color, albedo, exposure=0.5),
        "refine_flow 3/3/30": lambda: refine_flow(luminance, start),
        "refine_flow 3/3/30, 2 guides": lambda: refine_flow(guides, start),
        "refine_flow 2/2/15": lambda: refine_flow(luminance, start, **light),
        "refine_flow 2/2/15, 2 guides": lambda: refine_flow(guides, start, **light),
        "select_flow": lambda: select_flow([flow, start], guides),
        "dense_flow": lambda: dense_flow(guides),
        "estimate_confidence": lambda: estimate_confidence(
            flow, inside=inside, reverse=-flow, albedo=albedo, other_albedo=albedo, normal=normal, other_normal=normal
        ),
        "mix_centre": lambda: mix_centre(warped, albedo, inside.astype(np.float32)),
    }
    return report(options, stages.items())


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
