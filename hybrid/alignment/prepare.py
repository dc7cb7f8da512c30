"""Frames made safe to filter: finite, divided by their albedo, with the renderer's vectors in our convention."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flow.motion import Motion, invert_flow
from hybrid.alignment.transfer import compress, demodulate, measure_exposure, remodulate
from hybrid.files.frames import Frame
from nlm.average import reject_outliers, replace_nonfinite
from nlm.guided import guided_filter, measure_guide

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Name of the alpha channel among the AOVs; unlike the others it is not light, and is not demodulated.
ALPHA = "alpha"


@dataclass(frozen=True)
class PreparedFrame:
    """One frame, made safe to filter: finite, divided by its albedo, perhaps with a rough idea of its light.

    Attributes
    ----------
    number : int
        The frame's number.
    irradiance : (H, W, 3) array
        Color divided by albedo (`hybrid.alignment.transfer.demodulate`), or the color itself if not `demodulated`.
    light : (H, W, 3) array or None
        Irradiance without most of its noise, by a guided filter: what the gate compares where nothing better is given.
    albedo, normal : (H, W, 3) array or None
        Guides, finite.
    valid : (H, W) bool array
        False where the renderer's color was not finite.
    repaired : int
        How many pixels of any layer were not finite and have been filled in.
    motion : Motion or None
        The renderer's vectors in our convention.
    depth : (H, W) array or None
        Distance; only its order is used.
    variance : (H, W, 3) array or None
        Of the irradiance, where the renderer gave one of the color.
    aovs : dict of str to (H, W, C) array
        Further layers to be warped along, demodulated like the color.
    demodulated : bool
        Whether the albedo has been divided out.
    exposure : float
        Brightness of the irradiance (`hybrid.alignment.transfer.measure_exposure`).
    moments : (2, G + 1) array
        Mean and deviation over the frame of `guide`'s channels, and of the tone-mapped light.
    """

    number: int
    irradiance: Array
    light: Array | None
    albedo: Array | None
    normal: Array | None
    valid: Mask
    repaired: int
    motion: Motion | None
    depth: Array | None
    variance: Array | None
    aovs: dict[str, Array]
    demodulated: bool
    exposure: float
    moments: NDArray[np.float64]

    @property
    def guide(self) -> Array | None:
        """Albedo and normal side by side (H, W, G), or None."""
        guides = [layer for layer in (self.albedo, self.normal) if layer is not None]
        return np.concatenate(guides, axis=-1) if guides else None

    @property
    def radiance(self) -> Array:
        """The noisy radiance (H, W, 3)."""
        if self.albedo is None or not self.demodulated:
            return self.irradiance
        return remodulate(self.irradiance, self.albedo)


def prepare(frame: Frame, stages: Collection[str]) -> PreparedFrame:
    """Make one frame safe to filter, divide it by its albedo, and estimate its light where the gate will ask for it.

    Parameters
    ----------
    frame : Frame
        As read.
    stages : collection of str
        The plan's; "demodulate", "alpha" and "gate" matter here.
    """
    color, bad = replace_nonfinite(frame.color)
    repaired = bad
    layers: dict[str, Array | None] = {}
    for name in ("albedo", "normal", "variance"):
        layer = getattr(frame, name)
        if layer is not None:
            layer, bad_here = replace_nonfinite(layer)
            repaired = repaired | bad_here
        layers[name] = layer
    albedo, normal, variance = layers.values()
    albedo = None if albedo is None else np.maximum(albedo, 0)
    aovs = {}
    for name, layer in frame.aovs.items():
        aovs[name], bad_here = replace_nonfinite(layer)
        repaired = repaired | bad_here
    demodulated = albedo is not None and "demodulate" in stages
    if albedo is not None and demodulated:
        color = demodulate(color, albedo)
        variance = None if variance is None else demodulate(demodulate(variance, albedo), albedo)
        aovs = {name: demodulate(layer, albedo) for name, layer in aovs.items()}
    if frame.alpha is not None and "alpha" in stages:
        aovs[ALPHA] = replace_nonfinite(frame.alpha[..., None])[0]
    light = _rough_light(color, albedo, normal) if "gate" in stages else None
    shown = color if light is None else light
    exposure = measure_exposure(shown)
    gray = compress(shown.mean(axis=-1, keepdims=True), exposure)
    moments = [measure_guide(layer) for layer in (albedo, normal, gray) if layer is not None]
    return PreparedFrame(
        number=frame.number,
        irradiance=color,
        light=light,
        albedo=albedo,
        normal=normal,
        valid=~bad,
        repaired=int(np.count_nonzero(repaired)),
        motion=frame.flows(),
        depth=frame.depth,
        variance=None if variance is None else np.maximum(variance, 0),
        aovs=aovs,
        demodulated=demodulated,
        exposure=exposure,
        moments=np.concatenate(moments, axis=1),
    )


def _rough_light(irradiance: Array, albedo: Array | None, normal: Array | None) -> Array:
    """Light of one frame, cheaply: what the gate compares must not be noise."""
    clean, _ = reject_outliers(irradiance[None], np.ones((1, *irradiance.shape[:2]), np.float32))
    guides = [layer for layer in (albedo, normal) if layer is not None]
    if guides:
        return guided_filter(clean[0], np.concatenate(guides, axis=-1), radius=5, eps=1e-3, subsample=2)
    guide = compress(clean[0], measure_exposure(clean[0]))
    return guided_filter(clean[0], guide, radius=5, eps=1e-2, subsample=2)


def rendered_flow(here: PreparedFrame, there: PreparedFrame) -> tuple[Array, Mask] | None:
    """Flow between neighbouring frames as the renderer gave it, or None where it gave none.

    Vectors span one frame; where only every n-th frame was rendered they are taken n times as long.
    """
    step = abs(there.number - here.number)
    forward = there.number > here.number
    direct = here.motion and (here.motion.to_next if forward else here.motion.to_previous)
    if direct is not None:
        return _times(direct.flow, step), direct.valid
    reverse = there.motion and (there.motion.to_previous if forward else there.motion.to_next)
    if reverse is not None:
        # The other frame knows where each of its pixels is in this one.
        return invert_flow(_times(reverse.flow, step), valid=reverse.valid, depth=there.depth)
    return None


def _times(flow: Array, step: int) -> Array:
    return flow if step == 1 else flow * step
