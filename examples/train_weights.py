"""A training of the final stage from OIDN's weights: render shots, make clips of them, train each preset.

    python examples/train_weights.py OUT --blender-python blender/bin/python --scene a.blend --scene b.blend
    python examples/train_weights.py OUT --untrained    # the initial weights, which ship

The shots are drawn from seeds (`ravg simulate random` and `hard`, and two of each scene) and reproducible; no shot of
the evaluation or of the tuning of ravg is among them. Each has a render of many samples. Its frames, denoised by
`quality`, are half of the targets, and it is an input itself: networks trained without inputs of so many samples
blurred textures (0.65 dB on one shot). The other half is what `quality` makes of each input, which is what the network
can know. Shots are parts of large frames, where objects are smooth, and of small frames, full of detail.
An interrupted run continues at the same shot, and trainings continue from their last checkpoint.
docs/dev/experiments.md lists the gains.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from network.checkpoint import save_model
from network.presets import build_preset
from network.robust_unet import start_from_oidn


class TrainingShot(NamedTuple):
    """A shot to render."""

    scene: str  # "random", "hard" or a .blend
    seed: int
    film: str  # of which it is a part
    samples: str  # range of the samples per pixel that are drawn
    target: int  # samples per pixel of the cleanest render


def training_shots(scenes: Sequence[str]) -> Iterator[TrainingShot]:
    """All shots, of two of each scene; a few hard ones take as long as ten others."""
    for seed in range(20000, 20010):
        placed = [scene for index, scene in enumerate(scenes) if seed % 5 == index % 5]
        for scene in ("random", "hard", *placed):
            yield TrainingShot(scene, seed, "640x360" if seed % 2 else "1280x720", "4-128", 256)
    for seeds, samples, target in ((range(20700, 20721), "4-128", 128), (range(21000, 21049), "2-64", 64)):
        for seed in seeds:
            film = "1920x1080" if seed % 4 < 2 else "1280x720"
            yield TrainingShot("hard" if seed % 2 else "random", seed, film, samples, target)


CLIPS = "--reference --tile 0 --first-pass oidn-fast --window 7 --teacher quality"
#: Settings of each preset: the larger a network, the longer a step takes.
SCHEDULES = {
    "balanced": ["--window", 5, "--batch", 8, "--rate", 3e-5, "--steps", 2400],
    "quality": ["--window", 7, "--batch", 4, "--rate", 2e-5, "--steps", 2400],
}
TRAIN = ["--init", "oidn", "--loss", "display", "--differences", 0.5, "--crop", 80]
TRAIN += ["--backbone-rate", 1, "--warmup", 100, "--ema", 0.999, "--sets", 1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--blender-python", default=sys.executable, help="a Python that has bpy")
    parser.add_argument("--scene", action="append", default=[], help="a .blend; repeatable")
    parser.add_argument("--device", default="auto", help="as of ravg train")
    parser.add_argument("--untrained", action="store_true", help="write what the trainings begin with, and stop")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.untrained:
        for preset in SCHEDULES:
            model = start_from_oidn(build_preset(preset))
            save_model(options.out / f"{preset}.safetensors", model, {"start": "OIDN 2.5.1, nothing trained"})
        return 0

    def ravg(*words: object) -> None:
        subprocess.run([sys.executable, "-m", "hybrid.cli", *map(str, words)], check=True)

    shots, clips = options.out / "shots", options.out / "clips"
    for shot in training_shots(options.scene):
        folder = shots / f"{Path(shot.scene).stem}{shot.seed}"
        moved = ["--camera", "random", "--moving-objects", 2] if shot.scene.endswith(".blend") else []
        levels = ["--spp", shot.samples, "--levels", f"target={shot.target},a=n,b=n/e", "--frames", "1-7"]
        drawn = ["--seed", shot.seed, "--film", shot.film, "--size", "128x80", *levels, *moved]
        ravg("simulate", shot.scene, "-o", folder, *drawn, "--python", options.blender_python)
    for shot in sorted(shots.iterdir()):
        if not (shot / "reference.0007.exr").exists():
            ravg("denoise", shot / "target.####.exr", "-o", shot / "reference.####.exr", "--preset", "quality")
    # Whole frames, of which training takes crops.
    ravg("make-clips", *sorted(shots.iterdir()), "-o", clips, *CLIPS.split())
    for preset, schedule in SCHEDULES.items():
        weights = options.out / f"{preset}.safetensors"
        begun = ["--resume"] if weights.with_name(f"{weights.name}.state").exists() else []
        if begun or not weights.exists():
            settings = ["--preset", preset, "--device", options.device, *TRAIN, *schedule, *begun]
            ravg("train", clips, "-o", weights, *settings)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
