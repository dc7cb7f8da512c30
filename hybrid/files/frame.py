"""A frame: the arrays that were read for one number, and where frames come from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from flow.motion import Motion, MotionConvention, normalize_motion
from hybrid.files.passes import NO_PASSES, Passes

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a shot, of float32; all arrays of all frames of a shot are of one size."""

    number: int
    color: np.ndarray  # (H, W, 3): linear scene-referred radiance, unbounded; may hold NaN and Inf as rendered
    albedo: np.ndarray | None = None  # (H, W, 3)
    normal: np.ndarray | None = None  # (H, W, 3)
    depth: np.ndarray | None = None  # (H, W)
    motion: np.ndarray | None = None  # (H, W, C): as rendered, C at least 2, in the convention `motion_convention`
    motion_convention: MotionConvention | None = None
    # height and width of the whole picture in pixels, of which NDC motion is a fraction; default: of `color`
    resolution: tuple[int, int] | None = None
    variance: np.ndarray | None = None  # (H, W, 3): of the color's mean, in squared radiance
    alpha: np.ndarray | None = None  # (H, W)
    estimate: np.ndarray | None = None  # (H, W, 3)
    aovs: Mapping[str, np.ndarray] = field(default_factory=dict)  # (H, W, C): those asked for, by name
    # (H, W, 3): colors by which AOVs are multiplied that hold light without color
    pass_colors: Mapping[str, np.ndarray] = field(default_factory=dict)
    passes: Passes = NO_PASSES  # how `aovs` add up to the beauty
    source: Path | None = None  # the file
    samples: float | None = None  # samples per pixel, as the file's header states them
    # (H, W, 3): where the color is +Inf because its light exceeds the range of half; the color is NaN there
    beyond: np.ndarray | None = None
    orientation: int = 0  # in which a first pass denoises it: 0 to 3 quarter turns, 4 to 7 of the mirrored image

    def __post_init__(self) -> None:
        if self.color.ndim != 3 or self.color.shape[2] != 3:
            raise ValueError(f"color has shape {self.color.shape}, expected (H, W, 3)")
        size = self.color.shape[:2]
        expected: dict[str, tuple[tuple[int, ...], ...]] = {
            "color": ((*size, 3),),
            **{name: ((*size, 3),) for name in ("albedo", "normal", "variance", "estimate")},
            **{name: (size,) for name in ("depth", "alpha")},
            "motion": tuple((*size, count) for count in range(2, 9)),
        }
        for name, shapes in expected.items():
            array = getattr(self, name)
            if array is not None and (array.shape not in shapes or array.dtype != np.float32):
                allowed = " or ".join(map(str, shapes))
                raise ValueError(f"{name} is {array.dtype} {array.shape}, expected float32 {allowed}")
        for name, array in self.aovs.items():
            if array.ndim != 3 or array.shape[:2] != size:
                raise ValueError(f"aov {name!r} has shape {array.shape}, expected {(*size, 'C')}")
        if (self.motion is None) != (self.motion_convention is None):
            raise ValueError(f"motion_convention is {self.motion_convention!r}, expected one with motion only")

    def flows(self) -> Motion | None:
        """Return the motion in our own convention; None without motion."""
        if self.motion is None or self.motion_convention is None:
            return None
        return normalize_motion(self.motion, self.motion_convention, resolution=self.resolution)


class Frames(Protocol):
    """Numbered frames, read one by one: a `Shot`, a `MappedShot`, or frames in memory."""

    @property
    def numbers(self) -> tuple[int, ...]:
        """The frames that were asked for, ascending."""

    @property
    def step(self) -> int:
        """Distance between neighbouring frames."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of every frame."""

    def has(self, number: int) -> bool:
        """Whether this frame exists, asked for or not."""

    def read(self, number: int) -> Frame:
        """Read a frame."""


class MappedShot:
    """The frames of a shot, each changed as it is read; `shape` is that of the changed frames."""

    def __init__(self, shot: Frames, change: Callable[[Frame], Frame], *, shape: tuple[int, int] | None = None) -> None:
        self.numbers, self.step, self.shape = shot.numbers, shot.step, shape or shot.shape
        self.has = shot.has
        self._shot, self._change = shot, change

    def read(self, number: int) -> Frame:
        return self._change(self._shot.read(number))


def cut_middle(shot: Frames, side: int) -> MappedShot:
    """Cut the middle, at most `side` pixels each way, out of each frame of a shot."""
    height, width = shot.shape
    top, left = max(0, height - side) // 2, max(0, width - side) // 2

    def cut(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: cut(layer) for name, layer in value.items()}
        if not isinstance(value, np.ndarray):
            return value
        return np.ascontiguousarray(value[top : top + side, left : left + side])

    def part(frame: Frame) -> Frame:
        cuts = {name: cut(value) for name, value in vars(frame).items()}
        return Frame(**{**cuts, "resolution": frame.resolution or frame.color.shape[:2]})

    return MappedShot(shot, part, shape=(min(side, height), min(side, width)))
