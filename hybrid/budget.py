"""Which preset of the network fits a time per frame: measured on a part of the shot, on this machine."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from hybrid.alignment.align import Aligner, Estimates
from hybrid.estimates import MODE_OF, OfFrames, choose_estimate
from hybrid.files.frame import Frame, Frames, MappedShot
from hybrid.files.shots import Shot
from hybrid.plan import Rules
from hybrid.steady import DenoiseWindow, Pictures

# Pixels on a side of the part that is measured: large enough that threads have work, small enough for seconds.
SIDE = 512


@dataclass(frozen=True)
class Measured:
    """A preset and its time.

    Attributes
    ----------
    preset : str
        Of `hybrid.estimates.MODE_OF`.
    seconds : float
        Of wall clock for one frame of the shot, without writing it.
    """

    preset: str
    seconds: float


def parse_budget(text: str) -> float:
    """Seconds of "10s", "500ms", "2m" or "10".

    Raises
    ------
    ValueError
        If it is no positive duration.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?|\.\d+)\s*(ms|s|m|min)?", text.strip())
    seconds = float(found[1]) * {"ms": 1e-3, "m": 60.0, "min": 60.0}.get(found[2], 1.0) if found else 0.0
    if seconds <= 0:
        raise ValueError(f"budget is {text!r}, expected a time per frame such as 10s, 500ms or 2m")
    return seconds


def measure_presets(
    shot: Shot,
    rules: Rules,
    estimate: str,
    load: Callable[[str], tuple[DenoiseWindow, int]],
    device: str = "cpu",
) -> Iterator[Measured]:
    """Measure the presets on the middle of the shot, the most accurate first.

    Parameters
    ----------
    shot : Shot
        Its middle frames are read.
    rules : Rules
        What decides which stages run.
    estimate : str
        As for `hybrid.estimates.choose_estimate`.
    load : callable
        From a preset to its estimator and the frames on each side that it looks at.
    device : str
        Of OIDN, as for `hybrid.estimates.choose_estimate`.

    Yields
    ------
    Measured
        One after the other, so that nothing slower than needed is measured after what fits.

    Notes
    -----
    Of two neighbouring frames the second is timed: while a window slides, each frame is read, estimated, aligned and
    denoised once. The pictures of a finished sequence are counted as if they cost nothing.
    """
    middle = len(shot.numbers) // 2
    numbers = shot.numbers[max(0, middle - 1) : middle + 1]
    height, width = shot.shape
    part = cut_out(shot, SIDE)
    share = min(SIDE, height) * min(SIDE, width) / (height * width)
    start = time.perf_counter()
    shot.read(numbers[-1])
    reading = time.perf_counter() - start
    for preset in reversed(MODE_OF):
        denoise, radius = load(preset)
        source = choose_estimate(estimate, shot, mode=MODE_OF[preset], device=device)
        # A sequence's pictures are whole; what is measured is a part.
        given: Estimates | None = OfFrames(lambda frame: frame.color) if source.name == "sequence" else source.estimates
        aligner = Aligner(part, rules, radius=radius, estimates=given)
        pictures, spent = Pictures(aligner, denoise), []
        for number in numbers:
            start = time.perf_counter()
            pictures.make(number)
            spent.append(time.perf_counter() - start)
        # The last frame's picture is made with the one before it: then what both take together counts.
        seconds = spent[-1] if part.has(numbers[-1] + part.step) else sum(spent) / len(spent)
        yield Measured(preset, reading + max(seconds - reading, 0) / share)


def cut_out(shot: Frames, side: int) -> MappedShot:
    """Cut the middle out of each frame of a shot.

    Parameters
    ----------
    shot : Frames
        Frames of H × W pixels.
    side : int
        Pixels, at most, that are left each way.

    Returns
    -------
    MappedShot
    """
    height, width = shot.shape
    top, left = max(0, height - side) // 2, max(0, width - side) // 2
    here = slice(top, top + side), slice(left, left + side)

    def cut(frame: Frame) -> Frame:
        layers = {name: value[here] for name, value in vars(frame).items() if hasattr(value, "shape")}
        return replace(frame, **layers, aovs={name: layer[here] for name, layer in frame.aovs.items()})

    return MappedShot(shot, cut, shape=(min(side, height), min(side, width)))
