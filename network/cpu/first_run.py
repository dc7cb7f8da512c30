"""Compile the loops of this package: a program that the first run of a user starts beside itself."""

import gc

import torch

from network.devices import has_bfloat16
from network.robust_unet import RobustUNet, RobustUNetConfig, denoise_window, for_inference
from network.unet import denoise_color
from network.windows import UNetWindow


def compile_loops() -> None:
    """Run a small network on nothing, as a first pass and as a final stage of five frames."""
    model = for_inference(RobustUNet(RobustUNetConfig(5, "small")), has_bfloat16(torch.device("cpu")))
    frames, image = torch.zeros(1, 5, 16, 16, 3).movedim(-1, 2), torch.zeros(1, 16, 16, 3).movedim(-1, 1)
    with torch.inference_mode():
        # In the order in which a run needs them.
        denoise_color(model.backbone, image, image, image, exposure=1.0)
        one = torch.ones(1)
        denoise_window(model, UNetWindow(frames, frames, frames[:, :, :1], image, one, one, image, image))


if __name__ == "__main__":
    gc.disable()
    compile_loops()
