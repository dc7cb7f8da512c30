"""The U-Net of Intel Open Image Denoise (OIDN): the network, and denoising of single frames as OIDN does it.

Áfra 2025, "Intel Open Image Denoise", https://www.openimagedenoise.org. Network, exposure and transfer curve are those
of ``training/`` in RenderKit/oidn, Apache-2.0 (see NOTICE).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from network.cpu.convolution import can_fuse, convolve
from network.cpu.curve import decode, encode
from network.cpu.fused_ops import can_project, convolve_to_rgb, halve, with_low_bits
from network.cpu.upsample_conv import UpsampleTaps, can_upsample, convolve_upsampled, merge_taps
from network.strips import in_strips
from network.transfer import LARGEST, clip, srgb_forward, srgb_inverse

Module = TypeVar("Module", bound=nn.Module)

#: Channels of the convolutions at each scale of the encoder, finest first.
ENCODERS: dict[str, tuple[tuple[int, ...], ...]] = {
    "small": ((32, 32), (32,), (32,), (32,), (32, 32)),
    "base": ((32, 32), (48,), (64,), (80,), (96, 96)),
    "large": ((64, 64), (96, 96), (128, 128), (192, 192), (256, 256)),
}
#: Channels of the convolutions at each scale of the decoder, coarsest first.
DECODERS: dict[str, tuple[tuple[int, ...], ...]] = {
    "small": ((64, 64), (64, 64), (64, 32), (32, 32)),
    "base": ((112, 112), (96, 96), (64, 64), (64, 32)),
    "large": ((192, 192), (128, 128), (96, 96), (64, 64)),
}
#: Pixels of mirroring beyond the borders: rows before and after, columns before and after.
Borders = tuple[tuple[int, int], tuple[int, int]]
NO_BORDERS: Borders = ((0, 0), (0, 0))


@dataclass(frozen=True)
class OidnUNetConfig:
    inputs: int = 9  # channels: color, then albedo, then normal
    size: str = "base"  # of ENCODERS


class OidnUNet(nn.Module):
    """OIDN's U-Net: 3×3 convolutions at five scales, with skip connections from the input of each encoder scale."""

    #: Height and width must be multiples of this.
    multiple = 16

    def __init__(self, config: OidnUNetConfig) -> None:
        super().__init__()
        self.config = config
        width, skips = config.inputs, []
        self.encoder, self.decoder = nn.ModuleList(), nn.ModuleList()
        for widths in ENCODERS[config.size]:
            skips.append(width)
            self.encoder.append(Stage(width, widths))
            width = widths[-1]
        for skip, widths in zip(reversed(skips[:-1]), DECODERS[config.size], strict=True):
            self.decoder.append(Stage(width + skip, widths))
            width = widths[-1]
        self.last = nn.Conv2d(width, 3, 3, padding=1)

    @property
    def first(self) -> nn.Conv2d:
        return cast(nn.Conv2d, cast(nn.Sequential, self.encoder[0])[0])

    @property
    def convolutions(self) -> Iterator[nn.Conv2d]:
        return (module for module in self.modules() if isinstance(module, nn.Conv2d))

    def forward(self, x: Tensor) -> Tensor:
        """Denoise ``(N, C, H, W)`` inputs in [0, 1], float32, to ``(N, 3, H, W)``.

        Raises ValueError if height or width is no multiple of 16.
        """
        check_size("x", x, self.multiple)
        bottleneck, skips = self.encode(x.to(self.first.weight.dtype, memory_format=torch.channels_last))
        skips[0] = x
        (image,) = self.decode(bottleneck, skips, lambda features: [self.project(features)])
        return image

    def encode(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Run the encoder on ``(N, C, H, W)``: features of the coarsest scale, and inputs of the finer scales."""
        skips = []
        for stage in self.encoder[:-1]:
            skips.append(x)
            (x,) = in_strips(lambda x, stage=stage: [halve(stage(x))], 2, x)
        return self.encoder[-1](x), skips

    def decode(self, x: Tensor, skips: list[Tensor], head: Callable[[Tensor], Sequence[Tensor]]) -> list[Tensor]:
        """Run the decoder, and a head on its finest features. Returns the head's outputs.

        `x` and `skips` are those of `encode`, and no skip is left, so that features are freed as they are used; the
        first skip is the input of the network, not rounded, or its `input_skip`. The head maps ``(N, width, H, W)``
        features, or some of their rows, to outputs that depend on one further row at most.
        """
        *coarse, finest = (cast(Stage, stage) for stage in self.decoder)
        for stage in coarse:
            (x,) = in_strips(lambda x, skip, stage=stage: [stage.upsample(x, skip)], 2, x, skips.pop())
        return in_strips(lambda x, skip: head(finest.upsample(x, self.input_skip(skip))), 3, x, skips.pop())

    def input_skip(self, x: Tensor) -> Tensor:
        """Skip connection from the network's input; in bfloat16 with the low bits of the color (`round_unet`)."""
        if self.first.weight.dtype == torch.bfloat16:
            return x if x.dtype == torch.bfloat16 else with_low_bits(x)
        return x.to(self.first.weight.dtype, memory_format=torch.channels_last)

    def project(self, x: Tensor) -> Tensor:
        """Last convolution, from finest features to ``(N, 3, H, W)``; not rounded by any autocast."""
        if can_project(x):
            return convolve_to_rgb(x, self.last.weight, cast(Tensor, self.last.bias))
        with torch.autocast(x.device.type, enabled=False):
            return cast(Tensor, self.last(x.to(self.last.weight.dtype)))


class Stage(nn.Sequential):
    """3×3 convolutions, a ReLU after each."""

    # Merged taps of the first convolution in bfloat16, if `set_upsample_taps` was called.
    coarse: Tensor | None
    skip: Tensor | None

    def __init__(self, width: int, widths: Sequence[int]) -> None:
        layers: list[nn.Module] = []
        for following in widths:
            layers += [nn.Conv2d(width, following, 3, padding=1), nn.ReLU(inplace=True)]
            width = following
        super().__init__(*layers)
        for name in UpsampleTaps._fields:
            self.register_buffer(name, None, persistent=False)

    def upsample(self, x: Tensor, skip: Tensor) -> Tensor:
        """Enlarge features to twice their size, concatenate the skip connection, and run all layers."""
        first = cast(nn.Conv2d, self[0])
        if torch.is_grad_enabled() or not can_upsample(x, skip, first.weight):
            return self.forward(torch.cat([functional.interpolate(x, scale_factor=2.0, mode="nearest"), skip], 1))
        rounded = None if self.coarse is None or self.skip is None else UpsampleTaps(self.coarse, self.skip)
        taps = rounded or merge_taps(first.weight, x.shape[1])
        return self._run(convolve_upsampled(x, skip, taps, cast(Tensor, first.bias)), list(self)[2:])

    def set_upsample_taps(self, width: int, convert: Callable[[Tensor], Tensor]) -> None:
        """Keep converted sums of taps for `upsample` of `width` channels, since rounded taps do not add up to them."""
        for name, taps in merge_taps(cast(nn.Conv2d, self[0]).weight, width)._asdict().items():
            setattr(self, name, convert(taps).contiguous(memory_format=torch.channels_last))

    def forward(self, x: Tensor) -> Tensor:
        return self._run(x, list(self))

    @staticmethod
    def _run(x: Tensor, layers: list[nn.Module]) -> Tensor:
        fused = can_fuse(x)
        for layer in layers:
            if not fused:
                x = layer(x)
            elif isinstance(layer, nn.Conv2d):
                x = convolve(x, layer.weight, layer.bias)
        return x


def channels_last(model: Module) -> Module:
    """Convert the weights of all convolutions to the memory format of their activations, channels last; in place."""
    for parameter in model.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.to(memory_format=torch.channels_last)
    return model


def check_size(name: str, layer: Tensor, multiple: int) -> None:
    """Raise ValueError unless height and width of a named layer ``(..., H, W)`` are positive multiples of a number."""
    for axis, length in zip(("height", "width"), layer.shape[-2:], strict=True):
        if length == 0 or length % multiple:
            raise ValueError(f"{name}: expected a {axis} that is a multiple of {multiple}, got {length}")


def denoise_color(
    unet: OidnUNet,
    color: Tensor,
    albedo: Tensor | None = None,
    normal: Tensor | None = None,
    *,
    exposure: Tensor | float,
    borders: Borders = NO_BORDERS,
) -> Tensor:
    """Denoise images as OIDN does: ``(N, 3, H, W)`` linear radiance, float32, at least 0.

    NaN and negative values of the color count as 0; albedo is clipped to [0, 1], normals in any fixed space to [−1, 1].
    The exposure is a factor of the color, of the whole image (`hybrid.alignment.transfer.autoexposure`), ``(N,)`` or
    one number. Layers are mirrored beyond their borders, as far as `borders` says; beyond that the network sees 0.
    """
    factor = exposure.view(-1, 1, 1, 1) if isinstance(exposure, Tensor) else exposure
    layers = [(color, lambda x: encode(clip(x * factor, 0, LARGEST)))]
    if albedo is not None:
        layers.append((albedo, lambda x: clip(x, 0, 1)))
    if normal is not None:
        layers.append((normal, normal_to_unit))
    return _run(unet, layers, lambda x: decode(x) / factor, borders)


def denoise_albedo(unet: OidnUNet, albedo: Tensor) -> Tensor:
    """Denoise albedo ``(N, 3, H, W)`` in [0, 1] by itself, with OIDN's weights for albedo."""
    return _run(unet, [(albedo, lambda x: srgb_forward(clip(x, 0, 1)))], lambda x: srgb_inverse(x.clamp(0, 1)))


def denoise_normal(unet: OidnUNet, normal: Tensor) -> Tensor:
    """Denoise normals ``(N, 3, H, W)`` in [−1, 1] by themselves, with OIDN's weights for normals."""
    return _run(unet, [(normal, normal_to_unit)], lambda x: x.clamp(0, 1) * 2 - 1)


def normal_to_unit(normal: Tensor) -> Tensor:
    """Map normals from [−1, 1] to [0, 1]."""
    return clip(normal, -1, 1) * 0.5 + 0.5


def _run(
    unet: OidnUNet,
    layers: Sequence[tuple[Tensor, Callable[[Tensor], Tensor]]],
    decode: Callable[[Tensor], Tensor],
    borders: Borders = NO_BORDERS,
) -> Tensor:
    """Run the network on layers of any size, each mapped to [0, 1] by its function, and decode its output."""
    device, (height, width) = layers[0][0].device, layers[0][0].shape[2:]
    # Numbers of the rows and columns that the network sees.
    rows, columns = (
        torch.from_numpy(np.pad(np.arange(size), border, mode="reflect"))
        for size, border in zip((height, width), borders, strict=True)
    )
    below, right = -len(rows) % unet.multiple, -len(columns) % unet.multiple

    def encode(numbers: Tensor) -> list[Tensor]:
        parts = []
        for layer, to_unit in layers:
            part = layer.index_select(-2, numbers[:, 0].to(device))
            if len(columns) > width:
                part = part.index_select(-1, columns.to(device))
            parts.append(to_unit(part))
        encoded = torch.cat(parts, 1)
        return [functional.pad(encoded, (0, right)) if right else encoded]  # padding by nothing copies

    # In strips, so that intermediate results are small and stay in the caches.
    (x,) = in_strips(encode, 0, rows[:, None])
    (top, _), (left, _) = borders
    image = cast(Tensor, unet(functional.pad(x, (0, 0, 0, below)) if below else x))
    (result,) = in_strips(lambda rows: [decode(rows.float())], 0, image[..., top : top + height, left : left + width])
    return result
