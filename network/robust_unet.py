"""The final stage: a Robust Average block on the images of a window, then OIDN's U-Net once."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from network.bfloat16 import round_unet
from network.oidn_weights import load_oidn
from network.robust_average import Pooled, RobustAverage, UNetWindow, pool
from network.unet import ENCODERS, Borders, OidnUNet, OidnUNetConfig, channels_last, denoise_color

#: Share of the average of first passes in the image, by the size of the backbone: less for better backbones. Found on
#: four shots at two noise levels (docs/dev/experiments.md).
AVERAGE_BLEND = {"small": 0.5, "base": 0.4, "large": 0.25}
#: Networks of OIDN that a model of each size starts from. The first two accept noisy guides; the third, the only large
#: one, needs clean guides.
OIDN_BACKBONES = {"small": "rt_hdr_alb_nrm_small", "base": "rt_hdr_alb_nrm", "large": "rt_hdr_calb_cnrm_large"}
#: Pixels by which images are mirrored beyond their borders, which a backbone otherwise takes for darkness: 0.7 dB
#: within 8 pixels of a border, and a flat image stays flat to 0.4 %, where its rim came out a third too dark. Crops in
#: training are mirrored alike.
MIRRORED = 16


@dataclass(frozen=True)
class RobustUNetConfig:
    frames: int = 5  # T, odd; the window
    size: str = "base"  # of network.unet.ENCODERS, or "none": the average of the first passes is the image
    clean_guides: bool = False  # whether the backbone relies on its guides: noisy guides are filtered first

    def __post_init__(self) -> None:
        if self.frames < 1 or self.frames % 2 == 0:
            raise ValueError(f"frames: expected an odd number >= 1, got {self.frames}")
        if self.size not in (sizes := ("none", *ENCODERS)):
            raise ValueError(f"size: expected one of {', '.join(sizes)}, got {self.size!r}")


@dataclass(frozen=True)
class UNetOutput:
    """Image that a `RobustUNet` made of a window: ``(N, 3, H, W)`` irradiance, at least 0."""

    irradiance: Tensor
    pooled: Pooled

    def parts(self) -> tuple[Tensor, Tensor]:
        """Contribution of each frame to the pooled image, ``(N, T, 3, H, W)``, and its share, ``(N, T, 1, H, W)``."""
        return self.pooled.parts, self.pooled.share


class RobustUNet(nn.Module):
    """A Robust Average block, whose result OIDN's U-Net denoises.

    The image is ``(1 − k) O(b) + k G``, with b the pooled image, O the U-Net, G the average of the first passes and k
    the `AVERAGE_BLEND`: the errors of two images that are made differently cancel in part, and G flickers less. Without
    a U-Net it is G. There are 4,000 parameters beside the backbone's 0.32 M ("small"), 0.92 M ("base") or 3.85 M
    ("large").
    """

    def __init__(self, config: RobustUNetConfig) -> None:
        super().__init__()
        self.config = config
        self.robust_average = RobustAverage()
        self.backbone = None if config.size == "none" else OidnUNet(OidnUNetConfig(9, config.size))

    @property
    def multiple(self) -> int:
        """Height and width with borders must be multiples of this."""
        return 1 if self.backbone is None else self.backbone.multiple

    @property
    def frames(self) -> int:
        """Length of the windows, T."""
        return self.config.frames

    def forward(self, window: UNetWindow) -> UNetOutput:
        """Denoise the centre of a window; raises ValueError if it has another number of frames."""
        if window.confidence.shape[1] != self.frames:
            raise ValueError(f"frames: expected {self.frames}, got {window.confidence.shape[1]}")
        pooled = pool(window, self.robust_average(window))
        guides = window.albedo, window.normal
        borders = ((MIRRORED, MIRRORED), (MIRRORED, MIRRORED))
        image = self.denoise(pooled.image, pooled.average, window.modulation, *guides, window.gain, borders)
        return UNetOutput(image, pooled)

    def denoise(
        self,
        image: Tensor,
        average: Tensor,
        modulation: Tensor,
        albedo: Tensor | None,
        normal: Tensor | None,
        gain: Tensor,
        borders: Borders,
    ) -> Tensor:
        """Denoise the pooled image and blend it with the average of first passes, all ``(N, 3, H, W)``: irradiance.

        `borders` are the pixels by which layers are mirrored beyond their borders.
        """
        if self.backbone is None:
            return average.clamp_min(0)
        # Missing guides are 0.5 to a backbone; a normal of 0 is 0.5 to it.
        albedo = torch.full_like(modulation, 0.5) if albedo is None else albedo
        normal = torch.zeros_like(modulation) if normal is None else normal
        radiance = denoise_color(self.backbone, image * modulation, albedo, normal, exposure=gain, borders=borders)
        light = radiance / modulation
        return light + AVERAGE_BLEND[self.config.size] * (average.clamp_min(0) - light)


def start_from_oidn(model: RobustUNet) -> RobustUNet:
    """Load the weights of OIDN's network of its size into a model (`network.oidn_weights.load_oidn`); returns it."""
    if model.backbone is not None:
        model.backbone.load_state_dict(load_oidn(OIDN_BACKBONES[model.config.size]).state_dict())
    return model


def for_inference(model: RobustUNet, bfloat16: bool) -> RobustUNet:
    """Prepare a model for running, in place: without gradients, the backbone in `bfloat16` (`round_unet`) or not."""
    model.eval().requires_grad_(False)
    if bfloat16 and model.backbone is not None:
        model.backbone = round_unet(model.backbone)
    return channels_last(model)
