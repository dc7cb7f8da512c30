"""A window of frames that are aligned to its centre, and what is made of it when it is asked for."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flow.confidence import mix_centre
from flow.warp import warp
from hybrid.alignment.prepare import PreparedFrame
from hybrid.alignment.transfer import demodulate
from hybrid.files.passes import NO_PASSES, Passes
from nlm.samples import SampleMean
from nlm.variance import prefilter_guide, smooth_variance, variance_from_window

Array = NDArray[np.float32]


@dataclass(frozen=True)
class AlignedWindow:
    """A window of 2k + 1 frames, every one warped to the centre; or some rows of it.

    What is measured over a whole frame (`exposure`, `moments`) was measured before: all that is done with a window
    afterwards is local, so that a part of it gives what the whole would have given there.

    Attributes
    ----------
    number : int
        The centre frame's number.
    own : (H, W, 3) array
        The centre's irradiance.
    aligned_color : (T, H, W, 3) array or None
        `color`, where it was made at once.
    guides : dict of str to (H, W, 3) array
        The centre's albedo and normal, those that there are.
    window_of : callable
        What gives `albedo` and `normal`, and `color` where it was not.
    confidence : (T, H, W) array
        In [0, 1]; the centre's is 1 wherever its own color was finite.
    modulation : (H, W, 3) array
        What irradiance is multiplied by to give radiance: the centre's prefiltered albedo plus the floor, or 1.
    clean_albedo : (H, W, 3) array or None
        The centre's albedo, prefiltered where the plan has it.
    trust : (T, H, W) array
        Confidence by geometry alone, with which guides are prefiltered.
    rendered_variance : (H, W, 3) array or None
        Of the centre's `color`, where the file tells it.
    estimate : (T, H, W, 3) array or None
        The estimates that were asked for, aligned, as irradiance; the centre's where a frame shows nothing, pulled
        to it where the light drifts.
    picture : (h, W, 3) array or None
        The centre's estimate, radiance of the whole frame.
    beyond : callable or None
        What gives `residual`.
    aovs : dict of str to (T, H, W, C) array
        Further layers, warped and demodulated like the color where they are textured.
    repaired : int
        Pixels of the centre frame that were not finite.
    fireflies : int
        Single bright samples that were taken out of the centre frame before anything was made of it.
    removed : float
        Share of the centre's light that went with them, in [0, 1].
    outliers : int
        Pixels of the window, within `inner`, that were rejected as fireflies.
    exposure : float
        Brightness of the centre's irradiance.
    moments : (2, G + 1) array
        Mean and deviation over the whole frame of `guide`'s channels, and of the tone-mapped light.
    inner : slice
        The rows that were asked for. Those around them are there because the result depends on them.
    stages : frozenset of str
        The stages that made it.
    shares : dict of str to float
        On what share of the picture a stage ran that runs only where it is called for, in [0, 1].
    pass_colors : dict of str to (H, W, 3) array
        The centre's color of those of `aovs` that are light without it.
    sides : SampleMean or None
        The samples of the frames beside the centre, averaged at its pixels, radiance; with the stage "samples".
    passes : Passes
        What `aovs` are to the picture.
    """

    number: int
    own: Array
    aligned_color: Array | None
    guides: dict[str, Array]
    window_of: Callable[[str], Array]
    confidence: Array
    modulation: Array
    clean_albedo: Array | None
    trust: Array
    rendered_variance: Array | None
    estimate: Array | None
    picture: Array | None
    beyond: Callable[[], Array] | None
    aovs: dict[str, Array]
    repaired: int
    fireflies: int
    removed: float
    outliers: int
    exposure: float
    moments: NDArray[np.float64]
    inner: slice
    stages: frozenset[str]
    shares: dict[str, float] = field(default_factory=dict)
    pass_colors: dict[str, Array] = field(default_factory=dict)
    sides: SampleMean | None = None
    passes: Passes = NO_PASSES

    @cached_property
    def color(self) -> Array:
        """Irradiance of all frames, aligned, (T, H, W, 3). A missing one holds the centre's, with confidence 0.

        Without outliers where the plan rejects them. Made when asked for where there are estimates, as few ask then.
        """
        if self.aligned_color is not None:
            return self.aligned_color
        color = self.window_of("irradiance")
        color[self.centre] = self.own
        return color

    @property
    def albedo(self) -> Array | None:
        """That of all frames, aligned, (T, H, W, 3): each time that it is asked for, as few ask."""
        return self.window_of("albedo") if "albedo" in self.guides else None

    @property
    def normal(self) -> Array | None:
        """As `albedo`."""
        return self.window_of("normal") if "normal" in self.guides else None

    @cached_property
    def guide(self) -> Array | None:
        """The centre's albedo and normal, prefiltered, (H, W, G).

        Made when asked for: averages of estimates need none.
        """
        clean = [] if self.clean_albedo is None else [self.clean_albedo]
        if "normal" in self.guides:
            clean.append(clean_guide("normal", self.guides, self.window_of, self.trust, self.stages))
        return np.concatenate(clean, axis=-1) if clean else None

    @cached_property
    def variance(self) -> Array:
        """Of the centre's `color`, smoothed, (H, W, 3). Made when asked for, as the guide is."""
        if self.rendered_variance is None:
            return variance_from_window(self.color, self.confidence)
        return smooth_variance(self.rendered_variance)

    @cached_property
    def residual(self) -> Array | None:
        """What the noisy frames show beyond their estimates, aligned, (T, H, W, 3) irradiance, as `nlm.gather` asks.

        Noisy irradiance − estimate, each in its own place and divided by its own albedo, aligned to the nearest pixel.
        0 where a frame or its estimate is missing. Made when asked for.
        """
        return None if self.beyond is None else self.beyond()

    @property
    def centre(self) -> int:
        """Index of the centre frame."""
        return len(self.confidence) // 2

    def mixed(self, layer: Array) -> Array:
        """Mix the centre into the side frames of `layer` (T, H, W, C), in inverse proportion to confidence."""
        mixed = np.empty(layer.shape, np.float32)
        for warped, confidence, out in zip(layer, self.confidence, mixed, strict=True):
            mix_centre(warped, layer[self.centre], confidence, out)
        return mixed


