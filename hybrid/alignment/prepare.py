"""Frames made safe to filter: finite, divided by their albedo, with the renderer's vectors in our convention."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flow.motion import Motion, invert_flow
from hybrid.alignment.transfer import compress, demodulate, measure_exposure, remodulate
from hybrid.alignment.unfiltered import Unfiltered, split_unfiltered
from hybrid.files.frame import Frame
from hybrid.files.passes import NO_PASSES, Passes
from nlm.average import reject_outliers, replace_nonfinite
from nlm.fireflies import Highlights, add_highlights
from nlm.guided import guided_filter, measure_guide

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Name of the alpha channel among the AOVs; unlike the others it is not light, and is not demodulated.
ALPHA = "alpha"


class Brightness(NamedTuple):
    """How bright a frame is.

    Attributes
    ----------
    exposure : float
        Of the irradiance (`hybrid.alignment.transfer.measure_exposure`).
    moments : (2, G + 1) array
        Mean and deviation over the frame of `PreparedFrame.guide`'s channels, and of the tone-mapped irradiance.
    """

    exposure: float
    moments: NDArray[np.float64]


@dataclass(frozen=True)
class PreparedFrame:
    """One frame, made safe to filter: finite, and divided by its albedo.

    Attributes
    ----------
    number : int
        The frame's number.
    irradiance : (H, W, 3) array
        Color divided by albedo (`hybrid.alignment.transfer.demodulate`), or the color itself if not `demodulated`.
    albedo, normal : (H, W, 3) array or None
        Guides, finite.
    valid : (H, W) bool array
        False where the renderer's color was not finite.
    unfiltered : Unfiltered
        What no filter takes, to be put back into the picture.
    repaired : int
        How many pixels of any layer were not finite and have been filled in.
    motion : Motion or None
        The renderer's vectors in our convention.
    depth : (H, W) array or None
        Distance; only its order is used, and only where vectors go one way.
    variance : (H, W, 3) array or None
        Of the irradiance, where the renderer gave one of the color.
    alpha : (H, W, 1) array or None
        Coverage, finite.
    aovs : dict of str to (H, W, C) array
        Further layers to be warped along, demodulated like the color where they are textured.
    pass_colors : dict of str to (H, W, 3) array
        Of those the color, finite and at least 0.
    passes : Passes
        What `aovs` are to the picture, in this frame.
    demodulated : bool
        Whether the albedo has been divided out.
    fireflies : int
        Single bright samples that were taken out.
    removed_radiance : float
        Mean radiance that went with them: what fireflies carry belongs to the picture in expectation.
    removed_samples : (tuple of index arrays, (K, 3) array) or None
        Where `irradiance` is not as rendered as fireflies were taken out, and what was there.
    highlights : Lights or None
        Lights of a pixel that other frames show as well, in the mean of these frames: they are not in `irradiance`, and
        are added to the picture once it is finished. None where there are none.
    """

    number: int
    irradiance: Array
    albedo: Array | None
    normal: Array | None
    valid: Mask
    repaired: int
    motion: Motion | None
    depth: Array | None
    variance: Array | None
    alpha: Array | None
    aovs: dict[str, Array]
    demodulated: bool
    pass_colors: dict[str, Array] = field(default_factory=dict)
    passes: Passes = NO_PASSES
    unfiltered: Unfiltered = field(default_factory=Unfiltered)
    fireflies: int = 0
    removed_radiance: float = 0.0
    removed_samples: tuple[tuple[NDArray[np.intp], ...], Array] | None = None
    highlights: Highlights | None = None

    @cached_property
    def light(self) -> Array:
        """Irradiance without most of its noise (H, W, 3): what the gate compares where nothing better is given."""
        return rough_light(self.irradiance, self.albedo, self.normal)

    @cached_property
    def as_rendered(self) -> Brightness:
        """Exposure and moments with the irradiance as it was rendered."""
        return self._brightness(self.irradiance)

    @cached_property
    def as_light(self) -> Brightness:
        """Exposure and moments with its light."""
        return self._brightness(self.light)

    def _brightness(self, shown: Array) -> Brightness:
        exposure = measure_exposure(shown)
        gray = compress(np.einsum("...c->...", shown)[..., None] / np.float32(shown.shape[-1]), exposure)
        moments = [measure_guide(layer) for layer in (self.albedo, self.normal, gray) if layer is not None]
        return Brightness(exposure, np.concatenate(moments, axis=1))

    @property
    def guide(self) -> Array | None:
        """Albedo and normal side by side (H, W, G), or None."""
        guides = [layer for layer in (self.albedo, self.normal) if layer is not None]
        return np.concatenate(guides, axis=-1) if guides else None

    @property
    def divisor(self) -> Array | None:
        """The radiance that an irradiance of 1 is (H, W, 3); None where that is 1 as well."""
        if self.albedo is None or not self.demodulated:
            return None
        return remodulate(np.ones_like(self.irradiance), self.albedo)

    @property
    def radiance(self) -> Array:
        """The noisy radiance (H, W, 3), without fireflies and highlights."""
        return self._as_radiance(self.irradiance)

    @property
    def with_highlights(self) -> Array:
        """The noisy radiance (H, W, 3), without fireflies, with highlights."""
        return self.radiance if self.highlights is None else add_highlights(self.radiance, self.highlights)

    @property
    def rendered(self) -> Array:
        """The noisy radiance (H, W, 3), with fireflies, without highlights: right in the mean but for these."""
        if self.removed_samples is None:
            return self.radiance
        whole, (places, light) = self.irradiance.copy(), self.removed_samples
        whole[places] = light
        return self._as_radiance(whole)

    @property
    def radiance_variance(self) -> Array | None:
        """Variance of `radiance` (H, W, 3), where the renderer gave one."""
        return None if self.variance is None else self._as_radiance(self._as_radiance(self.variance))

    def _as_radiance(self, irradiance: Array) -> Array:
        if self.albedo is None or not self.demodulated:
            return irradiance
        return remodulate(irradiance, self.albedo)

    @cached_property
    def mean(self) -> float:
        """Mean radiance of all pixels and channels, highlights included."""
        return float(self.with_highlights.mean(dtype=np.float64))


def prepare(frame: Frame, *, demodulated: bool = True) -> PreparedFrame:
    """Make one frame safe to filter, and divide it by its albedo.

    Parameters
    ----------
    frame : Frame
        As read.
    demodulated : bool
        Whether to divide by the albedo, where there is one.
    """
    color, unfiltered = split_unfiltered(frame)
    color, bad = replace_nonfinite(color)
    repaired = bad if unfiltered.lights is None else bad & ~unfiltered.lights
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
    pass_colors = {name: np.maximum(replace_nonfinite(tint)[0], 0) for name, tint in frame.pass_colors.items()}
    passes = frame.passes
    if passes.sums:
        lights = {name: layer * pass_colors[name] if name in pass_colors else layer for name, layer in aovs.items()}
        passes = passes.in_frame(color, lights, measure_exposure(color))
    demodulated = albedo is not None and demodulated
    if albedo is not None and demodulated:
        color = demodulate(color, albedo)
        variance = None if variance is None else demodulate(demodulate(variance, albedo), albedo)
        aovs = {name: demodulate(layer, albedo) if name in passes.textured else layer for name, layer in aovs.items()}
    motion = frame.flows()
    one_way = motion is not None and (motion.to_previous is None or motion.to_next is None)
    return PreparedFrame(
        number=frame.number,
        irradiance=color,
        albedo=albedo,
        normal=normal,
        valid=~bad,
        repaired=int(np.count_nonzero(repaired)),
        motion=motion,
        depth=frame.depth if one_way else None,
        variance=None if variance is None else np.maximum(variance, 0),
        alpha=None if frame.alpha is None else replace_nonfinite(frame.alpha[..., None])[0],
        aovs=aovs,
        demodulated=demodulated,
        unfiltered=unfiltered,
        pass_colors=pass_colors,
        passes=passes,
    )


def rough_light(irradiance: Array, albedo: Array | None, normal: Array | None) -> Array:
    """Estimate the light of one frame, cheaply: what the gate compares must not be noise.

    Parameters
    ----------
    irradiance : (H, W, 3) array
        Finite.
    albedo, normal : (H, W, 3) array or None
        Guides, finite.

    Returns
    -------
    (H, W, 3) array
        Irradiance.
    """
    clean, _ = reject_outliers(irradiance[None], np.ones((1, *irradiance.shape[:2]), np.float32))
    guides = [layer for layer in (albedo, normal) if layer is not None]
    if guides:
        return guided_filter(clean[0], np.concatenate(guides, axis=-1), radius=5, eps=1e-3, subsample=2)
    guide = compress(clean[0], measure_exposure(clean[0]))
    return guided_filter(clean[0], guide, radius=5, eps=1e-2, subsample=2)


def rendered_flow(here: PreparedFrame, there: PreparedFrame) -> tuple[Array, Mask] | None:
    """Give the flow between neighbouring frames as the renderer gave it.

    Parameters
    ----------
    here, there : PreparedFrame
        Neighbours. Vectors span one frame; where only every n-th frame was rendered they are taken n times as long.

    Returns
    -------
    flow : (H, W, 2) array
        Pixels, from `here` to `there`. None, and no mask, where the renderer gave none.
    valid : (H, W) array of bool
        True where it is known.
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
