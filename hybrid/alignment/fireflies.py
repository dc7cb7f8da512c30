"""Remove single bright samples from a frame; those that neighbouring frames show as well are highlights, and stay."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from hybrid.alignment.measure import (
    MOVED_NOISE,
    NEAR,
    SAME,
    equal_noise,
    measure_fade,
    noise_free_around,
    repeats,
    same_noise_at,
    scaled,
)
from hybrid.alignment.prepare import PreparedFrame, rendered_flow
from hybrid.runtime.timing import Timings
from loops.parallel import Mask, Places
from nlm.fireflies import (
    Highlights,
    Points,
    average_highlights,
    find_bright_samples,
    follow_motion,
    measure_highlights,
    nearest_pixel,
    recurs_nearby,
    remove_highlights,
    replace_fireflies,
    same_highlight,
    without_strangers,
)

# A highlight of a pixel has to be in so many frames beside its own, at most so many frames away.
WITNESSES, REACH = 2, 2


def remove_fireflies(
    frame: PreparedFrame, neighbour: Callable[[int], PreparedFrame | None], timings: Timings
) -> PreparedFrame:
    """Remove single bright samples and set highlights apart, by `neighbour`: frames at −2, −1, 1, 2, or None."""
    with timings.stage("prepare"):
        places, isolated = find_bright_samples(frame.irradiance)
    if not len(places):
        return frame
    highlights, alone = _find_highlights(frame, places, neighbour, timings)
    with timings.stage("prepare"):
        rendered, fireflies = frame.irradiance, places[isolated & alone]
        if len(highlights.pixels):
            rendered = remove_highlights(rendered, highlights.pixels)
            frame = replace(frame, irradiance=rendered, highlights=highlights)
        if len(fireflies):
            mean = frame.mean
            clean, replaced, _ = replace_fireflies(rendered, fireflies)
            where = np.nonzero(replaced)
            taken = where, rendered[where]
            frame = replace(frame, irradiance=clean, fireflies=len(fireflies), removed_samples=taken)
            frame = replace(frame, removed_radiance=max(mean - frame.mean, 0.0))
    return frame


def _find_highlights(
    frame: PreparedFrame, places: Places, neighbour: Callable[[int], PreparedFrame | None], timings: Timings
) -> tuple[Highlights, Mask]:
    """Find which bright places are highlights, and which have nothing like them in the frames beside this one.

    The two nearest frames with noise of their own have to show a highlight with the same light at the same place along
    the motion, or the one that there is.
    """
    rough = measure_highlights(frame.irradiance, places)
    centre = measure_highlights(frame.irradiance, nearest_pixel(rough.points), frame.divisor_at)
    asked, shown = np.zeros(len(places), int), np.zeros(len(places), int)
    alone = np.ones(len(places), bool)
    still = np.zeros_like(centre.points)
    moved, last = {-1: still, 1: still}, {-1: frame, 1: frame}
    found: list[tuple[Highlights, Points, Mask]] = []
    compared, equal = [(frame, still)], SAME
    for distance, side in product(range(1, REACH + 1), (-1, 1)):
        undecided = (shown == asked) & (asked < WITNESSES)
        if side not in moved or not (distance == 1 or undecided.any()):
            continue
        there = neighbour(distance * side)
        if there is None:
            del moved[side]
            continue
        with timings.stage("prepare"):
            moved[side] = moved[side] + _motion(last[side], there, nearest_pixel(centre.points + moved[side]))
            last[side] = there
            fade = measure_fade(there.irradiance, frame.irradiance, frame.valid & there.valid)
            if (fade != 1).any():
                there, equal = scaled(there, fade), NEAR
            pixels = follow_motion(centre, moved[side])
            lights = measure_highlights(there.irradiance, pixels, there.divisor_at)
            # A lamp fades with the picture or stays as it is.
            off, unlit = (np.abs(light - centre.light).sum(axis=1) for light in (lights.light, lights.light / fade))
            lights = replace(lights, light=np.where((unlit < off)[:, None], lights.light / fade, lights.light))
            fresh = np.isfinite(lights.light).all(axis=1)
            for other, before in compared:
                fresh &= not repeats(other.irradiance, there.irradiance, equal)
                unmoved = np.abs(moved[side] - before).max(axis=1) < MOVED_NOISE
                if unmoved.any():
                    noise = equal_noise(other.irradiance, there.irradiance, equal)
                    fresh = fresh & ~(unmoved & same_noise_at(*noise, pixels))
            equal_frames = ~fresh & np.isfinite(lights.light).all(axis=1)
            if equal_frames.any():  # without noise they are no sample shown twice
                free = np.zeros(len(places), bool)
                free[equal_frames] = noise_free_around(frame, places[equal_frames])
                fresh = fresh | free
            if distance == 1:
                alone &= ~(fresh & recurs_nearby(places, frame.irradiance, pixels, there.irradiance))
            same = fresh & undecided & same_highlight(centre, moved[side], lights)
            same[same] = without_strangers(centre[same], frame.irradiance, pixels[same], there.irradiance)
        asked, shown = asked + (fresh & undecided), shown + same
        found.append((lights, moved[side], same))
        compared.append((there, moved[side]))
    lasting = (asked > 0) & (shown == asked)
    return average_highlights(centre, found)[lasting], alone & ~lasting


def _motion(here: PreparedFrame, there: PreparedFrame, pixels: Places) -> Points:
    """Rows and columns that pixels of a frame move by to another one; 0 without vectors."""
    flow, valid = rendered_flow(here, there) or (None, None)
    if flow is None or valid is None:
        return np.zeros(pixels.shape)
    rows, columns = (np.clip(pixels[:, axis], 0, flow.shape[axis] - 1) for axis in (0, 1))
    moved = flow[rows, columns, ::-1].astype(np.float64)
    return np.where(valid[rows, columns, None] & np.isfinite(moved), moved, 0)
