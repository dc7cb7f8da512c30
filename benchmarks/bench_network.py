"""Measure what the parts of `network` cost; JSON on standard output.

    OMP_WAIT_POLICY=PASSIVE python benchmarks/bench_network.py --threads 1

CPU seconds of the process after a warm-up: median, least and greatest of the repeats. Parts are measured in training
at the size of its crops and in inference at the size of its tiles; "naive" is the form that is written first.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.cpu_time import arguments, report
from network.paper.blocks import RobustAverage
from network.paper.kernels import apply_kernels, predict_kernel, threshold_kernel
from network.paper.models import for_inference as prepare_kernels
from network.presets import PRESETS, build_preset
from network.robust_average import outermost_first, ravg
from network.robust_unet import RobustUNet, channels_last, for_inference
from network.training.clips import Sample
from network.training.config import TrainConfig
from network.training.loop import batch_loss, predict
from network.training.losses import relmse


def naive_ravg(frames: list[Tensor]) -> Tensor:
    return torch.stack(frames).sort(0).values[1:-1].mean(0)


def naive_block(block: RobustAverage, x: Tensor) -> Tensor:
    """Concatenate, convolve and sort at every step."""
    frames = list(x.chunk(5))
    kernel = torch.cat([block.on_frame.weight, block.on_average.weight], 1)
    for i in outermost_first(5):
        average = naive_ravg(frames[:i] + frames[i + 1 :])
        both = torch.cat([frames[i], average], 1)
        hidden = torch.relu(functional.conv2d(both, kernel, block.on_frame.bias, padding=1))
        weight = torch.sigmoid(block.weight(hidden))
        frames[i] = (1 - weight) * frames[i] + weight * average
    return torch.cat(frames)


def unfolded(kernels: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
    n, t, c, h, w = frames.shape
    patches = functional.unfold(frames.flatten(0, 1), 5, padding=2).view(n, t, c, 25, h, w)
    kernels = kernels.view(n, t, 1, 25, h, w)
    return (patches * kernels).sum(3), kernels.sum(3)


def training(function: Callable[[Tensor], Tensor | tuple[Tensor, ...]], x: Tensor) -> Callable[[], None]:
    def step() -> None:
        y = function(x.detach().requires_grad_())
        (y if isinstance(y, Tensor) else y[0]).sum().backward()

    return step


def inference(function: Callable[[Tensor], object], x: Tensor) -> Callable[[], None]:
    def step() -> None:
        with torch.no_grad():
            function(x)

    return step


def parts(tile: int) -> Iterator[tuple[str, Callable[[], object]]]:
    """Name, and what to run."""
    for size, mode, name in ((tile, inference, ""), (128, training, ", training")):
        x = torch.randn(5, 32, size // 2, size // 2).bfloat16().contiguous(memory_format=torch.channels_last)
        block = RobustAverage(32).bfloat16().to(memory_format=torch.channels_last)
        yield f"ravg of four{name}", mode(lambda x: ravg(list(x.chunk(5))[:4]), x)
        yield f"ravg of four, naive{name}", mode(lambda x: naive_ravg(list(x.chunk(5))[:4]), x)
        yield f"RA block{name}", mode(lambda x, block=block: block(x, 5), x)
        yield f"RA block, naive{name}", mode(lambda x, block=block: naive_block(block, x), x)
        weights, frames = torch.rand(1, 125, size, size), torch.rand(1, 5, 3, size, size)
        yield f"predict_kernel{name}", mode(lambda x: predict_kernel(x, centre=62), weights)
        yield f"threshold_kernel{name}", mode(lambda x: threshold_kernel(x, centre=62), weights)
        yield f"apply_kernels{name}", mode(lambda x, f=frames: apply_kernels(x, f), weights)
        yield f"apply_kernels, unfolded{name}", mode(lambda x, f=frames: unfolded(x, f), weights)
        weights, frames = torch.rand(1, 125, 540, 960), torch.rand(1, 5, 3, 540, 960)
        yield f"apply_kernels, 960×540{name}", mode(lambda x, f=frames: apply_kernels(x, f), weights)


def networks(tile: int, presets: list[str]) -> Iterator[tuple[str, Callable[[], object]]]:
    for name in presets:
        for bfloat16 in (False, True):
            model = build_preset(name)
            model = (for_inference if isinstance(model, RobustUNet) else prepare_kernels)(model, bfloat16)
            batch = batch_of(1, tile, model.frames)
            yield (
                f"{name}, {'bfloat16' if bfloat16 else 'float32'}",
                lambda m=model, b=batch: torch.no_grad()(predict)(m, b),
            )
        for count in (1, 2):
            model, config = channels_last(build_preset(name)), TrainConfig(steps=1)
            batch = batch_of(count, 128, model.frames)
            yield (
                f"{name}, training, batch of {count}",
                lambda m=model, b=batch, c=config: batch_loss(m, b, c, relmse).backward(),
            )


def batch_of(count: int, size: int, frames: int) -> Sample:
    """Samples of noise."""
    window, image = torch.rand(count, frames, 3, size, size), torch.rand(count, 3, size, size)
    one = torch.ones(count)
    return Sample(*[window] * 5, window[:, :, :1], *[image] * 3, one, one, image[:, :2], image, one)


def main(argv: list[str]) -> int:
    parser = arguments(__doc__)
    parser.add_argument("--tile", type=int, default=256)
    parser.add_argument("--presets", nargs="*", choices=PRESETS, default=["fast"], help="paper takes a minute")
    options = parser.parse_args(argv)
    torch.set_num_threads(options.threads)
    return report(options, (*parts(options.tile), *networks(options.tile, options.presets)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
