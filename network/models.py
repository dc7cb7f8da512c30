"""Kernel-predicting networks in which only Robust Average blocks connect the frames.

A model maps the features of an aligned window (`network.inputs`) to kernels (`network.kernels`). All of its
convolutions are shared over the frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from network.blocks import ResidualBlock, RobustAverage, TemporalModule
from network.inputs import CHANNELS, ESTIMATE_CHANNELS, network_inputs, window_exposure
from network.kernels import filter_window, mean_of, predict_kernel


@dataclass(frozen=True)
class KernelConfig:
    """The kernels a model predicts: their sources and their threshold."""

    frames: int = 5  # T, odd; the window
    size: int = 5  # K of the noisy frames' K×K taps
    estimate_size: int = 0  # K of the K×K taps on each frame's estimate; 0: takes none (the paper's model)
    estimate_share: float = 0.95  # part of the output that the estimates have before training
    spread: float = 1.0  # part of a noisy frame's weight that is spread over all its taps before training
    threshold: float = 0.5  # t·K: 0.5 is the paper's t = 1 / (2K)

    def __post_init__(self) -> None:
        for name in ("frames", "size"):
            value = getattr(self, name)
            if value < 1 or value % 2 == 0:
                raise ValueError(f"{name}: expected an odd number >= 1, got {value}")
        if self.estimate_size < 0 or (self.estimate_size and self.estimate_size % 2 == 0):
            raise ValueError(f"estimate_size: expected 0 or an odd number, got {self.estimate_size}")
        for name in ("estimate_share", "spread"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected 0 < {name} <= 1, got {getattr(self, name)}")
        _check_threshold(self.threshold)

    @property
    def window_taps(self) -> int:
        """Taps on the noisy window, T·K·K."""
        return self.frames * self.size**2

    @property
    def estimate_taps(self) -> int:
        """Taps on the estimates, T·K·K, or 0."""
        return self.frames * self.estimate_size**2

    @property
    def centre(self) -> int:
        """The tap on the noisy pixel itself."""
        return self.window_taps // 2

    @property
    def channels(self) -> int:
        """Feature channels per frame that the model reads."""
        return CHANNELS + (ESTIMATE_CHANNELS if self.estimate_size else 0)


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
    conv_size: int = 3  # the paper does not tell; 3 gives 3.5 M parameters, 7 gives 19 M

    def __post_init__(self) -> None:
        if list(self.ra_after) != sorted(set(self.ra_after) & set(range(1, self.blocks + 1))):
            raise ValueError(f"ra_after: expected ascending blocks 1 to {self.blocks}, got {self.ra_after}")
        if not 0 <= self.skips <= len(self.ra_after):
            raise ValueError(f"skips: expected 0 to {len(self.ra_after)}, got {self.skips}")
        if self.conv_size < 1 or self.conv_size % 2 == 0:
            raise ValueError(f"conv_size: expected an odd number >= 1, got {self.conv_size}")


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
        if self.conv_size < 1 or self.conv_size % 2 == 0:
            raise ValueError(f"conv_size: expected an odd number >= 1, got {self.conv_size}")


class KernelHead(nn.Module):
    """Last layer: features of each frame to one kernel per pixel over all sources.

    Parameters
    ----------
    channels : int
        Width of the features.
    config : KernelConfig
        Sources and threshold.

    Notes
    -----
    The raw weight of tap i is ``b_i c_i e^{h_i}``, which is normalised and thresholded. b is the kernel at the start:
    on each noisy frame a peak on the pixel itself and the rest (`KernelConfig.spread`) on all its taps, on each
    estimate nearly all on the pixel itself, times the share of the source; c is the confidence of the frame; h is what
    the convolution predicts, bounded to ±4 on the noisy frames and ±1 on the estimates. The training thus starts from
    the gated average of the estimates with a tenth of the noisy frames, or without estimates from the mean over time
    and the taps. A noisy tap may gain or lose a factor of 55, and what falls below the threshold is gone; but what has
    no confidence stays out, whatever is predicted. With sums ``b_i c_i + h_i``, and with taps around the pixel on the
    estimates too, some weight leaked past every edge and to frames that were not to be trusted: a shot with sharp
    outlines came out 0.6 dB below the start.
    """

    window_start: Tensor
    estimate_start: Tensor

    def __init__(self, channels: int, config: KernelConfig) -> None:
        super().__init__()
        self.config = config
        self.window = nn.Conv2d(channels, config.size**2, 3, padding=1)
        self.estimate = nn.Conv2d(channels, config.estimate_size**2, 3, padding=1) if config.estimate_size else None
        self.register_buffer("window_start", _peak(config.size, config.spread), persistent=False)
        self.register_buffer("estimate_start", _peak(max(1, config.estimate_size), 0.01), persistent=False)
        with torch.no_grad():
            for convolution in (self.window, self.estimate):
                if convolution is not None:
                    convolution.weight.mul_(0.1)
                    cast(Tensor, convolution.bias).zero_()

    def forward(self, features: Tensor, confidence: Tensor, present: Tensor, threshold: float | None = None) -> Tensor:
        """Predict kernels.

        Parameters
        ----------
        features : Tensor
            ``(T·N, C, H, W)``, time first.
        confidence : Tensor
            ``(N, T, 1, H, W)``.
        present : Tensor
            ``(N,)``, 1 where a sample has an estimate, else 0: its taps then have no weight and do not count in K.
        threshold : float, optional
            t·K in [0, 1). Default: the configured one, which the model was trained with.

        Returns
        -------
        Tensor
            ``(N, taps, H, W)`` float32.
        """
        config = self.config
        here = present.float().view(-1, 1, 1, 1) if config.estimate_size else features.new_zeros(1, 1, 1, 1).float()
        taps = config.window_taps + here * config.estimate_taps
        share = (config.estimate_share * here).unsqueeze(1)
        # 1e-3: a pixel without confidence in any frame (even the centre was not finite) averages them all.
        confidence = confidence.float() + 1e-3
        factor = _factor(_frames_first(self.window(features), config.frames), 4)
        weights = ((1 - share) / config.window_taps * confidence * self.window_start * factor).flatten(1, 2)
        if self.estimate is not None:
            factor = _factor(_frames_first(self.estimate(features), config.frames), 1)
            more = share / config.estimate_taps * confidence * self.estimate_start * factor
            weights = torch.cat([weights, more.flatten(1, 2)], 1)
        cut = config.threshold if threshold is None else _check_threshold(threshold)
        return predict_kernel(weights, cut / taps, centre=config.centre)


class RAUNet(nn.Module):
    """Small U-Net: shared over the frames, connected in time by RA blocks on the way down.

    Parameters
    ----------
    config : RAUNetConfig
        Sizes.

    Notes
    -----
    One residual block per scale and direction; strided convolution down; 1×1 convolution, nearest
    neighbour and addition up.
    """

    def __init__(self, config: RAUNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = config.widths
        self.stem = nn.Conv2d(config.kernel.channels, widths[0], 3, padding=1)
        self.encode = nn.ModuleList(ResidualBlock(width) for width in widths)
        self.average = nn.ModuleDict({str(scale): RobustAverage(widths[scale]) for scale in config.ra_scales})
        self.down = nn.ModuleList(nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in pairwise(widths))
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairwise(widths))
        self.decode = nn.ModuleList(ResidualBlock(width) for width in widths[:-1])
        self.head = KernelHead(widths[0], config.kernel)

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this."""
        return int(2 ** (len(self.config.widths) - 1))

    def forward(self, features: Tensor, confidence: Tensor, present: Tensor, threshold: float | None = None) -> Tensor:
        """Kernels of an aligned window.

        Parameters
        ----------
        features : Tensor
            ``(N, T, channels, H, W)`` from `network.inputs.network_inputs`.
        confidence, present, threshold
            As for `KernelHead.forward`.

        Returns
        -------
        Tensor
            ``(N, taps, H, W)`` float32, sums to 1 over the taps.

        Raises
        ------
        ValueError
            If frames or channels are not the model's, or height or width is no multiple of `multiple`.
        """
        frames = self.config.kernel.frames
        x = self.stem(_time_first(features, self.config.kernel, self.multiple, self.stem.weight.dtype))
        skips = []
        for scale, block in enumerate(self.encode):
            if scale:
                skips.append(x)
                x = self.down[scale - 1](x)
            x = block(x)
            if str(scale) in self.average:
                x = self.average[str(scale)](x, frames)
        for scale in reversed(range(len(skips))):
            x = skips[scale] + functional.interpolate(self.up[scale](x), scale_factor=2.0, mode="nearest")
            x = self.decode[scale](x)
        return cast(Tensor, self.head(torch.relu(x), confidence, present, threshold))


