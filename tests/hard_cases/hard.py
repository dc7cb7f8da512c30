"""Shots without files, and the whole chain on them."""

from collections.abc import Collection, Iterable
from dataclasses import replace

import cv2
import numpy as np

from flow.motion import CYCLES
from hybrid.alignment.window import AlignedWindow
from hybrid.denoising.pseudo_reference import CLASSICAL_PRESETS, filter_window
from hybrid.denoising.stream import FrameStream
from hybrid.files.frame import Frame
from tests.scenes import Scene, only

STAGES = frozenset({"demodulate", "outliers", "warp", "gate", "prefilter"})
SCENE = Scene(frames=5)
MIDDLE = 2
# Pixels around one whose value depends on it: search of the non-local means (5 in "final"), and the guided filter's box
# of boxes (2).
REACH = 7
# Pixels around one for which anything depends on it, weights too: outliers 1, gate 7, variance 6, patch 2, the above.
SUPPORT = 1 + 7 + 6 + 2 + REACH


class Reel:
    """Frames in memory, for an `FrameStream`."""

    step = 1

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames = {frame.number: frame for frame in frames}
        self.numbers = tuple(self._frames)

    @property
    def shape(self) -> tuple[int, int]:
        return next(iter(self._frames.values())).color.shape[:2]

    def has(self, number: int) -> bool:
        return number in self._frames

    def read(self, number: int) -> Frame:
        return self._frames[number]


def frame(index: int, scene: Scene = SCENE, *, clean: bool = False, scale: float = 1) -> Frame:
    """One frame of a scene, as if it had been read."""
    layers = scene.clean(index) if clean else scene.noisy(index)
    return Frame(
        number=index,
        color=(layers["ViewLayer.Combined"] * np.float32(scale)).astype(np.float32),
        albedo=layers["ViewLayer.Denoising Albedo"],
        normal=layers["ViewLayer.Denoising Normal"],
        depth=layers["ViewLayer.Depth"],
        motion=layers["ViewLayer.Vector"],
        motion_convention=CYCLES,
    )


def shot(scene: Scene = SCENE, **options: object) -> list[Frame]:
    """All frames of a scene."""
    return [frame(index, scene, **options) for index in range(scene.frames)]  # type: ignore[arg-type]


def constant(value: float = 0.7, size: tuple[int, int] = (24, 32), frames: int = 5) -> list[Frame]:
    """Frames of one colour, with guides of one colour, that stand still."""
    flat = np.full((*size, 3), value, np.float32)
    return [
        Frame(
            number=index,
            color=flat.copy(),
            albedo=np.full_like(flat, 0.5),
            normal=np.broadcast_to(np.float32([0, 0, 1]), flat.shape).copy(),
            depth=np.ones(size, np.float32),
            motion=np.zeros((*size, 4), np.float32),
            motion_convention=CYCLES,
        )
        for index in range(frames)
    ]


def spoil(one: Frame, **layers: np.ndarray | None) -> Frame:
    """A frame with some layers exchanged."""
    return replace(one, **layers)  # type: ignore[arg-type]


def align(
    frames: Iterable[Frame], number: int = MIDDLE, stages: Collection[str] = STAGES, **options: object
) -> AlignedWindow:
    return FrameStream(Reel(frames), only(stages), **options).align(number)  # type: ignore[arg-type]


def denoise(frames: Iterable[Frame], preset: str = "standard", number: int = MIDDLE, stages: Collection[str] = STAGES):
    """The aligned window, and the picture made of it."""
    window = align(frames, number, stages)
    return window, filter_window(window, CLASSICAL_PRESETS[preset])


def itself(one: Frame) -> np.ndarray:
    """An estimate of a frame that costs nothing: the frame as it is, whatever is in it."""
    return one.color


def truth(scene: Scene = SCENE, index: int = MIDDLE) -> np.ndarray:
    return scene.clean(index)["ViewLayer.Combined"]


def within_range(window: AlignedWindow, image: np.ndarray) -> bool:
    """Whether no irradiance lies beyond all that of the window within `REACH` pixels, 1e-5 of rounding aside."""
    box = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)
    low = cv2.erode(window.color.min(axis=0), box).reshape(image.shape)
    high = cv2.dilate(window.color.max(axis=0), box).reshape(image.shape)
    light = image / window.modulation
    slack = 1e-5 * np.maximum(np.abs(low), np.abs(high))
    return bool(((light >= low - slack) & (light <= high + slack)).all())
