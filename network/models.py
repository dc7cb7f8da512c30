"""The networks by name, and those that predict kernels: in these only Robust Average blocks connect the frames.

A model maps the features of an aligned window (`network.paper.inputs`) to kernels (`network.paper.kernels`). All of its
convolutions are shared over the frames. `RobustUNet`, in a file of its own, makes the
picture itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from network.paper.blocks import ResidualBlock, RobustAverage, TemporalModule, UNet
from network.paper.inputs import CHANNELS, network_inputs
from network.paper.kernels import Filtered, Pyramid, check_threshold, predict_kernel, softmax_kernel
from network.robust_unet import Borders, Picture, RobustUNet, RobustUNetConfig, denoise_window, round_robust


@dataclass(frozen=True)
class KernelConfig:
    """The kernels a model predicts: their taps and their threshold."""

    frames: int = 5  # T, odd; the window
    size: int = 5  # K×K taps on each frame
    threshold: float = 0.5  # t·taps: 0.5 is the paper's t = 1 / (2K)
    activation: str = "relu"  # the paper's η_t, or "softmax"; both with the threshold, 0 for none

    def __post_init__(self) -> None:
        if self.activation not in ("relu", "softmax"):
            raise ValueError(f"activation: expected relu or softmax, got {self.activation!r}")
        for name in ("frames", "size"):
            value = getattr(self, name)
            if value < 1 or value % 2 == 0:
                raise ValueError(f"{name}: expected an odd number >= 1, got {value}")
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
    conv_size: int = 3  # the paper does not tell; 3 gives 3.5 M parameters, 7 gives 19 M

    def __post_init__(self) -> None:
        if list(self.ra_after) != sorted(set(self.ra_after) & set(range(1, self.blocks + 1))):
            raise ValueError(f"ra_after: expected ascending blocks 1 to {self.blocks}, got {self.ra_after}")
        if not 0 <= self.skips <= len(self.ra_after):
            raise ValueError(f"skips: expected 0 to {len(self.ra_after)}, got {self.skips}")
        if self.conv_size < 1 or self.conv_size % 2 == 0:
            raise ValueError(f"conv_size: expected an odd number >= 1, got {self.conv_size}")


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
        """The kernels, alike at every resolution."""
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
        if self.conv_size < 1 or self.conv_size % 2 == 0:
            raise ValueError(f"conv_size: expected an odd number >= 1, got {self.conv_size}")


class KernelHead(nn.Module):
    """Last layer: features of each frame to one kernel per pixel over all frames.

    Parameters
    ----------
    channels : int
        Width of the features.
    config : KernelConfig
        Taps and threshold.

    Notes
    -----
    h is what the convolution predicts, c the confidence of the frame over the mean of all. With relu, the paper's η_t,
    the raw weights are ``t + (1 − tK) c / K + h / K``: as η_t takes t away and renormalises, h = 0 gives the mean over
    time and the taps, weighted by confidence, and a tap may reach any weight and none. With softmax they are
    ``log c + h`` with h bounded to ±4: what has no confidence stays out, whatever is predicted.
    """

    def __init__(self, channels: int, config: KernelConfig) -> None:
        super().__init__()
        self.config = config
        self.window = nn.Conv2d(channels, config.size**2, 3, padding=1)
        with torch.no_grad():
            self.window.weight.mul_(0.1)
            cast(Tensor, self.window.bias).zero_()

    def forward(self, features: Tensor, confidence: Tensor, threshold: float | None = None) -> Tensor:
        """Predict kernels.

        Parameters
        ----------
        features : Tensor
            ``(T·N, C, H, W)``, time first.
        confidence : Tensor
            ``(N, T, 1, H, W)``.
        threshold : float, optional
            t·K in [0, 1). Default: the configured one, which the model was trained with.

        Returns
        -------
        Tensor
            ``(N, taps, H, W)`` float32.
        """
        config = self.config
        # 1e-3: a pixel without confidence in any frame (even the centre was not finite) averages them all.
        confidence = confidence.float() + 1e-3
        confidence = confidence / confidence.mean(1, keepdim=True)
        raw = _frames_first(self.window(features), config.frames)
        cut = config.threshold if threshold is None else check_threshold(threshold)
        if config.activation == "softmax":
            weights = 4.0 * torch.tanh(raw / 4.0) + confidence.log()
            return softmax_kernel(weights.flatten(1, 2), cut / config.taps, centre=config.centre)
        # In units of 1/K, which η_t does not see.
        weights = config.threshold + (1 - config.threshold) * confidence + raw
        return predict_kernel(weights.flatten(1, 2), cut / config.taps, centre=config.centre)


class RAUNet(UNet):
    """Small U-Net: shared over the frames, connected in time by RA blocks on the way down.

    Parameters
    ----------
    config : RAUNetConfig
        Sizes.
    """

    def __init__(self, config: RAUNetConfig) -> None:
        super().__init__(CHANNELS, config.widths, config.ra_scales)
        self.config = config
        self.head = KernelHead(config.widths[0], config.kernel)

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this."""
        return int(2 ** (len(self.config.widths) - 1))

    def forward(self, features: Tensor, confidence: Tensor, threshold: float | None = None) -> Tensor:
        """Kernels of an aligned window.

        Parameters
        ----------
        features : Tensor
            ``(N, T, channels, H, W)`` from `network.paper.inputs.network_inputs`.
        confidence : Tensor
            ``(N, T, 1, H, W)``.
        threshold : float, optional
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
        return cast(Tensor, self.head(self.trunk(features), confidence, threshold))

    def trunk(self, features: Tensor) -> Tensor:
        """Features of an aligned window to those that kernels are predicted from.

        Parameters
        ----------
        features : Tensor
            ``(N, T, channels, H, W)`` from `network.paper.inputs.network_inputs`.

        Returns
        -------
        Tensor
            ``(T·N, C, H, W)``, time first.
        """
        x = _time_first(features, self.config.kernel, self.multiple, self.stem.weight.dtype)
        return self.scales(x, self.config.kernel.frames)[0]


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
        self.stem = nn.Conv2d(CHANNELS, width, size, padding=size // 2)
        self.blocks = nn.ModuleList(ResidualBlock(width, size) for _ in range(config.blocks))
        self.average = nn.ModuleDict({str(block): RobustAverage(width, size) for block in config.ra_after})
        self.skip = nn.ModuleList(nn.Conv2d(2 * width, width, 1) for _ in range(config.skips))
        self.head = KernelHead(width, config.kernel)

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this."""
        return 1

    def forward(self, features: Tensor, confidence: Tensor, threshold: float | None = None) -> Tensor:
        """Kernels of an aligned window.

        Parameters
        ----------
        features : Tensor
            ``(N, T, channels, H, W)`` from `network.paper.inputs.network_inputs`.
        confidence : Tensor
            ``(N, T, 1, H, W)``.
        threshold : float, optional
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
        return cast(Tensor, self.head(self.trunk(features), confidence, threshold))

    def trunk(self, features: Tensor) -> Tensor:
        """Features of an aligned window to those that kernels are predicted from.

        Parameters
        ----------
        features : Tensor
            ``(N, T, channels, H, W)`` from `network.paper.inputs.network_inputs`.

        Returns
        -------
        Tensor
            ``(T·N, C, H, W)``, time first.
        """
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
        return torch.relu(x)


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
        self.stem = nn.Conv2d(CHANNELS, width, size, padding=size // 2)
        self.blocks = nn.ModuleList(ResidualBlock(width, size) for _ in range(config.blocks))
        self.temporal = TemporalModule(width, config.kernel.frames, config.temporal_blocks, size)
        self.head = KernelHead(width, config.kernel)

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this."""
        return 1

    def forward(self, features: Tensor, confidence: Tensor, threshold: float | None = None) -> Tensor:
        """Kernels of an aligned window.

        Parameters
        ----------
        features : Tensor
            ``(N, T, channels, H, W)`` from `network.paper.inputs.network_inputs`.
        confidence : Tensor
            ``(N, T, 1, H, W)``.
        threshold : float, optional
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
        x = self.stem(_time_first(features, self.config.kernel, self.multiple, self.stem.weight.dtype))
        for block in self.blocks:
            x = block(x)
        x = self.temporal(x, self.config.kernel.frames)
        return cast(Tensor, self.head(torch.relu(x), confidence, threshold))


class MultiScale(nn.Module):
    """A Robust Average network whose kernels are predicted at full, half and quarter resolution, and blended.

    Parameters
    ----------
    config : MultiScaleConfig
        The network, and the number of resolutions.

    Notes
    -----
    The network's features, averaged over 2×2 pixels once and again, go to a head of each resolution. A convolution on
    the centre's features tells, pixel by pixel, how much of the low frequencies comes from the next coarser resolution:
    K×K taps there reach twice as far. It starts at 2 %.

    References
    ----------
    Vogels et al. 2018, section 5.3, doi:10.1145/3197517.3201388; Kalojanov and Thurston 2023, section 7.
    """

    def __init__(self, config: MultiScaleConfig) -> None:
        super().__init__()
        self.config = config
        self.base = RAUNet(config.base) if isinstance(config.base, RAUNetConfig) else RAResNet(config.base)
        width = self.base.head.window.in_channels
        self.heads = nn.ModuleList(KernelHead(width, config.kernel) for _ in range(config.scales - 1))
        self.blend = nn.ModuleList(nn.Conv2d(width, 1, 3, padding=1) for _ in range(config.scales - 1))
        for convolution in self.blend:
            nn.init.constant_(cast(Tensor, convolution.bias), -4.0)

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this."""
        return max(self.base.multiple, int(2 ** (self.config.scales - 1)))

    def forward(self, features: Tensor, confidence: Tensor, threshold: float | None = None) -> Pyramid:
        """Kernels of an aligned window at each resolution.

        Parameters
        ----------
        features : Tensor
            ``(N, T, channels, H, W)`` from `network.paper.inputs.network_inputs`.
        confidence : Tensor
            ``(N, T, 1, H, W)``.
        threshold : float, optional
            As for `KernelHead.forward`.

        Returns
        -------
        Pyramid
            Of as many resolutions as configured.

        Raises
        ------
        ValueError
            If frames or channels are not the model's, or height or width is no multiple of `multiple`.
        """
        for name, length in zip(("height", "width"), features.shape[3:], strict=True):
            if length % self.multiple:
                raise ValueError(f"features: expected a {name} that is a multiple of {self.multiple}, got {length}")
        x = self.base.trunk(features)
        kernels, blends = [self.base.head(x, confidence, threshold)], []
        for head, blend in zip(self.heads, self.blend, strict=True):
            centre = x.chunk(self.config.kernel.frames)[self.config.kernel.frames // 2]
            blends.append(torch.sigmoid(blend(centre)).float())
            x, confidence = functional.avg_pool2d(x, 2), functional.avg_pool3d(confidence, (1, 2, 2))
            kernels.append(head(x, confidence, threshold))
        return Pyramid(tuple(kernels), tuple(blends))


Model = RAUNet | RAResNet | TKPCN | MultiScale | RobustUNet


def window_length(model: Model) -> int:
    """Length of the windows that a model looks at.

    Parameters
    ----------
    model : Model
        Any.

    Returns
    -------
    int
        T, odd.
    """
    return model.config.frames if isinstance(model, RobustUNet) else model.config.kernel.frames


def fast(frames: int = 5, seed: int = 0) -> RobustUNet:
    """The final stage on OIDN's small U-Net, the frames meeting at full resolution: 0.3 M parameters.

    Parameters
    ----------
    frames : int
        Length of the windows, odd.
    seed : int
        Of the initial weights.

    Returns
    -------
    RobustUNet
        In training layout.
    """
    with _seeded(seed):
        return RobustUNet(RobustUNetConfig(frames, "small"))


def balanced(frames: int = 5, seed: int = 0) -> RobustUNet:
    """The final stage on OIDN's U-Net: 0.9 M parameters.

    Parameters
    ----------
    frames : int
        Length of the windows, odd.
    seed : int
        Of the initial weights.

    Returns
    -------
    RobustUNet
        In training layout.
    """
    with _seeded(seed):
        return RobustUNet(RobustUNetConfig(frames, "base"))


def quality(frames: int = 7, seed: int = 0) -> RobustUNet:
    """The final stage on OIDN's large U-Net, which relies on clean guides: 3.9 M parameters.

    Parameters
    ----------
    frames : int
        Length of the windows, odd.
    seed : int
        Of the initial weights.

    Returns
    -------
    RobustUNet
        In training layout.
    """
    with _seeded(seed):
        return RobustUNet(RobustUNetConfig(frames, "large", clean_guides=True))


def unet(frames: int = 5, seed: int = 0) -> RAUNet:
    """From noisy frames alone, a small U-Net: 0.24 M parameters.

    Parameters
    ----------
    frames : int
        Length of the windows, odd.
    seed : int
        Of the initial weights.

    Returns
    -------
    RAUNet
        In training layout.
    """
    with _seeded(seed):
        return RAUNet(RAUNetConfig(KernelConfig(frames)))


def multiscale(frames: int = 5, seed: int = 0) -> MultiScale:
    """From noisy frames alone: a four-scale U-Net with RA blocks at every scale, kernels at three resolutions.

    Parameters
    ----------
    frames : int
        Length of the windows, odd.
    seed : int
        Of the initial weights.

    Returns
    -------
    MultiScale
        In training layout.
    """
    with _seeded(seed):
        base = RAUNetConfig(KernelConfig(frames), widths=(32, 64, 96, 128), ra_scales=(0, 1, 2, 3))
        return MultiScale(MultiScaleConfig(base))


def paper(frames: int = 5, seed: int = 0) -> RAResNet:
    """The paper's network: 24 blocks of width 80.

    Parameters
    ----------
    frames : int
        Length of the windows, odd.
    seed : int
        Of the initial weights.

    Returns
    -------
    RAResNet
        In training layout.
    """
    with _seeded(seed):
        return RAResNet(RAResNetConfig(KernelConfig(frames)))


def tkpcn(frames: int = 5, seed: int = 0) -> TKPCN:
    """The paper's baseline at the size of `paper`: no RA blocks, the temporal module of Vogels et al. 2018 instead.

    Parameters
    ----------
    frames : int
        Length of the windows, odd.
    seed : int
        Of the initial weights.

    Returns
    -------
    TKPCN
        In training layout.
    """
    with _seeded(seed):
        return TKPCN(TKPCNConfig(KernelConfig(frames)))


#: What can be asked for by name.
PRESETS: dict[str, Callable[..., Model]] = {
    build.__name__: build for build in (fast, balanced, quality, unet, multiscale, paper, tkpcn)
}


def for_inference(model: Model, bfloat16: bool) -> Model:
    """Lay a model out for running: channels last, no gradients.

    Parameters
    ----------
    model : Model
        Is changed.
    bfloat16 : bool
        Whether its weights become bfloat16. It pays only where the processor has it (AVX-512 bf16, AMX); the arithmetic
        on kernels and weights of frames stays float32 either way.

    Returns
    -------
    Model
        The same.
    """
    dtype = torch.bfloat16 if bfloat16 else torch.float32
    model.eval().requires_grad_(False)
    if isinstance(model, RobustUNet):
        return channels_last(round_robust(model) if bfloat16 else model)
    for parameter in model.parameters():
        parameter.data = parameter.to(dtype)
    return channels_last(model)


def channels_last(model: Model) -> Model:
    """Lay the weights of the convolutions out with the channels last, as the activations are.

    Parameters
    ----------
    model : Model
        Is changed.

    Returns
    -------
    Model
        The same.
    """
    for parameter in model.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.to(memory_format=torch.channels_last)
    return model


def filter_window(
    model: Model,
    window: Mapping[str, Tensor | None],
    threshold: float | None = None,
    run: Callable[..., Any] | None = None,
    borders: Borders = ((0, 0), (0, 0)),
) -> Filtered | Picture:
    """Run a model on an aligned window.

    Parameters
    ----------
    model : Model
        Any.
    window : mapping
        As for `denoise_tile`.
    threshold : float, optional
        Of the kernels, instead of the model's own; a `RobustUNet` has none.
    run : callable, optional
        Stands for the model where it is wrapped.
    borders : pairs of int
        By how many pixels a `RobustUNet`'s window is mirrored (`network.robust_unet.denoise_window`).

    Returns
    -------
    Filtered or Picture
        The sums of each frame, or the picture.

    Raises
    ------
    ValueError
        If shapes do not fit the model, or it takes estimates and there are none.
    """
    confidence, exposure = (cast(Tensor, window[name]) for name in ("confidence", "exposure"))
    if not isinstance(model, RobustUNet):
        run = model if run is None else run
        color = cast(Tensor, window["color"])
        features = network_inputs(color, window.get("albedo"), window.get("normal"), confidence, exposure)
        return Filtered.of(run(features, confidence, threshold), color)
    if window.get("estimate") is None:
        raise ValueError("estimate: expected those of the frames, as this network takes, got none")
    names = ("estimate", "residual", "confidence", "modulation", "exposure", "gain")
    layers = {name: cast(Tensor, window[name]) for name in names}
    albedo, normal = (None if (guide := window.get(n)) is None else centre_of(guide) for n in ("albedo", "normal"))
    return denoise_window(model, layers, albedo, normal, run, borders=borders)


@torch.inference_mode()
def denoise_tile(
    model: Model,
    window: Mapping[str, Tensor | None],
    *,
    threshold: float | None = None,
    aovs: Tensor | None = None,
    borders: Borders = ((0, 0), (0, 0)),
) -> tuple[Tensor, Filtered | Picture, Tensor | None]:
    """Denoise one tile of an aligned window.

    Parameters
    ----------
    model : Model
        In the precision of `for_inference`.
    window : mapping
        ``color``, ``(N, T, 3, H, W)`` aligned irradiance, float32, finite; ``albedo``, ``normal`` likewise, or None;
        ``confidence``, ``(N, T, 1, H, W)``; ``exposure``, ``(N,)`` of the *whole* window, as for
        `network.paper.inputs.network_inputs`. For a `RobustUNet`, in the place of color: ``estimate``, ``residual``,
        ``modulation`` and ``gain`` as for `network.robust_unet.realise`.
    threshold : float, optional
        t·K in [0, 1); more keeps more of the input. Default: what the model was trained with.
    aovs : Tensor, optional
        ``(N, T, C, H, W)`` other layers, aligned like color, to be filtered with the same kernels; a `RobustUNet`
        has none.
    borders : pairs of int
        As for `filter_window`.

    Returns
    -------
    denoised : Tensor
        ``(N, 3, H, W)`` irradiance.
    filtered : Filtered or Picture
        Its ``parts()`` are what each frame contributes.
    aovs : Tensor or None
        ``(N, C, H, W)``, where there were any.

    Raises
    ------
    ValueError
        See `filter_window`.
    """
    filtered = filter_window(model, window, threshold, borders=borders)
    if isinstance(filtered, Picture):
        return filtered.irradiance, filtered, None
    denoised = filtered.image(centre_of(cast(Tensor, window["color"]))).clamp_min(0)
    return denoised, filtered, None if aovs is None else filtered.apply(aovs)


def centre_of(layers: Tensor) -> Tensor:
    """The centre frame's of layers ``(N, T, C, H, W)``: ``(N, C, H, W)``."""
    return layers[:, layers.shape[1] // 2]


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Initial weights of their own; the global generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def _time_first(features: Tensor, config: KernelConfig, multiple: int, dtype: torch.dtype) -> Tensor:
    """``(N, T, C, H, W)`` to ``(T·N, C, H, W)`` channels last, after checking each axis by itself."""
    expected = (config.frames, CHANNELS)
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
