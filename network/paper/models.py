"""Networks that predict kernels (`network.paper.kernels`) from the features of an aligned window.

All of their convolutions are shared over the frames; only Robust Average blocks, or a temporal module, connect these.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from network.paper.blocks import ResidualBlock, RobustAverage, TemporalModule
from network.paper.inputs import CHANNELS, KernelWindow, network_inputs
from network.paper.kernels import Filtered, Pyramid, check_threshold, predict_kernel
from network.unet import channels_last, check_size


@dataclass(frozen=True)
class KernelConfig:
    """The kernels a model predicts: their taps and their threshold."""

    frames: int = 5  # T, odd; the window
    size: int = 5  # K×K taps on each frame
    threshold: float = 0.5  # t·taps: 0.5 is the paper's t = 1 / (2K)

    def __post_init__(self) -> None:
        _check_odd("frames", self.frames)
        _check_odd("size", self.size)
        check_threshold(self.threshold)

    @property
    def taps(self) -> int:
        """T·K·K."""
        return self.frames * self.size**2

    @property
    def centre(self) -> int:
        """The tap on the pixel itself."""
        return self.taps // 2


@dataclass(frozen=True)
class RAUNetConfig:
    """U-Net with Robust Average blocks."""

    kernel: KernelConfig = field(default_factory=KernelConfig)
    widths: tuple[int, ...] = (16, 32, 64)  # channels at full, half, quarter scale; multiples of 16 run fastest
    ra_scales: tuple[int, ...] = (1, 2)  # scales with an RA block; 0 is full scale and the most expensive

    def __post_init__(self) -> None:
        if not self.widths or min(self.widths) < 1:
            raise ValueError(f"widths: expected at least one positive width, got {self.widths}")
        if not set(self.ra_scales) <= set(range(len(self.widths))):
            raise ValueError(f"ra_scales: expected scales 0 to {len(self.widths) - 1}, got {self.ra_scales}")


@dataclass(frozen=True)
class RAResNetConfig:
    """Residual network with Robust Average blocks, at one scale: the paper's."""

    kernel: KernelConfig = field(default_factory=KernelConfig)
    width: int = 80
    blocks: int = 24
    ra_after: tuple[int, ...] = (3, 6, 9, 12, 15, 24)  # RA blocks after these residual blocks (counted from 1)
    skips: int = 4  # skip connections around each of the first so many sections that end in an RA block
    conv_size: int = 3  # the paper does not say; 3 gives 3.5 M parameters, 7 gives 19 M

    def __post_init__(self) -> None:
        if list(self.ra_after) != sorted(set(self.ra_after) & set(range(1, self.blocks + 1))):
            raise ValueError(f"ra_after: expected ascending blocks 1 to {self.blocks}, got {self.ra_after}")
        if not 0 <= self.skips <= len(self.ra_after):
            raise ValueError(f"skips: expected 0 to {len(self.ra_after)}, got {self.skips}")
        _check_odd("conv_size", self.conv_size)


@dataclass(frozen=True)
class MultiScaleConfig:
    """A Robust Average network with kernels at several resolutions."""

    base: RAUNetConfig | RAResNetConfig = field(default_factory=RAUNetConfig)
    scales: int = 3  # full, half and quarter resolution

    def __post_init__(self) -> None:
        if self.scales < 1:
            raise ValueError(f"scales: expected at least 1, got {self.scales}")

    @property
    def kernel(self) -> KernelConfig:
        return self.base.kernel


@dataclass(frozen=True)
class TKPCNConfig:
    """Residual network without Robust Average blocks, with a temporal module at its end: the paper's baseline."""

    kernel: KernelConfig = field(default_factory=KernelConfig)
    width: int = 80
    blocks: int = 24  # of the spatial part, shared over the frames
    temporal_blocks: int = 2
    conv_size: int = 3

    def __post_init__(self) -> None:
        if self.blocks < 0 or self.temporal_blocks < 0:
            raise ValueError(
                f"blocks, temporal_blocks: expected 0 or more, got {self.blocks} and {self.temporal_blocks}"
            )
        _check_odd("conv_size", self.conv_size)


def _check_odd(name: str, value: int) -> None:
    if value < 1 or value % 2 == 0:
        raise ValueError(f"{name}: expected an odd number >= 1, got {value}")


