"""A window of frames: the frames with the flows between them, and the same aligned to the centre."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from flow.confidence import mix_centre
from flow.warp import warp
from hybrid.alignment.flows import Link
from hybrid.alignment.prepare import PreparedFrame
from hybrid.alignment.residual import Limited, warp_residual
from hybrid.files.frame import Array
from hybrid.files.passes import NO_PASSES, Passes
from loops.parallel import Doubles, Mask
from nlm.pooling import PooledSamples, SampleRange, find_range, pool_samples
from nlm.samples import SampleMean
from nlm.variance import prefilter_noisy_rows, smooth_variance, variance_from_window

# Rows of a strip of residuals: those of five frames fit the caches of a processor.
STRIP = 64


def _nothing() -> None:
    """Release nothing: frames lie in memory."""


@dataclass(frozen=True)
class Window:
    """2k + 1 frames, the flows from the centre to each, and the stages that run on them."""

    frames: tuple[PreparedFrame | None, ...]  # in order; None for a missing one. The centre is there.
    links: tuple[Link | None, ...]  # None for the centre, and where a flow is missing
    first_pass: tuple[Array | None, ...] | None  # (H, W, 3): denoised radiance of each frame; None without a first pass
    stages: frozenset[str]  # the stages that run
    repeated: tuple[bool, ...]  # whether a frame has the samples of the frame beside it on the side of the centre
    samples: tuple[np.float32, ...]  # samples of each frame over those of the centre, at most 1
    # the shares of the picture on which TV-L1 corrected vectors, for all flows within the window
    refined: tuple[float, ...] = ()
    outline_noise: tuple[float, float] = (0.0, 0.0)  # the least of `measure.PairFacts` within the window
    # (H, W, 3): albedo and normal of each frame without noise; None where no network needs them
    filtered_guides: tuple[Mapping[str, Array] | None, ...] | None = None
    limited: tuple[Limited | None, ...] = ()  # what the limit of residuals takes from each frame with a first pass
    release: Callable[[], None] = _nothing  # called when a frame has been read (`hybrid.runtime.kept.Keeper.release`)

    @property
    def centre(self) -> PreparedFrame:
        """The centre frame."""
        frame = self.frames[len(self.frames) // 2]
        assert frame is not None
        return frame

    @property
    def lit(self) -> PreparedFrame:
        """The frame nearest to the centre with any valid pixel."""
        centre = self.centre.number
        there = [frame for frame in self.frames if frame is not None]
        return min(there, key=lambda frame: (not frame.valid.any(), abs(frame.number - centre)))


class Trust(NamedTuple):
    """How far geometry trusts a warped neighbour, before anything is known of its light."""

    coverage: Mask  # (h, W): where the neighbour shows a measured color
    confidence: Array  # (h, W), in [0, 1]


@dataclass(frozen=True)
class WarpSources:
    """Frames of a window and their flows, for layers that are warped when they are read."""

    frames: Sequence[PreparedFrame | None]  # in order
    # (h, W, 2), from these rows of the centre to each; None for the centre and where there is none
    flows: Sequence[Array | None]
    first_pass: Sequence[Array | None]  # (H, W, 3): denoised radiance of each frame; empty without a first pass
    limited: Sequence[Limited | None]  # as `Window.limited`
    rows: slice  # of the centre
    # (h, W, 3): radiance of an irradiance of 1 at the centre, where the albedo has noise
    modulation: Array | None = None
    release: Callable[[], None] = _nothing  # as `Window.release`

    def warp(self, name: str, centre_layer: Array, part: slice = slice(None)) -> Array:
        """Warp a layer of all frames, (T, h, W, 3), to rows of the centre, or all; its own where there is no flow."""
        here = centre_layer[part]
        first = self.rows.start + part.indices(len(centre_layer))[0]
        window = np.empty((len(self.frames), *here.shape), np.float32)
        for frame, flow, out in zip(self.frames, self.flows, window, strict=True):
            if frame is None or flow is None:
                out[...] = here
            elif (vectors := flow[part]).any():
                warp(getattr(frame, name), vectors, first_row=first, out=out)
            else:
                out[...] = getattr(frame, name)[first : first + len(here)]
            self.release()
        return window

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the rows."""
        width = next(frame.irradiance.shape[1] for frame in self.frames if frame is not None)
        return self.rows.stop - self.rows.start, width

    def residual(self, part: tuple[slice, slice] = np.s_[:, :], *, limited: bool = False) -> Array:
        """Noisy irradiance − first pass of each frame, (T, h, w, 3), each divided by its own albedo.

        With `modulation` by the centre's, as far as a frame's own is not clean (`warp_residual`).
        Warped to the nearest pixel; 0 where a frame or its first pass is missing. `part` are rows and columns;
        `limited` as a network gets it, with bright samples limited and their light spread.
        """
        (top, bottom, _), (left, right, _) = (s.indices(size) for s, size in zip(part, self.shape, strict=True))
        residuals = np.empty((len(self.frames), bottom - top, right - left, 3), np.float32)
        limits = self.limited if limited else len(self.frames) * (None,)
        sources = zip(self.frames, self.first_pass, self.flows, limits, residuals, strict=True)
        for frame, denoised, flow, limit, out in sources:
            if frame is None or denoised is None:
                out[:] = 0
                continue
            divisor, start = frame.albedo if frame.demodulated else None, (self.rows.start + top, left)
            moved, clean = (None if layer is None else layer[part] for layer in (flow, self.modulation))
            warp_residual(frame.irradiance, denoised, divisor, moved, start, out, limit, clean)
            self.release()
        return residuals

    def residual_strips(self, *, limited: bool = False) -> Iterator[tuple[int, Array]]:
        """Yield the residual strip by strip, with the first row of each: it is made for each use, and not kept."""
        for top in range(0, self.shape[0], STRIP):
            yield top, self.residual(np.s_[top : top + STRIP, :], limited=limited)


