"""What Robust Average blocks are worth on OIDN's trunk: against convolutions over all frames, and against nothing.

    ravg prepare shots/* -o clips --target target --tile 0 --estimate oidn-fast
    ravg prepare a/* -o test_a --reference --tile 0 --estimate oidn-fast      # the same frames, each with
    ravg prepare b/* -o test_b --reference --tile 0 --estimate oidn-fast      # a reference of its own
    python benchmarks/ra_worth.py clips --test test_a test_b --steps 150 --seeds 0 1 2
    python benchmarks/ra_worth.py clips --test test_a test_b --seconds 120      # for equal time

All begin with OIDN's weights and see the same samples in the same order. *RA* is the final stage as it ships. *Joined*
has in the block's place what tKPCN does with the frames (Vogels et al. 2018, section 5.2): a convolution over the
features of all of them, which begins as their mean, and a residual block. *None* has nothing there: the gathered
picture enters the decoder alone. The table has PSNR before and after, against both references
(`hybrid.comparison.metrics.psnr`); by how many per cent the picture brightens when a frame of the window does by one;
steps, and CPU seconds of one.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.comparison.metrics import psnr
from network.models import filter_window
from network.paper.blocks import ResidualBlock
from network.robust_unet import Picture, RobustUNet, RobustUNetConfig, start_from_oidn
from network.training.clips import Clips, open_clips, whole_frames
from network.training.config import SamplerConfig, TrainConfig
from network.training.loop import train


class Joined(nn.Module):
    """A convolution over the features of all frames; before any training their mean."""

    def __init__(self, channels: int, frames: int) -> None:
        super().__init__()
        self.join = nn.Conv2d(frames * channels, channels, 3, padding=1)
        self.block = ResidualBlock(channels)
        nn.init.zeros_(self.block.second.weight)
        for bias in (self.join.bias, self.block.second.bias):
            nn.init.zeros_(bias)
        nn.init.zeros_(self.join.weight)
        for frame in range(frames):
            nn.init.eye_(self.join.weight.data[:, frame * channels : (frame + 1) * channels, 1, 1])
        self.join.weight.data /= frames

    def forward(self, x: Tensor, frames: int, centre: bool) -> Tensor:
        """As `network.paper.blocks.ChannelAverage`, of the centre."""
        return self.block(self.join(torch.cat(x.chunk(frames), 1)))


def make(name: str, size: str, seed: int) -> RobustUNet:
    """The final stage with what is named in the block's place."""
    torch.manual_seed(seed)
    config = RobustUNetConfig(size=size, ra_scales=() if name == "none" else (0,))
    model = start_from_oidn(RobustUNet(config))
    if name == "joined":
        model.average["0"] = Joined(model.trunk.first.out_channels, config.frames)
    return model


@torch.no_grad()
def judge(model: RobustUNet, tests: tuple[Clips, Clips]) -> tuple[float, list[float]]:
    """PSNR in dB, the mean over clips and levels; per cent that each frame of the window gives."""
    model.eval()
    found: list[float] = []
    gives: list[list[float]] = []

    def picture(batch: dict[str, Tensor]) -> Tensor:
        out = filter_window(model, batch)
        assert isinstance(out, Picture)
        return out.irradiance * batch["modulation"]

    for index in range(len(tests[0])):
        pairs = zip(*(whole_frames(test, index, model.multiple) for test in tests), strict=True)
        for batch, other in pairs:
            image = picture(batch)
            shown, *truths = (x[0].permute(1, 2, 0).numpy() for x in (image, batch["target"], other["target"]))
            found.append(psnr(shown, (truths[0], truths[1])))
            row = []
            for frame in range(batch["estimate"].shape[1]):
                brighter = {name: batch[name].clone() for name in ("estimate", "residual")}
                for layer in brighter.values():
                    layer[:, frame] *= 1.01
                row.append(100 * float(picture(batch | brighter).sum() / image.sum() - 1))
            gives.append(row)
    return statistics.mean(found), [statistics.mean(column) for column in zip(*gives, strict=True)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("clips", type=Path)
    parser.add_argument("--test", type=Path, nargs=2, required=True, help="clips of whole frames, two references")
    parser.add_argument("--size", default="small", help="of the trunk")
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--seconds", type=float, help="CPU seconds of each training, in place of steps")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    options = parser.parse_args()
    training = open_clips(options.clips)
    tests = (open_clips(options.test[0]), open_clips(options.test[1]))
    config = TrainConfig(
        steps=options.steps,
        loss="display",
        batch=4,
        sampler=SamplerConfig(crop=min(SamplerConfig.crop, training.size)),
        rate=3e-4,
        warmup=20,
        ema=0.98,
        checkpoint_minutes=1e9,
    )

    def trained(name: str, steps: int, seed: int) -> tuple[RobustUNet, float]:
        """A model after so many steps, and CPU seconds of one."""
        model, started = make(name, options.size, seed), time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            own = replace(config, steps=steps, seed=seed)
            train(training, training.of([]), model, own, Path(folder) / "w.safetensors")
        return model, (time.process_time() - started) / steps

    print("| in the block's place | untrained | trained, each seed | frames give | steps | CPU-s a step |")
    print("|---|---|---|---|---|---|")
    for name in ("RA", "joined", "none"):
        before = judge(make(name, options.size, 0), tests)[0]
        steps = options.steps
        if options.seconds is not None:
            trained(name, 2, 0)  # what runs for the first time takes longer
            steps = max(round(options.seconds / trained(name, 8, 0)[1]), 1)
        after, gives, seconds = [], [], []
        for seed in options.seeds:
            model, spent = trained(name, steps, seed)
            seconds.append(spent)
            found, shares = judge(model, tests)
            after.append(found)
            gives.append(shares)
        each, mean = " ".join(f"{value:.2f}" for value in after), [statistics.mean(c) for c in zip(*gives, strict=True)]
        given = " ".join(f"{value:.2f}" for value in mean)
        print(f"| {name} | {before:.2f} | {each} | {given} | {steps} | {statistics.mean(seconds):.2f} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