class KernelHead(nn.Module):
    """Last layer: features of each frame to one kernel per pixel over all frames.

    With h the output of the convolution and c the confidence of the frame over the mean of all, the raw weights are
    ``t + (1 − tK) c / K + h / K``: as the paper's η_t takes t away and renormalises, h = 0 gives the mean over time and
    the taps, weighted by confidence, and a tap may get any weight or none.
    """

    def __init__(self, channels: int, config: KernelConfig) -> None:
        super().__init__()
        self.config = config
        self.window = nn.Conv2d(channels, config.size**2, 3, padding=1)
        with torch.no_grad():
            self.window.weight.mul_(0.1)
            cast(Tensor, self.window.bias).zero_()

    def forward(self, features: Tensor, confidence: Tensor, threshold: float | None = None) -> Tensor:
        """Predict kernels ``(N, taps, H, W)``: features ``(T·N, C, H, W)``, time first, confidence ``(N, T, 1, H, W)``.

        The threshold is t·K in [0, 1); by default the one that the model was trained with.
        """
        config = self.config
        # 1e-3: a pixel without confidence in any frame (even the centre was not finite) averages them all.
        confidence = confidence.float() + 1e-3
        confidence = confidence / confidence.mean(1, keepdim=True)
        # Frames first, planes contiguous as the kernels' passes need them.
        raw = self.window(features).unflatten(0, (config.frames, -1)).transpose(0, 1)
        raw = raw.to(torch.float32, memory_format=torch.contiguous_format)
        cut = config.threshold if threshold is None else check_threshold(threshold)
        # In units of 1/K, to which η_t is invariant.
        weights = config.threshold + (1 - config.threshold) * confidence + raw
        return predict_kernel(weights.flatten(1, 2), cut / config.taps, centre=config.centre)


class KernelNetwork(nn.Module):
    """A network at one resolution: `trunk` makes features of frames, `head` kernels; see `filter_window`."""

    #: Height and width must be multiples of this.
    multiple = 1
    stem: nn.Conv2d
    head: KernelHead

    def __init__(self, config: RAUNetConfig | RAResNetConfig | TKPCNConfig) -> None:
        super().__init__()
        self.config: Any = config
        self.frames = config.kernel.frames  # length of the windows, T

    def forward(self, features: Tensor, confidence: Tensor, threshold: float | None = None) -> Tensor:
        """Predict ``(N, taps, H, W)`` kernels; see `KernelHead.forward`."""
        return cast(Tensor, self.head(self.trunk(features), confidence, threshold))

    def trunk(self, features: Tensor) -> Tensor:
        """Features ``(T·N, width, H, W)``, time first, that kernels are predicted from, of ``(N, T, C, H, W)``."""
        raise NotImplementedError

    def _enter(self, features: Tensor) -> Tensor:
        """Run the first convolution on ``(N, T, C, H, W)``: ``(T·N, width, H, W)``."""
        check_size("features", features, self.multiple)
        x = features.transpose(0, 1).flatten(0, 1)
        return cast(Tensor, self.stem(x.to(dtype=self.stem.weight.dtype, memory_format=torch.channels_last)))


class RAUNet(KernelNetwork):
    """Small U-Net: shared over the frames, connected in time by RA blocks on the way down.

    One residual block per scale and direction; strided convolution down; 1×1 convolution, nearest neighbour and
    addition up.
    """

    def __init__(self, config: RAUNetConfig) -> None:
        super().__init__(config)
        widths = config.widths
        self.stem = nn.Conv2d(CHANNELS, widths[0], 3, padding=1)
        self.encode = nn.ModuleList(ResidualBlock(width) for width in widths)
        self.average = nn.ModuleDict({str(scale): RobustAverage(widths[scale]) for scale in config.ra_scales})
        self.down = nn.ModuleList(nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in pairwise(widths))
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairwise(widths))
        self.decode = nn.ModuleList(ResidualBlock(width) for width in widths[:-1])
        self.head = KernelHead(widths[0], config.kernel)
        self.multiple = int(2 ** (len(widths) - 1))

    def trunk(self, features: Tensor) -> Tensor:
        x = self._enter(features)
        scales: list[Tensor] = []
        for scale, block in enumerate(self.encode):
            x = block(self.down[scale - 1](x) if scale else x)
            if str(scale) in self.average:
                x = self.average[str(scale)](x, self.frames)
            scales.append(x)
        for scale in reversed(range(len(self.decode))):
            up = functional.interpolate(self.up[scale](x), scale_factor=2.0, mode="nearest")
            x = self.decode[scale](scales[scale] + up)
        return torch.relu(x)


