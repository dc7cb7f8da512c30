"""A window of frames: the frames with the flows between them, and the same aligned to the centre."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from flow.confidence import mix_centre
from flow.warp import warp
from hybrid.alignment.flows import Link
from hybrid.alignment.prepare import Brightness, PreparedFrame
from hybrid.alignment.residual import Limited, warp_residual
from hybrid.files.frame import Array
from loops.parallel import STRIP, Mask
from nlm.pooling import PooledSamples, pool_samples
from nlm.samples import SampleMean
from nlm.variance import prefilter_guide, smooth_variance, variance_from_window


def _nothing() -> None:
    """Release nothing: frames lie in memory."""


def moves_over_noise(stages: Collection[str]) -> bool:
    """Whether a picture moves over noise that stands still.

    Copies of the noise that are warped and pooled pass for detail, and shared ones for light: slow pans with one seed
    lost 2 to 12 dB. Denoised frames are averaged in their place.
    """
    return {"fixed-noise", "warp"} <= {*stages}


@dataclass(frozen=True)
class Window:
    """2k + 1 frames, the flows from the centre to each, and the stages that run on them."""

    frames: tuple[PreparedFrame | None, ...]  # in order; None for a missing one. The centre is there.
    links: tuple[Link | None, ...]  # None for the centre, and where a flow is missing
    first_pass: tuple[Array | None, ...] | None  # (H, W, 3): denoised radiance of each frame; None without a first pass
    stages: frozenset[str]  # the stages that run
    # samples of each frame over those of the centre, at most 1; 0 if the frame beside it, towards the centre, has the
    # same samples
    own_samples: tuple[np.float32, ...]
    # the shares of the picture on which TV-L1 corrected vectors, for all flows within the window
    refined: tuple[float, ...] = ()
    outline_noise: tuple[float, float] = (0.0, 0.0)  # the least of `measure.PairFacts` within the window
    # (H, W, 3): albedo and normal of each frame without noise; None where no network needs them
    filtered_guides: tuple[Mapping[str, Array] | None, ...] | None = None
    limited: tuple[Limited | None, ...] = ()  # light lost by the limit of residuals in each frame with a first pass
    release: Callable[[], None] = _nothing  # called when a frame has been read (`hybrid.runtime.kept.Keeper.release`)
    # (H, W, 2): pixels a frame that light moves by beside the links (`flow.reflections`); None: nowhere
    reflections: Array | None = None

    @property
    def centre(self) -> PreparedFrame:
        """The centre frame."""
        frame = self.frames[len(self.frames) // 2]
        assert frame is not None
        return frame

    def light_flow(self, index: int, rows: slice) -> Array | None:
        """The flow of light (h, W, 2) from rows of the centre to a frame; None without a link."""
        link = self.links[index]
        if link is None:
            return None
        flow = link.forward.vectors[rows]
        return flow if self.reflections is None else flow + (index - len(self.frames) // 2) * self.reflections[rows]

    @cached_property
    def reflecting(self) -> Mask | None:
        """Where (H, W) light moves beside the links; None: nowhere."""
        if self.reflections is None:
            return None
        x, y = np.moveaxis(self.reflections, -1, 0)
        return np.asarray((x != 0) | (y != 0))  # `any` over the last axis takes ten times as long

    @property
    def lit(self) -> PreparedFrame:
        """The frame nearest to the centre with any valid pixel."""
        centre = self.centre.number
        present = [frame for frame in self.frames if frame is not None]
        return min(present, key=lambda frame: (not frame.valid.any(), abs(frame.number - centre)))


class Geometry(NamedTuple):
    """The comparison of a warped neighbour with the centre by motion, albedo and normals, without its light."""

    coverage: Mask  # (h, W): where the neighbour shows a measured color
    confidence: Array  # (h, W), in [0, 1]


@dataclass(frozen=True)
class WarpSources:
    """Frames of a window and their flows, for layers that are warped when they are read."""

    frames: Sequence[PreparedFrame | None]  # in order
    # (h, W, 2), from these rows of the centre to each; None for the centre and where there is none
    flows: Sequence[Array | None]
    # the same of light, which differ where reflections move otherwise than their surface
    light_flows: Sequence[Array | None]
    first_pass: Sequence[Array | None]  # (H, W, 3): denoised radiance of each frame; empty without a first pass
    limited: Sequence[Limited | None]  # as `Window.limited`
    rows: slice  # of the centre
    # (h, W, 3): radiance of an irradiance of 1 at the centre, where the albedo has noise
    modulation: Array | None = None
    release: Callable[[], None] = _nothing  # as `Window.release`

    def warp(self, name: str, centre_layer: Array, part: slice = slice(None)) -> Array:
        """Warp a layer of all frames, (T, h, W, 3), to rows of the centre, or all; its own where there is no flow."""
        first = self.rows.start + part.indices(len(centre_layer))[0]
        window = np.empty((len(self.frames), *centre_layer[part].shape), np.float32)
        flows = self.flows if name in ("albedo", "normal") else self.light_flows
        for frame, flow, out in zip(self.frames, flows, window, strict=True):
            if frame is None or flow is None:
                out[...] = centre_layer[part]
            else:
                warp_rows(getattr(frame, name), flow[part], first, out)
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
        sources = zip(self.frames, self.first_pass, self.light_flows, limits, residuals, strict=True)
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
class Centre:
    """The centre of an aligned window, at its rows."""

    frame: PreparedFrame  # the whole frame
    # (h, W, 3): without rejected outliers; the mean of the neighbours where the renderer's color was not finite
    irradiance: Array
    guides: dict[str, Array]  # (h, W, 3): albedo and normal, as far as there are any
    # (h, W, 3): the albedo, prefiltered where the plan has it; None also where `AlignedWindow.guide` is not read
    clean_albedo: Array | None
    filtered_guides: dict[str, Array] | None = None  # (h, W, 3): `guides` without noise, as `Window.filtered_guides`
    first_pass: Array | None = None  # (H, W, 3): radiance of the whole frame


@dataclass(frozen=True)
class Neighbours:
    """Measurements of the neighbours by which the denoised centre is averaged with others, and corrected."""

    geometry: tuple[Geometry | None, Geometry | None]  # of the frames before and after the centre
    samples: SampleMean | None = None  # their mean at the centre's pixels, radiance; with the stage "blend-samples"
    drift_weight: Array | None = None  # (h, W): weight of the frame after the centre by its drift; with stage "drift"


@dataclass(frozen=True)
class AlignedWindow:
    """A window of 2k + 1 frames, every one warped to the centre; or some rows of it, for the same pixels.

    Figures of the whole frame (`brightness`) are measured before: everything done with a window is local.
    """

    centre: Centre
    neighbours: Neighbours
    sources: WarpSources  # the frames and flows, for layers that are warped when they are read
    stages: frozenset[str]  # the stages that run
    inner: slice  # the requested rows, among the rows around them that the result depends on
    confidence: Array  # (T, h, W), in [0, 1]; the centre's is 1 wherever its own color was finite
    # (T, h, W): confidence by geometry alone, with which guides are prefiltered; None where `guide` is not read
    geometric_confidence: Array | None
    modulation: Array  # (h, W, 3): radiance of an irradiance of 1: the centre's prefiltered albedo plus the floor, or 1
    brightness: Brightness  # of the centre, or of the nearest frame with light
    aovs: dict[str, Array]  # (T, h, W, C): further layers, warped, and divided by the albedo where they are textured
    aligned_color: Array | None = None  # (T, h, W, 3): `color`, where it was needed for the alignment
    # (T, h, W, 3): the first pass, aligned, as irradiance; the centre's where a frame shows nothing, pulled to it where
    # the light drifts
    first_pass: Array | None = None
    outliers: int = 0  # samples of the window, within `inner`, rejected as fireflies

    @cached_property
    def color(self) -> Array:
        """Irradiance (T, H, W, 3) without rejected outliers; a missing frame is the centre's, with confidence 0."""
        if self.aligned_color is not None:
            return self.aligned_color
        color = self.sources.warp("irradiance", self.centre.irradiance)
        color[self.middle] = self.centre.irradiance
        return color

    @property
    def albedo(self) -> Array | None:
        """Albedo of all frames, aligned, (T, H, W, 3), or None. Warped at each access."""
        return self.sources.warp("albedo", self.centre.guides["albedo"]) if "albedo" in self.centre.guides else None

    @property
    def normal(self) -> Array | None:
        """As `albedo`."""
        return self.sources.warp("normal", self.centre.guides["normal"]) if "normal" in self.centre.guides else None

    @cached_property
    def guide(self) -> Array | None:
        """The centre's albedo and normal, prefiltered, (H, W, G). Made at the first access."""
        clean = [] if self.centre.clean_albedo is None else [self.centre.clean_albedo]
        if "normal" in self.centre.guides:
            assert self.geometric_confidence is not None
            normal = clean_guide("normal", self.centre.guides, self.sources, self.geometric_confidence, self.stages)
            clean.append(normal)
        return np.concatenate(clean, axis=-1) if clean else None

    @cached_property
    def variance(self) -> Array:
        """The smoothed variance of the centre's `color`, (H, W, 3). Made at the first access."""
        variance = self.centre.frame.variance
        if variance is None:
            return variance_from_window(self.color, self.confidence)
        return smooth_variance(variance[self.sources.rows])

    @property
    def residual(self) -> Array | None:
        """Noisy irradiance − first pass, aligned and limited, (T, H, W, 3); None without a first pass.

        Made at each access.
        """
        return None if self.first_pass is None else self.sources.residual(limited=True)

    def pool(self, weight: Array | None = None) -> PooledSamples:
        """Average the samples of all frames at the centre, by weights (T, H, W) or the confidence; irradiance.

        Over noise that stands still those of the centre alone. Raises ValueError without a first pass.
        """
        if self.first_pass is None:
            raise ValueError("aligned: expected a window with first passes, got none")
        weight = self.confidence if weight is None else weight
        if moves_over_noise(self.stages):
            weight = weight * (np.arange(len(weight)) == self.middle)[:, None, None]
        pooled = PooledSamples(*(np.empty_like(self.centre.irradiance) for _ in PooledSamples._fields))
        for top, residual in self.sources.residual_strips(limited=True):
            rows = slice(top, top + residual.shape[1])
            strip = pool_samples(self.first_pass[:, rows], residual, weight[:, rows], self.brightness.exposure)
            for whole, part in zip(pooled, strip, strict=True):
                whole[rows] = part
        return pooled

    @property
    def middle(self) -> int:
        """Index of the centre frame."""
        return len(self.confidence) // 2

    @property
    def number(self) -> int:
        """Number of the centre frame."""
        return self.centre.frame.number

    def mixed(self, layer: Array) -> Array:
        """Mix the centre into the side frames of `layer` (T, H, W, C), in inverse proportion to confidence."""
        mixed = np.empty(layer.shape, np.float32)
        for warped, confidence, out in zip(layer, self.confidence, mixed, strict=True):
            mix_centre(warped, layer[self.middle], confidence, out)
        return mixed


def warp_rows(layer: Array, flow: Array, first_row: int, out: Array, *, interpolation: str = "bilinear") -> None:
    """Warp a layer (H, W, C) to the centre's rows from `first_row`, by their flow (h, W, 2), into `out` (h, W, C)."""
    if flow.any():
        warp(layer, flow, interpolation=interpolation, first_row=first_row, out=out)
    else:
        out[...] = layer[first_row : first_row + len(out)]


def clean_guide(
    name: str, guides: dict[str, Array], sources: WarpSources, confidence: Array, stages: Collection[str]
) -> Array:
    """Average the centre's "albedo" or "normal" over the window with the stage "prefilter"; else return it."""
    guide = guides[name]
    if "prefilter" not in stages:
        return guide
    return prefilter_guide(guide, partial(sources.warp, name, guide), confidence)
