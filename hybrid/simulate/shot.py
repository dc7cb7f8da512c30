"""The settings of one simulated shot, as plain data."""

import dataclasses
import hashlib
import math
import re
from dataclasses import dataclass
from typing import Any, Literal, Self

RANDOM = ("random", "hard")  # shots drawn from the seed; the second kind holds what is hard to denoise
MARGIN = 4  # frames keyed before and after the shot, so that vectors are valid on its first and last frame


@dataclass(frozen=True)
class ShotSettings:
    """One shot: everything needed to render it again, given the scene.

    `size` is what is rendered, a crop around `center` of a camera of `film` pixels. `film`, `center` and `camera`
    may be None: drawn from the seed for random shots, else the whole image of the scene's own camera.
    """

    scene: str  # a .blend file, or one of RANDOM
    seed: int
    frames: tuple[int, ...]
    size: tuple[int, int]
    levels: dict[str, int]  # name → samples per pixel
    reference: int = 0  # samples per pixel of both halves together; 0: none
    reference_frames: tuple[int, ...] | None = None  # None: all
    film: tuple[int, int] | None = None
    center: tuple[float, float] | None = None  # fractions of the film, y down
    camera: str | None = None  # of the file, or "random"
    motion: Literal["auto", "keep", "add"] = "auto"  # auto: added to a file that has none
    moving_objects: int | None = None  # None: drawn, where motion is added
    motion_blur: bool = False
    halves: bool = False  # adds half buffers, for the variance
    effects: Literal["auto", "all"] = "auto"  # auto: those that the scene needs

    def __post_init__(self) -> None:
        for name, spp in {**self.levels, "reference": self.reference}.items():
            if spp < (name != "reference"):
                raise ValueError(f"level {name}: got {spp} samples per pixel, expected at least 1")
            if self.halves and spp == 1:
                raise ValueError(f"level {name}: got 1 sample per pixel, expected at least 2 for half buffers")
        if min(self.size) < 8:
            raise ValueError(f"size: got {self.size[0]}x{self.size[1]}, expected at least 8x8")
        if self.film is not None and (self.film[0] < self.size[0] or self.film[1] < self.size[1]):
            raise ValueError(
                f"film: got {self.film[0]}x{self.film[1]}, expected at least the size, {self.size[0]}x{self.size[1]}"
            )
        for frame in self.reference_frames or ():
            if frame not in self.frames:
                raise ValueError(f"reference frames: got {frame}, expected one of {self.frames[0]}-{self.frames[-1]}")

    @property
    def middle(self) -> int:
        """The frame at which a scene is built."""
        return self.frames[len(self.frames) // 2]

    @property
    def keyed(self) -> range:
        """The frames that motion is keyed on: those of the shot and `MARGIN` on each side."""
        return range(self.frames[0] - MARGIN, self.frames[-1] + MARGIN + 1)

    def renders(self, frame: int) -> dict[str, int]:
        """Return the renders of a frame: name of the level, or `reference` → samples per pixel."""
        referenced = self.reference and (self.reference_frames is None or frame in self.reference_frames)
        return {**self.levels, **({"reference": self.reference} if referenced else {})}

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        values: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in data.items()}
        return cls(**values)


def frame_seed(seed: int, level: str, frame: int) -> int:
    """Return the seed of one render, in [0, 2³¹): unrelated to that of any other frame, level or shot."""
    digest = hashlib.sha256(f"{seed} {level} {frame}".encode()).digest()
    return int.from_bytes(digest[:4], "little") & 0x7FFFFFFF


def parse_levels(text: str, samples: int) -> dict[str, int]:
    """Parse noise levels such as `n,n/e,4` or `noisy=n,half=n/2` into name → samples per pixel.

    Each level is a number, `n` (= `samples`), or `n/NUMBER` (`e` is Euler's), rounded down, at least 1. A single level
    without a name is called `noisy`, several are called `a`, `b`, `c`, …
    """
    parts = text.replace(" ", "").split(",")
    levels: dict[str, int] = {}
    for number, part in enumerate(parts):
        name, _, expression = part.rpartition("=")
        name = name or ("noisy" if len(parts) == 1 else chr(ord("a") + number))
        match = re.fullmatch(r"(?:(n)(?:/(e|\d+(?:\.\d+)?))?)|(\d+)", expression)
        if match is None or not re.fullmatch(r"\w+", name):
            raise ValueError(f"levels: got {part!r}, expected NUMBER, n or n/NUMBER, or NAME= and one of these")
        if name in levels or name.startswith("reference"):
            raise ValueError(f"levels: got the name {name!r} twice or one kept for references")
        divisor = {"e": math.e, None: 1.0}.get(match[2]) or float(match[2])
        if divisor == 0:
            raise ValueError(f"levels: got {part!r}, expected no division by zero")
        levels[name] = max(int(match[3]) if match[3] else int(samples / divisor), 1)
    return levels


def parse_samples(text: str, seed: int) -> int:
    """Parse samples per pixel: a number, or `LOW-HIGH`, from which the seed draws uniformly in the logarithm."""
    match = re.fullmatch(r"(\d+)(?:-(\d+))?", text)
    if match is None or int(match[1]) < 1 or (match[2] is not None and int(match[2]) < int(match[1])):
        raise ValueError(f"spp: got {text!r}, expected a number or LOW-HIGH, from 1 up")
    if match[2] is None:
        return int(match[1])
    low, high = math.log(int(match[1])), math.log(int(match[2]) + 1)
    return min(int(math.exp(low + (high - low) * frame_seed(seed, "spp", 0) / 2**31)), int(match[2]))
