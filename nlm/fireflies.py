"""Isolated bright samples: fireflies are removed before any filter spreads them; persistent highlights are added back.

A persistent highlight is a light of one or two pixels that neighbouring frames show along the motion. K highlights have
(K, 2) rows and columns.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from loops.parallel import Doubles, Floats, Mask, Places, run_bands
from nlm.average import channel_mean

Points = Doubles

# A bright sample is so many times as bright as the brightest pixel of the ring around it, and as the ring's mean. A
# firefly is so many times brighter yet. Weaker ones are left to the network: removed in single frames, they cost 85
# training frames 0.04 dB in the mean and 0.37 at most. With 16 *kitchen* loses 0.4 dB at 512 samples.
OVER_BRIGHTEST, OVER_MEAN = 16.0, 64.0
FIREFLY = 4.0
# Another frame shows the same highlight where the centre is within so many pixels of the moved position, and the light
# differs by at most this share of the sum of both: a quarter is a factor of 0.6. In glass and caustics of 8 samples a
# pixel one of 344 bright samples passed this test in both neighbours.
NEAR = 0.75
DIFFERENT = 0.25
# A sample that another frame shows within 3 pixels at a quarter of its brightness is ordinary noise and no firefly:
# kitchens at 8 samples a pixel lose a tenth of their light, and 2 dB, without such samples.
SPREAD, RECURS = 7, 0.25
DIM = 1 / 16  # pixels of a 3×3 pattern below this share of its brightest pixel are noise of the surroundings
# Two frames may agree by chance where noise is so strong that the other has more than 3 samples of a quarter of the
# highlight's brightness within 8 pixels that the frame lacks: kitchens have 3 to 90 there. Fireflies on a hundredth of
# the pixels are 2.
STRANGER_WINDOW, STRANGERS = 17, 3
# Patterns are averaged over frames where the highlight is within so many pixels of the same place in its pixel: farther
# away the light spreads over other pixels.
SAME_PHASE = 0.25
# Places whose surroundings are looked at together: those of all at once would take gigabytes.
TOGETHER = 256


@dataclass(frozen=True)
class Highlights:
    """K lights of one or two pixels in one frame."""

    pixels: Places  # (K, 2) middle of the 3×3 pixels of each
    points: Points  # (K, 2) centre of each; pixel centres are integers
    light: Floats  # (K, C) radiance above the surroundings, summed over the 3×3 pixels; NaN outside the frame
    pattern: Floats  # (K, 3, 3) distribution over these pixels, in the mean over channels

    def __getitem__(self, chosen: Mask) -> "Highlights":
        """Select some highlights by a mask (K,)."""
        return Highlights(self.pixels[chosen], self.points[chosen], self.light[chosen], self.pattern[chosen])


_BRIGHT, _FIREFLY = 1, 2


def nearest_pixel(points: Points) -> Places:
    """Return the pixels (K, 2) that contain points; halves round up."""
    return np.floor(points + 0.5).astype(np.intp)


def find_bright_samples(color: Floats) -> tuple[Places, Mask]:
    """Find isolated bright samples, the candidates for highlights, and which of them are fireflies.

    Returns row and column (K, 2) of the brightest pixel of each, and (K,) True for a firefly. The color is finite.

    In the mean over channels, a pixel that no other of its 3×3 exceeds is bright where it is above 16 times the
    brightest but one and 64 times the mean of the 5×5 ring around these: a renderer's pixel filter may spread a sample
    over 3×3 pixels. It is a firefly where it is above 64 times the brightest and 256 times the mean. Nothing is found
    where the ring is black: there a spark may be all the light.
    """
    if color.ndim != 3:
        raise ValueError(f"color: expected (height, width, channels), got {color.shape}")
    level = channel_mean(color)
    found = np.zeros(level.shape, np.uint8)
    run_bands(_find, len(level), level, OVER_BRIGHTEST, OVER_MEAN, FIREFLY, found)
    places = np.argwhere(found)
    return places, found[places[:, 0], places[:, 1]] == _FIREFLY


def measure_highlights(
    color: Floats, pixels: Places, factor: Callable[[Places, Places], Floats | None] = lambda *_: None
) -> Highlights:
    """Measure position, light and pattern of pixels (K, 2), anywhere, above their surroundings in a color (H, W, C).

    `factor` maps rows and columns (K, y, x) to the factor (K, y, x, C) from the color to radiance there, or to None.
    The light is Σ f (c − r) over the 3×3 around a pixel, r the mean of the 5×5 ring around these without its brightest
    pixel: this holds all of a small lamp under a pixel filter of up to 1.5 pixels, wherever in the pixel the lamp is.
    """
    rows, columns, inside = _blocks(pixels, color.shape)
    block = color[rows, columns].astype(np.float64)
    core = (block - _around(block, inside)[:, None, None])[:, 1:4, 1:4] * inside[:, 1:4, 1:4, None]
    if (scale := factor(rows[:, 1:4, 1:4], columns[:, 1:4, 1:4])) is not None:
        core *= scale
    light = core.sum(axis=(1, 2))
    light[~inside[:, 2, 2]] = np.nan
    pattern = core.mean(axis=-1)
    weight = _significant(pattern)
    total, side = weight.sum(axis=(1, 2))[:, None], np.array([-1, 0, 1])
    offset = np.stack([weight.sum(axis=2) @ side, weight.sum(axis=1) @ side], axis=-1)
    points = pixels + np.divide(offset, total, out=np.zeros_like(offset), where=total > 0)
    return Highlights(pixels, points, light.astype(np.float32), pattern.astype(np.float32))


def follow_motion(lights: Highlights, moved: Points) -> Places:
    """Return the pixels (K, 2) that highlights reach with the motion to (K, 2) rows and columns."""
    straight = lights.pixels + nearest_pixel(moved)
    return np.where(_same_phase(moved)[:, None], straight, nearest_pixel(lights.points + moved))


def same_highlight(first: Highlights, moved: Points, second: Highlights) -> Mask:
    """Return where (K,) a highlight, moved by up to 0.75 pixels, is shown: Σ |a − b| ≤ Σ (a + b) / 4 over channels."""
    far = np.hypot(*(second.points - first.points - moved).T)
    difference, total = np.abs(first.light - second.light).sum(axis=1), (first.light + second.light).sum(axis=1)
    return np.asarray((far <= NEAR) & (difference <= DIFFERENT * total))


def without_strangers(lights: Highlights, color: Floats, pixels: Places, other: Floats) -> Mask:
    """Return around which highlights (K,) of a frame the other frame has no bright samples of its lights at `pixels`.

    At most 3 of 17×17 pixels are above a quarter of the brightest where the frame has none above an eighth beside.
    """
    counts = [np.zeros(0, np.intp)]
    for first in range(0, len(pixels), TOGETHER):
        some = slice(first, first + TOGETHER)
        # A pixel more on each side, for the brightest of 3×3 pixels.
        own, around = (_levels(color, lights.pixels[some], side) for side in (3, STRANGER_WINDOW + 2))
        near = np.maximum(np.maximum(around[:, :-2], around[:, 1:-1]), around[:, 2:])
        near = np.maximum(np.maximum(near[..., :-2], near[..., 1:-1]), near[..., 2:])
        bright = _levels(other, pixels[some], STRANGER_WINDOW)
        peak = own.max(axis=(1, 2), keepdims=True)
        inside = np.isfinite(around[:, 1:-1, 1:-1])
        counts.append(np.count_nonzero(inside & (bright > peak / 4) & (near < peak / 8), axis=(1, 2)))
    return np.asarray(np.concatenate(counts) <= STRANGERS)


def recurs_nearby(places: Places, color: Floats, pixels: Places, other: Floats) -> Mask:
    """Return which bright samples (K,) recur: at `pixels` the other frame has a quarter of the brightness within 3
    pixels.
    """
    rows, columns, inside = (block[:, 0, 0] for block in _blocks(pixels, color.shape, 1))
    nearby = [np.zeros(0, np.float32)]
    for first in range(0, len(places), TOGETHER):
        some = slice(first, first + TOGETHER)
        around = _levels(other, np.stack([rows[some], columns[some]], axis=-1), SPREAD)
        nearby.append(around.max(axis=(1, 2)))
    near = np.concatenate(nearby)
    return np.asarray(inside & (near >= RECURS * channel_mean(color[places[:, 0], places[:, 1]][None])[0]))


def average_highlights(lights: Highlights, others: Sequence[tuple[Highlights, Points, Mask]]) -> Highlights:
    """Average the light of highlights over the frames that show them, with equal weights, at the positions of `lights`.

    Others are measured in other frames, with the motion there, and where (K,) they are the same. Patterns of frames
    with another place in the pixel are left out; a pattern sums to 1.
    """
    light, count, pattern = (
        lights.light.astype(np.float64),
        np.ones(len(lights.light)),
        lights.pattern.astype(np.float64),
    )
    for other, moved, shown in others:
        light[shown] += other.light[shown]
        count += shown
        alike = shown & _same_phase(moved)
        pattern[alike] += other.pattern[alike]
    pattern = _significant(pattern)
    # A light that was found has some, but for a sample whose surroundings, without the pixel filter, are brighter.
    total = pattern.sum(axis=(1, 2), keepdims=True)
    pattern = np.divide(pattern, total, out=np.zeros_like(pattern), where=total != 0)
    mean = (light / count[:, None]).astype(np.float32)
    return Highlights(lights.pixels, lights.points, mean, pattern.astype(np.float32))


def add_highlights(picture: Floats, lights: Highlights) -> Floats:
    """Return radiance (H, W, C) with highlights of `average_highlights` added by their patterns."""
    brighter = picture.copy()
    blocks = _blocks(lights.pixels, picture.shape, 3)
    for rows, columns, inside, light, pattern in zip(*blocks, lights.light, lights.pattern, strict=True):
        brighter[rows[inside], columns[inside]] += pattern[inside][:, None] * light
    return brighter


def remove_highlights(color: Floats, pixels: Places) -> Floats:
    """Return radiance or irradiance (H, W, C) with the 3×3 pixels of each highlight replaced by its surroundings."""
    rows, columns, inside = _blocks(pixels, color.shape)
    around, core = _around(color[rows, columns].astype(np.float64), inside), inside[:, 1:4, 1:4]
    clean = color.copy()
    clean[rows[:, 1:4, 1:4][core], columns[:, 1:4, 1:4][core]] = np.repeat(around, core.sum(axis=(1, 2)), axis=0)
    return clean


def clamp_halos(picture: Floats, places: Places) -> Floats:
    """Clamp a picture (H, W, C) around highlights to the brightest of the ring, if nearest to them, around a halo."""
    held, radius = picture.copy(), 3
    middles = np.zeros(picture.shape[:2], np.uint8)
    middles[places[:, 0], places[:, 1]] = 1
    near = cv2.dilate(middles, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    for place in places:
        block, distance = _neighbourhood(place, radius + 1, picture.shape)
        halo = distance <= radius
        ring = ~halo & (near[block] == 0)
        if ring.any():
            held[block][halo] = np.minimum(held[block][halo], picture[block][ring].max(axis=0))
    return held


def replace_fireflies(color: Floats, places: Places) -> tuple[Floats, Mask, float]:
    """Replace fireflies by the mean of the ring around them, which leaves neither a dark hole nor a halo.

    Returns a copy, where (H, W) it was replaced, and the removed share of the frame's light, in [0, 1]; in expectation
    this light belongs to the picture. Pixels in the 3×3 around a place are replaced if they are above four times the
    brightest of the ring.
    """
    cleaned, replaced = color.copy(), np.zeros(color.shape[:2], bool)
    for place in places:
        block, distance = _neighbourhood(place, 2, color.shape)
        core, level = distance <= 1, channel_mean(color[block])
        ring = ~core
        bright = core & (level > 4 * level[ring].max())
        cleaned[block][bright] = color[block][ring].mean(axis=0)
        replaced[block] |= bright
    before = float(color.sum(dtype=np.float64))
    removed = 1 - float(cleaned.sum(dtype=np.float64)) / before if before > 0 else 0.0
    return cleaned, replaced, max(removed, 0.0)


def _neighbourhood(place: Places, radius: int, shape: tuple[int, ...]) -> tuple[tuple[slice, slice], Places]:
    """Block of `radius` pixels around a place, cut at the frame, and each pixel's distance from the place."""
    top, left = np.maximum(place - radius, 0)
    block = slice(top, min(place[0] + radius + 1, shape[0])), slice(left, min(place[1] + radius + 1, shape[1]))
    rows, columns = np.mgrid[block]
    return block, np.maximum(np.abs(rows - place[0]), np.abs(columns - place[1]))


