"""Networks by name, with initial weights."""

from collections.abc import Callable
from typing import NamedTuple

import torch

from network.paper import models as paper
from network.robust_unet import RobustUNet, RobustUNetConfig

Model = RobustUNet | paper.KernelModel


class Preset(NamedTuple):
    """A network by the length of its windows, and its usual length."""

    build: Callable[[int], Model]
    frames: int = 5


def _multiscale(frames: int) -> paper.MultiScale:
    base = paper.RAUNetConfig(paper.KernelConfig(frames), widths=(32, 64, 96, 128), ra_scales=(0, 1, 2, 3))
    return paper.MultiScale(paper.MultiScaleConfig(base))


def _ra(frames: int, width: int) -> paper.RAResNetConfig:
    return paper.RAResNetConfig(paper.KernelConfig(frames), width=width)


def _tkpcn(frames: int, width: int) -> paper.TKPCNConfig:
    """The baseline of the same width and, within 1 %, number of parameters."""
    return paper.TKPCNConfig(paper.KernelConfig(frames), width=width, temporal_blocks=4)


PRESETS: dict[str, Preset] = {
    # The final stage without a U-Net, and with OIDN's base and large one: 0.9 and 3.9 M parameters.
    "fast": Preset(lambda frames: RobustUNet(RobustUNetConfig(frames, "none"))),
    "balanced": Preset(lambda frames: RobustUNet(RobustUNetConfig(frames, "base"))),
    "quality": Preset(lambda frames: RobustUNet(RobustUNetConfig(frames, "large", clean_guides=True)), frames=7),
    # From noisy frames alone: a small U-Net of 0.24 M parameters; a four-scale U-Net with RA blocks at every scale and
    # kernels at three resolutions; the paper's network and its baseline with blocks of width 32 and 0.57 M parameters,
    # equal within 1 %; both with width 16 and 0.15 M; both with the paper's width of 80.
    "unet": Preset(lambda frames: paper.RAUNet(paper.RAUNetConfig(paper.KernelConfig(frames)))),
    "multiscale": Preset(_multiscale),
    "ra": Preset(lambda frames: paper.RAResNet(_ra(frames, 32))),
    "tkpcn": Preset(lambda frames: paper.TKPCN(_tkpcn(frames, 32))),
    "ra-small": Preset(lambda frames: paper.RAResNet(_ra(frames, 16))),
    "tkpcn-small": Preset(lambda frames: paper.TKPCN(_tkpcn(frames, 16))),
    "paper": Preset(lambda frames: paper.RAResNet(paper.RAResNetConfig(paper.KernelConfig(frames)))),
    "paper-tkpcn": Preset(lambda frames: paper.TKPCN(paper.TKPCNConfig(paper.KernelConfig(frames)))),
}


def build_preset(name: str, frames: int | None = None, seed: int = 0) -> Model:
    """Build a network of `PRESETS` with initial weights, in training mode; the global generator is left as it was."""
    preset = PRESETS[name]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return preset.build(preset.frames if frames is None else frames)
