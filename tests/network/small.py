"""Small networks of every kind, for tests that train, write or read them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open

from network.paper.models import (
    TKPCN,
    KernelConfig,
    MultiScale,
    MultiScaleConfig,
    RAResNet,
    RAResNetConfig,
    RAUNet,
    RAUNetConfig,
    TKPCNConfig,
)
from network.presets import Model
from network.robust_unet import RobustUNet, RobustUNetConfig


def notes_of(path: Path) -> dict[str, Any]:
    """The notes that `save_model` has written."""
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["notes"])


def make_model(seed: int = 0) -> RAUNet:
    torch.manual_seed(seed)
    kernel = KernelConfig(frames=3, size=3, threshold=0)
    return RAUNet(RAUNetConfig(kernel, widths=(8, 8), ra_scales=(1,)))


def make_robust() -> RobustUNet:
    torch.manual_seed(0)
    return RobustUNet(RobustUNetConfig(3, "small"))


SMALL = KernelConfig(frames=3, size=3)
MODELS: dict[str, Callable[[], Model]] = {
    "resnet": lambda: RAResNet(RAResNetConfig(SMALL, width=4, blocks=2, ra_after=(1, 2), skips=1)),
    "tkpcn": lambda: TKPCN(TKPCNConfig(SMALL, width=4, blocks=1)),
    "multi-scale": lambda: MultiScale(MultiScaleConfig(make_model().config, scales=3)),
    "unet": lambda: RAUNet(RAUNetConfig(SMALL, (4, 4), (1,))),
    "robust": make_robust,
}
