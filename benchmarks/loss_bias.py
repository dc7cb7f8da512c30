"""Measure which way each loss pulls the mean of a network that is trained on noisy targets.

    python benchmarks/loss_bias.py "examples/shot/noisy.####.exr" --reference "examples/shot/reference.####.exr"

A network sees what is common to many renders of a place, not the noise of the one that is its target. So: in every
block of 16×16 pixels the reference, times a gain of that block, against the noisy frame as target; the gain that a loss
likes best leaves the mean alone, darkens or brightens. Printed is the mean of the blocks so scaled over the mean of the
reference: 1 is unbiased. Losses whose denominators carry no gradient are followed to where their gradient vanishes. The
mean of the noisy frame over that of the reference stands beside: so far chance has moved it.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.alignment.transfer import measure_exposure
from hybrid.files.frames import open_shot
from network.training.losses import ImageLoss, l1, relmse, smape
from network.training.perceptual import Perceptual, load_vgg19

BLOCK = 16


def favourite_mean(loss: ImageLoss, reference: Tensor, target: Tensor, scale: Tensor) -> float:
    """Mean of the reference over its mean, each block times the gain (1/4 to 4) where the slope changes sign."""
    rows, columns = (length // BLOCK for length in reference.shape[2:])
    reference, target = (image[..., : rows * BLOCK, : columns * BLOCK] for image in (reference, target))
    low = torch.full((1, 1, rows, columns), math.log(0.25))
    high = -low

    def scaled(logarithm: Tensor) -> Tensor:
        return reference * logarithm.exp().repeat_interleave(BLOCK, 2).repeat_interleave(BLOCK, 3)

    for _ in range(16):
        middle = ((low + high) / 2).requires_grad_()
        (slope,) = torch.autograd.grad(loss(scaled(middle), target, scale).sum(), middle)
        middle = middle.detach()
        low, high = torch.where(slope > 0, low, middle), torch.where(slope > 0, middle, high)
    return float(scaled((low + high) / 2).mean() / reference.mean())


def losses(vgg: str | None) -> dict[str, ImageLoss]:
    """What is measured."""

    def pure(prediction: Tensor, target: Tensor, scale: Tensor, weight: Tensor | None = None) -> Tensor:
        return relmse(prediction, target, scale, weight, limit=math.inf)

    found: dict[str, ImageLoss] = {"l1": l1, "smape": smape, "relmse, limit 4": relmse, "relmse, no limit": pure}
    if vgg is not None:
        found["perceptual"] = Perceptual(load_vgg19(vgg))
    return found


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("shot", nargs="+", help="noisy frames")
    parser.add_argument("--reference", action="append", required=True, help="of each shot, in the same order")
    parser.add_argument("--vgg", help="torchvision's VGG19 weights, or hub: adds the perceptual loss")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    for spec, clean in zip(options.shot, options.reference, strict=True):
        noisy, reference = open_shot(spec), open_shot(clean)
        gains: dict[str, list[float]] = {}
        for number in (n for n in noisy.numbers if reference.has(n)):
            target, mean = (
                torch.from_numpy(shot.read(number).color).permute(2, 0, 1)[None].contiguous()
                for shot in (noisy, reference)
            )
            scale = torch.tensor([measure_exposure(reference.read(number).color)])
            gains.setdefault("mean of the noisy frame", []).append(float(target.mean() / mean.mean()))
            for name, loss in losses(options.vgg).items():
                gains.setdefault(name, []).append(favourite_mean(loss, mean, target, scale))
        print(spec)
        for name, values in gains.items():
            print(f"  {name:26s}{statistics.mean(values):8.4f}  ({min(values):.4f} to {max(values):.4f})")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
