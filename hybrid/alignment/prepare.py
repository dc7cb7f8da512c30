"""Prepared frames: finite, divided by their albedo, with the renderer's vectors in our convention."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from flow.motion import Motion, invert_flow
from hybrid.alignment.transfer import ALBEDO_FLOOR, compress, demodulate, measure_exposure, remodulate
from hybrid.alignment.unfiltered import Unfiltered, split_unfiltered
from hybrid.files.frame import Array, Frame
from hybrid.files.layers import Layers
from hybrid.files.passes import NO_PASSES, Passes
from loops.parallel import Doubles, Mask, Places
from nlm.average import channel_mean, reject_outliers, replace_nonfinite
from nlm.fireflies import Highlights, add_highlights
from nlm.guided import guided_filter, measure_guide
from nlm.pixel_filter import PixelFilter, find_filter

Values = TypeVar("Values", bound=NDArray[Any])

# Name of the alpha channel among the AOVs; unlike the others it is no light, and is not demodulated.
ALPHA = "alpha"
# Rows to which frames are reduced for measuring: a mean of k×k pixels has a k-th of their noise, and a k²-th of their
# cost. Frames below twice this are not reduced.
SHORT_SIDE = 270


class Brightness(NamedTuple):
    """Exposure of a frame's irradiance; mean and deviation (2, G + 1) of `PreparedFrame.guide` and irradiance."""

    exposure: float
    moments: Doubles


@dataclass(frozen=True)
class PreparedFrame:
    """One frame, finite and divided by its albedo."""

    number: int
    # (H, W, 3): color divided by albedo (`hybrid.alignment.transfer.demodulate`), or the color itself if not
    # `demodulated`
    irradiance: Array
    # (H, W, 3), finite
    albedo: Array | None
    normal: Array | None
    valid: Mask  # (H, W): False where the renderer's color was not finite
    repaired: int  # number of pixels, of any layer, that were not finite and have been filled in
    motion: Motion | None  # in our convention
    depth: Array | None  # (H, W): distance; only its order is used, and only with vectors of one direction
    variance: Array | None  # (H, W, 3), of the irradiance
    alpha: Array | None  # (H, W, 1): coverage, finite
    aovs: dict[str, Array]  # (H, W, C), demodulated if they are textured
    demodulated: bool  # whether the albedo has been divided out
    pass_colors: dict[str, Array] = field(default_factory=dict)  # (H, W, 3): colors of AOVs, finite and at least 0
    passes: Passes = NO_PASSES  # how `aovs` add up to the beauty in this frame
    samples: float | None = None  # samples per pixel, if known
    unfiltered: Unfiltered = field(default_factory=Unfiltered)  # light that is restored in the finished picture
    fireflies: int = 0  # number of fireflies that were removed
    removed_radiance: float = 0.0  # their mean radiance, which belongs to the picture in expectation
    # indices where fireflies were removed from `irradiance`, and its values there, (K, 3), as rendered
    removed_samples: tuple[tuple[Places, ...], Array] | None = None
    # persistent highlights: lights of a pixel that other frames show as well, averaged over these frames. They are not
    # in `irradiance`, and are added to the finished picture.
    highlights: Highlights | None = None
    # the pixel filter that is undone in the light and the guides, and applied to the finished picture
    spread: PixelFilter | None = None
    # (H, W, 1): with it, mean over channels of the irradiance as rendered, in which equal samples are equal
    as_rendered_gray: Array | None = None

    @cached_property
    def light(self) -> Array:
        """Irradiance without most of its noise (H, W, 3), which the gate compares if there is no first pass."""
        return rough_light(self.irradiance, self.albedo, self.normal)

    @cached_property
    def as_rendered(self) -> Brightness:
        """Exposure and moments of the noisy irradiance."""
        return self._brightness(self.irradiance)

    @cached_property
    def as_light(self) -> Brightness:
        """Exposure and moments of `light`."""
        return self._brightness(self.light)

    def _brightness(self, shown: Array) -> Brightness:
        exposure = measure_exposure(shown)
        gray = compress(np.einsum("...c->...", shown)[..., None] / np.float32(shown.shape[-1]), exposure)
        moments = [measure_guide(layer) for layer in (self.albedo, self.normal, gray) if layer is not None]
        return Brightness(exposure, np.concatenate(moments, axis=1))

    def with_filter(self, light: Array) -> Array:
        """Apply the pixel filter that is undone in this frame, if any, to denoised light (H, W, C)."""
        return light if self.spread is None else np.maximum(self.spread.apply(light), 0)

    @property
    def guide(self) -> Array | None:
        """Channels of albedo and normal (H, W, G), or None."""
        guides = [layer for layer in (self.albedo, self.normal) if layer is not None]
        return np.concatenate(guides, axis=-1) if guides else None

    def divisor_at(self, rows: Places, columns: Places) -> Array | None:
        """Radiance per irradiance (..., 3) at some pixels (...); None if both are the same."""
        if self.albedo is None or not self.demodulated:
            return None
        return np.maximum(self.albedo[rows, columns], 0) + np.float32(ALBEDO_FLOOR)

    @property
    def sampled(self) -> Array:
        """Irradiance (H, W, C) for comparing samples, without the undoing of filters, which differ between frames."""
        return self.irradiance if self.as_rendered_gray is None else self.as_rendered_gray

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
        """The noisy radiance (H, W, 3), with fireflies, without highlights: unbiased but for these."""
        if self.removed_samples is None:
            return self.radiance
        whole, (places, light) = self.irradiance.copy(), self.removed_samples
        whole[places] = light
        return self._as_radiance(whole)

    @property
    def radiance_variance(self) -> Array | None:
        """Variance of `radiance` (H, W, 3), or None."""
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
    """Fill non-finite pixels of a frame, set light apart that is not filtered, and divide by any albedo."""
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
    albedo = albedo if albedo is None or albedo.min() >= 0 else np.maximum(albedo, 0)
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
    if motion is not None:
        motion = Motion(*(way and way._replace(valid=_one_value(way.valid)) for way in motion))
    one_way = motion is not None and (motion.to_previous is None or motion.to_next is None)
    return PreparedFrame(
        number=frame.number,
        irradiance=color,
        albedo=albedo,
        normal=normal,
        valid=_one_value(~bad),
        repaired=int(np.count_nonzero(repaired)),
        motion=motion,
        depth=frame.depth if one_way else None,
        variance=None if variance is None else np.maximum(variance, 0),
        alpha=None if frame.alpha is None else _one_value(replace_nonfinite(frame.alpha[..., None])[0]),
        aovs=aovs,
        demodulated=demodulated,
        unfiltered=unfiltered,
        pass_colors=pass_colors,
        passes=passes,
        samples=frame.samples,
    )


