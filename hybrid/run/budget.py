"""Which preset of the network fits a time per frame: measured on a part of the shot, on this machine."""

import re
import time
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from hybrid.denoising.denoisers import open_stream
from hybrid.denoising.first_pass import FirstPassSource, PerFrame
from hybrid.denoising.plan import Rules
from hybrid.denoising.stabilize import FrameDenoiser, WindowDenoiser
from hybrid.denoising.stream import FirstPass
from hybrid.files.frame import cut_middle
from hybrid.files.shots import Shot

# Pixels on a side of the part that is measured: large enough that threads have work, small enough for seconds.
SIDE = 512


class Measured(NamedTuple):
    """A preset, and the seconds of wall clock that one frame takes, without writing it."""

    preset: str
    seconds: float


def parse_budget(text: str) -> float:
    """Seconds of "10s", "500ms", "2m" or "10"; ValueError if `text` is no positive duration."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?|\.\d+)\s*(ms|s|m|min)?", text.strip())
    seconds = float(match[1]) * {"ms": 1e-3, "m": 60.0, "min": 60.0}.get(match[2], 1.0) if match else 0.0
    if seconds <= 0:
        raise ValueError(f"budget is {text!r}, expected a time per frame such as 10s, 500ms or 2m")
    return seconds


def measure_presets(
    shot: Shot, rules: Rules, presets: Iterable[str], load: Callable[[str], tuple[WindowDenoiser, FirstPassSource]]
) -> Iterator[Measured]:
    """Measure presets, the most accurate first, on the middle of a shot, until one fits that nothing slower follows.

    The second of two neighbouring frames is timed: while a window slides, each frame is read, aligned and denoised
    once. A finished sequence as first pass counts as if reading it cost nothing.
    """
    middle = len(shot.numbers) // 2
    numbers = shot.numbers[max(0, middle - 1) : middle + 1]
    height, width = shot.shape
    part = cut_middle(shot, SIDE)
    share = min(SIDE, height) * min(SIDE, width) / (height * width)
    start = time.perf_counter()
    shot.read(numbers[-1])
    reading = time.perf_counter() - start
    for preset in presets:
        denoiser, source = load(preset)
        # A sequence holds whole frames, and only a part is measured.
        whole = source.name == "sequence"
        given: FirstPass | None = PerFrame(lambda frame: frame.color) if whole else source.first_pass
        frames, spent = FrameDenoiser(open_stream(part, rules, given, denoiser), denoiser), []
        for number in numbers:
            start = time.perf_counter()
            frames.make(number)
            spent.append(time.perf_counter() - start)
        # The last frame of a shot is denoised together with the one before: then the mean of both counts.
        seconds = spent[-1] if part.has(numbers[-1] + part.step) else sum(spent) / len(spent)
        yield Measured(preset, reading + max(seconds - reading, 0) / share)
