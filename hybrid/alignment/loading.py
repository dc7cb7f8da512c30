"""The frames of a shot that are in memory: read once, made safe, without fireflies, measured, and forgotten."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Protocol

import numpy as np

from hybrid.alignment.measure import (
    MOVED_NOISE,
    FrameFacts,
    PairFacts,
    SmallFrame,
    equal_noise,
    measure_frame,
    measure_pair,
    repeats,
    same_noise_at,
    shrink,
)
from hybrid.alignment.prepare import PreparedFrame, prepare, rendered_flow
from hybrid.alignment.unfiltered import find_region, mirror_region
from hybrid.files.frame import Frame, Frames
from hybrid.runtime.timing import Timings
from nlm.fireflies import (
    Lights,
    Mask,
    Places,
    Points,
    bright_near,
    find_lights,
    follow,
    in_calm,
    mean_light,
    measure_lights,
    nearest,
    replace_fireflies,
    same_light,
    take_lights,
)

# A lamp of a pixel is known by so many frames beside its own, of these on each side.
WITNESSES, REACH = 2, 2


class Decide(Protocol):
    """What decides which stages run on a window (`hybrid.plan.Rules`).

    Attributes
    ----------
    allowed : frozenset of str
        The stages that may run at all.
    """

    @property
    def allowed(self) -> frozenset[str]:
        """The stages that may run at all."""

    def __call__(self, frames: Sequence[FrameFacts], pairs: Sequence[PairFacts], /) -> Collection[str]:
        """Say which stages frames call for that show this, with these pairs of neighbours among them."""


class LoadedFrames:
    """The frames of a shot that windows need now, and what is measured of all that have been.

    Parameters
    ----------
    shot : Frames
        Read lazily.
    stages : collection of str, or callable
        Which stages run, on all frames; or what decides it for a window by what its frames show (`hybrid.plan.Rules`).
    timings : Timings, optional
        Where to count the stages "read", "prepare" and "plan".
    """

    def __init__(self, shot: Frames, stages: Collection[str] | Decide, timings: Timings | None = None) -> None:
        self.shot = shot
        self.timings = timings or Timings()
        self._decide = stages if callable(stages) else _Always(frozenset(stages))
        self._read: dict[int, tuple[Frame | None, PreparedFrame]] = {}
        self._frames: dict[int, PreparedFrame] = {}
        self._small: dict[int, SmallFrame] = {}
        self._frame_facts: dict[int, FrameFacts] = {}
        self._pair_facts: dict[tuple[int, int], PairFacts] = {}

    def load(
        self, numbers: Collection[int], seen: Callable[[Frame], None] = lambda frame: None, hold: Collection[int] = ()
    ) -> None:
        """Read and prepare these frames, where they are there, and forget all others.

        Parameters
        ----------
        numbers : collection of int
            Of the frames.
        seen : callable
            Called with each frame as it is read.
        hold : collection of int
            Others that are not forgotten.
        """
        # What no window from here on needs is dropped, so that memory does not grow with the shot.
        kept = {*numbers, *hold}
        near = {n + k * self.shot.step for n in numbers for k in range(-REACH, REACH + 1)}
        self._read = {n: pair for n, pair in self._read.items() if n in near}
        self._frames = {n: frame for n, frame in self._frames.items() if n in kept}
        self._small = {n: small for n, small in self._small.items() if n in kept}
        for n in numbers:
            if n not in self._frames and self.shot.has(n):
                frame, prepared = self._read_once(n)
                if "fireflies" in self.allowed:
                    frame, prepared = self._without_fireflies(frame, prepared)
                self._frames[n] = prepared
                self._read[n] = None, self._read[n][1]
                if frame is not None:
                    seen(frame)
        # As they were before fireflies were taken out, frames are asked only by those after them.
        last = max(self._frames, default=0) - (REACH - 1) * self.shot.step
        self._read = {n: pair for n, pair in self._read.items() if n >= last}

    def __getitem__(self, number: int) -> PreparedFrame:
        """Frame `number`, which is loaded."""
        return self._frames[number]

    def get(self, number: int) -> PreparedFrame | None:
        """Frame `number`, or None where the shot has none or it is not loaded."""
        return self._frames.get(number)

    def around(self, number: int, radius: int) -> list[int]:
        """Numbers of the window around a frame, ascending, whether or not these frames are there."""
        step = self.shot.step
        return list(range(number - radius * step, number + radius * step + 1, step))

    @property
    def allowed(self) -> frozenset[str]:
        """The stages that may run on some window."""
        return self._decide.allowed

    def stages_of(self, numbers: Sequence[int]) -> frozenset[str]:
        """Decide which stages these frames call for; they are loaded, where they are there."""
        if isinstance(self._decide, _Always):  # nothing has to be measured
            return self._decide.allowed
        return frozenset(self._decide(*self.facts_of(numbers)))

    def facts_of(self, numbers: Sequence[int]) -> tuple[list[FrameFacts], list[PairFacts]]:
        """Return what those of these frames show that are there, and their pairs of neighbours; they are loaded."""
        there = [n for n in numbers if n in self._frames]
        pairs = [(a, b) for a, b in pairwise(there) if b - a == self.shot.step]
        return [self._facts_of(n) for n in there], [self._facts_of_pair(a, b) for a, b in pairs]

    def cut(self, a: int, b: int) -> bool:
        """Whether these neighbours, the earlier one first, are two shots; never where all stages are told."""
        return not isinstance(self._decide, _Always) and self._facts_of_pair(a, b).cut

    def repeated(self, a: int, b: int) -> bool:
        """Whether these neighbours are one frame twice; never where all stages are told."""
        first, second = sorted((a, b))
        return not isinstance(self._decide, _Always) and self._facts_of_pair(first, second).repeated

    def _facts_of(self, number: int) -> FrameFacts:
        if number not in self._frame_facts:
            with self.timings.stage("plan"):
                self._frame_facts[number] = measure_frame(self._frames[number], self._shrunk(number))
        return self._frame_facts[number]

    def _facts_of_pair(self, a: int, b: int) -> PairFacts:
        if (a, b) not in self._pair_facts:
            with self.timings.stage("plan"):
                smalls = self._shrunk(a), self._shrunk(b)
                self._pair_facts[a, b] = measure_pair(self._frames[a], self._frames[b], smalls)
        return self._pair_facts[a, b]

    def _shrunk(self, number: int) -> SmallFrame:
        if number not in self._small:
            self._small[number] = shrink(self._frames[number])
        return self._small[number]

    def _read_once(self, number: int) -> tuple[Frame | None, PreparedFrame]:
        if number not in self._read:
            with self.timings.stage("read"):
                frame = self.shot.read(number)
            with self.timings.stage("prepare"):
                region = find_region(frame.color)
                frame = frame if region is None else mirror_region(frame, region)
                prepared = prepare(frame, demodulated="demodulate" in self.allowed)
                if region is not None:
                    inside = np.zeros_like(prepared.valid)
                    inside[region] = prepared.valid[region]
                    prepared = replace(prepared, unfiltered=replace(prepared.unfiltered, region=region), valid=inside)
                self._read[number] = frame, prepared
        return self._read[number]

    def _without_fireflies(self, frame: Frame | None, prepared: PreparedFrame) -> tuple[Frame | None, PreparedFrame]:
        """Remove single bright samples before the frame is used; persistent highlights are stored apart."""
        with self.timings.stage("prepare"):
            places, isolated = find_lights(prepared.irradiance)
        if not len(places):
            return frame, prepared
        highlights, alone = self._tell_apart(prepared, places)
        with self.timings.stage("prepare"):
            whole, fireflies = prepared.irradiance, places[isolated & alone]
            if len(highlights.pixels):
                whole = take_lights(whole, highlights.pixels)
                prepared = replace(prepared, irradiance=whole, highlights=highlights)
            if len(fireflies):
                rendered = prepared.mean
                clean, replaced, _ = replace_fireflies(whole, fireflies)
                where = np.nonzero(replaced)
                removed = where, whole[where]
                prepared = replace(prepared, irradiance=clean, fireflies=len(fireflies), removed_samples=removed)
                prepared = replace(prepared, removed_radiance=max(rendered - prepared.mean, 0.0))
        return None if frame is None else replace(frame, color=prepared.radiance), prepared

    def _tell_apart(self, prepared: PreparedFrame, places: Places) -> tuple[Lights, Mask]:
        """Find which bright places are highlights, and which nothing beside the frame is like.

        Of a lamp the two nearest frames whose noise is their own have to show the same light at the same place along
        the motion, or the one that there is.
        """
        rough = measure_lights(prepared.irradiance, places)
        own = measure_lights(prepared.irradiance, nearest(rough.points), prepared.divisor)
        asked, shown = np.zeros(len(places), int), np.zeros(len(places), int)
        alone = np.ones(len(places), bool)
        still = np.zeros_like(own.points)
        moved, last = {-1: still, 1: still}, {-1: prepared, 1: prepared}
        others: list[tuple[Lights, Points, Mask]] = []
        used = [(prepared, still)]
        for distance, side in product(range(1, REACH + 1), (-1, 1)):
            number = prepared.number + distance * side * self.shot.step
            undecided = (shown == asked) & (asked < WITNESSES)
            if side not in moved or not (distance == 1 or undecided.any()):
                continue
            if not self.shot.has(number):
                del moved[side]
                continue
            _, there = self._read_once(number)
            with self.timings.stage("prepare"):
                moved[side] = moved[side] + _motion(last[side], there, nearest(own.points + moved[side]))
                last[side] = there
                pixels = follow(own, moved[side])
                lights = measure_lights(there.irradiance, pixels, there.divisor)
                fresh = np.isfinite(lights.light).all(axis=1)
                for frame, before in used:
                    noise = equal_noise(frame.irradiance, there.irradiance)
                    unmoved = np.abs(moved[side] - before).max(axis=1) < MOVED_NOISE
                    fresh &= not repeats(*noise)
                    fresh &= ~(unmoved & same_noise_at(*noise, pixels))
                if distance == 1:
                    alone &= ~(fresh & bright_near(places, prepared.irradiance, pixels, there.irradiance))
                same = fresh & undecided & same_light(own, moved[side], lights)
                same[same] = in_calm(own[same], prepared.irradiance, pixels[same], there.irradiance)
            asked, shown = asked + (fresh & undecided), shown + same
            others.append((lights, moved[side], same))
            used.append((there, moved[side]))
        lasting = (asked > 0) & (shown == asked)
        return mean_light(own, others)[lasting], alone & ~lasting


def _motion(here: PreparedFrame, there: PreparedFrame, pixels: Places) -> Points:
    """Rows and columns that pixels of a frame move by to another one; 0 where nothing tells."""
    flow, valid = rendered_flow(here, there) or (None, None)
    if flow is None or valid is None:
        return np.zeros(pixels.shape)
    rows, columns = (np.clip(pixels[:, axis], 0, flow.shape[axis] - 1) for axis in (0, 1))
    moved = flow[rows, columns, ::-1].astype(np.float64)
    return np.where(valid[rows, columns, None] & np.isfinite(moved), moved, 0)


@dataclass(frozen=True)
class _Always:
    """The same stages on all frames, whatever they show."""

    allowed: frozenset[str]

    def __call__(self, frames: Sequence[FrameFacts], pairs: Sequence[PairFacts], /) -> frozenset[str]:
        return self.allowed
