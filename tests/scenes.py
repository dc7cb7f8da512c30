"""Made-up shots whose truth is known."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybrid.alignment.window import AlignedWindow
from hybrid.denoising.plan import STAGES, Rules
from hybrid.denoising.stabilize import Denoised, WindowDenoiser
from hybrid.denoising.stream import FirstPass
from hybrid.files.shots import Shot
from hybrid.run.pipeline import Failed, Finished, RunSettings, View, denoise_frames
from hybrid.runtime.timing import Timings
from tests.exr_files import write_layers


def grained(picture: np.ndarray, seed: object, noise: float = 0.3) -> np.ndarray:
    """Multiply by unbiased noise, skewed as that of a path tracer is."""
    shape = 1 / noise**2
    grain = np.random.default_rng(seed).gamma(shape, 1 / shape, (*picture.shape[:2], 1)).astype(np.float32)
    return picture * grain


@dataclass(frozen=True)
class Scene:
    """A textured wall lit by a soft gradient, passing the camera by whole pixels per frame."""

    height: int = 40
    width: int = 56
    frames: int = 3
    first: int = 1001
    step: tuple[int, int] = (2, 1)  # pixels right and down that the wall moves per frame
    noise: float = 0.3

    def clean(self, index: int) -> dict[str, np.ndarray]:
        """Noise-free layers of frame `index`, with Cycles' names and conventions."""
        rng = np.random.default_rng(7)
        margin = 40
        wall = rng.uniform(0.2, 0.8, (self.height // 4 + margin, self.width // 4 + margin, 3)).astype(np.float32)
        wall = wall.repeat(4, axis=0).repeat(4, axis=1)
        y, x = 2 * margin - self.step[1] * index, 2 * margin - self.step[0] * index
        albedo = wall[y : y + self.height, x : x + self.width]
        light = np.linspace(0.5, 2, wall.shape[1], dtype=np.float32)[None, x : x + self.width, None]
        vector = np.empty((self.height, self.width, 4), np.float32)
        # The previous frame is sampled at (x + X, y - Y), the next at (x - Z, y + W).
        vector[:] = -self.step[0], self.step[1], -self.step[0], self.step[1]
        normal = np.broadcast_to(np.float32([0, 0, 1]), albedo.shape).copy()
        return {
            "ViewLayer.Combined": albedo * light,
            "ViewLayer.Denoising Albedo": albedo.copy(),
            "ViewLayer.Denoising Normal": normal,
            "ViewLayer.Depth": np.full((self.height, self.width), 4, np.float32),
            "ViewLayer.Vector": vector,
        }

    def noisy(self, index: int) -> dict[str, np.ndarray]:
        """The same with unbiased multiplicative noise in the color, skewed as that of a path tracer is."""
        layers = self.clean(index)
        layers["ViewLayer.Combined"] = grained(layers["ViewLayer.Combined"], (11, index), self.noise)
        return layers

    def write(
        self,
        folder: Path,
        *,
        clean: bool = False,
        scale: float = 1,
        without: Collection[str] = (),
        edit: Callable[[int, dict[str, np.ndarray]], None] | None = None,
    ) -> Path:
        """Write the frames as shot.####.exr: color times `scale`, some layers left out, or edited frame by frame."""
        folder.mkdir(parents=True, exist_ok=True)
        for index in range(self.frames):
            layers = self.clean(index) if clean else self.noisy(index)
            layers["ViewLayer.Combined"] = layers["ViewLayer.Combined"] * np.float32(scale)
            if edit is not None:
                edit(index, layers)
            kept = {name: layer for name, layer in layers.items() if name.partition(".")[2] not in without}
            write_layers(folder / f"shot.{self.first + index:04d}.exr", kept, half=False)
        return folder


def only(stages: Collection[str]) -> Rules:
    """Rules that run these stages and no others, whatever is measured."""
    return Rules(on=frozenset(stages), off=frozenset(STAGES) - frozenset(stages))


@dataclass
class Function(WindowDenoiser):
    """A denoiser that is a function of windows."""

    function: Callable[[AlignedWindow], Denoised]
    radius: int = 2

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        return self.function(aligned)


def denoise_view(
    shot: Shot,
    output: Path,
    denoise: WindowDenoiser,
    rules: Rules,
    first_pass: FirstPass | None = None,
    *,
    timings: Timings | None = None,
    **settings: Any,
) -> Iterator[Finished | Failed]:
    """Denoise and write the frames of one view."""
    views = [View(shot, first_pass)]
    return denoise_frames(views, output, denoise, rules, RunSettings(**settings), timings=timings)
