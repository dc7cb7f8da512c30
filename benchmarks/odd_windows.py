"""Made-up shots in which one window differs from the rest: planned, against everything that guards forced on.

    python benchmarks/odd_windows.py [--shots 300] [--seed 1]

Each shot is calm but for one event: a light that flares or is switched, another exposure, a cut, a burst of motion,
fireflies, coverage, noisy guides, vectors that are not there. Seven frames around the event are denoised twice, as
planned and with every guarding stage on; but motion is searched for only in shots with some, as a flow that is found in
noise guards against nothing, and blurs it. A frame is a problem where its PSNR is more than 0.2 dB lower, or its mean
more than 1 % farther from the truth's. It prints a table and one line of JSON, and exits with 1 where there is a
problem.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from flow.motion import CYCLES
from hybrid.alignment.align import Aligner
from hybrid.alignment.window import AlignedWindow
from hybrid.estimates import OfFrames
from hybrid.files.frame import Frame
from hybrid.plan import Rules
from hybrid.pseudo_reference import STANDARD, filter_window, gated_average

SIZE, FRAMES = (48, 72), 11
# What keeps pictures from being averaged that are not alike, and noise from spreading. The other stages are either
# no guards (alpha, skip) or leave out what may be good (fixed-noise); motion is found where there are no vectors.
GUARDS = frozenset({"fireflies", "outliers", "warp", "gate", "prefilter"})
WORSE_DB, WORSE_MEAN = 0.2, 0.01


@dataclass(frozen=True)
class Shot:
    """Clean and noisy frames in memory, for an `Aligner`."""

    clean: tuple[np.ndarray, ...]
    frames: tuple[Frame, ...]
    moves: bool
    step: int = 1

    @property
    def numbers(self) -> tuple[int, ...]:
        return tuple(range(len(self.frames)))

    @property
    def shape(self) -> tuple[int, int]:
        return SIZE

    def has(self, number: int) -> bool:
        return 0 <= number < len(self.frames)

    def read(self, number: int) -> Frame:
        return self.frames[number]


@dataclass
class Layers:
    """One clean frame, to be edited by an event."""

    light: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray
    alpha: np.ndarray
    burnt: np.ndarray  # what single samples add
    astray: np.ndarray  # what the albedo that is written differs by from that of the picture
    missing: frozenset[str] = frozenset()  # layers that are not in the file


def make_shot(event: str, rng: np.random.Generator) -> tuple[Shot, int]:
    """A shot with one event, and the frame of it."""
    odd = int(rng.integers(3, FRAMES - 3))
    drift = int(rng.integers(0, 3)) if event != "motion" else 0
    burst = int(rng.integers(1, 4))
    vectors = rng.random() < 0.8
    noise = float(rng.uniform(0.1, 0.5))
    margin = 60
    height, width = SIZE[0] + 2 * margin, SIZE[1] + 2 * margin
    wall = cv2.resize(rng.uniform(0.1, 0.9, (height // 6, width // 6, 3)).astype(np.float32), (width, height))
    slope = rng.uniform(0.3, 3, 4).astype(np.float32)
    glow = cv2.resize(slope.reshape(2, 2, 1), (width, height))[..., None]
    where = [margin - drift * index for index in range(FRAMES)]
    if event == "motion":
        where = [margin - burst * min(max(index - odd, 0), 3) for index in range(FRAMES)]
    strength = float(rng.choice([0.1, 0.3, 3, 10]))
    place = (slice(int(rng.integers(0, 20)), None), slice(int(rng.integers(0, 30)), None))
    clean, frames = [], []
    for index, left in enumerate(where):
        block = slice(margin, margin + SIZE[0]), slice(left, left + SIZE[1])
        layers = Layers(
            light=glow[block].copy(),
            albedo=wall[block].copy(),
            normal=np.broadcast_to(np.float32([0, 0, 1]), (*SIZE, 3)).copy(),
            alpha=np.ones(SIZE, np.float32),
            burnt=np.zeros((*SIZE, 1), np.float32),
            astray=np.zeros((*SIZE, 3), np.float32),
        )
        EVENTS[event](layers, index, odd, strength, place, rng)
        picture = (layers.light * layers.albedo).astype(np.float32)
        grain = rng.gamma(1 / noise**2, noise**2, (*SIZE, 1)).astype(np.float32)
        motion = np.zeros((*SIZE, 4), np.float32)
        motion[..., 0] = 0 if index == 0 else where[index] - where[index - 1]
        motion[..., 2] = 0 if index == FRAMES - 1 else where[index + 1] - where[index]
        guides = {
            "albedo": (layers.albedo + layers.astray).clip(0.02, 1),
            "normal": layers.normal,
            "alpha": layers.alpha,
            "motion": motion if vectors else None,
        }
        guides |= dict.fromkeys(layers.missing)
        convention = None if guides["motion"] is None else CYCLES
        clean.append(picture)
        frames.append(Frame(number=index, color=picture * grain + layers.burnt, motion_convention=convention, **guides))
    return Shot(tuple(clean), tuple(frames), moves=len({*where}) > 1), odd


Event = Callable[[Layers, int, int, float, tuple[slice, slice], np.random.Generator], None]


def flare(layers: Layers, index: int, odd: int, strength: float, place: tuple, rng: np.random.Generator) -> None:
    """One frame in another light."""
    layers.light *= strength if index == odd else 1


def switch(layers: Layers, index: int, odd: int, strength: float, place: tuple, rng: np.random.Generator) -> None:
    """Another light from one frame on."""
    layers.light *= strength if index >= odd else 1


def exposure(layers: Layers, index: int, odd: int, strength: float, place: tuple, rng: np.random.Generator) -> None:
    """One frame a little brighter or darker: 16 to 41 %."""
    layers.light *= strength**0.15 if index == odd else 1


def local_light(layers: Layers, index: int, odd: int, strength: float, place: tuple, rng: np.random.Generator) -> None:
    """A part of the picture in another light for two frames."""
    layers.light[place] *= strength if index in (odd, odd + 1) else 1


def cut(layers: Layers, index: int, odd: int, strength: float, place: tuple, rng: np.random.Generator) -> None:
    """Another picture from one frame on."""
    if index >= odd:
        layers.albedo = np.ascontiguousarray(layers.albedo[::-1, ::-1])
        layers.light = np.ascontiguousarray(layers.light[::-1, ::-1])


def motion(layers: Layers, index: int, odd: int, strength: float, place: tuple, rng: np.random.Generator) -> None:
    """A burst of motion: in where the frames are cut from the wall."""


def fireflies(layers: Layers, index: int, odd: int, strength: float, place: tuple, rng: np.random.Generator) -> None:
    """Single bright samples in one frame."""
    if index == odd:
        for _ in range(int(rng.integers(1, 6))):
            layers.burnt[rng.integers(0, SIZE[0]), rng.integers(0, SIZE[1])] += 10 ** rng.uniform(3, 5)


def coverage(layers: Layers, index: int, odd: int, strength: float, place: tuple, rng: np.random.Generator) -> None:
    """A hole in one frame: no color, no alpha, no guides."""
    if index == odd:
        layers.light[place] = 0
        layers.alpha[place] = 0


def lens(layers: Layers, index: int, odd: int, strength: float, place: tuple, rng: np.random.Generator) -> None:
    """Noise in the guides of three frames."""
    if abs(index - odd) <= 1:
        layers.astray += rng.normal(0, 0.05, layers.astray.shape).astype(np.float32)


def missing(layers: Layers, index: int, odd: int, strength: float, place: tuple, rng: np.random.Generator) -> None:
    """One frame, or two, without vectors; a frame without an albedo, a normal or an alpha is refused."""
    layers.missing = frozenset({"motion"} if index in (odd, odd + rng.integers(0, 2)) else ())


EVENTS: dict[str, Event] = {
    event.__name__: event
    for event in (flare, switch, exposure, local_light, cut, motion, fireflies, coverage, lens, missing)
}


def ours(window: AlignedWindow) -> np.ndarray:
    """Without estimates."""
    return filter_window(window, STANDARD)


def blurred(frame: Frame) -> np.ndarray:
    """A cheap denoiser of single frames: light, blurred."""
    albedo = frame.albedo + np.float32(0.1)  # type: ignore[operator]
    return np.asarray(cv2.GaussianBlur(frame.color / albedo, (0, 0), 2) * albedo, np.float32)


def problems(shot: Shot, odd: int) -> Iterator[tuple[str, int, float, float]]:
    """Kind, frame, decibels and share of the mean that planned pictures are worse by, where that is too much."""
    for kind, estimates, denoise in (("own", None, ours), ("estimates", OfFrames(blurred), gated_average)):
        guards = GUARDS if shot.moves else GUARDS - {"warp"}
        aligners = [Aligner(shot, rules, estimates=estimates) for rules in (Rules(), Rules(on=guards))]
        for number in range(odd - 3, odd + 4):
            truth = shot.clean[number]
            planned, forced = (denoise(aligner.align(number)) for aligner in aligners)
            scale = float(truth.mean()) or 1.0
            errors = [float(np.mean(np.square(x / (x + scale) - truth / (truth + scale)))) for x in (planned, forced)]
            decibels = 10 * float(np.log10((errors[0] + 1e-9) / (errors[1] + 1e-9)))
            means = [abs(float(x.mean()) - float(truth.mean())) / scale for x in (planned, forced)]
            if decibels > WORSE_DB or means[0] - means[1] > WORSE_MEAN:
                yield kind, number - odd, decibels, means[0] - means[1]


def main(argv: list[str] | None = None) -> int:
    """Run, print, and tell by the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--shots", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(argv)
    counts = {event: [0, 0] for event in EVENTS}
    found = []
    for index in range(options.shots):
        event = list(EVENTS)[index % len(EVENTS)]
        shot, odd = make_shot(event, np.random.default_rng((options.seed, index)))
        worse = list(problems(shot, odd))
        counts[event][0] += 1
        counts[event][1] += bool(worse)
        found += [(index, event, *row) for row in worse]
        for row in worse:
            words = "  shot {} ({}): {}, frame {:+d} by {:.2f} dB, mean by {:.2%}"
            print(words.format(index, event, *row), file=sys.stderr)
    print("| event | shots | worse than with every guard on |\n|---|---|---|")
    for event, (shots, worse_shots) in counts.items():
        print(f"| {event} | {shots} | {worse_shots} |")
    print(json.dumps({"cases": options.shots, "failed": sum(worse for _, worse in counts.values())}))
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
