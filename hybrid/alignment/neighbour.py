"""Warp the layers of a neighbour to the centre of a window, and measure how far they can be trusted."""

from collections.abc import Collection

import numpy as np
from numba import njit

from flow.confidence import GuideNoise, estimate_confidence, find_coverage
from flow.warp import warp
from hybrid.alignment.flows import Link
from hybrid.alignment.prepare import ALPHA, PreparedFrame
from hybrid.alignment.window import Trust
from hybrid.files.frame import Array
from loops.parallel import run_bands

# The confidence that geometry leaves at least to denoised frames of one color: outlines, whose albedo and normals
# are mixed anew in each frame, flicker most. Worth 0.1 to 0.2 dB, and 1 dB in time, at 16 to 32 samples; 1 and 2 dB
# at 6 to 10, where more (0.5) would be better yet.
AGREEING = 0.3
# With one seed for all frames a neighbour's noise is the centre's until the picture has moved so far, pixels: a
# bilinear sample half a pixel away still shares its noise, one and a half pixels away hardly.
SAME_NOISE, OTHER_NOISE = 0.5, 1.5


def layers_of(frame: PreparedFrame, *, light: bool = False, alpha: bool = False) -> dict[str, Array]:
    """Layers of a frame that are warped, by name; with `light`, which is compared where there is no first pass."""
    named = {
        "color": frame.irradiance,
        "light": frame.light if light else None,
        "albedo": frame.albedo,
        "normal": frame.normal,
        **{f"aov {name}": layer for name, layer in frame.aovs.items()},
        f"aov {ALPHA}": frame.alpha if alpha else None,
    }
    return {name: layer for name, layer in named.items() if layer is not None}


def warp_layers(there: PreparedFrame, flow: Array, rows: slice, warped: dict[str, Array]) -> None:
    """Warp a neighbour's `layers_of` to some rows of the centre, along their flow (h, W, 2), into `warped`."""
    layers = layers_of(there, light="light" in warped, alpha=f"aov {ALPHA}" in warped)
    moves = bool(warped) and flow.any()
    for name, out in warped.items():
        if moves:
            warp(layers[name], flow, first_row=rows.start, out=out)
        else:
            out[...] = layers[name][rows]


def trust_geometry(
    centre: dict[str, Array], there: PreparedFrame, link: Link, rows: slice, noise: GuideNoise | None
) -> Trust:
    """Measure how far geometry trusts a neighbour at some rows of the centre, whose layers are `centre`.

    `noise` is that of the centre's guides; None: they have none.
    """
    flow = link.forward.vectors[rows]
    covered = find_coverage(flow, link.forward.valid[rows], there.valid, rows.start)
    confidence = estimate_confidence(
        flow,
        inside=covered,
        reverse=link.backward.vectors,
        albedo=centre.get("albedo"),
        other_albedo=there.albedo,
        normal=centre.get("normal"),
        other_normal=there.normal,
        first_row=rows.start,
        noise=noise,
    )
    return Trust(covered, confidence)


def novelty_of(flow: Array) -> Array:
    """Share of a neighbour's noise that is its own where all frames have one seed, in [0, 1], by its motion."""
    distance = np.hypot(flow[..., 0], flow[..., 1])
    return np.clip((distance - SAME_NOISE) / (OTHER_NOISE - SAME_NOISE), 0, 1)


def trust_light(
    confidence: Array,
    coverage: Array,
    gate: Array,
    stages: Collection[str],
    *,
    agreeing: float = AGREEING,
) -> Array:
    """Combine confidence c, coverage and gate g, each (T, h, W): max(c g, coverage · agreeing · g).

    Without the stage "gate" c stands for c g. `agreeing` is the confidence that geometry leaves at least where the
    light agrees.
    """
    trust = np.empty_like(confidence)
    given = confidence, coverage, np.ascontiguousarray(gate), np.float32(agreeing), "gate" in stages
    run_bands(_combine, trust.shape[1], *given, trust)
    return trust


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
