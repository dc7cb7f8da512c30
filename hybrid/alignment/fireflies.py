"""Remove single bright samples from a frame; those that neighbouring frames show as well are highlights, and stay."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from hybrid.alignment.fade import measure_fade, scaled
from hybrid.alignment.noise import (
    MOVED_NOISE,
    NEAR,
    SAME,
    Grain,
    equal_noise,
    noise_free_around,
    repeats,
    same_noise_at,
)
from hybrid.alignment.prepare import PreparedFrame, rendered_flow
from hybrid.files.frame import Array
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


@dataclass
class _Witnesses:
    """Frames beside this one that were tested for each of K bright places, and those that show the same highlight."""

    tested: Places  # (K,): how many frames with noise of their own
    showing: Places  # (K,): how many of these show the highlight
    # lights of each frame, the motion there, and which (K,) are the same highlight
    found: list[tuple[Highlights, Points, Mask]] = field(default_factory=list)

    @property
    def undecided(self) -> Mask:
        """Places (K,) that all tested frames show, but too few were tested."""
        return np.asarray((self.showing == self.tested) & (self.tested < WITNESSES))

    @property
    def lasting(self) -> Mask:
        """Places (K,) that all tested frames show."""
        return np.asarray((self.tested > 0) & (self.showing == self.tested))

    def add(self, lights: Highlights, moved: Points, tested: Mask, same: Mask) -> None:
        """Count a frame at the places (K,) where it was tested, and where it shows the same highlight."""
        self.tested += tested
        self.showing += same
        self.found.append((lights, moved, same))


def remove_fireflies(
    frame: PreparedFrame,
    neighbour: Callable[[int], PreparedFrame | None],
    repeats_noise: Callable[[int], bool],
    timings: Timings,
) -> PreparedFrame:
    """Remove single bright samples and set highlights apart, by `neighbour`: frames at −2, −1, 1, 2, or None.

    `repeats_noise` says of these whether their noise is at equal pixels that of the next frame towards this one.
    """
    with timings.stage("prepare"):
        places, isolated = find_bright_samples(frame.irradiance)
    if not len(places):
        return frame
    highlights, alone = _find_highlights(frame, places, neighbour, repeats_noise, timings)
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
    frame: PreparedFrame,
    places: Places,
    neighbour: Callable[[int], PreparedFrame | None],
    repeats_noise: Callable[[int], bool],
    timings: Timings,
) -> tuple[Highlights, Mask]:
    """Find which bright places are highlights, and which have nothing like them in the frames beside this one.

    The two nearest frames with noise of their own have to show a highlight with the same light at the same place along
    the motion, or the one that there is.
    """
    rough = measure_highlights(frame.irradiance, places)
    centre = measure_highlights(frame.irradiance, nearest_pixel(rough.points), frame.divisor_at)
    witnesses = _Witnesses(np.zeros(len(places), int), np.zeros(len(places), int))
    alone = np.ones(len(places), bool)
    still = np.zeros_like(centre.points)
    moved = {-1: still, 1: still}
    last: dict[int, PreparedFrame | None] = {-1: frame, 1: frame}
    compared, equal = [(Grain(frame.sampled), still)], SAME
    for distance, side in product(range(1, REACH + 1), (-1, 1)):
        nearer, undecided = last[side], witnesses.undecided
        if nearer is None or not (distance == 1 or undecided.any()):
            continue
        other = last[side] = neighbour(distance * side)
        if other is None:  # no motion leads to the frames behind it
            continue
        held = repeats_noise(distance * side)
        with timings.stage("prepare"):
            motion = moved[side] = moved[side] + _motion(nearer, other, nearest_pixel(centre.points + moved[side]))
            fade = measure_fade(other.irradiance, frame.irradiance, frame.valid & other.valid)
            if (fade != 1).any():
                other, equal = scaled(other, fade), NEAR
            lights = _lights_of(other, follow_motion(centre, motion), centre, fade)
            grain = Grain(other.sampled)
            fresh = _has_own_noise(frame, places, grain, lights, motion, compared, equal, held)
            if distance == 1:
                alone &= ~(fresh & recurs_nearby(places, frame.irradiance, lights.pixels, other.irradiance))
            tested = fresh & undecided
            same = tested & same_highlight(centre, motion, lights)
            same[same] = without_strangers(centre[same], frame.irradiance, lights.pixels[same], other.irradiance)
        witnesses.add(lights, motion, tested, same)
        compared.append((grain, motion))
    lasting = witnesses.lasting
    return average_highlights(centre, witnesses.found)[lasting], alone & ~lasting


def _lights_of(frame: PreparedFrame, pixels: Places, centre: Highlights, fade: Array) -> Highlights:
    """Measure highlights at pixels of a frame in the light of the centre, which is `fade` times its own."""
    lights = measure_highlights(frame.irradiance, pixels, frame.divisor_at)
    # A lamp fades with the picture or stays as it is.
    unfaded = lights.light / fade
    off, off_unfaded = (np.abs(light - centre.light).sum(axis=1) for light in (lights.light, unfaded))
    return replace(lights, light=np.where((off_unfaded < off)[:, None], unfaded, lights.light))


def _has_own_noise(
    frame: PreparedFrame,
    places: Places,
    other: Grain,
    lights: Highlights,
    motion: Points,
    compared: Sequence[tuple[Grain, Points]],
    equal: float,
    held: bool,
) -> Mask:
    """Return which places (K,) another frame, `other`, shows with samples that no frame of `compared` has.

    `compared` are those of others with the motion there; samples are the same up to a share `equal` of their value.
    If noise is `held` at equal pixels, it is the same wherever motion is slow: the paths of one seed are alike though
    their samples are not equal, and clamped ones are equally bright.
    """
    inside = np.isfinite(lights.light).all(axis=1)
    repeated = np.zeros(len(places), bool)
    for earlier, before in compared:
        repeated |= repeats(earlier.samples, other.samples, equal)
        unmoved = np.abs(motion - before).max(axis=1) < MOVED_NOISE
        if unmoved.any():
            repeated |= unmoved & (held or same_noise_at(*equal_noise(earlier, other, equal), lights.pixels))
    repeated &= inside
    if repeated.any():  # without noise they are no sample shown twice
        repeated[repeated] = ~noise_free_around(frame, places[repeated])
    return inside & ~repeated


def _motion(start: PreparedFrame, end: PreparedFrame, pixels: Places) -> Points:
    """Rows and columns that pixels of a frame move by to another one; 0 without vectors."""
    flow, valid = rendered_flow(start, end) or (None, None)
    if flow is None or valid is None:
        return np.zeros(pixels.shape)
    rows, columns = (np.clip(pixels[:, axis], 0, flow.shape[axis] - 1) for axis in (0, 1))
    moved = flow[rows, columns, ::-1].astype(np.float64)
    return np.where(valid[rows, columns, None] & np.isfinite(moved), moved, 0)