def clean_guide(
    name: str, guides: dict[str, Array], window_of: Callable[[str], Array], trust: Array, stages: Collection[str]
) -> Array:
    """Clean a guide of the centre, if the plan has it.

    Parameters
    ----------
    name : str
        "albedo" or "normal".
    guides : dict of str to (H, W, 3) array
        Those of the centre.
    window_of : callable
        As `AlignedWindow` has it.
    trust : (T, H, W) array
        Confidence by geometry.
    stages : collection of str
        With "prefilter" it is averaged over the window, without it is as it was.
    """
    return prefilter_guide(window_of(name), trust) if "prefilter" in stages else guides[name]


def warp_layer(
    centre: dict[str, Array],
    there: Sequence[PreparedFrame | None],
    flows: Sequence[Array | None],
    rows: slice,
    name: str,
) -> Array:
    """Align a layer of all frames to the centre's.

    Parameters
    ----------
    centre : dict of str to (h, W, 3) array
        Layers of the centre, these rows of them.
    there : sequence of PreparedFrame
        The frames of the window; None for those that are missing.
    flows : sequence of (h, W, 2) array
        To each; None where there is none, and the centre's layer takes its place.
    rows : slice
        Of the centre.
    name : str
        "albedo", "normal" or "irradiance".

    Returns
    -------
    (T, h, W, 3) array
        The layer.
    """
    own = centre[name]
    window = np.empty((len(there), *own.shape), np.float32)
    for frame, flow, out in zip(there, flows, window, strict=True):
        if frame is None or flow is None:
            out[...] = own
        elif flow.any():
            warp(getattr(frame, name), flow, first_row=rows.start, out=out)
        else:
            out[...] = getattr(frame, name)[rows]
    return window


def warp_residuals(
    there: Sequence[tuple[PreparedFrame | None, Array | None]], flows: Sequence[Array | None], rows: slice
) -> Array:
    """Align what frames show beyond their estimates, as `AlignedWindow.residual` has it.

    Parameters
    ----------
    there : sequence of (PreparedFrame, (H, W, 3) array)
        The frames of the window and their estimates, radiance; None for those that are missing.
    flows : sequence of (h, W, 2) array
        To each; None for the centre, and for those that are missing.
    rows : slice
        Of the centre.

    Returns
    -------
    (T, h, W, 3) array
        Irradiance.
    """
    shape = next(
        frame.irradiance[rows].shape for frame, estimate in there if frame is not None and estimate is not None
    )
    residuals = np.empty((len(there), *shape), np.float32)
    for (frame, estimate), flow, out in zip(there, flows, residuals, strict=True):
        if frame is None or estimate is None:
            out[:] = 0
            continue
        own = demodulate(estimate, frame.albedo) if frame.demodulated and frame.albedo is not None else estimate
        left = frame.irradiance - own
        if flow is None or not flow.any():
            out[:] = left[rows]
        else:
            warp(left, flow, interpolation="nearest", first_row=rows.start, out=out)
    return residuals
