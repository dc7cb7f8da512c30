"""Made-up shots under noise from 100 % to 0.1 %: no preset makes a picture that is worse than what went in.

Four scenes whose truth is known: a wall with texture and lines of one pixel that passes by, the same seen through a
camera that stands still while its light changes, an object of 2 % of the frame on black, and a flat picture behind
textured guides. Noise is unbiased, skewed and independent between frames.
"""

from pathlib import Path

import numpy as np
import pytest

from ravg import denoise_shot, open_shot
from tests.exr_files import write_layers

pytestmark = pytest.mark.reliability
HEIGHT, WIDTH, FRAMES = 96, 160, 7
JUDGED = range(2, 5)
WORSE_DB = 0.05


def wall(shift: int) -> np.ndarray:
    """Texture with lines of one pixel, moved to the right by so many pixels."""
    rng = np.random.default_rng(1)
    blocks = rng.uniform(0.1, 0.9, (HEIGHT // 8, WIDTH // 4, 3)).repeat(8, axis=0).repeat(8, axis=1)
    blocks[:, ::13], blocks[::17] = 0.02, 0.95
    return blocks[:, 64 - shift : 64 - shift + WIDTH]


def scene(name: str, index: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Layers without noise but the color, and the true color."""
    shift = 2 * index if name == "wall" else 0
    albedo, normal = wall(shift), np.zeros((HEIGHT, WIDTH, 3))
    normal[..., 2] = 1
    alpha = np.ones((HEIGHT, WIDTH))
    light = np.linspace(0.5, 2, WIDTH)[None, :, None]
    if name == "still":
        light = light * (1 + 0.03 * np.sin(2 * index))
    color = albedo * light
    if name == "object":
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        alpha = (np.hypot(y - HEIGHT / 2, x - WIDTH / 2) < 10).astype(float)
        albedo, color, normal = (layer * alpha[..., None] for layer in (albedo, color, normal))
    if name == "flat":
        color = np.full_like(albedo, 0.5)
    vectors = np.zeros((HEIGHT, WIDTH, 4))
    vectors[..., [0, 2]] = -2 if name == "wall" else 0
    layers = {
        "ViewLayer.Combined": np.dstack([color, alpha]),
        "ViewLayer.Denoising Albedo": albedo,
        "ViewLayer.Denoising Normal": normal,
        "ViewLayer.Vector": vectors,
    }
    return layers, color


def write_shot(folder: Path, name: str, noise: float) -> list[np.ndarray]:
    """Write the noisy frames of a scene, and return the true ones."""
    truths = []
    for index in range(FRAMES):
        layers, truth = scene(name, index)
        grain = np.random.default_rng((2, index)).gamma(1 / noise**2, noise**2, (HEIGHT, WIDTH, 1))
        layers["ViewLayer.Combined"][..., :3] *= grain
        kept = {layer: values.astype(np.float32) for layer, values in layers.items()}
        write_layers(folder / f"shot.{index + 1:04d}.exr", kept, half=False)
        truths.append(truth)
    return truths


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """PSNR on x / (1 + x), at most 120 dB."""
    a, b = (np.maximum(x, 0) / (1 + np.maximum(x, 0)) for x in (image.astype(np.float64), truth))
    return float(-10 * np.log10(max(np.mean(np.square(a - b)), 1e-12)))


@pytest.mark.parametrize("noise", [1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001])
@pytest.mark.parametrize("name", ["wall", "still", "object", "flat"])
def test_no_preset_makes_a_picture_worse_than_its_input(tmp_path: Path, name: str, noise: float) -> None:
    truths = write_shot(tmp_path, name, noise)
    shot = open_shot(tmp_path, frames="-".join(str(JUDGED[end] + 1) for end in (0, -1)))
    noisy = np.mean([psnr(shot.read(n + 1).color, truths[n]) for n in JUDGED])
    found = {}
    for preset in ("fast", "balanced", "quality", "draft", "standard", "final"):
        frames = denoise_shot(shot, tmp_path / preset, preset=preset)
        made = [open_shot(frame.path).read(frame.number).color for frame in frames]
        found[preset] = np.mean([psnr(image, truths[n]) for image, n in zip(made, JUDGED, strict=True)])
    assert min(found.values()) >= noisy - WORSE_DB, found