@dataclass(frozen=True)
class AlignedWindow:
    """A window of 2k + 1 frames, every one warped to the centre; or some rows of it, for the same pixels.

    Figures of the whole frame (`exposure`, `moments`) are measured before: everything done with a window is local.
    """

    number: int  # the centre frame's number
    centre_irradiance: Array  # (H, W, 3): the centre's irradiance
    aligned_color: Array | None  # (T, H, W, 3): `color`, where it was needed for the alignment
    guides: dict[str, Array]  # (H, W, 3): the centre's albedo and normal, as far as there are any
    sources: WarpSources  # the frames and flows, for layers that are warped when they are read
    confidence: Array  # (T, H, W), in [0, 1]; the centre's is 1 wherever its own color was finite
    modulation: Array  # (H, W, 3): radiance of an irradiance of 1: the centre's prefiltered albedo plus the floor, or 1
    # (H, W, 3): the centre's albedo, prefiltered where the plan has it; None also where nobody reads the `guide`
    clean_albedo: Array | None
    # (T, H, W): confidence by geometry alone, with which guides are prefiltered; None where nobody reads the `guide`
    geometric_confidence: Array | None
    rendered_variance: Array | None  # (H, W, 3), of the centre's irradiance, where the file has one
    # (T, H, W, 3): the first pass, aligned, as irradiance; the centre's where a frame shows nothing, pulled to it where
    # the light drifts
    first_pass: Array | None
    centre_first_pass: Array | None  # (H, W, 3): the centre's first pass, radiance of the whole frame
    aovs: dict[str, Array]  # (T, H, W, C): further layers, warped, and divided by the albedo where they are textured
    repaired: int  # pixels of the centre frame that were not finite
    fireflies: int  # single bright samples removed from the centre frame
    outliers: int  # samples of the window, within `inner`, rejected as fireflies
    exposure: float  # brightness of the centre's irradiance
    # (2, G + 1): mean and deviation over the whole frame of `guide`'s channels, and of the tone-mapped light
    moments: Doubles
    inner: slice  # the requested rows; those around them are there because the result depends on them
    stages: frozenset[str]  # the stages that run
    # the share of the picture, in [0, 1], on which a stage ran that runs only in places
    shares: Mapping[str, float] = field(default_factory=dict)
    # (H, W, 3): the centre's colors of those `aovs` that are light without it
    pass_colors: dict[str, Array] = field(default_factory=dict)
    # the mean of the neighbours' samples at the centre's pixels, radiance; with the stage "blend-samples"
    neighbour_samples: SampleMean | None = None
    # of the frame before and the frame after the centre; None where there is none
    neighbour_trust: tuple[Trust | None, Trust | None] = (None, None)
    # (H, W): the weight of the frame after the centre by its drift; with the stage "drift"
    drift_weight: Array | None = None
    known_range: SampleRange | None = None  # `sample_range`, where it was found along the way
    passes: Passes = NO_PASSES  # the relation of `aovs` to the color
    filtered_guides: dict[str, Array] | None = None  # (H, W, 3): `guides` without noise, as `Window.filtered_guides`

    @cached_property
    def color(self) -> Array:
        """Irradiance (T, H, W, 3) without rejected outliers; a missing frame is the centre's, with confidence 0."""
        if self.aligned_color is not None:
            return self.aligned_color
        color = self.sources.warp("irradiance", self.centre_irradiance)
        color[self.centre] = self.centre_irradiance
        return color

    @property
    def albedo(self) -> Array | None:
        """Albedo of all frames, aligned, (T, H, W, 3), or None. Warped at each access."""
        return self.sources.warp("albedo", self.guides["albedo"]) if "albedo" in self.guides else None

    @property
    def normal(self) -> Array | None:
        """As `albedo`."""
        return self.sources.warp("normal", self.guides["normal"]) if "normal" in self.guides else None

    @cached_property
    def guide(self) -> Array | None:
        """The centre's albedo and normal, prefiltered, (H, W, G). Made at the first access."""
        clean = [] if self.clean_albedo is None else [self.clean_albedo]
        if "normal" in self.guides:
            assert self.geometric_confidence is not None
            clean.append(clean_guide("normal", self.guides, self.sources, self.geometric_confidence, self.stages))
        return np.concatenate(clean, axis=-1) if clean else None

    @cached_property
    def variance(self) -> Array:
        """The smoothed variance of the centre's `color`, (H, W, 3). Made at the first access."""
        if self.rendered_variance is None:
            return variance_from_window(self.color, self.confidence)
        return smooth_variance(self.rendered_variance)

    @property
    def residual(self) -> Array | None:
        """Noisy irradiance − first pass, aligned and limited, (T, H, W, 3); None without a first pass.

        Made at each access.
        """
        return None if self.first_pass is None else self.sources.residual(limited=True)

    def pool(self, weight: Array | None = None) -> PooledSamples:
        """Average the samples of all frames at the centre, by weights (T, H, W) or the confidence; irradiance.

        Raises ValueError without a first pass.
        """
        if self.first_pass is None:
            raise ValueError("aligned: expected a window with estimates, got none")
        weight = self.confidence if weight is None else weight
        pooled = PooledSamples(*(np.empty_like(self.centre_irradiance) for _ in PooledSamples._fields))
        for top, residual in self.sources.residual_strips(limited=True):
            rows = slice(top, top + residual.shape[1])
            strip = pool_samples(self.first_pass[:, rows], residual, weight[:, rows], self.exposure)
            for whole, part in zip(pooled, strip, strict=True):
                whole[rows] = part
        return pooled

    @property
    def sample_range(self) -> SampleRange:
        """Range of the first passes and the samples of all frames; of windows with a first pass."""
        assert self.first_pass is not None
        return self.known_range or find_range(self.first_pass, self.sources.residual_strips())

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
    name: str, guides: dict[str, Array], sources: WarpSources, trust: Array, stages: Collection[str]
) -> Array:
    """Average the centre's "albedo" or "normal" over the window with the stage "prefilter"; else return it."""
    guide = guides[name]
    if "prefilter" not in stages:
        return guide
    return prefilter_noisy_rows(guide, partial(sources.warp, name, guide), trust)