class RAResNet(nn.Module):
    """The paper's network: residual blocks at full resolution, RA blocks among them.

    Parameters
    ----------
    config : RAResNetConfig
        Sizes.

    Notes
    -----
    The paper's figure shows skip connections after the first four RA blocks and does not say how they join. Here
    each section (residual blocks up to and with an RA block) is skipped: its input is concatenated to its output
    and a 1×1 convolution brings both back to the width.

    With 3×3 convolutions it has 3.5 M parameters, with 7×7 19.0 M. The paper says 24 M; 3×3 and the trunk of the
    VGG19 in its loss (20.0 M) come close to that.

    References
    ----------
    Kalojanov and Thurston 2023, figure 1 and section 7.
    """

    def __init__(self, config: RAResNetConfig) -> None:
        super().__init__()
        self.config = config
        width, size = config.width, config.conv_size
        self.stem = nn.Conv2d(config.kernel.channels, width, size, padding=size // 2)
        self.blocks = nn.ModuleList(ResidualBlock(width, size) for _ in range(config.blocks))
        self.average = nn.ModuleDict({str(block): RobustAverage(width, size) for block in config.ra_after})
        self.skip = nn.ModuleList(nn.Conv2d(2 * width, width, 1) for _ in range(config.skips))
        self.head = KernelHead(width, config.kernel)

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this."""
        return 1

    def forward(self, features: Tensor, confidence: Tensor, present: Tensor, threshold: float | None = None) -> Tensor:
        """Kernels of an aligned window; see `RAUNet.forward`."""
        x = self.stem(_time_first(features, self.config.kernel, self.multiple, self.stem.weight.dtype))
        section, skips = x, iter(self.skip)
        for count, block in enumerate(self.blocks, start=1):
            x = block(x)
            if str(count) in self.average:
                x = self.average[str(count)](x, self.config.kernel.frames)
                skip = next(skips, None)
                if skip is not None:
                    x = skip(torch.cat([x, section], 1))
                section = x
        return cast(Tensor, self.head(torch.relu(x), confidence, present, threshold))


class TKPCN(nn.Module):
    """The paper's baseline: a spatial network with shared weights, then one temporal module; no RA blocks.

    Parameters
    ----------
    config : TKPCNConfig
        Sizes.

    References
    ----------
    Kalojanov and Thurston 2023, section 7; Vogels et al. 2018, section 5.2, doi:10.1145/3197517.3201388.
    """

    def __init__(self, config: TKPCNConfig) -> None:
        super().__init__()
        self.config = config
        width, size = config.width, config.conv_size
        self.stem = nn.Conv2d(config.kernel.channels, width, size, padding=size // 2)
        self.blocks = nn.ModuleList(ResidualBlock(width, size) for _ in range(config.blocks))
        self.temporal = TemporalModule(width, config.kernel.frames, config.temporal_blocks, size)
        self.head = KernelHead(width, config.kernel)

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this."""
        return 1

    def forward(self, features: Tensor, confidence: Tensor, present: Tensor, threshold: float | None = None) -> Tensor:
        """Kernels of an aligned window; see `RAUNet.forward`."""
        x = self.stem(_time_first(features, self.config.kernel, self.multiple, self.stem.weight.dtype))
        for block in self.blocks:
            x = block(x)
        x = self.temporal(x, self.config.kernel.frames)
        return cast(Tensor, self.head(torch.relu(x), confidence, present, threshold))


Model = RAUNet | RAResNet | TKPCN


def fast(frames: int = 5, seed: int = 0) -> RAUNet:
    """Small U-Net for two CPU cores: 0.24 M parameters, 0.2 M multiplications per pixel.

    Parameters
    ----------
    frames : int
        Window length.
    seed : int
        Of the initial weights.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        # The threshold: noisy taps start at a hundredth of the mean weight, and must not be cut before they learn.
        kernel = KernelConfig(frames=frames, estimate_size=1, estimate_share=0.9, threshold=0.005)
        return RAUNet(RAUNetConfig(kernel))


def paper(frames: int = 5, conv_size: int = 3, seed: int = 0) -> RAResNet:
    """The paper's network: 24 blocks of width 80, no estimate.

    Parameters
    ----------
    frames : int
        Window length.
    conv_size : int
        Size of the convolutions, which the paper leaves open.
    seed : int
        Of the initial weights.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return RAResNet(RAResNetConfig(KernelConfig(frames=frames), conv_size=conv_size))


def for_inference(model: Model, bfloat16: bool) -> Model:
    """Lay a model out for running: channels last, no gradients, weights in bfloat16 if asked.

    Changes the model given. bfloat16 pays only where the processor has it (AVX-512 bf16, AMX); the head's
    arithmetic on kernels stays float32 either way.
    """
    dtype = torch.bfloat16 if bfloat16 else torch.float32
    for parameter in model.eval().requires_grad_(False).parameters():
        layout = torch.channels_last if parameter.ndim == 4 else torch.preserve_format
        parameter.data = parameter.to(dtype=dtype, memory_format=layout)
    return model


@torch.inference_mode()
def denoise_tile(
    model: Model,
    color: Tensor,
    albedo: Tensor | None,
    normal: Tensor | None,
    confidence: Tensor,
    exposure: Tensor | None = None,
    estimate: Tensor | None = None,
    *,
    threshold: float | None = None,
    aovs: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Denoise one tile of an aligned window.

    Parameters
    ----------
    model : Model
        In the precision of `for_inference`.
    color : Tensor
        ``(N, T, 3, H, W)`` aligned irradiance, float32, finite.
    albedo, normal : Tensor, optional
        ``(N, T, 3, H, W)``.
    confidence : Tensor
        ``(N, T, 1, H, W)``.
    exposure : Tensor, optional
        ``(N,)`` of the *whole* window, from `network.inputs.window_exposure`. Default: of this tile, which is
        right only if the tile is the frame.
    estimate : Tensor, optional
        ``(N, T, 3, H, W)`` aligned estimates, irradiance. Ignored by a model that takes none.
    threshold : float, optional
        t·K in [0, 1); more keeps more of the input. Default: what the model was trained with.
    aovs : Tensor, optional
        ``(N, T, C, H, W)`` other layers, aligned like color, to be filtered with the same kernels.

    Returns
    -------
    denoised : Tensor
        ``(N, 3, H, W)`` irradiance.
    share : Tensor
        ``(N, T, 1, H, W)``, the part each frame has in it; sums to 1 except at the image's border.
    aovs : Tensor or None
        ``(N, C, H, W)``, where there were any. Without an estimate of their own, they get the window's taps
        renormalised.

    Raises
    ------
    ValueError
        If shapes do not fit the model; see `RAUNet.forward`.
    """
    config = model.config.kernel
    if not config.estimate_size:
        estimate = None
    exposure = window_exposure(color) if exposure is None else exposure
    present = color.new_full((color.shape[0],), 0.0 if estimate is None else 1.0)
    features = network_inputs(
        color,
        albedo,
        normal,
        confidence,
        exposure,
        takes_estimate=config.estimate_size > 0,
        estimate=estimate,
        present=present,
    )
    kernels = model(features, confidence, present, threshold)
    numerators, share = filter_window(kernels, color, config.size, estimate, confidence)
    centre = config.frames // 2
    denoised = mean_of(numerators, share, color[:, centre]).clamp_min(0)
    if aovs is None:
        return denoised, share, None
    return denoised, share, mean_of(*filter_window(kernels, aovs, config.size), aovs[:, centre])


def _time_first(features: Tensor, config: KernelConfig, multiple: int, dtype: torch.dtype) -> Tensor:
    """``(N, T, C, H, W)`` to ``(T·N, C, H, W)`` channels last, after checking each axis by itself."""
    expected = (config.frames, config.channels)
    if features.ndim != 5 or tuple(features.shape[1:3]) != expected:
        raise ValueError(f"features: expected (N, {expected[0]}, {expected[1]}, H, W), got {tuple(features.shape)}")
    for name, length in zip(("height", "width"), features.shape[3:], strict=True):
        if length == 0 or length % multiple:
            raise ValueError(f"features: expected a {name} that is a multiple of {multiple}, got {length}")
    return features.transpose(0, 1).flatten(0, 1).to(dtype=dtype, memory_format=torch.channels_last)


def _frames_first(x: Tensor, frames: int) -> Tensor:
    """``(T·N, K·K, H, W)`` to float32 ``(N, T, K·K, H, W)``, planes contiguous as the kernels' passes want them."""
    x = x.unflatten(0, (frames, -1)).transpose(0, 1)
    return x.to(torch.float32, memory_format=torch.contiguous_format)


def _factor(predicted: Tensor, bound: float) -> Tensor:
    """``e^h``, h the prediction bounded smoothly to ±bound."""
    return torch.exp(bound * torch.tanh(predicted / bound))


def _peak(size: int, spread: float) -> Tensor:
    """A K×K kernel, (1, 1, K·K, 1, 1), of mean 1: `spread` of it uniform, the rest at the centre."""
    taps = size * size
    kernel = torch.full((1, 1, taps, 1, 1), spread)
    kernel[:, :, taps // 2] += taps * (1 - spread)
    return kernel


def _check_threshold(relative: float) -> float:
    """A threshold in units of 1/K, checked."""
    if not 0 <= relative < 1:
        raise ValueError(f"threshold: expected 0 <= t·K < 1, so that t < 1/K, got t·K = {relative}")
    return relative
