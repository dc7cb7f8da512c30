"""Warp the layers of a neighbour to the centre of a window, and measure how far they can be trusted."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from flow.confidence import estimate_confidence
from flow.warp import warp
from hybrid.alignment.prepare import ALPHA, PreparedFrame

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

# The confidence that geometry leaves at least to denoised frames of one color: outlines, whose albedo and normals
# are mixed anew in each frame, flicker most. Worth 0.1 to 0.2 dB, and 1 dB in time, at 16 to 32 samples; 1 and 2 dB
# at 6 to 10, where more (0.5) would be better yet.
AGREEING = 0.3
# With one seed for all frames a neighbour's noise is the centre's until the picture has moved so far, pixels: a
# bilinear sample half a pixel away still shares its noise, one and a half pixels away hardly.
SAME_NOISE, OTHER_NOISE = 0.5, 1.5


def layers_of(frame: PreparedFrame, *, light: bool = False, alpha: bool = False) -> dict[str, Array]:
    """Layers of a frame that are warped, by name.

    With `light`, which the gate compares where there is no first pass.
    """
    named = {
        "color": frame.irradiance,
        "light": frame.light if light else None,
        "albedo": frame.albedo,
        "normal": frame.normal,
        **{f"aov {name}": layer for name, layer in frame.aovs.items()},
        f"aov {ALPHA}": frame.alpha if alpha else None,
    }
    return {name: layer for name, layer in named.items() if layer is not None}


def warp_layers(there: PreparedFrame, flow: Array, rows: slice, warped: dict[str, Array]) -> Mask:
    """Warp a neighbour's layers to some rows of the centre, into `warped`; return where (h, W) the color was measured.

    The flow (h, W, 2) leads from these rows to the neighbour; names are those of `layers_of`.
    """
    layers = layers_of(there, light="light" in warped, alpha=f"aov {ALPHA}" in warped)
    if not flow.any():
        for name, out in warped.items():
            out[...] = layers[name][rows]
        return there.valid[rows]
    inside = None
    for name, out in warped.items():
        _, inside = warp(layers[name], flow, first_row=rows.start, out=out)
    if inside is not None and there.valid.all():
        return inside
    # The share of finite color in each warped pixel: a pixel with less than all of it is not measured.
    share, inside = warp(there.valid.astype(np.float32), flow, first_row=rows.start)
    return np.asarray(inside & (share > 0.999))


def trust_geometry(
    centre: dict[str, Array],
    warped: dict[str, Array],
    flow: Array,
    measured: Mask,
    back: Array,
    first_row: int,
) -> Array:
    """Measure the confidence (h, W), in [0, 1], of geometry in a warped neighbour.

    The flow (h, W, 2) leads from rows of the centre, of which `first_row` is the first, to the neighbour; `back` (H, W,
    2) from the neighbour to the centre. `measured` is the result of `warp_layers`.
    """
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
    """Combine confidence and coverage of geometry with the gate, each (T, h, W): max(c g, min(coverage, agreeing) g).

    Coverage is an upper bound of the confidence; `agreeing` is the confidence that geometry leaves at least where the
    light agrees. Without the stage "gate" the confidence of geometry stands.
    """
    floor = np.minimum(coverage, agreeing) * gate
    return np.maximum(confidence * gate if "gate" in stages else confidence, floor) * (coverage > 0)
