"""Repeat the paper's comparison: RA blocks or a temporal module, spatial or temporal loss; what RA blocks are worth.

    ravg prepare shots/kept_out -o clips --tile 0 && ravg prepare shots/* -o clips
    python benchmarks/ablation.py clips --test kept_out -o ablation --steps 2000 --seeds 0 1 2

Everything is trained on the same samples in the same order for the same number of steps, without estimates, as the
paper's networks have none. Table 1: average and maximum weight of each frame of the window. Table 2: PSNR and SSIM on
x/(1+x) over the test shots' clips against their cleanest independent target. Table 3: a U-Net with RA blocks at every
scale, at the coarse ones only, and without, at equal steps and, `equal time`, with as many steps as fit into the CPU
time of the first. Finished trainings are kept in the output folder and not repeated, broken ones resumed; one seed is
done before the next begins. ablation.json holds every figure, from the first training on.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.comparison.metrics import ssim
from network.checkpoint import load_model, load_notes
from network.models import (
    TKPCN,
    KernelConfig,
    Model,
    RAResNet,
    RAResNetConfig,
    RAUNet,
    RAUNetConfig,
    TKPCNConfig,
)
from network.training.clips import Clips, open_clips, split_by_shot, whole_frames
from network.training.config import SamplerConfig, TrainConfig
from network.training.loop import predict, train
from network.training.losses import tone_mapped_psnr


def networks(frames: int, width: int, blocks: int, activation: str) -> dict[str, Callable[[], Model]]:
    """What is compared: RA and tKPCN have the same residual blocks, and RA blocks or the temporal module."""
    kernel = KernelConfig(frames=frames, activation=activation)
    after = tuple(sorted({max(1, round(blocks * k / 24)) for k in (3, 6, 9, 12, 15, 24)}))  # the paper's places
    widths = (width, 2 * width, 4 * width)
    return {
        "RA": lambda: RAResNet(RAResNetConfig(kernel, width, blocks, after, min(4, len(after)))),
        "tKPCN": lambda: TKPCN(TKPCNConfig(kernel, width, blocks)),
        "U-Net, RA everywhere": lambda: RAUNet(RAUNetConfig(kernel, widths, (0, 1, 2))),
        "U-Net, RA coarse": lambda: RAUNet(RAUNetConfig(kernel, widths, (1, 2))),
        "U-Net, no RA": lambda: RAUNet(RAUNetConfig(kernel, widths, ())),
    }


@torch.no_grad()
def judge(model: Model | None, clips: Clips) -> dict[str, list[float]]:
    """PSNR, SSIM and mean over the target's, of each test clip and level; weights of each frame if there is a model."""
    found: dict[str, list[float]] = {"psnr": [], "ssim": [], "mean": []}
    sums, greatest, count = np.zeros(clips.frames), np.zeros(clips.frames), 0
    for index in range(len(clips)):
        for batch in whole_frames(clips, index, 4 if model is None else model.multiple):
            centre = batch["color"].shape[1] // 2
            image = batch["color"][:, centre]
            if model is not None:
                filtered = predict(model, batch)
                image, weights = filtered.image(image), filtered.parts()[1][0, :, 0].flatten(1)
                sums += weights.sum(1).double().numpy()
                greatest = np.maximum(greatest, weights.amax(1).double().numpy())
                count += weights.shape[1]
            image, target = image * batch["modulation"], batch["target"]
            found["psnr"].append(float(tone_mapped_psnr(image, target)))
            found["mean"].append(float(image.sum() / target.sum()))
            found["ssim"].append(ssim(*(x[0].permute(1, 2, 0).numpy() for x in (image, target))))
    if model is not None:
        found["average"], found["maximum"] = (sums / count).tolist(), greatest.tolist()
    return found


def run(
    name: str, build: Callable[[], Model], config: TrainConfig, training: Clips, test: Clips, folder: Path
) -> dict[str, list[float]]:
    """Train and judge; what is done already is read."""
    out = folder / f"{name}, seed {config.seed}.safetensors"
    row = out.with_suffix(".json")
    found: dict[str, list[float]] = json.loads(row.read_text()) if row.exists() else {}
    if not found:
        torch.manual_seed(config.seed)
        model, start = build(), time.process_time()

        def log(step: int, values: dict[str, float]) -> None:
            if "done" in values and step % 50 == 0:
                left = values["seconds"] / values["done"] * (1 - values["done"]) / 60
                print(f"\r{name}, seed {config.seed}: step {step}, {left:.1f} min left ", end="", flush=True)

        losses = train(training, training.of([]), model, config, out, resume=Path(f"{out}.state").exists(), log=log)
        steps = load_notes(out)["training"]["steps"]
        # Of a resumed training only the last part has been timed.
        found = {"cpu_seconds": [(time.process_time() - start) / max(1, len(losses)) * steps], "steps": [steps]}
        row.write_text(json.dumps(found))
    if "mean" not in found:
        found |= judge(load_model(out), test)
        row.write_text(json.dumps(found))
        figures = f"PSNR {statistics.mean(found['psnr']):.2f}, SSIM {statistics.mean(found['ssim']):.4f}"
        print(f"\r{name}, seed {config.seed}: {figures}, weights {' '.join(f'{x:.4f}' for x in found['average'])}")
    return found


