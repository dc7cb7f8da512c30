"""The confidence in the pixels of a neighbour: by geometry, by its motion where all frames have one seed, by light."""

from collections.abc import Collection

import numpy as np
from numba import njit

from flow.confidence import GuideNoise, estimate_confidence, find_coverage
from hybrid.alignment.flows import Link
from hybrid.alignment.noise import MOVED_NOISE
from hybrid.alignment.prepare import PreparedFrame
from hybrid.alignment.window import Geometry
from hybrid.files.frame import Array
from loops.parallel import run_bands

# Least confidence by geometry in denoised frames of one color: outlines, whose albedo and normals are mixed anew in
# each frame, flicker most. It gains 0.1 to 0.2 dB, and 1 dB in time, at 16 to 32 samples; 1 and 2 dB at 6 to 10, where
# 0.5 gains more.
AGREEING = 0.3
# With one seed for all frames a neighbour has the centre's noise up to this motion, pixels, and its own from
# `MOVED_NOISE` on.
SAME_NOISE = 0.5


def confidence_by_geometry(
    guides: dict[str, Array], neighbour: PreparedFrame, link: Link, rows: slice, noise: GuideNoise | None
) -> Geometry:
    """Compare motion, albedo and normals of a neighbour with the centre's `guides` (h, W, 3) at these rows.

    `noise` is that of the guides; None: they have none.
    """
    flow = link.forward.vectors[rows]
    coverage = find_coverage(flow, link.forward.valid[rows], neighbour.valid, rows.start)
    confidence = estimate_confidence(
        flow,
        inside=coverage,
        reverse=link.backward.vectors,
        albedo=guides.get("albedo"),
        other_albedo=neighbour.albedo,
        normal=guides.get("normal"),
        other_normal=neighbour.normal,
        first_row=rows.start,
        noise=noise,
    )
    return Geometry(coverage, confidence)


def novelty_of(flow: Array) -> Array:
    """Share of a neighbour's noise that is its own where all frames have one seed, in [0, 1], by its motion."""
    distance = np.hypot(flow[..., 0], flow[..., 1])
    return np.clip((distance - SAME_NOISE) / (MOVED_NOISE - SAME_NOISE), 0, 1)


def combine_confidence(
    geometric: Array, coverage: Array, gate: Array, stages: Collection[str], *, least: float = AGREEING
) -> Array:
    """Combine confidence by geometry c, coverage and gate g, each (T, h, W): max(c g, coverage · least · g).

    Without the stage "gate" c stands for c g. `least` is the confidence that geometry leaves where the light agrees.
    """
    confidence = np.empty_like(geometric)
    given = geometric, coverage, np.ascontiguousarray(gate), np.float32(least), "gate" in stages
    run_bands(_combine, confidence.shape[1], *given, confidence)
    return confidence


@njit(cache=True, nogil=True)
def _combine(
    first: int, last: int, confidence: Array, coverage: Array, gate: Array, agreeing: np.float32, gated: bool,
    trust: Array,
) -> None:  # fmt: skip
    zero, one = np.float32(0), np.float32(1)
    for t in range(len(trust)):
        for y in range(first, last):
            for x in range(trust.shape[2]):
                weight = gate[t, y, x]
                floor = coverage[t, y, x] * agreeing * weight
                # A factor and no condition, so that several pixels are computed at once.
                shown = one if coverage[t, y, x] > zero else zero
                trust[t, y, x] = max(confidence[t, y, x] * (weight if gated else one), floor) * shown
