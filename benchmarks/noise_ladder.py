"""Made-up shots under noise from 100 % to 0.1 %: no preset makes a picture that is worse than what went in.

    python benchmarks/noise_ladder.py [--presets fast,balanced,quality,draft,standard,final] [--noise 1,0.3,…]

Four scenes whose truth is known: a wall with texture and lines of one pixel that passes by, the same seen through a
camera that stands still while its light changes, an object of 2 % of the frame on black, and a flat picture behind
textured guides. Noise is unbiased, skewed and independent between frames. Prints PSNR on x / (1 + x) of the noisy
frames and of the denoised ones, and exits with 1 where one is more than 0.05 dB worse.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid import denoise_shot, open_shot
from tests.exr_files import write_layers

HEIGHT, WIDTH, FRAMES = 96, 160, 7
JUDGED = range(2, 5)
LEVELS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001)
PRESETS = ("fast", "balanced", "quality", "draft", "standard", "final")
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


def main() -> int:
    """Run all and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", default=",".join(PRESETS))
    parser.add_argument("--noise", default=",".join(map(str, LEVELS)))
    parser.add_argument("--scenes", default="wall,still,object,flat")
    arguments = parser.parse_args()
    worse = 0
    for name in arguments.scenes.split(","):
        for noise in map(float, arguments.noise.split(",")):
            with tempfile.TemporaryDirectory() as folder:
                truths = write_shot(Path(folder), name, noise)
                shot = open_shot(folder, frames="-".join(str(JUDGED[end] + 1) for end in (0, -1)))
                row = [np.mean([psnr(shot.read(n + 1).color, truths[n]) for n in JUDGED])]
                for preset in arguments.presets.split(","):
                    out = Path(folder) / preset
                    made = [open_shot(f.path).read(f.number).color for f in denoise_shot(shot, out, preset=preset)]
                    row.append(np.mean([psnr(image, truths[n]) for image, n in zip(made, JUDGED, strict=True)]))
            worse += sum(found < row[0] - WORSE_DB for found in row[1:])
            print(f"{name:8s} {noise:7.3%}  " + "  ".join(f"{value:6.2f}" for value in row), flush=True)
    print(f"{worse} worse than the input; columns: noisy, {arguments.presets}")
    return int(worse > 0)


if __name__ == "__main__":
    sys.exit(main())
