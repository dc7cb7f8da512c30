"""The weights that ship, and a training from there: render shots, make clips of them, train.

    python examples/train_weights.py OUT                                  # the three presets before any training
    python examples/train_weights.py OUT --scenes SCENES --blender-python blender/bin/python

What ships is what the first line writes: the final stage on OIDN's weights, read from the installed pyoidn. The second
line trains it. SCENES holds the .blend files named below; what is added to them and where the camera stands follows
from the table, so the same shots come out again; 32 random shots are `ravg simulate random`, seeds from 3000 on. None
of the scenes that ravg is judged on (contemporary_bathroom, breakfast_room, modern_hall) is among them. Rendering
takes four hours of one core, the clips half an hour, both resumable shot by shot.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from network.checkpoint import save_model
from network.models import PRESETS as ALL
from network.robust_unet import start_from_oidn

HERE = Path(__file__).parent


class Shot(NamedTuple):
    """One training shot: 7 frames of 256×144, a crop of a `film`-sized camera, at three noise levels."""

    scene: str
    camera: str
    center: str
    film: str
    spp: int
    movers: int  # textured objects that cross the picture
    seed: int
    first: int


SHOTS = [
    Shot("classroom", "Camera_near2", "0.704,0.638", "640x360", 24, 2, 101, 1),
    Shot("grey_white_room", "Camera_move", "0.481,0.373", "1920x1080", 12, 1, 102, 12),
    Shot("white_room", "Camera_near1", "0.445,0.341", "1920x1080", 21, 1, 103, 7),
    Shot("wooden_staircase", "Camera", "0.571,0.472", "1920x1080", 37, 1, 104, 5),
    Shot("veach_ajar", "Camera_move", "0.723,0.395", "1920x1080", 10, 1, 105, 6),
    Shot("spaceship", "Camera_near1", "0.765,0.595", "1920x1080", 44, 3, 106, 6),
    Shot("chalice", "Camera", "0.449,0.718", "1920x1080", 45, 2, 107, 12),
    Shot("classroom", "Camera_move", "0.694,0.308", "1920x1080", 18, 1, 151, 7),
    Shot("spaceship", "Camera_near1", "0.534,0.581", "1920x1080", 11, 3, 152, 5),
    Shot("ashtray", "Camera_move", "0.675,0.346", "1280x720", 6, 0, 153, 6),
    Shot("wooden_staircase", "Camera", "0.270,0.525", "1920x1080", 23, 1, 154, 11),
    Shot("grey_white_room", "Camera", "0.243,0.673", "1920x1080", 8, 1, 155, 7),
    Shot("white_room", "Camera", "0.260,0.651", "640x360", 15, 3, 156, 3),
    Shot("veach_ajar", "Camera_move", "0.546,0.664", "1920x1080", 15, 2, 157, 4),
    Shot("chalice", "Camera_near1", "0.576,0.710", "1920x1080", 21, 1, 158, 15),
    Shot("country_kitchen", "Camera_move", "0.349,0.536", "1280x720", 23, 0, 159, 17),
]
RANDOM = ["--frames", "1-7", "--size", "256x144", "--spp", "8-64", "--levels", "a=n,c=n/e,d=4", "--shots", "32"]
RANDOM += ["--seed", "3000", "--reference", "128", "--reference-frames", "4"]
PRESETS = "fast", "balanced", "quality"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=Path, help="train, on shots of these")
    parser.add_argument("--blender-python", default=sys.executable, help="a Python that has bpy")
    parser.add_argument("--minutes", type=float, default=27, help="of training, for each preset")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for preset in PRESETS:
        model = start_from_oidn(ALL[preset]())
        save_model(options.out / f"{preset}.safetensors", model, {"start": "OIDN 2.5.1, nothing trained"})
    if options.scenes is None:
        return 0
    ravg = [sys.executable, "-m", "hybrid.cli"]

    def run(*words: object) -> None:
        subprocess.run([*map(str, words)], check=True)

    folders = []
    for shot in SHOTS:
        folders.append(options.out / f"{shot.scene}{shot.seed}")
        levels = f"a={shot.spp},b={shot.spp},c={max(2, int(shot.spp / 2.71828))}"
        scene, middle = options.scenes / f"{shot.scene}.blend", f"{shot.first + 3}-{shot.first + 3}"
        render = [options.blender_python, HERE / "render_shot.py", scene, folders[-1], "--camera", shot.camera]
        render += ["--center", shot.center, "--film", shot.film, "--size", "256x144", "--levels", levels]
        render += ["--movers", shot.movers, "--seed", shot.seed, "--frames", f"{shot.first}-{shot.first + 6}"]
        run(*render, "--reference", 256, "--reference-frames", middle)
    run(*ravg, "simulate", "random", "-o", options.out / "random", *RANDOM, "--python", options.blender_python)
    folders += sorted((options.out / "random").iterdir())
    # Whole frames, of which training takes crops.
    clips = options.out / "clips"
    run(*ravg, "prepare", *folders, "-o", clips, "--tile", 0, "--reference", "--estimate", "oidn-fast")
    schedule = ["--init", "oidn", "--trunk-rate", 0, "--minutes", options.minutes, "--rate", 1e-4, "--batch", 1]
    further = ["--loss", "display", "--clip", 0.1, "--ema", 0.997, "--drop-frames", 0.3]
    for preset in PRESETS:
        out = options.out / f"{preset}.trained.safetensors"
        run(*ravg, "train", clips, "-o", out, "--preset", preset, *schedule, *further)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
