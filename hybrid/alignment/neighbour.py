"""What a neighbour shows of the centre of a window, and how far it is to be trusted."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from flow.confidence import estimate_confidence
from flow.warp import warp
from hybrid.alignment.prepare import ALPHA, PreparedFrame

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Of estimates that agree in color, geometry can take away no more than all but this: outlines, whose albedo and normals
# are mixed anew in each frame, flicker most. Worth 0.1 to 0.2 dB, and 1 dB in time, at 16 to 32 samples; 1 and 2 dB
# at 6 to 10, where more (0.5) would be better yet.
AGREEING = 0.3
# With one seed for all frames a neighbour's noise is the centre's until the picture has moved so far, pixels: a
# bilinear sample half a pixel away still shares its noise, one and a half pixels away hardly.
SAME_NOISE, OTHER_NOISE = 0.5, 1.5


def layers_of(frame: PreparedFrame, *, light: bool = False, alpha: bool = False) -> dict[str, Array]:
    """Name all layers of a frame that are warped.

    Parameters
    ----------
    frame : PreparedFrame
        The frame.
    light : bool
        Whether its light is among them, which the gate compares where there are no estimates.
    alpha : bool
        Whether alpha is.
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
    """Warp a neighbour's layers to some rows of the centre.

    Parameters
    ----------
    there : PreparedFrame
        The neighbour.
    flow : (h, W, 2) array
        To it, from these rows.
    rows : slice
        Of the centre.
    warped : dict of str to (h, W, C) array
        Where to, by the names of `layers_of`.

    Returns
    -------
    (h, W) bool array
        Where they show its color.
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
    # The share of finite color in the mix of each warped pixel: less than all of it is no measurement.
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
    """Measure how far geometry trusts a warped neighbour.

    Parameters
    ----------
    centre, warped : dict of str to (h, W, C) array
        Layers of the centre and the neighbour.
    flow : (h, W, 2) array
        To the neighbour, from these rows of the centre.
    measured : (h, W) bool array
        Where the neighbour shows anything.
    back : (H, W, 2) array
        The neighbour's flow to the centre.
    first_row : int
        The first of these rows.

    Returns
    -------
    (h, W) array
        Confidence, in [0, 1].
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
    """Say how much of a neighbour's noise is its own where one seed makes the noise of all frames, in [0, 1]."""
    distance = np.hypot(flow[..., 0], flow[..., 1])
    return np.clip((distance - SAME_NOISE) / (OTHER_NOISE - SAME_NOISE), 0, 1)


def trust_light(
    confidence: Array,
    seen: Array,
    gate: Array,
    stages: Collection[str],
    *,
    agreeing: float = AGREEING,
) -> Array:
    """Measure how far aligned estimates are to be trusted.

    Parameters
    ----------
    confidence : (T, h, W) array
        By geometry.
    seen : (T, h, W) array
        What it could be at most: 0 where a frame shows nothing.
    gate : (T, h, W) array
        How far they show the centre's light (`nlm.gate`).
    stages : collection of str
        Without "gate" what geometry trusts is trusted.
    agreeing : float
        What geometry leaves at least to those that show the same light.

    Returns
    -------
    (T, h, W) array
        Confidence, in [0, 1]: by geometry and by whether they show the same light, or by that alone.
    """
    floor = np.minimum(seen, agreeing) * gate
    return np.maximum(confidence * gate if "gate" in stages else confidence, floor) * (seen > 0)