def mean(values: list[list[float]]) -> list[float]:
    """Mean over the seeds."""
    return [statistics.mean(column) for column in zip(*values, strict=True)]


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("clips", type=Path)
    parser.add_argument("--test", nargs="+", required=True, help="shots kept out of training")
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--whole", type=float, default=0.0, help="weight of the whole window in the temporal loss")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--width", type=int, default=16)
    parser.add_argument("--blocks", type=int, default=8)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--crop", type=int, default=128)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--loss", default="relmse", choices=("relmse", "l1", "smape"))
    parser.add_argument("--activation", default="relu", choices=("relu", "softmax"), help="relu is the paper's")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", choices=("paper", "unet"), help="one half of it")
    options = parser.parse_args(argv)
    torch.set_num_threads(options.threads)
    numba.set_num_threads(min(options.threads, numba.get_num_threads()))
    options.out.mkdir(parents=True, exist_ok=True)
    training, test = split_by_shot(open_clips(options.clips), options.test)
    built = networks(training.frames, options.width, options.blocks, options.activation)
    base = TrainConfig(
        steps=options.steps,
        batch=options.batch,
        rate=options.rate,
        warmup=min(200, options.steps // 5),
        loss=options.loss,
        device="cpu",
        whole=options.whole,
        checkpoint_minutes=2,
        sampler=SamplerConfig(crop=options.crop, sets=1),
    )
    results: dict[str, dict[str, list[float]]] = {"input": judge(None, test)}
    rows: dict[str, list[dict[str, list[float]]]] = {}
    shots = {shot: test.of([shot]) for shot in test.shots}
    values = {shot: sum(len(clips.pairs(index)) for index in range(len(clips))) for shot, clips in shots.items()}

    def compare(label: str, network: str, config: TrainConfig) -> dict[str, list[float]]:
        each = rows.setdefault(label, [])
        each.append(run(label, built[network], config, training, test, options.out))
        results[label] = {key: mean([found[key] for found in each]) for key in each[0]}
        results[label]["mean of each seed"] = [statistics.mean(found["psnr"]) for found in each]
        written = {"arguments": argv, "values of each shot": values, "results": results}
        (options.out / "ablation.json").write_text(json.dumps(written, indent=2))
        return each[-1]

    for seed in options.seeds:
        if options.only != "unet":
            for network in ("RA", "tKPCN"):
                for loss in ("spatial", "temporal"):
                    compare(f"{network} + {loss} loss", network, replace(base, terms=loss, seed=seed))
        if options.only != "paper":
            unet = replace(base, terms="temporal", whole=1.0, seed=seed)
            everywhere = compare("U-Net, RA everywhere", "U-Net, RA everywhere", unet)
            for network in ("U-Net, RA coarse", "U-Net, no RA"):
                ratio = everywhere["cpu_seconds"][0] / compare(network, network, unet)["cpu_seconds"][0]
                longer = replace(unet, steps=max(1, round(options.steps * ratio)))
                compare(f"{network}, equal time", network, longer)
    report(results, training.frames, values)
    return 0


def report(results: dict[str, dict[str, list[float]]], frames: int, values: dict[str, int]) -> None:
    """Print the tables; values are how many figures each test shot has, in order."""
    print("\nTable 1: weights of the frames")
    print(f"{'':38s}" + "".join(f"{k:9d}" for k in range(-(frames // 2), frames // 2 + 1)))
    for name, found in results.items():
        for kind in ("average", "maximum"):
            if kind in found:
                label = name if kind == "average" else ""
                print(f"{label:30s}{kind:8s}" + "".join(f"{value:9.4f}" for value in found[kind]))
    print("\nTable 2 and 3: PSNR, SSIM on x/(1+x); CPU seconds of training")
    print(f"{'':36s}{'min':>8s}{'mean':>8s}{'max':>8s}   {'min':>8s}{'mean':>8s}{'max':>8s}{'steps':>8s}{'CPU s':>8s}")
    for name, found in results.items():
        psnr, similarity = found["psnr"], found["ssim"]
        line = "".join(f"{f(psnr):8.2f}" for f in (min, statistics.mean, max)) + "   "
        line += "".join(f"{f(similarity):8.4f}" for f in (min, statistics.mean, max))
        if "steps" in found:
            line += f"{found['steps'][0]:8.0f}{found['cpu_seconds'][0]:8.0f}"
        if len(found.get("mean of each seed", [])) > 1:
            line += f"   PSNR of each seed: {', '.join(f'{value:.2f}' for value in found['mean of each seed'])}"
        print(f"{name:36s}{line}")
    print("\nOf each test shot PSNR, and how much brighter the mean is than the target's")
    print(f"{'':36s}" + "".join(f"{shot[-16:]:>18s}" for shot in values))
    ends = [0, *itertools.accumulate(values.values())]
    for name, found in results.items():
        line = ""
        for part in itertools.starmap(slice, itertools.pairwise(ends)):
            brighter = 100 * (statistics.mean(found["mean"][part]) - 1)
            line += f"{statistics.mean(found['psnr'][part]):9.2f} {brighter:+7.2f}%"
        print(f"{name:36s}{line}")


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