def _blocks(pixels: Places, shape: tuple[int, ...], side: int = 5) -> tuple[Places, Places, Mask]:
    """Rows and columns of `side`² pixels around each pixel (K, side, side), clamped to the frame; True inside the
    frame.
    """
    step = np.arange(side) - side // 2
    rows = pixels[:, 0, None, None] + step[:, None] + 0 * step
    columns = pixels[:, 1, None, None] + step + 0 * step[:, None]
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    return np.clip(rows, 0, shape[0] - 1), np.clip(columns, 0, shape[1] - 1), inside


def _around(block: Doubles, inside: Mask) -> Doubles:
    """Mean (K, C) of the rings of 5×5 pixels (K, 5, 5, C) without their brightest pixel; 0 without a ring."""
    ring = inside.copy()
    ring[:, 1:4, 1:4] = False
    level = np.where(ring, block.sum(axis=-1), -np.inf).reshape(len(block), 25)
    spared = ring & (np.argmax(level, axis=1)[:, None] == np.arange(25)).reshape(ring.shape)
    ring &= ~spared
    return np.asarray(np.einsum("kyxc,kyx->kc", block, ring) / np.maximum(ring.sum(axis=(1, 2)), 1)[:, None])


def _significant(pattern: Doubles) -> Doubles:
    """Zero the part of patterns (K, 3, 3) that is noise of the surroundings."""
    return np.where(pattern > DIM * pattern.max(axis=(1, 2), keepdims=True), pattern, 0)


