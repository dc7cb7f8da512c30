"""The noise of frames: its size, its correlation, and how much of it two frames share."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from flow.confidence import ALBEDO_SIGMA, compare_guides, find_coverage, local_variance, measure_share, outline_variance
from flow.patches import CUT
from flow.warp import at_whole_pixels, warp_block
from hybrid.alignment.flows import search_flow
from hybrid.alignment.prepare import PreparedFrame, rendered_flow
from hybrid.alignment.transfer import ALBEDO_FLOOR, measure_exposure, remodulate
from hybrid.files.frame import Array
from loops.parallel import STRIP, Mask, Places
from nlm.average import channel_mean, replace_nonfinite
from nlm.fireflies import TOGETHER
from nlm.pixel_filter import measure_alone, measure_correlation
from nlm.variance import LEAST_ALBEDO, second_differences

# Side of the crop in which fixed noise is measured: enough pixels to detect a correlation of 0.02.
CROP = 512
# Pixels of motion below which a pixel is static, and above which its noise is that of another pixel: a bilinear sample
# loses less than 1 % of its contrast up to the first, and hardly shares the noise beyond the second.
STILL, MOVED_NOISE = 0.05, 1.5
# Neighbouring half floats differ by at least 2^-11 of their value, and by at most 2^-10: values that differ by less
# than the first are the same sample, those up to the second are so near by chance.
SAME, NEAR = 2.0**-12, 2.0**-10
# Pixels between two of a row at which samples are equal by chance alone; where nearly all are, equal ones mean nothing.
APART, LEAST_UNEQUAL = 2, 0.02
# Pixels that differ from their surroundings by less have neither noise nor detail.
GRAIN = 4 * NEAR
# Means of 9×9 pixels of guides that differ by more, in units of albedo, show other surfaces; depth of field leaves
# noise of 0.05 in a pixel, and a tenth of it in these means.
GUIDE_CHANGE = 0.02
# Side of the places in which noise of a frame is measured, by one row of each: all take a tenth of a second at
# 1920×1080. Outlines are compared in so many rows of `SmallFrame.factor` times as many.
PLACE = 16
# Ratio of samples from which on two frames differ in these places: by this measure frames of equal samples differ by up
# to 1.7, and those of four times as many by 1.9 to 8.4.
UNEQUAL = 3.0
# Outlines are compared if this share of the picture moves by whole pixels: 1.6 % of vectors of any length do by chance.
WHOLE_PIXELS = 0.05
# Deviation, pixels, of the Gaussian mean of the ratio of light by which two frames are made equal before their noise is
# compared.
LIGHT_AROUND = 8.0
# Two frames have fixed noise where more than this share of it is the same at equal pixels: of thirty shots with a seed
# for each frame at most 0.07, and 0.17 of frames of 40 rows; of three slow pans with one seed 0.29 to 0.68.
FIXED_NOISE_ABOVE = 0.2
# Least noise, relative to the light, that is compared by what denoised pictures lack: below, lost detail counts too.
RESIDUAL_NOISE = np.float32(0.02)
# A frame repeats another where at least this share is equal: all but burned-in text.
REPEATED = 0.99
# Fewer pixels show nothing of noise.
FEW = 32
# Pixels on each side in which noise is looked for, and the share of lit ones without it that lies on a line with its
# neighbours: of noise of 1 % a third does.
AROUND, STRAIGHT = 16, 0.9
# Sum over the first two lags of the correlation between two frames less that in one, from which on light moves: on
# three shots with filters, of 8 to 512 samples, it is at most 0.07; up to 0.19 where shadows of leaves move.
MOVING_LIGHT = 0.08
#: Correlation of the noise along x and along y, each at 1 to 4 pixels.
Correlation = tuple[tuple[float, ...], tuple[float, ...]]


def near_correlation(lags: Correlation) -> float:
    """The correlation of neighbouring pixels along x or along y, whichever is less."""
    return min(along[0] for along in lags)


def without_moving_light(between: Correlation, alone: Correlation) -> Correlation:
    """The correlation of noise between two frames, or in one alone where moving light has added to the first."""
    first, second = (float(np.mean(lags, axis=0)[:2].sum()) for lags in (between, alone))
    return alone if first > second + MOVING_LIGHT else between


def guide_pairs(frame: PreparedFrame, neighbour: PreparedFrame) -> dict[str, tuple[Array, Array]]:
    """Pairs of the guides that both frames have."""
    pairs = {"albedo": (frame.albedo, neighbour.albedo), "normal": (frame.normal, neighbour.normal)}
    return {name: (guide, other) for name, (guide, other) in pairs.items() if guide is not None and other is not None}


def fixed_noise(frame: PreparedFrame, neighbour: PreparedFrame, *, moves: bool, same: float = SAME) -> float | None:
    """Measure the share of the noise of two frames that is the same at equal pixels, in [-1, 1]; 0 without noise.

    None where most of it moves by less than half a pixel, as detail and noise then correlate alike.

    With `moves` the picture changes at equal pixels: without vectors, motion is then searched for.

    Detail correlates at equal pixels as fixed noise does, so it is removed first. In moving parts each frame is
    compared with the other one, warped to it: d_a = a - b(x + v), d_b = b - a(x - v). With a seed for each frame their
    covariance at equal pixels is 0, with and without detail; with one seed it is half of their variance. Where motion
    is slower but leads to another pixel, the figure is the correlation at equal pixels less that of a(x) and b(x + v),
    v rounded, if that is above 0: detail correlates more along the motion. In slow pans with one seed it is 0.2 to 0.7,
    as the samples of a pixel follow nearly the same paths. In static parts samples of one seed are equal to the bit,
    and samples of two seeds by chance. All are relative to the light, without their 5×5 mean, and clipped at three
    times their median size: fireflies must not decide.
    """
    block = _middle(frame.irradiance.shape[:2])
    a, b = (channel_mean(each.sampled[block]) for each in (frame, neighbour))
    level = 0.5 * (cv2.blur(a, (9, 9)) + cv2.blur(b, (9, 9)))
    floor = 0.01 * measure_exposure(level[..., None])
    noise = [_high_pass(image / (level + floor)) for image in (a, b)]
    grainy = np.minimum(np.abs(noise[0]), np.abs(noise[1])) > GRAIN
    forth, back, slowest = rendered_flow(frame, neighbour), rendered_flow(neighbour, frame), STILL
    if (forth is None or back is None) and moves:
        # Optical flow is exact to some tenths of a pixel: slower motion may be none, and static pixels must be equal.
        forth, back = search_flow(frame.radiance, neighbour.radiance), search_flow(neighbour.radiance, frame.radiance)
        slowest = MOVED_NOISE
    if forth is None or back is None:
        still, moved, slow = np.ones(a.shape, bool), np.zeros(a.shape, bool), np.zeros(a.shape, bool)
    else:
        length = np.hypot(forth[0][block][..., 0], forth[0][block][..., 1])
        still = (length < slowest) & forth[1][block]
        both = forth[1][block] & back[1][block]
        moved, slow = both & (length > MOVED_NOISE), both & grainy & (length > slowest) & (length <= MOVED_NOISE)
    shares, figures, unknown = [], [], 0
    compared = still & grainy
    if compared.any():
        shares.append(int(compared.sum()))
        # Samples of a few values, as black or the light of one lamp, are as often equal at other pixels.
        chance = max(_equal_share(a, np.roll(b, APART, axis=1), compared, same), 0)
        figures.append((_equal_share(a, b, compared, same) - chance) / max(1 - chance, LEAST_UNEQUAL))
    if moved.sum() > CROP and forth is not None and back is not None:
        corner = block[0].start, block[1].start
        d_a, d_b = (
            here - channel_mean(warp_block(np.ascontiguousarray(other), np.ascontiguousarray(flow[block]), corner)[0])
            for here, other, (flow, _) in ((a, neighbour.sampled, forth), (b, frame.sampled, back))
        )
        d = [_high_pass(image / (level + floor))[moved] for image in (d_a, d_b)]
        shares.append(int(moved.sum()))
        figures.append(2 * correlation(*d))
    if slow.sum() > CROP and forth is not None and back is not None:
        for here, there, (flow, _) in ((noise[0], noise[1], forth), (noise[1], noise[0], back)):
            along, other = _at_ends(there, flow[block])
            other &= slow
            if other.any():
                at_equal, at_ends = (correlation(here[other], image[other]) for image in (there, along))
                shares.append(int(other.sum()))
                figures.append(max(at_equal - at_ends, 0.0))
            unknown += int(slow.sum()) - int(other.sum())
    if unknown > sum(shares):
        return None
    return float(np.clip(np.average(figures, weights=shares), -1, 1)) if any(shares) else 0.0


def relative_residual(color: Array, picture: Array) -> Array | None:
    """The noise (h, w) in the middle of a frame by its denoised picture, relative to the light; None if it is little.

    It is clipped at three times its median size: fireflies must not decide.
    """
    block = _middle(color.shape[:2])
    noisy, denoised = (channel_mean(replace_nonfinite(image[block])[0]) for image in (color, picture))
    noise = (noisy - denoised) / (np.abs(denoised) + 0.01 * measure_exposure(denoised[..., None]))
    size = np.float32(np.median(np.abs(noise)))
    return np.clip(noise, -3 * size, 3 * size) if size > RESIDUAL_NOISE else None


def shared_residual(first: Array | None, second: Array | None) -> float:
    """Share of the noise of two frames that is the same at equal pixels, by their `relative_residual`; 0 if unknown.

    It is their correlation there less that with neighbouring pixels, as detail that a denoiser has lost has both. On
    ten shots of 8 to 512 samples it is at most 0.07 with a seed for each frame, on six slow pans with one seed 0.4
    to 0.7.
    """
    if first is None or second is None or min(first.shape) < 2:
        return 0.0
    beside = (
        (first[:, 1:], second[:, :-1]),
        (first[:, :-1], second[:, 1:]),
        (first[1:], second[:-1]),
        (first[:-1], second[1:]),
    )
    return max(correlation(first, second) - max(0.0, *(correlation(*pair) for pair in beside)), 0.0)


def _at_ends(image: Array, flow: Array) -> tuple[Array, Mask]:
    """An image (H, W) at the pixels where a flow (H, W, 2) ends, and where these are others of the image."""
    height, width = image.shape
    moved = np.rint(np.where(np.isfinite(flow), flow, np.float32(-1e6))).astype(np.intp)
    columns, rows = np.arange(width) + moved[..., 0], np.arange(height)[:, None] + moved[..., 1]
    other = moved.any(axis=-1) & (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    return image[rows.clip(0, height - 1), columns.clip(0, width - 1)], other


def noise_correlation(frame: PreparedFrame, neighbour: PreparedFrame) -> Correlation | None:
    """Correlation of the noise of two neighbours (`nlm.pixel_filter.measure_correlation`): 0 without noise.

    None where it is unknown, as at a cut, where most of the picture is not comparable.

    Frames are compared along whole pixels of the vectors, in the middle of the picture, where their guides agree.
    Without vectors and albedo nothing tells texture that moves from noise.
    """
    block = _middle(frame.irradiance.shape[:2])
    height, width = frame.valid.shape
    rows, columns = np.arange(height)[block[0], None], np.arange(width)[None, block[1]]
    vectors = rendered_flow(frame, neighbour)
    if vectors is None and (frame.albedo is None or neighbour.albedo is None):
        return None
    compared = frame.valid[block].copy()
    if vectors is not None:
        moved = np.rint(np.where(vectors[1][block][..., None], vectors[0][block], np.float32(-1e6))).astype(np.intp)
        columns, rows = columns + moved[..., 0], rows + moved[..., 1]
        compared &= (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        rows, columns = rows.clip(0, height - 1), columns.clip(0, width - 1)
    compared &= neighbour.valid[rows, columns]
    for guide, other in guide_pairs(frame, neighbour).values():
        compared &= np.abs(guide[block] - other[rows, columns]).max(axis=-1) < ALBEDO_SIGMA
    first, second = frame.irradiance[block], neighbour.irradiance[rows, columns]
    lit = (np.minimum(first, second) > 0).all(axis=-1) & compared
    ratios = np.log(first, where=lit[..., None], out=np.zeros_like(first))
    ratios -= np.log(second, where=lit[..., None], out=np.zeros_like(second))
    ratios, counted = (cv2.GaussianBlur(layer, (0, 0), LIGHT_AROUND) for layer in (ratios, lit.astype(np.float32)))
    # Below 1e-3 no pixel within 30 is lit in both.
    second = second * np.exp(ratios / np.maximum(counted, np.float32(1e-3))[..., None])
    compared &= (counted > 1e-3) & ((first != 0) | (second != 0)).any(axis=-1)  # what is black in both has no noise
    first, second = channel_mean(first), channel_mean(second)
    measured = measure_correlation(
        first - second, compared, np.float32(GRAIN) * np.maximum(np.abs(first), np.abs(second))
    )
    if measured is None and compared.mean() > CUT:
        measured = np.zeros((2, 4))  # both show the same, without noise
    return None if measured is None else (tuple(measured[0].tolist()), tuple(measured[1].tolist()))


def correlation_alone(frame: PreparedFrame) -> tuple[Correlation, float] | None:
    """Correlation of the noise of one frame, and its lower quartile (`nlm.pixel_filter.measure_alone`), or None.

    Texture correlates as noise under a filter does. The frame needs an albedo that differs between surfaces, and
    normals, as a photograph behind the scene has none. Highlights on texture leave some of it in the quotient of color
    and albedo: noise has to exceed the contrast of the albedo.
    """
    block = _middle(frame.irradiance.shape[:2])
    if not frame.demodulated or frame.albedo is None or frame.normal is None:
        return None
    albedo = frame.albedo[block]
    if np.ptp(albedo) < GUIDE_CHANGE:
        return None
    # Not by the floor of the irradiance, which leaves a part of the texture.
    light = channel_mean(
        np.asarray(remodulate(frame.irradiance[block], albedo) / np.maximum(albedo, LEAST_ALBEDO), np.float32)
    )
    gray = channel_mean(albedo)
    contrast = np.abs(gray - cv2.blur(gray, (3, 3))) / np.maximum(gray, LEAST_ALBEDO)
    texture = np.asarray(cv2.medianBlur(np.asarray(contrast, np.float32), 5), np.float32)  # without outlines
    surface = (frame.normal[block] != 0).any(axis=-1)
    level = np.abs(light)
    measured = measure_alone(light, frame.valid[block] & surface, np.float32(NEAR) * level, texture * level)
    if measured is None:
        return None
    (along_x, along_y), certain = measured
    return (tuple(along_x.tolist()), tuple(along_y.tolist())), certain


def _equal_share(a: Array, b: Array, compared: Mask, same: float) -> float:
    """Share of some pixels at which two images (H, W) have the same sample, less those that are equal by chance."""
    distance, greater = np.abs(a - b)[compared], np.maximum(np.abs(a), np.abs(b))[compared]
    equal, near = (np.count_nonzero(distance <= share * greater) for share in (same, max(NEAR, 2 * same)))
    # Noise of a thousandth makes as many halves equal by chance as half of those one step apart; in a fade, where
    # none is one step apart, as many as those up to twice as far.
    return float((equal - (near - equal) / (2 if same == SAME else 1)) / distance.size)


@dataclass(frozen=True)
class Grain:
    """The samples of a frame (H, W, 3), and their deviation from those around them."""

    samples: Array

    @cached_property
    def level(self) -> Array:
        """Mean (H, W) over channels."""
        return channel_mean(self.samples)

    @cached_property
    def deviation(self) -> Array:
        """Absolute difference (H, W) of the level from the median of 5×5 pixels."""
        return np.asarray(np.abs(self.level - cv2.medianBlur(self.level, 5)))


def equal_noise(frame: Grain, other: Grain, same: float = SAME) -> tuple[Array, Array]:
    """Find pixels at which two frames have noise or detail, and those at which it is the same sample.

    The first (H, W) is 1 where both differ from the median of 5×5 pixels by more than 2^-8 of their value, and are not
    both black, as pixels of few samples are by chance; else 0. The second is 1 where they are also equal, as half
    floats; in a fade that is up to `NEAR`, as both are rounded.
    """
    a, b = frame.level, other.level
    most = np.maximum(np.abs(a), np.abs(b))
    grainy = (np.minimum(frame.deviation, other.deviation) > GRAIN * most) & (most > 0)
    return grainy.astype(np.float32), (grainy & (np.abs(a - b) <= same * most)).astype(np.float32)


def repeats(frame: Array, other: Array, same: float = SAME) -> bool:
    """Return whether a frame (H, W, 3) repeats another, by `equal_noise`; False if hardly any pixel has detail."""
    height, size, grainy, equal = len(frame), frame.shape[0] * frame.shape[1], 0, 0
    for top in range(0, height, STRIP):
        # With the two rows on each side that a median of 5×5 pixels reads.
        first, last = max(top - 2, 0), min(top + STRIP, height)
        detail, alike = equal_noise(Grain(frame[first : last + 2]), Grain(other[first : last + 2]), same)
        grainy += int(np.count_nonzero(detail[top - first : last - first]))
        equal += int(np.count_nonzero(alike[top - first : last - first]))
        if grainy - equal > (1 - REPEATED) * size:  # too many already
            return False
    return bool(grainy >= FEW and equal >= REPEATED * grainy)


def noise_free_around(frame: PreparedFrame, places: Places) -> Mask:
    """Return whether there is no noise around places (K, 2); False where hardly any pixel is lit.

    A pixel's color, or its light, color over albedo, is then the mean of those on two sides of it, as far as halves
    show. A pixel without noise is seen or lit directly, and has no fireflies.
    """
    lit, straight = np.zeros((2, len(places)), int)
    near, (height, width) = np.arange(-AROUND, AROUND + 1), frame.valid.shape
    for first in range(0, len(places), TOGETHER):
        some = slice(first, first + TOGETHER)
        y, x = (places[some, axis, None] + near for axis in (0, 1))
        inside = ((y >= 0) & (y < height))[:, :, None] & ((x >= 0) & (x < width))[:, None]
        rows, columns = np.clip(y, 0, height - 1)[:, :, None], np.clip(x, 0, width - 1)[:, None]
        color, divisor = frame.irradiance[rows, columns], frame.divisor_at(rows, columns)
        shown = [color]
        if divisor is not None:
            color = color * divisor
            shown = [color, color / np.maximum(divisor - np.float32(ALBEDO_FLOOR), LEAST_ALBEDO)]
        for layer in shown:
            level = np.where(inside, layer.mean(axis=-1), np.float32(0))
            centre = level[:, 1:-1, 1:-1]
            sides = level[:, 1:-1, :-2] + level[:, 1:-1, 2:], level[:, :-2, 1:-1] + level[:, 2:, 1:-1]
            off = np.minimum(*(np.abs(side / 2 - centre) for side in sides))
            lit[some] = (centre > 0).sum(axis=(1, 2))
            count = ((centre > 0) & (off <= 2 * NEAR * centre)).sum(axis=(1, 2))
            straight[some] = np.maximum(straight[some], count)
    return np.asarray((lit >= FEW) & (straight >= STRAIGHT * lit))


def is_noise_free(frame: PreparedFrame) -> bool:
    """Whether there is no noise in most of a frame: if it equals its neighbour, none of its samples is there twice."""
    height, width = frame.valid.shape
    grid = np.mgrid[AROUND : height : 2 * AROUND, AROUND : width : 2 * AROUND].reshape(2, -1).T
    return bool(len(grid)) and float(noise_free_around(frame, grid).mean()) > STRAIGHT


def same_noise_at(grainy: Array, equal: Array, pixels: Places) -> Mask:
    """Return whether two frames, by `equal_noise`, have the same noise around each of some pixels, (K,) bool."""
    share = float(equal.sum() / max(grainy.sum(), 1))
    rows, columns = (np.clip(pixels[:, axis], 0, grainy.shape[axis] - 1) for axis in (0, 1))
    side = (2 * AROUND + 1, 2 * AROUND + 1)
    count, same = (cv2.boxFilter(m, -1, side, normalize=False)[rows, columns] for m in (grainy, equal))
    return np.asarray(np.where(count >= FEW, same / np.maximum(count, 1), share) > FIXED_NOISE_ABOVE)


def measure_guide_noise(
    frame: PreparedFrame, neighbour: PreparedFrame, vectors: tuple[Array, Mask] | None, factor: int
) -> float:
    """Upper quartile of guide differences over every `factor`-th pixel; reduced guides would have less noise."""
    grid = slice(factor // 2, None, factor)
    differences = []
    for guide, other in guide_pairs(frame, neighbour).values():
        moved = other[grid]
        if vectors is not None:
            whole = np.ascontiguousarray(other)
            rows = enumerate(vectors[0][grid, None])
            moved = np.concatenate([warp_block(whole, row, (factor // 2 + n * factor, 0))[0] for n, row in rows])
        differences += [*np.moveaxis(np.abs(guide[grid, grid] - moved[:, grid]), -1, 0)]
    return float(np.quantile(np.maximum.reduce(differences), 0.75)) if differences else 0.0


def measure_outline_noise(
    frame: PreparedFrame, neighbour: PreparedFrame, vectors: tuple[Array, Mask] | None, factor: int
) -> tuple[float, float] | None:
    """Share of the noise of albedo and normals at outlines that move by whole pixels, in one of `factor` bands of rows.

    None without vectors or guides, and where next to nothing moves by whole pixels.
    """
    both = guide_pairs(frame, neighbour)
    if vectors is None or not both or at_whole_pixels(vectors[0][::factor, ::factor]).mean() < WHOLE_PIXELS:
        return None
    others = {f"other_{name}": other for name, (_, other) in both.items()}
    bands: list[tuple[Array, Array, Mask]] = []
    for top in range(0, len(frame.valid), factor * PLACE):
        rows = slice(top, top + PLACE)
        guides = {name: guide[rows] for name, (guide, _) in both.items()}
        flow, valid = (layer[rows] for layer in vectors)
        inside = find_coverage(flow, valid, neighbour.valid, top) & at_whole_pixels(flow)
        distance = compare_guides(flow, inside=inside, **guides, **others, first_row=top)
        outlines = outline_variance(local_variance(guides.get("albedo"), guides.get("normal")), distance)
        bands.append((outlines, distance, inside))
    return measure_share(*(np.concatenate(layers) for layers in zip(*bands, strict=True)))


def measure_guide_grain(guides: Sequence[Array]) -> float | None:
    """Upper quartile of the second differences of guides (H, W, C) in every `PLACE`-th row."""
    if not guides:
        return None
    grain, shown = np.zeros(1, np.float32), np.zeros(1, bool)
    for bent, level in map(_second_differences, guides):
        grain, shown = np.maximum(grain, np.abs(bent).max(axis=-1)), shown | (level != 0).any(axis=-1)
    return float(np.quantile(grain[shown], 0.75)) if shown.any() else 0.0


def measure_alpha_grain(alpha: Array) -> float:
    """Median of the second differences of alpha (H, W, 1) within soft shadows and rims, which outlines are not."""
    partly = (alpha[..., 0] > 0) & (alpha[..., 0] < 1)
    if np.count_nonzero(partly) < FEW:
        return 0.0
    soft = cv2.erode(partly.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    bent = np.abs(second_differences(alpha)[..., 0][soft]) / np.float32(6)
    return float(np.median(bent)) if len(bent) >= FEW else 0.0


def measure_noise(light: Array) -> float:
    """Median of the second differences of lit pixels, relative to the light, in every `PLACE`-th row."""
    bent, level = (part.mean(axis=-1) for part in _second_differences(light))
    lit = level > 0
    return float(np.median(np.abs(bent[lit]) / level[lit])) if lit.any() else 0.0


def samples_ratio(earlier: PreparedFrame, later: PreparedFrame) -> float:
    """Samples of the later frame over those of the earlier one: as stated, or by noise; 1 where that is similar."""
    if earlier.samples is not None and later.samples is not None:
        return later.samples / earlier.samples
    noises = []
    for frame in (earlier, later):
        change, level = (
            np.add.reduceat(part.mean(axis=-1), np.arange(0, part.shape[1], PLACE), axis=1)
            for part in map(np.abs, _second_differences(frame.irradiance))
        )
        noises.append(np.divide(change, level, out=np.zeros_like(change), where=level > 0))
    grainy = np.minimum(noises[0], noises[1]) > GRAIN
    if np.count_nonzero(grainy) < FEW:
        return 1.0
    # Detail that changes has no one ratio: three quarters of the places must show it.
    least, ratio, most = np.quantile(noises[0][grainy] / noises[1][grainy], (0.25, 0.5, 0.75)) ** 2
    return float(ratio) if least >= UNEQUAL or most <= 1 / UNEQUAL else 1.0


def _second_differences(layer: Array) -> tuple[Array, Array]:
    """Second differences, in units of the noise, and means of 3×3 pixels, in some rows of a layer (H, W, C)."""
    rows = np.arange(1, len(layer) - 1, PLACE)[:, None] + np.arange(-1, 2)  # with one on each side
    if not rows.size:
        return layer[:0], layer[:0]
    strips = layer[rows.ravel()]
    return second_differences(strips)[1::3] / np.float32(6), np.asarray(cv2.blur(strips, (3, 3)), np.float32)[1::3]


def _middle(shape: tuple[int, int]) -> tuple[slice, slice]:
    """The block of at most `CROP` pixels on a side in the middle of a frame."""
    starts = [max(size - CROP, 0) // 2 for size in shape]
    return slice(starts[0], starts[0] + CROP), slice(starts[1], starts[1] + CROP)


def _high_pass(image: Array) -> Array:
    noise = image - cv2.blur(image, (5, 5))
    limit = 3 * float(np.median(np.abs(noise[::2, ::2])))  # a quarter of the pixels takes a quarter of the time
    return np.asarray(np.clip(noise, -limit, limit), np.float32)


def correlation(a: Array, b: Array) -> float:
    """Return the correlation of two arrays, in [-1, 1]; 0 if one is constant."""
    first, second = a - a.mean(), b - b.mean()
    power = float(np.sqrt(np.mean(first**2) * np.mean(second**2)))
    return float(np.mean(first * second)) / power if power > 0 else 0.0
