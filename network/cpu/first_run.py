"""Compile the loops of this package: a program that the first run of a user starts beside itself."""

import gc

import torch

from network.devices import has_bfloat16
from network.robust_unet import RobustUNet, RobustUNetConfig, for_inference
from network.unet import denoise_color


def compile_loops() -> None:
    """Run a small network on nothing."""
    model = for_inference(RobustUNet(RobustUNetConfig(5, "small")), has_bfloat16(torch.device("cpu")))
    image = torch.zeros(1, 16, 16, 3).movedim(-1, 1)
    with torch.inference_mode():
        denoise_color(model.backbone, image, image, image, exposure=1.0)


if __name__ == "__main__":
    gc.disable()
    compile_loops()
