"""Shots in memory, and methods for them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from flow.motion import CYCLES
from hybrid.comparison.methods import METHODS, Method, Run
from hybrid.files.frame import Frame

Array = NDArray[np.float32]
SIZE = (24, 32)
NOISY = {"noisy": METHODS["noisy"]}


@dataclass(eq=False)
class MemoryShot:
    """The members of a `Shot` that a method uses, without files."""

    frames: dict[int, Frame]

    @property
    def numbers(self) -> tuple[int, ...]:
        return tuple(self.frames)

    def has(self, number: int) -> bool:
        return number in self.frames

    step = 1

    @property
    def shape(self) -> tuple[int, int]:
        height, width = next(iter(self.frames.values())).color.shape[:2]
        return height, width

    def read(self, number: int) -> Frame:
        return self.frames[number]


def make_shots(numbers: tuple[int, ...] = (4, 5, 6)) -> tuple[MemoryShot, MemoryShot]:
    """A still noisy shot with vectors, and its reference."""
    rng = np.random.default_rng(9)
    albedo = rng.uniform(0.2, 0.9, (*SIZE, 3)).astype(np.float32)
    normal = np.zeros_like(albedo)
    normal[..., 2] = 1
    clean, rendered = {}, {}
    for number in numbers:
        clean[number] = Frame(number, albedo)
        color = (albedo * rng.gamma(4, 0.25, (*SIZE, 1))).astype(np.float32)
        vectors = np.zeros((*SIZE, 4), np.float32)
        rendered[number] = Frame(number, color, albedo, normal, motion=vectors, motion_convention=CYCLES)
    return MemoryShot(rendered), MemoryShot(clean)


def perfect(shot: MemoryShot) -> Iterator[tuple[int, Array]]:
    for number in shot.numbers:
        yield number, shot.read(number).albedo


def use_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run in this process what a comparison runs in processes of their own, which take longer to start than to work."""
    for module in ("comparison.compare", "comparison.running", "commands.compare"):
        name = f"hybrid.{module}.run_in_process"
        monkeypatch.setattr(name, lambda function, *given, **named: function(*given, **named))


def ways(**runs: Run) -> dict[str, Method]:
    return {name: Method(run, "Tests") for name, run in runs.items()}
