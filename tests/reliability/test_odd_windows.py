"""Made-up shots in which one window differs from the rest: as planned, against everything that guards forced on.

Each shot is calm but for one event. Seven frames around it are denoised twice. Motion is only searched for in shots
that move: a flow that is found in noise guards against nothing, and blurs.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.commands import ravg
from tests.reliability.shots import ALBEDO, COLOR, NORMAL, VECTOR, assert_no_worse, color, write
from tests.scenes import grained

pytestmark = [pytest.mark.reliability, pytest.mark.posix]
SIZE, FRAMES, SHOTS = (48, 72), 11, 12
# They keep pictures from being averaged that are not alike, and noise from spreading. The other stages are no guards
# (alpha, skip), or leave out what may be good (fixed-noise).
GUARDS = "fireflies", "outliers", "gate", "prefilter"


@dataclass
class Layers:
    """One clean frame, to be edited by an event."""

    light: np.ndarray
    albedo: np.ndarray
    alpha: np.ndarray = field(default_factory=lambda: np.ones((*SIZE, 1), np.float32))
    sparks: np.ndarray = field(default_factory=lambda: np.zeros((*SIZE, 1), np.float32))  # added by single samples
    astray: np.ndarray = field(default_factory=lambda: np.zeros((*SIZE, 3), np.float32))  # noise of the albedo
    vectors: bool = True


EVENTS = {
    "flare": "one frame in another light",
    "switch": "another light from one frame on",
    "exposure": "one frame a little brighter or darker: 16 to 41 %",
    "local light": "a part of the picture in another light for two frames",
    "cut": "another picture from one frame on",
    "motion": "a burst of motion, by where the frames are cut from the wall",
    "fireflies": "single bright samples in one frame",
    "coverage": "a hole in one frame: no color and no alpha",
    "lens": "noise in the guides of three frames",
    "missing": "one frame, or two, without vectors",
}


def edit(event: str, layers: Layers, index: int, odd: int, rng: np.random.Generator, shot_seed: object) -> None:
    """Change frame `index`, where `odd` is the odd one; `shot_seed` is the same for all frames of a shot."""
    of_shot = np.random.default_rng(shot_seed)
    strength = float(of_shot.choice([0.1, 0.3, 3, 10]))
    place = slice(int(of_shot.integers(0, 20)), None), slice(int(of_shot.integers(0, 30)), None)
    if (event == "flare" and index == odd) or (event == "switch" and index >= odd):
        layers.light *= strength
    elif event == "exposure" and index == odd:
        layers.light *= strength**0.15
    elif event == "local light" and index in (odd, odd + 1):
        layers.light[place] *= strength
    elif event == "cut" and index >= odd:
        layers.albedo = np.ascontiguousarray(layers.albedo[::-1, ::-1])
        layers.light = np.ascontiguousarray(layers.light[::-1, ::-1])
    elif event == "fireflies" and index == odd:
        for _ in range(int(rng.integers(1, 6))):
            layers.sparks[rng.integers(0, SIZE[0]), rng.integers(0, SIZE[1])] += 10 ** rng.uniform(3, 5)
    elif event == "coverage" and index == odd:
        layers.light[place] = 0
        layers.alpha[place] = 0
    elif event == "lens" and abs(index - odd) <= 1:
        layers.astray += rng.normal(0, 0.05, layers.astray.shape).astype(np.float32)
    elif event == "missing":
        layers.vectors = index not in (odd, odd + of_shot.integers(0, 2))


def write_shot(folder: Path, event: str, number: int) -> tuple[list[np.ndarray], int, bool]:
    """Write a shot with one event; return the clean frames, the odd one, and whether something moves."""
    seed = 1, list(EVENTS).index(event), number
    rng = np.random.default_rng(seed)
    odd = int(rng.integers(3, FRAMES - 3))
    drift = int(rng.integers(0, 3)) if event != "motion" else 0
    burst = int(rng.integers(1, 4))
    vectors = rng.random() < 0.8
    noise = float(rng.uniform(0.1, 0.5))
    margin = 60
    height, width = SIZE[0] + 2 * margin, SIZE[1] + 2 * margin
    wall = cv2.resize(rng.uniform(0.1, 0.9, (height // 6, width // 6, 3)).astype(np.float32), (width, height))
    glow = cv2.resize(rng.uniform(0.3, 3, (2, 2)).astype(np.float32), (width, height))[..., None]
    left = [margin - drift * index for index in range(FRAMES)]
    if event == "motion":
        left = [margin - burst * min(max(index - odd, 0), 3) for index in range(FRAMES)]
    clean = []
    for index, x in enumerate(left):
        block = slice(margin, margin + SIZE[0]), slice(x, x + SIZE[1])
        layers = Layers(glow[block].copy(), wall[block].copy())
        edit(event, layers, index, odd, rng, seed)
        clean.append((layers.light * layers.albedo).astype(np.float32))
        picture = grained(clean[-1], rng, noise) + layers.sparks
        vector = np.zeros((*SIZE, 4), np.float32)
        vector[..., 0] = 0 if index == 0 else x - left[index - 1]
        vector[..., 2] = 0 if index == FRAMES - 1 else left[index + 1] - x
        channels = {
            COLOR: np.concatenate([picture, layers.alpha], axis=-1),
            ALBEDO: (layers.albedo + layers.astray).clip(0.02, 1),
            NORMAL: np.broadcast_to(np.float32([0, 0, 1]), (*SIZE, 3)).copy(),
        }
        if vectors and layers.vectors:
            channels[VECTOR] = vector
        write(folder / f"shot.{index:04d}.exr", channels)
    return clean, odd, len({*left}) > 1


def write_estimates(folder: Path, source: Path) -> Path:
    """Write what a cheap denoiser of single frames makes: light, blurred."""
    for path in sorted(source.glob("*.exr")):
        albedo = color(path, ALBEDO) + np.float32(0.1)
        write(folder / path.name, {COLOR: cv2.GaussianBlur(color(path) / albedo, (0, 0), 2) * albedo})
    return folder


@pytest.mark.parametrize("number", range(SHOTS))
@pytest.mark.parametrize("event", EVENTS)
def test_no_frame_is_worse_than_with_every_guard_forced_on(folder, event, number):
    """Without estimates, and with those of single frames."""
    noisy = folder / "in"
    clean, odd, moves = write_shot(noisy, event, number)
    frames = ["--frames", f"{odd - 3}-{odd + 3}"]
    guards = [word for guard in (*GUARDS, *(["warp"] if moves else [])) for word in ("--stages", guard)]
    for kind, estimate in (("own", "none"), ("estimates", write_estimates(folder / "single", noisy))):
        planned, forced = folder / f"{kind} planned", folder / f"{kind} forced"
        for out, more in ((planned, []), (forced, guards)):
            done = ravg("denoise", noisy, "-o", out, "--method", "classical", *frames, "--first-pass", estimate, *more)
            if re.search(r"error: (the .* of frame \d+: it has|first pass .*: it differs)", done.said):
                return  # an estimate that has spread a firefly's light all over a small picture is refused
            done.succeeds()
        for index in range(odd - 3, odd + 4):
            name = f"shot.{index:04d}.exr"
            assert_no_worse(color(planned / name), color(forced / name), clean[index], f"{kind}: {name}")
