"""Isolated bright samples: fireflies are taken out of a frame before anything spreads them, lamps are put back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
Places = NDArray[np.intp]
Points = NDArray[np.float64]

# A firefly is so many times as bright as the brightest pixel of the ring around it, and as the ring's mean. Half of it
# is two stops above what denoisers of single frames take for noise; below that they do without our help.
OVER_BRIGHTEST, OVER_MEAN = 16.0, 64.0
# Another frame shows the same light where its centre is within so many pixels of where the motion leads, and its light
# differs by no more than this share of the sum of both: a quarter is a factor of 0.6. In glass and caustics of 8
# samples a pixel one of 344 bright samples had this in both neighbours.
NEAR = 0.75
DIFFERENT = 0.25
# A sample that another frame shows within 3 pixels at a quarter of its brightness is no firefly but what the noise is
# like there: kitchens at 8 samples a pixel lose a tenth of their light, and 2 dB, without such.
SPREAD, RECURS = 7, 0.25
# Of a pattern of 3×3 what is below this share of its brightest pixel is noise of the surroundings.
DIM = 1 / 16
# Where noise is so strong that another frame has more than 3 samples within 8 pixels that are as bright as a lamp's
# quarter, and not in the frame, two may agree by chance: kitchens have 3 to 90 around such. Fireflies on a hundredth of
# the pixels are 2.
STRANGER_WINDOW, STRANGERS = 17, 3
# Patterns are averaged over frames where the light is within so many pixels of the same place in its pixel: farther
# away it is spread over other pixels.
SAME_PHASE = 0.25


@dataclass(frozen=True)
class Highlights:
    """Lights of one or two pixels, of one frame.

    Attributes
    ----------
    pixels : (K, 2) intp
        Row and column of the middle of 3×3 pixels that each is in.
    points : (K, 2) float64
        Centre of each, row and column; pixel centres are integers.
    light : (K, C) float32
        Radiance above the surroundings, summed over the 3×3 pixels. NaN outside the frame.
    pattern : (K, 3, 3) float32
        What these pixels show of it, in the mean over channels.
    """

    pixels: Places
    points: Points
    light: Floats
    pattern: Floats

    def __getitem__(self, chosen: Mask) -> Highlights:
        """Some of them."""
        return Highlights(self.pixels[chosen], self.points[chosen], self.light[chosen], self.pattern[chosen])


_PAIRED, _ISOLATED = 1, 2


def nearest_pixel(points: Points) -> Places:
    """Return the pixels that points are in, (K, 2): halves go to the later one."""
    return np.floor(points + 0.5).astype(np.intp)


def find_fireflies(color: Floats) -> Places:
    """Find single pixels, or blots of up to 3×3, far above everything around them.

    Parameters
    ----------
    color : (H, W, C) float32
        Linear radiance or irradiance, finite.

    Returns
    -------
    (K, 2) intp
        Row and column of the brightest pixel of each.

    Raises
    ------
    ValueError
        If `color` is not (H, W, C).

    Notes
    -----
    In the mean over channels, a pixel that no other of its 3×3 exceeds is a firefly where it is above
    16 times the brightest and 64 times the mean of the 5×5 ring around these. A renderer's pixel filter may spread a
    sample over 3×3 pixels. Where the ring is black nothing is found: there a spark may be all the light there is.
    """
    if color.ndim != 3:
        raise ValueError(f"color: expected (height, width, channels), got {color.shape}")
    return np.argwhere(_find(_level(color), OVER_BRIGHTEST, OVER_MEAN) == _ISOLATED)


def find_bright_samples(color: Floats) -> tuple[Places, Mask]:
    """Find what may be a lamp of a pixel: fireflies, and what would be one but for one pixel of the ring.

    Parameters
    ----------
    color : (H, W, C) float32
        Linear radiance or irradiance, finite.

    Returns
    -------
    places : (K, 2) intp
        Row and column of the brightest pixel of each.
    isolated : (K,) bool
        Which `find_fireflies` finds.
    """
    found = _find(_level(color), OVER_BRIGHTEST, OVER_MEAN)
    places = np.argwhere(found)
    return places, found[places[:, 0], places[:, 1]] == _ISOLATED


def measure_highlights(color: Floats, pixels: Places, factor: Floats | None = None) -> Highlights:
    """Measure what pixels and those around them show above their surroundings.

    Parameters
    ----------
    color : (H, W, C) float32
        Irradiance or radiance, finite.
    pixels : (K, 2) intp
        Rows and columns, anywhere.
    factor : (H, W, C) float32, optional
        What `color` is multiplied by to give radiance.

    Returns
    -------
    Lights

    Notes
    -----
    The light is Σ f (c − r) over the 3×3 around a pixel, r the mean of the 5×5 ring around them without its brightest
    pixel: a small lamp under a pixel filter of up to 1.5 pixels is in it, wherever in the pixel it is.
    """
    rows, columns, inside = _blocks(pixels, color.shape)
    block = color[rows, columns].astype(np.float64)
    core = (block - _around(block, inside)[:, None, None])[:, 1:4, 1:4] * inside[:, 1:4, 1:4, None]
    if factor is not None:
        core *= factor[rows, columns][:, 1:4, 1:4]
    light = core.sum(axis=(1, 2))
    light[~inside[:, 2, 2]] = np.nan
    pattern = core.mean(axis=-1)
    weight = _significant(pattern)
    total, side = weight.sum(axis=(1, 2))[:, None], np.array([-1, 0, 1])
    offset = np.stack([weight.sum(axis=2) @ side, weight.sum(axis=1) @ side], axis=-1)
    points = pixels + np.divide(offset, total, out=np.zeros_like(offset), where=total > 0)
    return Highlights(pixels, points, light.astype(np.float32), pattern.astype(np.float32))


def follow_motion(lights: Highlights, moved: Points) -> Places:
    """Return the pixels in which lights are once they have moved, (K, 2).

    Parameters
    ----------
    lights : Lights
        K.
    moved : (K, 2) float64
        By so many rows and columns.
    """
    straight = lights.pixels + nearest_pixel(moved)
    return np.where(_same_phase(moved)[:, None], straight, nearest_pixel(lights.points + moved))


def same_highlight(first: Highlights, moved: Points, second: Highlights) -> Mask:
    """Tell which lights of a frame another frame shows as well.

    Parameters
    ----------
    first : Lights
        Of the frame, K.
    moved : (K, 2) float64
        Where the motion leads from there, rows and columns.
    second : Lights
        What the other frame shows there.

    Returns
    -------
    (K,) bool
        Where the second is within 0.75 pixels of there, and its light is 0.6 to 1.7 times the first's, in all channels
        together: Σ |a − b| ≤ Σ (a + b) / 4.
    """
    far = np.hypot(*(second.points - first.points - moved).T)
    difference, total = np.abs(first.light - second.light).sum(axis=1), (first.light + second.light).sum(axis=1)
    return np.asarray((far <= NEAR) & (difference <= DIFFERENT * total))


def without_strangers(own: Highlights, color: Floats, pixels: Places, other: Floats) -> Mask:
    """Tell around which lights of a frame another one has no bright samples of its own.

    Parameters
    ----------
    own : Lights
        Of the frame, K, within it.
    color : (H, W, C) float32
        The frame, finite.
    pixels : (K, 2) intp
        Where the motion leads in the other.
    other : (H, W, C) float32
        The other frame, finite.

    Returns
    -------
    (K,) bool
        True where of the 17×17 pixels around there no more than 3 are above a quarter of the light's brightest pixel
        where the frame has none within a pixel that is above an eighth.
    """
    first, second = cv2.dilate(_level(color), np.ones((3, 3), np.uint8)), _level(other)
    peak = first[own.pixels[:, 0], own.pixels[:, 1], None, None]
    (rows, columns, inside), (y, x, seen) = (
        _blocks(middle, color.shape, STRANGER_WINDOW) for middle in (own.pixels, pixels)
    )
    strange = (second[y, x] > peak / 4) & (first[rows, columns] < peak / 8) & inside & seen
    return np.asarray(strange.sum(axis=(1, 2)) <= STRANGERS)


def recurs_nearby(places: Places, color: Floats, pixels: Places, other: Floats) -> Mask:
    """Tell which bright samples of a frame are like others that another frame has near there.

    Parameters
    ----------
    places : (K, 2) intp
        From `find_fireflies` on `color`.
    color : (H, W, C) float32
        The frame, finite.
    pixels : (K, 2) intp
        Where the motion leads in the other.
    other : (H, W, C) float32
        The other frame, finite.

    Returns
    -------
    (K,) bool
        True where the other frame holds a quarter of the place's brightness within 3 pixels of there.
    """
    rows, columns = pixels.T
    inside = (rows >= 0) & (rows < color.shape[0]) & (columns >= 0) & (columns < color.shape[1])
    brightest = cv2.dilate(_level(other), np.ones((SPREAD, SPREAD), np.uint8))
    near = brightest[rows * inside, columns * inside]
    return np.asarray(inside & (near >= RECURS * _level(color)[places[:, 0], places[:, 1]]))


def average_highlights(own: Highlights, others: Sequence[tuple[Highlights, Points, Mask]]) -> Highlights:
    """Average lights over the frames that show them.

    Parameters
    ----------
    own : Lights
        Of the frame, K.
    others : sequence of (Lights, (K, 2) float64, (K,) bool)
        What other frames show, where the motion has led, and which of it is the same light.

    Returns
    -------
    Lights
        Where `own` are. All frames have the same weight, as samples of one render have the same noise. Patterns of
        frames in which a light lies elsewhere in its pixel are left out; they sum to 1.
    """
    light, count, pattern = own.light.astype(np.float64), np.ones(len(own.light)), own.pattern.astype(np.float64)
    for lights, moved, shown in others:
        light[shown] += lights.light[shown]
        count += shown
        alike = shown & _same_phase(moved)
        pattern[alike] += lights.pattern[alike]
    pattern = _significant(pattern)
    pattern /= pattern.sum(axis=(1, 2), keepdims=True)  # a light that was found has some
    mean = (light / count[:, None]).astype(np.float32)
    return Highlights(own.pixels, own.points, mean, pattern.astype(np.float32))


def add_highlights(picture: Floats, lights: Highlights) -> Floats:
    """Return a picture (H, W, C) with lights added to it, each in its pattern, which sums to 1.

    Parameters
    ----------
    picture : (H, W, C) float32
        Radiance.
    lights : Lights
        Of its frame.
    """
    made = picture.copy()
    height, width = picture.shape[:2]
    for (y, x), light, pattern in zip(lights.pixels, lights.light, lights.pattern, strict=True):
        rows, columns = np.mgrid[y - 1 : y + 2, x - 1 : x + 2]
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        made[rows[inside], columns[inside]] += pattern[inside][:, None] * light
    return made


def remove_highlights(color: Floats, pixels: Places) -> Floats:
    """Return a frame (H, W, C) without what `measure_highlights` finds at these pixels, (K, 2).

    Parameters
    ----------
    color : (H, W, C) float32
        Radiance or irradiance, finite.
    pixels : (K, 2) intp
        Rows and columns of the lights.
    """
    rows, columns, inside = _blocks(pixels, color.shape)
    around, core = _around(color[rows, columns].astype(np.float64), inside), inside[:, 1:4, 1:4]
    clean = color.copy()
    clean[rows[:, 1:4, 1:4][core], columns[:, 1:4, 1:4][core]] = np.repeat(around, core.sum(axis=(1, 2)), axis=0)
    return clean


def clamp_halos(picture: Floats, places: Places, radius: int = 3) -> Floats:
    """Hold a denoised picture around lights to the brightest of what is around them.

    Parameters
    ----------
    picture : (H, W, C) float32
        A denoised picture, in which a light may have a halo.
    places : (K, 2) intp
        Rows and columns.
    radius : int
        Of the halo, pixels.

    Returns
    -------
    (H, W, C) float32
        Of (2 radius + 1)² pixels around each place none is above the brightest of the ring around them that is not as
        near to another place.
    """
    held = picture.copy()
    height, width = picture.shape[:2]
    middles = np.zeros((height, width), np.uint8)
    middles[places[:, 0], places[:, 1]] = 1
    near = cv2.dilate(middles, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    for y, x in places:
        top, left = max(y - radius - 1, 0), max(x - radius - 1, 0)
        block = slice(top, min(y + radius + 2, height)), slice(left, min(x + radius + 2, width))
        rows, columns = np.mgrid[block]
        halo = np.maximum(np.abs(rows - y), np.abs(columns - x)) <= radius
        ring = ~halo & (near[block] == 0)
        if ring.any():
            held[block][halo] = np.minimum(held[block][halo], picture[block][ring].max(axis=0))
    return held


def replace_fireflies(color: Floats, places: Places) -> tuple[Floats, Mask, float]:
    """Replace fireflies by the mean of the ring around them.

    Parameters
    ----------
    color : (H, W, C) float32
        The frame.
    places : (K, 2) intp
        Rows and columns.

    Returns
    -------
    cleaned : (H, W, C) float32
        A copy.
    replaced : (H, W) bool
        Which pixels were.
    removed : float
        Share of the frame's light that is gone, in [0, 1]: what fireflies carry belongs to the picture in expectation.

    Notes
    -----
    Of the 3×3 around a place those pixels are replaced that are above four times the brightest of the ring. The ring's
    mean leaves neither a dark hole nor a halo.
    """
    cleaned, replaced = color.copy(), np.zeros(color.shape[:2], bool)
    height, width = color.shape[:2]
    level = _level(color)
    for y, x in places:
        top, left = max(y - 2, 0), max(x - 2, 0)
        block = slice(top, min(y + 3, height)), slice(left, min(x + 3, width))
        rows, columns = np.mgrid[block]
        core = (np.abs(rows - y) <= 1) & (np.abs(columns - x) <= 1)
        ring = ~core
        bright = core & (level[block] > 4 * level[block][ring].max())
        cleaned[block][bright] = color[block][ring].mean(axis=0)
        replaced[block] |= bright
    before = float(color.sum(dtype=np.float64))
    removed = 1 - float(cleaned.sum(dtype=np.float64)) / before if before > 0 else 0.0
    return cleaned, replaced, max(removed, 0.0)


def _blocks(pixels: Places, shape: tuple[int, ...], side: int = 5) -> tuple[Places, Places, Mask]:
    """Rows and columns of the 5×5 or so around each pixel, (K, 5, 5), held to the frame, and which are inside it."""
    step = np.arange(side) - side // 2
    rows = pixels[:, 0, None, None] + step[:, None] + 0 * step
    columns = pixels[:, 1, None, None] + step + 0 * step[:, None]
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    return np.clip(rows, 0, shape[0] - 1), np.clip(columns, 0, shape[1] - 1), inside


def _around(block: NDArray[np.float64], inside: Mask) -> NDArray[np.float64]:
    """The mean of the ring of 5×5 pixels (K, 5, 5, C) without its brightest pixel, (K, C); 0 where there is no ring."""
    ring = inside.copy()
    ring[:, 1:4, 1:4] = False
    level = np.where(ring, block.sum(axis=-1), -np.inf).reshape(len(block), 25)
    spared = ring & (np.argmax(level, axis=1)[:, None] == np.arange(25)).reshape(ring.shape)
    ring &= ~spared
    return np.asarray(np.einsum("kyxc,kyx->kc", block, ring) / np.maximum(ring.sum(axis=(1, 2)), 1)[:, None])


def _level(color: Floats) -> Floats:
    """The mean over channels."""
    return np.ascontiguousarray(np.einsum("hwc->hw", color, dtype=np.float32) / np.float32(color.shape[-1]))


def _significant(pattern: NDArray[np.float64]) -> NDArray[np.float64]:
    """What of patterns (K, 3, 3) is not noise of the surroundings."""
    return np.where(pattern > DIM * pattern.max(axis=(1, 2), keepdims=True), pattern, 0)


def _same_phase(moved: Points) -> Mask:
    """Whether what has moved so far is at the same place in its pixel."""
    return np.asarray(np.abs(moved - nearest_pixel(moved)).max(axis=1) <= SAME_PHASE)


@njit(cache=True)
def _find(level, over_brightest, over_mean):  # type: ignore[no-untyped-def]
    height, width = level.shape
    found = np.zeros((height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            value = level[y, x]
            # Nearly all pixels end here: a firefly towers over the pixels two to its left and right, or over one.
            left, right = level[y, max(x - 2, 0)], level[y, min(x + 2, width - 1)]
            if not value > over_brightest * (right if x < 2 else left if x >= width - 2 else min(left, right)):
                continue
            brightest, second, total, count, peak = np.float32(0), np.float32(0), 0.0, 0, True
            for j in range(max(y - 2, 0), min(y + 3, height)):
                for i in range(max(x - 2, 0), min(x + 3, width)):
                    near = level[j, i]
                    if abs(j - y) <= 1 and abs(i - x) <= 1:
                        # Of equal pixels the first counts.
                        if near > value or (near == value and (j, i) < (y, x)):
                            peak = False
                    else:
                        second = max(second, min(brightest, near))
                        brightest = max(brightest, near)
                        total += near
                        count += 1
            if not peak:
                continue
            if brightest > 0 and value > over_brightest * brightest and value * count > over_mean * total:
                found[y, x] = _ISOLATED
                continue
            rest = total - brightest
            if second > 0 and value > over_brightest * second and value * (count - 1) > over_mean * rest:
                found[y, x] = _PAIRED
    return found
