"""Measurements of frames and pairs, from which stages are chosen alike in every part of a shot (`denoising.plan`)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np

from flow.patches import CUT
from flow.warp import warp
from hybrid.alignment.fade import NO_FADE, Fade, find_factors, inverse, scaled
from hybrid.alignment.flows import search_flow
from hybrid.alignment.noise import (
    AROUND,
    GUIDE_CHANGE,
    NEAR,
    SAME,
    Correlation,
    fixed_noise,
    guide_pairs,
    is_noise_free,
    measure_alpha_grain,
    measure_guide_grain,
    measure_guide_noise,
    measure_noise,
    measure_outline_noise,
    repeats,
    samples_ratio,
)
from hybrid.alignment.prepare import SHORT_SIDE, PreparedFrame, rendered_flow, rough_light
from hybrid.alignment.transfer import compress, measure_exposure, remodulate
from hybrid.files.frame import Array
from loops.parallel import Mask
from nlm.average import channel_mean, reject_outliers
from nlm.gate import color_gate

# Areas whose means show changes that noise hides in 9×9 pixels: they must differ by more than a twentieth, and by eight
# standard errors, as samples that a pixel filter spreads are alike in several pixels.
AREA, AREA_CHANGE, AREA_NOISE = 32, 0.05, 8.0
# A tile that differs from its smoothed version by less than this, relative to exposure, has no noise.
NOISE_FREE = 1e-4


@dataclass(frozen=True)
class FrameFacts:
    """Measurements of one frame."""

    number: int
    albedo_spread: float | None  # standard deviation of the albedo over the frame
    noise: float  # median over lit pixels of the noise, or texture, of a pixel relative to its light
    # upper quartile over pixels of the noise or texture of the size of a pixel in albedo and normal; None without these
    guide_grain: float | None
    fireflies: int  # number of fireflies that were removed
    outliers: float  # share of the pixels far above all their neighbours, in [0, 1]
    transparent: float | None  # share of the pixels whose alpha is below 0.999
    noise_free: float  # share of the tiles without noise, in [0, 1]
    samples: float | None  # samples per pixel, if known
    noise_correlation: Correlation | None = None  # of the noise; None if unknown
    # where that was measured in the frame alone, its lower quartile over the picture at one pixel; else None
    noise_correlation_alone: float | None = None
    alpha_grain: float = 0.0  # median noise, or texture, of alpha where all of 3×3 pixels are partly transparent


@dataclass(frozen=True)
class PairFacts:
    """Measurements of two neighbouring frames."""

    numbers: tuple[int, int]  # ascending
    vectors: bool  # whether the frames have motion vectors
    speed: float  # pixels per frame, the 0.999 quantile of the vectors; 0 without vectors
    changed: float  # share of the picture that changes at equal pixels by more than noise, in [0, 1]
    # share of the picture whose light changes along the vectors by more than noise; `changed` without vectors
    unexplained: float
    # share of the noise that is fixed to the screen, in [-1, 1]: about 1 with one seed for all frames, else 0; None if
    # it is known of frames farther apart alone
    fixed_noise: float | None
    guide_noise: float  # upper quartile of the difference of albedo and normal between the frames, along the vectors
    # share of the noise of albedo and normals in their variance at outlines (`flow.confidence.measure_share`); None
    # where it cannot be measured
    outline_noise: tuple[float, float] | None = None
    cut: bool = False  # whether the frames are of different scenes, so that they must not be averaged
    repeated: bool = False  # whether the later frame repeats the earlier one, and has no samples of its own
    # factor of each channel from the earlier frame to the later, where they explain most of the change; else 1
    fade: Fade = NO_FADE
    # share of the noise at equal pixels by denoised pictures in the files (`shared_residual`), in [0, 1]; 0 without
    shared_noise: float = 0.0
    samples: float = 1.0  # samples of the later frame over those of the earlier one


@dataclass(frozen=True)
class SmallFrame:
    """A frame reduced by a whole `factor` for measuring."""

    factor: int
    # (h, w, 3): means over factor × factor pixels, noisy and without most of the noise
    irradiance: Array
    light: Array
    albedo: Array | None  # (h, w, 3): divisor of the irradiance
    valid: Mask  # (h, w): where the frame has been rendered

    def textured(self) -> Self:
        """Return the frame times its albedo: motion shows in texture first."""
        if self.albedo is None:
            return self
        irradiance, light = (remodulate(layer, self.albedo) for layer in (self.irradiance, self.light))
        return replace(self, irradiance=irradiance, light=light, albedo=None)

    def relit(self, fade: Fade) -> Self:
        """Return the frame with `fade` times its light."""
        irradiance, light = (layer * np.array(fade, np.float32) for layer in (self.irradiance, self.light))
        return self if fade == NO_FADE else replace(self, irradiance=irradiance, light=light)


def shrink(frame: PreparedFrame) -> SmallFrame:
    """Reduce a frame to about `SHORT_SIDE` rows."""
    height, width = frame.irradiance.shape[:2]
    factor = round(min(height, width) / SHORT_SIDE)
    if min(height, width) < 2 * SHORT_SIDE:
        albedo = frame.albedo if frame.demodulated else None
        return SmallFrame(1, frame.irradiance, frame.light, albedo, frame.valid)
    irradiance = _means(frame.irradiance, factor)
    albedo, normal = (None if layer is None else _means(layer, factor) for layer in (frame.albedo, frame.normal))
    light = rough_light(irradiance, albedo, normal)
    valid = _means(frame.valid.astype(np.float32)[..., None], factor)[..., 0] > 0.5
    return SmallFrame(factor, irradiance, light, albedo if frame.demodulated else None, valid)


def measure_frame(frame: PreparedFrame, small: SmallFrame) -> FrameFacts:
    """Measure one frame, and its `shrink`."""
    _, rejected = reject_outliers(frame.irradiance[None], frame.valid[None].astype(np.float32))
    return FrameFacts(
        number=frame.number,
        albedo_spread=None if frame.albedo is None else float(frame.albedo.std()),
        noise=measure_noise(frame.irradiance),
        guide_grain=measure_guide_grain([guide for guide in (frame.albedo, frame.normal) if guide is not None]),
        fireflies=frame.fireflies,
        outliers=float(np.mean(rejected)),
        transparent=None if frame.alpha is None else float(np.mean(frame.alpha < 0.999)),
        noise_free=_noise_free_share(small),
        samples=frame.samples,
        alpha_grain=0.0 if frame.alpha is None else measure_alpha_grain(frame.alpha),
    )


def measure_pair(earlier: PreparedFrame, later: PreparedFrame, smalls: tuple[SmallFrame, SmallFrame]) -> PairFacts:
    """Measure two neighbouring frames, in order of time, and their `shrink`."""
    vectors = rendered_flow(earlier, later)
    changed = _changed(smalls[0].textured(), smalls[1].textured(), None)
    if vectors is None:  # motion shows in the guides first, which have next to no noise
        changed = max(changed, _guide_change(earlier, later))
    speed = 0.0
    if vectors is not None:
        factor = smalls[0].factor
        flow = vectors[0][factor // 2 :: factor, factor // 2 :: factor]
        speed = float(np.quantile(np.hypot(flow[..., 0], flow[..., 1]), 0.999))
    reduced = None if vectors is None else _reduced(vectors, smalls[0])
    fade = _fade(*smalls, reduced)
    alike = smalls[0], smalls[1].relit(inverse(fade))
    differ = changed if fade == NO_FADE else _changed(alike[0].textured(), alike[1].textured(), None)
    lit, same = (later, SAME) if fade == NO_FADE else (scaled(later, inverse(fade)), NEAR)
    equal = repeats(earlier.sampled, lit.sampled, same)
    free = equal and is_noise_free(earlier)
    cut = differ > CUT and _is_cut(earlier, later, alike, vectors)
    unexplained = changed if reduced is None else _changed(*smalls, reduced)
    return PairFacts(
        numbers=(earlier.number, later.number),
        vectors=vectors is not None,
        speed=speed,
        changed=changed,
        unexplained=max(unexplained, _changed_areas(*smalls, reduced)),
        fixed_noise=0.0 if free else fixed_noise(earlier, lit, moves=changed > 0, same=same),
        guide_noise=measure_guide_noise(earlier, later, vectors, smalls[0].factor),
        outline_noise=measure_outline_noise(earlier, later, vectors, smalls[0].factor),
        cut=cut,
        repeated=equal and not free,
        fade=NO_FADE if cut else fade,
        samples=samples_ratio(earlier, later),
    )


def _is_cut(
    earlier: PreparedFrame,
    later: PreparedFrame,
    smalls: tuple[SmallFrame, SmallFrame],
    vectors: tuple[Array, Mask] | None,
) -> bool:
    """Whether neither vectors nor optical flow connect two frames that differ much.

    A change of light does as much, but leaves the guides as they are: along the vectors 0.04 to 0.36 of them changed,
    at a cut 0.7 to 0.96.
    """
    shown = smalls[0].textured(), smalls[1].textured()
    if vectors is not None and _changed(*shown, _reduced(vectors, smalls[0])) <= CUT:
        return False
    flow = search_flow(shown[0].light, shown[1].light)
    if _changed(*shown, flow) <= CUT * _changed(*shown, None):
        return False
    guides = [*guide_pairs(earlier, later).values()]
    return not guides or _guide_change(earlier, later, vectors or search_flow(*guides[0])) > CUT


def _changed(frame: SmallFrame, neighbour: SmallFrame, vectors: tuple[Array, Mask] | None) -> float:
    """Share of the picture whose light differs between two frames by more than its noise, along `vectors`."""
    exposure = measure_exposure(frame.light, neighbour.light)
    other, inside = neighbour.light, np.ones(frame.light.shape[:2], bool)
    if vectors is not None:
        other, inside = warp(other, vectors[0])
        inside &= vectors[1]
    inside &= _coverage(frame, neighbour)
    window = np.stack([other, frame.light, other])
    weight = color_gate(window, frame.irradiance, exposure)[0]
    # The gate is e^-1 where 9×9 means differ by its scale, as 1 or 2 % of them do by noise alone. At twice the scale
    # noise brings one in a thousand.
    return float(np.mean(weight[inside] < np.exp(-4))) if inside.any() else 0.0


def _fade(frame: SmallFrame, neighbour: SmallFrame, vectors: tuple[Array, Mask] | None) -> Fade:
    """Factors of light from the first of two frames to the second, along `vectors`; 1 where none explain the change."""
    other, compared = neighbour.light, frame.valid & neighbour.valid
    if vectors is not None:
        other, inside = warp(neighbour.light, vectors[0])
        compared = frame.valid & inside & vectors[1]
    red, green, blue = find_factors(frame.light, other, compared, frame.irradiance - frame.light)
    return float(red), float(green), float(blue)


def _changed_areas(frame: SmallFrame, neighbour: SmallFrame, vectors: tuple[Array, Mask] | None) -> float:
    """Share of the picture in areas whose mean light differs by more than noise, along `vectors`.

    Areas are of 32×32 pixels, or the whole picture; differences are relative to the light of both, or to a twentieth of
    the exposure in the dark: the mean of tone-mapped noise would depend on its variance, which warping reduces.
    """
    shape = frame.light.shape[:2]
    both, light, inside = [frame.irradiance, neighbour.irradiance], neighbour.light, np.ones(shape, bool)
    if vectors is not None:
        (both[1], inside), (light, _) = warp(neighbour.irradiance, vectors[0]), warp(neighbour.light, vectors[0])
        inside &= vectors[1]
    inside &= _coverage(frame, neighbour)
    floor = np.float32(0.05 * measure_exposure(frame.light, neighbour.light))
    level = 0.5 * (channel_mean(frame.light) + channel_mean(light)) + floor
    difference = np.where(inside, (channel_mean(both[1]) - channel_mean(both[0])) / level, np.float32(0))
    sums = np.stack([difference, np.square(difference), inside.astype(np.float32)], axis=-1)
    shares = [0.0]
    for side in {min(AREA, *shape), min(shape)} - {*range(8)}:  # fewer pixels give no estimate of the noise
        mean, square, covered = np.moveaxis(_means(sums, side).astype(np.float64), 2, 0)
        full = covered > 0.5
        mean, square = mean[full] / covered[full], square[full] / covered[full]
        error = np.sqrt(np.maximum(square - np.square(mean), 0) / (side**2 * covered[full]))
        changed = (np.abs(mean) > AREA_CHANGE) & (np.abs(mean) > AREA_NOISE * error)
        shares.append(float(changed.sum() / max(full.sum(), 1)))
    return max(shares)


def _coverage(frame: SmallFrame, neighbour: SmallFrame) -> Mask:
    """Where the first of two frames is lit; where either is, if less than half of that: uncovered background."""
    # Closed: noise leaves single pixels of lit surfaces black.
    lit = ((each.valid & (channel_mean(each.irradiance) > 0)).astype(np.uint8) for each in (frame, neighbour))
    shown = [cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0 for mask in lit]
    if 2 * np.count_nonzero(shown[0]) > np.count_nonzero(shown[1]):
        return np.asarray(shown[0])
    return np.asarray(np.logical_or(*shown))


def _reduced(vectors: tuple[Array, Mask], small: SmallFrame) -> tuple[Array, Mask]:
    """Vectors of the small frame: means of the valid ones, in its pixels."""
    flow, valid = vectors
    if small.factor == 1:
        return vectors
    covered = _means(valid.astype(np.float32)[..., None], small.factor)[..., 0]
    mean = _means(np.where(valid[..., None], flow, np.float32(0)), small.factor)
    share = np.maximum(covered, np.float32(1 / small.factor**2))[..., None]
    return np.asarray(mean / share / np.float32(small.factor), np.float32), covered > 0.5


def least_outline_noise(pairs: Sequence[PairFacts]) -> tuple[float, float] | None:
    """Return the least noise of albedo and of normals at outlines: errors of vectors add to the others.

    None if it is unknown for a pair without a cut, and without pairs.
    """
    noises = [pair.outline_noise for pair in pairs if not pair.cut]
    measured = [noise for noise in noises if noise is not None]
    return (
        (min(n[0] for n in measured), min(n[1] for n in measured))
        if measured and len(measured) == len(noises)
        else None
    )


def _guide_change(frame: PreparedFrame, neighbour: PreparedFrame, vectors: tuple[Array, Mask] | None = None) -> float:
    """Share of the picture whose guides differ along the vectors, in means of 9×9 pixels, by more than noise."""
    shares = [0.0]
    for guide, other in guide_pairs(frame, neighbour).values():
        moved = other if vectors is None else warp(other, vectors[0])[0]
        difference = cv2.blur(guide - moved, (9, 9))
        shares.append(float(np.mean(np.square(difference).sum(axis=-1) > 3 * GUIDE_CHANGE**2)))
    return max(shares)


def _noise_free_share(small: SmallFrame) -> float:
    exposure = measure_exposure(small.light)
    removed = np.abs(compress(small.irradiance, exposure) - compress(small.light, exposure)).max(axis=-1)
    side = max(2 * AROUND // small.factor, 1)
    for axis, length in enumerate(removed.shape):
        removed = np.maximum.reduceat(removed, np.arange(0, length, side), axis=axis)
    return float(np.mean(removed < NOISE_FREE))


def _means(layer: Array, factor: int) -> Array:
    """Means over blocks of factor × factor pixels; incomplete blocks at the end are left out."""
    height, width = (size // factor for size in layer.shape[:2])
    cut = np.ascontiguousarray(layer[: height * factor, : width * factor])
    small = cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small.reshape(height, width, layer.shape[-1]), np.float32)
