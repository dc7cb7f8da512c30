"""Compile the loops of this package: a program that the first run of a user starts beside itself."""

import gc

import torch

from network.bfloat16 import round_unet
from network.devices import has_bfloat16
from network.unet import OidnUNet, OidnUNetConfig, denoise_color


def compile_loops() -> None:
    """Run a small network on nothing."""
    unet = OidnUNet(OidnUNetConfig(size="small")).eval().requires_grad_(False)
    unet = round_unet(unet) if has_bfloat16(torch.device("cpu")) else unet
    image = torch.zeros(1, 16, 16, 3).movedim(-1, 1)
    with torch.inference_mode():
        denoise_color(unet, image, image, image, exposure=1.0)


if __name__ == "__main__":
    gc.disable()
    compile_loops()
