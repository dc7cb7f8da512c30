"""A training of the final stage from OIDN's weights: render shots, make clips of them, train each preset.

    python examples/train_weights.py OUT --blender-python blender/bin/python
    python examples/train_weights.py OUT --untrained    # as the trainings begin, which is what ships

The shots are drawn from seeds (`ravg simulate random` and `hard`), so that the same come out again; none of those that
ravg is judged or tuned on is among them. Each has a render of many samples, whose pseudo-references the others are
trained towards. All of it goes on where it was stopped, shot by shot, and trainings from their last checkpoint.
docs/experiments.md has what it gains.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from network.checkpoint import save_model
from network.models import PRESETS as ALL
from network.robust_unet import start_from_oidn

#: Kind of shot, first seed, how many.
SHOTS = [("random", 5100, 11), ("hard", 6100, 7)]
RENDER = ["--frames", "1-5", "--size", "192x128", "--spp", "4-12", "--levels", "target=32,a=n,c=n/e"]
#: Of each preset: the larger a network, the longer a step takes.
SCHEDULES = {
    "fast": ["--steps", 800, "--warmup", 50, "--ema", 0.99],
    "balanced": ["--steps", 600, "--warmup", 50, "--ema", 0.99],
    "quality": ["--steps", 250, "--warmup", 30, "--ema", 0.98],
}
TRAIN = ["--init", "oidn", "--loss", "display", "--batch", 4, "--rate", 3e-4, "--trunk-rate", 0.1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--blender-python", default=sys.executable, help="a Python that has bpy")
    parser.add_argument("--untrained", action="store_true", help="write what the trainings begin with, and stop")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.untrained:
        for preset in SCHEDULES:
            model = start_from_oidn(ALL[preset]())
            save_model(options.out / f"{preset}.safetensors", model, {"start": "OIDN 2.5.1, nothing trained"})
        return 0

    def ravg(*words: object) -> None:
        subprocess.run([sys.executable, "-m", "hybrid.cli", *map(str, words)], check=True)

    shots, clips = options.out / "shots", options.out / "clips"
    for kind, seed, count in SHOTS:
        drawn = ["--seed", seed, "--shots", count, "--python", options.blender_python]
        ravg("simulate", kind, "-o", shots, *RENDER, *drawn)
    # Whole frames, of which training takes crops.
    ravg(
        "prepare",
        *sorted(shots.iterdir()),
        "-o",
        clips,
        "--target",
        "target",
        "--tile",
        0,
        "--estimate",
        "oidn-fast",
        "--frames",
        "2-4",
    )
    for preset, schedule in SCHEDULES.items():
        weights = options.out / f"{preset}.safetensors"
        begun = ["--resume"] if weights.with_name(f"{weights.name}.state").exists() else []
        if begun or not weights.exists():
            ravg("train", clips, "-o", weights, "--preset", preset, *TRAIN, *schedule, *begun)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