def _same_phase(moved: Points) -> Mask:
    """Return where a motion (K, 2) ends at the same place in a pixel."""
    return np.asarray(np.abs(moved - nearest_pixel(moved)).max(axis=1) <= SAME_PHASE)


def _levels(color: Floats, pixels: Places, side: int) -> Floats:
    """Mean over channels of `side`² pixels around each pixel, (K, side, side); −∞ outside the frame."""
    rows, columns, inside = _blocks(pixels, color.shape, side)
    level = channel_mean(color[rows, columns].reshape(len(pixels), -1, color.shape[2])).reshape(inside.shape)
    return np.where(inside, level, np.float32(-np.inf))


@njit(cache=True, nogil=True)
def _find(
    first: int, last: int, level: Floats, over_brightest: float, over_mean: float, firefly: float,
    found: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Mark pixels as 0, `_BRIGHT` or `_FIREFLY`."""
    height, width = level.shape
    for y in range(first, last):
        for x in range(width):
            value = level[y, x]
            # Skips nearly all pixels: a firefly exceeds the pixels two to its left and right, or one of these.
            left, right = level[y, max(x - 2, 0)], level[y, min(x + 2, width - 1)]
            if not value > over_brightest * (right if x < 2 else left if x >= width - 2 else min(left, right)):
                continue
            brightest, second, total, count, peak = np.float32(0), np.float32(0), 0.0, 0, True
            for j in range(max(y - 2, 0), min(y + 3, height)):
                for i in range(max(x - 2, 0), min(x + 3, width)):
                    near = level[j, i]
                    if abs(j - y) <= 1 and abs(i - x) <= 1:
                        # The first of equal pixels counts.
                        if near > value or (near == value and (j, i) < (y, x)):
                            peak = False
                    else:
                        second = max(second, min(brightest, near))
                        brightest = max(brightest, near)
                        total += near
                        count += 1
            if not peak:
                continue
            above = value / firefly
            if brightest > 0 and above > over_brightest * brightest and above * count > over_mean * total:
                found[y, x] = _FIREFLY
                continue
            rest = total - brightest
            if second > 0 and value > over_brightest * second and value * (count - 1) > over_mean * rest:
                found[y, x] = _BRIGHT