class RAResNet(KernelNetwork):
    """The paper's network (figure 1): residual blocks at full resolution, RA blocks among them.

    The figure shows skip connections after the first four RA blocks and not how they join: here the input of each
    section up to an RA block is concatenated to its output, and a 1×1 convolution brings both back to the width. With
    3×3 convolutions it has 3.5 M parameters, with 7×7 19.0 M. The paper says 24 M; 3×3 and the trunk of the VGG19 in
    its loss (20.0 M) come close to that.
    """

    def __init__(self, config: RAResNetConfig) -> None:
        super().__init__(config)
        width, size = config.width, config.conv_size
        self.stem = nn.Conv2d(CHANNELS, width, size, padding=size // 2)
        self.blocks = nn.ModuleList(ResidualBlock(width, size) for _ in range(config.blocks))
        self.average = nn.ModuleDict({str(block): RobustAverage(width, size) for block in config.ra_after})
        self.skip = nn.ModuleList(nn.Conv2d(2 * width, width, 1) for _ in range(config.skips))
        self.head = KernelHead(width, config.kernel)

    def trunk(self, features: Tensor) -> Tensor:
        x = self._enter(features)
        section, skips = x, iter(self.skip)
        for count, block in enumerate(self.blocks, start=1):
            x = block(x)
            if str(count) in self.average:
                x = self.average[str(count)](x, self.frames)
                skip = next(skips, None)
                if skip is not None:
                    x = skip(torch.cat([x, section], 1))
                section = x
        return torch.relu(x)


class TKPCN(KernelNetwork):
    """The paper's baseline: a spatial network with shared weights, then one temporal module; no RA blocks."""

    def __init__(self, config: TKPCNConfig) -> None:
        super().__init__(config)
        width, size = config.width, config.conv_size
        self.stem = nn.Conv2d(CHANNELS, width, size, padding=size // 2)
        self.blocks = nn.ModuleList(ResidualBlock(width, size) for _ in range(config.blocks))
        self.temporal = TemporalModule(width, config.kernel.frames, config.temporal_blocks, size)
        self.head = KernelHead(width, config.kernel)

    def trunk(self, features: Tensor) -> Tensor:
        x = self._enter(features)
        for block in self.blocks:
            x = block(x)
        return torch.relu(self.temporal(x, self.frames))


class MultiScale(nn.Module):
    """A Robust Average network whose kernels are predicted at full, half and quarter resolution, and blended.

    The network's features, averaged over 2×2 pixels once and again, go to a head of each resolution. A convolution on
    the centre's features predicts, pixel by pixel, the share of the low frequencies that comes from the next coarser
    resolution, where K×K taps extend twice as far. It starts at 2 %. Vogels et al. 2018, section 5.3.
    """

    def __init__(self, config: MultiScaleConfig) -> None:
        super().__init__()
        self.config = config
        #: Length of the windows, T.
        self.frames = config.kernel.frames
        self.base = RAUNet(config.base) if isinstance(config.base, RAUNetConfig) else RAResNet(config.base)
        #: Height and width must be multiples of this.
        self.multiple = max(self.base.multiple, int(2 ** (config.scales - 1)))
        width = self.base.head.window.in_channels
        self.heads = nn.ModuleList(KernelHead(width, config.kernel) for _ in range(config.scales - 1))
        self.blend = nn.ModuleList(nn.Conv2d(width, 1, 3, padding=1) for _ in range(config.scales - 1))
        for convolution in self.blend:
            nn.init.constant_(cast(Tensor, convolution.bias), -4.0)

    def forward(self, features: Tensor, confidence: Tensor, threshold: float | None = None) -> Pyramid:
        """Predict kernels at each resolution; see `KernelHead.forward`."""
        check_size("features", features, self.multiple)
        x = self.base.trunk(features)
        kernels, blends = [self.base.head(x, confidence, threshold)], []
        for head, blend in zip(self.heads, self.blend, strict=True):
            centre = x.chunk(self.frames)[self.frames // 2]
            blends.append(torch.sigmoid(blend(centre)).float())
            x, confidence = functional.avg_pool2d(x, 2), functional.avg_pool3d(confidence, (1, 2, 2))
            kernels.append(head(x, confidence, threshold))
        return Pyramid(tuple(kernels), tuple(blends))


KernelModel = KernelNetwork | MultiScale


def filter_window(
    model: KernelModel, window: KernelWindow, threshold: float | None = None, run: Callable[..., Any] | None = None
) -> Filtered:
    """Predict the kernels of a window, by `run` where the model is wrapped, and apply them to its color.

    Height and width are multiples of `model.multiple`. The threshold is t·K in [0, 1), instead of the model's own;
    higher stays closer to the input. Raises ValueError if shapes do not fit the model.
    """
    kernels = (model if run is None else run)(network_inputs(window), window.confidence, threshold)
    return Filtered.of(kernels, window.color)


def for_inference(model: KernelModel, bfloat16: bool) -> KernelModel:
    """Prepare a model for running: channels last, no gradients, bfloat16 weights if asked; changes and returns it."""
    model.eval().requires_grad_(False)
    for parameter in model.parameters():
        parameter.data = parameter.to(torch.bfloat16 if bfloat16 else torch.float32)
    return channels_last(model)
