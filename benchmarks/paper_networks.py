"""The paper's network and its baseline at a small size: both losses, two seeds, trained and judged alike.

    python benchmarks/paper_networks.py filter SHOT [SHOT ...] OUT
    python benchmarks/paper_networks.py train CLIPS OUT --validation SHOT,SHOT [--steps 1000]
    python benchmarks/paper_networks.py judge CLIPS OUT SHOT [SHOT ...] --validation SHOT,SHOT

The first command writes shots to train on as a pixel filter shows them, whose pixels share noise. `CLIPS` is a folder
of `ravg make-clips --tile 64`. The second trains two networks at a time, on one processor each, and continues what was
interrupted. The third takes shots as `benchmarks/ladder.py` does, and measures each network on each shot and level:
PSNR and temporal PSNR in dB, SSIM, FLIP; the same of frames that are not warped, and of networks whose Robust Average
blocks are cut; and the weight of each frame of the window on the shots of validation. It writes OUT/figures.json,
continues that, and prints tables.
"""

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

import figures
import ladder
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.comparison.flip import flip_maps
from hybrid.comparison.metrics import ssim
from hybrid.files.shots import Shot
from network.checkpoint import load_model, save_model
from network.paper.blocks import RobustAverage
from network.paper.kernels import Filtered
from network.training.clips import open_clips, whole_frames
from network.training.loop import predict

NETWORKS = ("ra-small", "tkpcn-small")
TERMS = ("temporal", "spatial")
SEEDS = (0, 1)
SETTINGS = "--batch 4 --crop 64 --loss display --whole 6 --clip 0.1 --ema 0.997 --threads 1 --validate-minutes 4"
MEASURES = ("PSNR", "temporal PSNR", "SSIM", "FLIP")


def filter_shots(options: argparse.Namespace) -> None:
    """Write the levels of each shot as a pixel filter shows them; its width changes from shot to shot."""
    for index, folder in enumerate(options.shots):
        radius = figures.RADII[index % len(figures.RADII)]
        figures.spread(folder, options.out / f"{folder.name}_filtered", radius, ladder.levels(folder))


def train(options: argparse.Namespace) -> None:
    """Train all networks, two at a time."""

    def run(training: tuple[int, str, str]) -> None:
        seed, terms, network = training
        out = options.out / f"{network}.{terms}.{seed}.safetensors"
        state = Path(f"{out}.state")
        if out.exists() and not state.exists():
            return
        command = [sys.executable, "-m", "hybrid.cli", "train", options.clips, "-o", out, "--preset", network]
        command += ["--terms", terms, "--seed", seed, "--steps", options.steps, "--validation", options.validation]
        command += SETTINGS.split() + ["--resume"] * state.exists()
        with Path(f"{out}.log").open("a", encoding="utf-8") as log:
            subprocess.run([str(part) for part in command], check=True, stdout=log, stderr=log)

    options.out.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(run, product(SEEDS, TERMS, NETWORKS)))  # a comparison comes early


def cut(weights: Path, out: Path) -> bool:
    """Write weights whose Robust Average blocks return their input; False if the network has none."""
    model = load_model(weights)
    blocks = [module for module in model.modules() if isinstance(module, RobustAverage)]
    for block in blocks:
        torch.nn.init.zeros_(block.weight.weight)
        torch.nn.init.constant_(block.weight.bias, -30)  # the share of the average, e^-30, vanishes in float32
    if blocks:
        save_model(out, model)
    return bool(blocks)


@torch.no_grad()
def frame_weights(weights: Path, clips: Path, shots: list[str]) -> list[float]:
    """Mean weight of each frame of the window in the kernels, on the clips of some shots."""
    model, of_shots = load_model(weights), open_clips(clips).of(shots)
    sums, count = np.zeros(model.frames), 0
    for index in range(len(of_shots)):
        for batch in whole_frames(of_shots, index, model.multiple):
            output = predict(model, batch)
            assert isinstance(output, Filtered)
            share = output.parts()[1].mean(dim=(0, 2, 3, 4))
            sums, count = sums + (share / share.sum()).numpy(), count + 1
    return [round(float(share), 3) for share in sums / count]