def without_filter(frame: PreparedFrame, correlation: Sequence[Sequence[float]]) -> PreparedFrame:
    """Undo the pixel filter by which noise has this correlation in the light and the guides of a frame, as rendered.

    The quotient of color and albedo is that of both without the filter. Light may be negative beside what is bright.
    """
    spread = find_filter(np.array(correlation))
    albedo, normal = (None if layer is None else spread.undo(layer) for layer in (frame.albedo, frame.normal))
    albedo = None if albedo is None else np.maximum(albedo, 0)

    def undo(layer: Array, textured: bool) -> Array:
        if not textured or frame.albedo is None or albedo is None:
            return spread.undo(layer)
        return demodulate(spread.undo(remodulate(layer, frame.albedo)), albedo)

    return replace(
        frame,
        irradiance=undo(frame.irradiance, frame.demodulated),
        albedo=albedo,
        normal=normal,
        variance=None if frame.variance is None else frame.variance * np.float32(spread.gain),
        spread=spread,
        as_rendered_gray=channel_mean(frame.irradiance)[..., None],
        aovs={
            name: undo(layer, frame.demodulated and name in frame.passes.textured) for name, layer in frame.aovs.items()
        },
    )


def _one_value(layer: Values) -> Values:
    """A layer, in the memory of one pixel where all are equal, as where every pixel is opaque or valid."""
    first = layer[:1, :1].copy()
    return cast(Values, np.broadcast_to(first, layer.shape)) if (layer == first).all() else layer


def prepared_planes(layers: Layers) -> float:
    """Count the float32 planes of a `PreparedFrame` of these layers, with its light."""
    given = (layers.albedo, layers.normal, layers.variance)
    motion = 0 if layers.motion is None else len(layers.motion.channels) + 0.5
    single = (layers.depth is not None and layers.one_way) + (layers.alpha is not None)
    aovs = sum(len(layer.channels) for layer in (*layers.aovs.values(), *layers.pass_colors.values()))
    return 3 + 3 + 3 * sum(layer is not None for layer in given) + motion + single + aovs + 0.25  # validity: a byte


def rough_light(irradiance: Array, albedo: Array | None, normal: Array | None) -> Array:
    """Denoise the finite irradiance of one frame by a guided filter, cheaply, for the gate."""
    clean, _ = reject_outliers(irradiance[None], np.ones((1, *irradiance.shape[:2]), np.float32))
    guides = [layer for layer in (albedo, normal) if layer is not None]
    if guides:
        return guided_filter(clean[0], np.concatenate(guides, axis=-1), radius=5, eps=1e-3, subsample=2)
    guide = compress(clean[0], measure_exposure(clean[0]))
    return guided_filter(clean[0], guide, radius=5, eps=1e-2, subsample=2)


def rendered_flow(start: PreparedFrame, end: PreparedFrame) -> tuple[Array, Mask] | None:
    """Return the renderer's flow (H, W, 2) over n frames, n times its vectors, and its validity; None without."""
    step = abs(end.number - start.number)
    forward = end.number > start.number
    direct = start.motion and (start.motion.to_next if forward else start.motion.to_previous)
    if direct is not None:
        return _times(direct.flow, step), direct.valid
    reverse = end.motion and (end.motion.to_previous if forward else end.motion.to_next)
    if reverse is not None:
        # The other frame's vectors lead from its pixels to this frame.
        return invert_flow(_times(reverse.flow, step), valid=reverse.valid, depth=end.depth)
    return None


def _times(flow: Array, step: int) -> Array:
    return flow if step == 1 else flow * step
