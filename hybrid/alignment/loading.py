"""The frames of a shot that are in memory: read once, made safe, without fireflies, measured, and forgotten."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from hybrid.alignment.measure import FrameFacts, PairFacts, SmallFrame, measure_frame, measure_pair, shrink
from hybrid.alignment.prepare import PreparedFrame, prepare, rendered_flow
from hybrid.files.frames import Frame, Frames
from hybrid.timing import Timings
from nlm.fireflies import find_fireflies, recurring, replace_fireflies


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
        near = {n + k * self.shot.step for n in numbers for k in (-1, 0, 1)}
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
        last = max(self._frames, default=0)
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
                self._read[number] = frame, prepare(frame, demodulated="demodulate" in self.allowed)
        return self._read[number]

    def _without_fireflies(self, frame: Frame | None, prepared: PreparedFrame) -> tuple[Frame | None, PreparedFrame]:
        """Take out the single bright samples that neither neighbour shows: before anything is made of the frame."""
        with self.timings.stage("prepare"):
            places = find_fireflies(prepared.irradiance)
        if not len(places):
            return frame, prepared
        # A lamp shines in every frame; noise, where there is much of it, now and then in two.
        known, everywhere = np.zeros(len(places), bool), np.ones(len(places), bool)
        for neighbour in (prepared.number - self.shot.step, prepared.number + self.shot.step):
            if self.shot.has(neighbour):
                _, there = self._read_once(neighbour)
                flow, valid = rendered_flow(prepared, there) or (None, None)
                shown = recurring(places, prepared.irradiance, there.irradiance, flow, valid)
                known, everywhere = known | shown, everywhere & shown
        lasting = places[known & everywhere]
        lamps = replace_fireflies(prepared.irradiance, lasting)[1] if len(lasting) else None
        places = places[~known]
        clean, replaced, _ = replace_fireflies(prepared.irradiance, places)
        rendered, where = prepared.mean, np.nonzero(replaced)
        taken = (where, prepared.irradiance[where]) if len(places) else None
        prepared = replace(prepared, irradiance=clean, fireflies=len(places), lamps=lamps, taken=taken)
        prepared = replace(prepared, burnt=max(rendered - prepared.mean, 0.0))
        return None if frame is None else replace(frame, color=prepared.radiance), prepared


@dataclass(frozen=True)
class _Always:
    """The same stages on all frames, whatever they show."""

    allowed: frozenset[str]

    def __call__(self, frames: Sequence[FrameFacts], pairs: Sequence[PairFacts], /) -> frozenset[str]:
        return self.allowed
