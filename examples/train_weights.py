"""A training of the final stage from OIDN's weights: render shots, make clips of them, train each preset.

    python examples/train_weights.py OUT --blender-python blender/bin/python
    python examples/train_weights.py OUT --untrained    # the initial weights, which ship

The shots are drawn from seeds (`ravg simulate random` and `hard`) and reproducible; no shot of the evaluation or of the
tuning of ravg is among them. Each has a render of many samples. Its frames, denoised by `quality`, are the targets, and
it is an input itself: networks trained without inputs of so many samples blurred textures (0.65 dB on one shot).
Shots are parts of large frames, where objects are smooth, and of small frames, full of detail.
An interrupted run continues at the same shot, and trainings continue from their last checkpoint.
docs/dev/experiments.md lists the gains.
"""

import argparse
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from network.checkpoint import save_model
from network.presets import build_preset
from network.robust_unet import start_from_oidn

#: Kind of shot, first seed, how many, and the film of which they are a part.
#: Hard 6315 is left out: its smoke takes as long as ten others.
SHOTS = [
    ("random", 5300, 35, "1920x1080"),
    ("random", 5335, 35, "320x180"),
    ("hard", 6300, 15, "320x180"),
    ("hard", 6316, 31, "1920x1080"),
]
RENDER = ["--frames", "1-7", "--size", "128x80", "--spp", "4-128", "--levels", "target=256,a=n,b=n/e"]
CLIPS = "--reference --tile 0 --first-pass oidn-fast --window 7"
#: Settings of each preset: the larger a network, the longer a step takes.
SCHEDULES = {
    "fast": ["--window", 5, "--batch", 8, "--rate", 3e-5, "--steps", 5000],
    "balanced": ["--window", 5, "--batch", 8, "--rate", 3e-5, "--steps", 5000],
    "quality": ["--window", 7, "--batch", 4, "--rate", 2e-5, "--steps", 3800],
}
TRAIN = ["--init", "oidn", "--loss", "display", "--differences", 0.5, "--crop", 80]
TRAIN += ["--backbone-rate", 1, "--warmup", 100, "--ema", 0.999, "--sets", 1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--blender-python", default=sys.executable, help="a Python that has bpy")
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
    for kind, seed, count, film in SHOTS:
        drawn = ["--film", film, "--seed", seed, "--shots", count, "--python", options.blender_python]
        ravg("simulate", kind, "-o", shots, *RENDER, *drawn)
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