def measure(truth: ladder.Truth, shot: Shot, method: str, **options: object) -> list[float]:
    """PSNR, temporal PSNR, SSIM and FLIP of a method: means over the frames."""
    images = ladder.denoise(shot, method, **options)
    means = [(a + b) / 2 for a, b in truth.references]
    alike = np.mean([ssim(*pair) for pair in zip(images, means, strict=True)])
    error = np.mean([flip_maps([image], mean)[0].mean() for image, mean in zip(images, means, strict=True)])
    return [*truth.judge(shot, images), round(float(alike), 4), round(float(error), 4)]


def judge(options: argparse.Namespace) -> None:
    """Measure all networks and print tables."""
    path = options.out / "figures.json"
    measured = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    files = [path for path in sorted(options.out.glob("*.safetensors")) if not Path(f"{path}.state").exists()]
    first = [weights for weights in files if weights.stem.endswith("temporal.0")]
    (options.out / "cut").mkdir(exist_ok=True)
    without = {weights: out for weights in first if cut(weights, out := options.out / "cut" / weights.name)}
    for weights in files:
        if (key := f"weights {weights.stem}") not in measured:
            measured[key] = frame_weights(weights, options.clips, options.validation.split(","))
    for folder in options.shots:
        truth = ladder.Truth(folder)
        for level in ladder.levels(folder):
            shot = truth.shot(level)
            runs: dict[str, tuple[str, dict[str, object]]] = {
                name: (name, {}) for name in ("noisy", "final", "ra", "tkpcn")
            }
            for weights in files:
                runs[weights.stem] = (str(weights), {})
                if weights in first:
                    runs[f"{weights.stem} unwarped"] = (str(weights), {"no_stages": ["warp"]})
                if weights in without:
                    runs[f"{weights.stem} cut"] = (str(without[weights]), {})
            for name, (method, settings) in runs.items():
                if (key := f"{folder.name} {level} {name}") not in measured:
                    measured[key] = measure(truth, shot, method, **settings)
                    path.write_text(json.dumps(measured, indent=0), encoding="utf-8")
                    print(key, *measured[key], flush=True)
    print(table(measured))


def table(figures: dict[str, list[float]]) -> str:
    """Means over the shots of each level, and the weights of frames, in Markdown."""
    rows = [key.split(" ", 2) for key in figures if not key.startswith("weights ")]
    lines = []
    for level in dict.fromkeys(level for _, level, _ in rows):
        lines += [f"| {level} | " + " | ".join(MEASURES) + " |", "|---" * (len(MEASURES) + 1) + "|"]
        for name in dict.fromkeys(name for *_, name in rows):
            means = np.mean([figures[" ".join(row)] for row in rows if row[1:] == [level, name]], axis=0)
            lines.append(f"| {name} | " + " | ".join(f"{mean:.4g}" for mean in means) + " |")
    lines += [f"{key}: {figures[key]}" for key in figures if key.startswith("weights ")]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(required=True)
    filtering = commands.add_parser("filter")
    filtering.add_argument("shots", nargs="+", type=Path)
    filtering.add_argument("out", type=Path)
    filtering.set_defaults(run=filter_shots)
    training = commands.add_parser("train")
    training.add_argument("clips", type=Path)
    training.add_argument("out", type=Path)
    training.add_argument("--steps", type=int, default=1000)
    training.set_defaults(run=train)
    judging = commands.add_parser("judge")
    judging.add_argument("clips", type=Path)
    judging.add_argument("out", type=Path)
    judging.add_argument("shots", nargs="+", type=Path)
    judging.set_defaults(run=judge)
    for command in (training, judging):
        command.add_argument("--validation", required=True, help="names of shots, with commas between")
    options = parser.parse_args()
    options.run(options)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
