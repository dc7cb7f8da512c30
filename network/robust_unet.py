"""The final stage: OIDN's U-Net over an aligned window, its frames fused by Robust Average blocks.

Each frame of the window enters as a noisy image of the centre; Robust Average (RA) blocks, the first behind the first
convolution at full resolution, fuse the frames; one decoder makes the image of the centre.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import log
from typing import NamedTuple, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from network.bfloat16 import round_taps, round_unet
from network.cpu.convolution import convolve
from network.cpu.curve import decode
from network.cpu.fused_ops import halve
from network.cpu.input_packing import can_pack, packer
from network.oidn_weights import load_oidn
from network.robust_average import ChannelAverage
from network.strips import in_strips
from network.transfer import pu_forward
from network.unet import DECODERS, ENCODERS, OidnUNet, OidnUNetConfig, Stage, check_size
from network.windows import PackedInputs, UNetWindow
from nlm.pooling import RESIDUAL_LIMIT

Module = TypeVar("Module", bound=nn.Module)

#: Input channels of a frame beyond those of OIDN's networks: average of the first passes, confidence, pooled samples.
AUX_CHANNELS = 5
#: Initial weight of the robust average in an RA block.
BLEND = 0.8
#: Initial share of the average of first passes in the image, by the size of the backbone: less for better backbones.
#: Found on four shots at two noise levels (docs/dev/experiments.md).
AVERAGE_BLEND = {"small": 0.5, "base": 0.4, "large": 0.25}
#: Networks of OIDN that a model of each size starts from. The first two accept noisy guides; the third, the only large
#: one, needs clean guides.
OIDN_BACKBONES = {"small": "rt_hdr_alb_nrm_small", "base": "rt_hdr_alb_nrm", "large": "rt_hdr_calb_cnrm_large"}
#: Pixels by which images are mirrored beyond their borders, which a backbone otherwise takes for darkness: 0.7 dB
#: within 8 pixels of a border, and a flat image stays flat to 0.4 %, where its rim came out a third too dark. Crops in
#: training are mirrored alike.
MIRRORED = 16
#: Pixels of mirroring beyond the borders: rows before and after, columns before and after.
Borders = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class RobustUNetConfig:
    frames: int = 5  # T, odd; the window
    size: str = "base"  # of network.unet.ENCODERS
    ra_scales: tuple[int, ...] = (0,)  # 0: behind the first convolution; s: behind the convolutions of scale s
    clean_guides: bool = False  # whether the backbone relies on its guides: noisy guides are filtered first

    def __post_init__(self) -> None:
        if self.frames < 1 or self.frames % 2 == 0:
            raise ValueError(f"frames: expected an odd number >= 1, got {self.frames}")
        if self.size not in ENCODERS:
            raise ValueError(f"size: expected one of {', '.join(ENCODERS)}, got {self.size!r}")
        scales = range(len(ENCODERS[self.size]))
        if not set(self.ra_scales) <= set(scales):
            raise ValueError(f"ra_scales: expected scales 0 to {len(scales) - 1}, got {self.ra_scales}")


class PooledWindow(NamedTuple):
    """A window whose frames are noisy images of its centre, and averages of it."""

    frames: Tensor  # ``(N, T, 3, H, W)`` on the transfer curve, each with its own noise; their mean is `pooled`
    pooled: Tensor  # ``(N, 3, H, W)`` on the curve: the pooled samples of all frames
    average: Tensor  # ``(N, 3, H, W)`` irradiance: average of the first passes by confidence
    encoded_average: Tensor  # the same as radiance on the curve
    confidence: Tensor  # ``(N, T, 1, H, W)``; 1 for the centre where no frame has any
    samples: Tensor  # ``(N, 1, H, W)`` in (0, 1]: frames' worth of pooled samples, over T
    parts: Tensor  # ``(N, T, 3, H, W)`` irradiance: contribution of each frame to the pooled image


def pool_samples(window: UNetWindow) -> PooledWindow:
    """Pool the samples of a window, and make a noisy image of the centre from each of its frames.

    Notes
    -----
    With e the first passes, r' the residuals limited to `nlm.pooling.RESIDUAL_LIMIT` times the light, c the confidence,

        G = Σ c e / Σ c,    b = G + Σ c r' / Σ c,    x_s = P(G + c_s r'_s + (1 − c_s) r'_t),

    P the transfer curve, t the centre: a frame without confidence gets the noise of the centre. All x_s are then
    shifted by P(b) − mean x_s: noise on a concave curve has a mean that is too dark, and without the shift, images of a
    few samples lost up to 5 dB.
    """
    first_pass, residual, confidence, modulation, exposure, gain, _, _ = window
    assert residual is not None
    centre = confidence.shape[1] // 2
    total = confidence.sum(1, keepdim=True)
    centre_only = torch.zeros_like(confidence)
    centre_only[:, centre] = 1
    confidence = torch.where(total > 0, confidence, centre_only)
    share = confidence / confidence.sum(1, keepdim=True)
    light = first_pass.mean(2, keepdim=True).clamp_min(0) + exposure.view(-1, 1, 1, 1, 1)
    limit = float(RESIDUAL_LIMIT) * light
    limited = residual * (limit / torch.maximum(residual.mean(2, keepdim=True).abs(), limit))
    parts = share * (first_pass + limited)
    average, pooled = (share * first_pass).sum(1), parts.sum(1)
    scale = modulation * gain.view(-1, 1, 1, 1)
    centre_noise = limited[:, centre, None]
    noisy = average[:, None] + centre_noise + confidence * (limited - centre_noise)
    frames = pu_forward((noisy * scale[:, None]).clamp_min_(0))
    encoded = pu_forward((pooled * scale).clamp_min(0))
    frames += (encoded - frames.mean(1))[:, None]
    samples = share.square().sum(1).reciprocal() / share.shape[1]
    encoded_average = pu_forward((average * scale).clamp_min(0))
    return PooledWindow(frames, encoded, average, encoded_average, confidence, samples, parts)


def pack_inputs(window: UNetWindow) -> PackedInputs:
    """Inputs of the network from a window, in plain operations; `network.cpu.input_packing` is the fused form."""
    pooled = pool_samples(window)
    missing = torch.full_like(window.modulation, 0.5)
    albedo = missing if window.albedo is None else window.albedo.clamp(0, 1)
    normal = missing if window.normal is None else window.normal.clamp(-1, 1) * 0.5 + 0.5
    frames = torch.cat([pooled.frames, pooled.confidence], 2).transpose(0, 1).flatten(0, 1)
    shared = torch.cat([albedo, normal, pooled.encoded_average, pooled.samples], 1)
    return PackedInputs(frames, shared, torch.cat([pooled.pooled, albedo, normal], 1), pooled.average)


@dataclass(frozen=True)
class UNetOutput:
    """Image that a `RobustUNet` made of a window: ``(N, 3, H, W)`` irradiance, at least 0."""

    irradiance: Tensor
    window: UNetWindow

    def parts(self) -> tuple[Tensor, Tensor]:
        """Contribution of each frame to the pooled image, ``(N, T, 3, H, W)``, and its share, ``(N, T, 1, H, W)``."""
        pooled = pool_samples(self.window)
        return pooled.parts, pooled.confidence / pooled.confidence.sum(1, keepdim=True)


class RobustUNet(nn.Module):
    """OIDN's U-Net over a window of frames, fused by RA blocks.

    The frames share the encoder up to the last RA block; all later layers see the centre alone. The first block stands
    *before* the first ReLU: a convolution of an average is the average of convolutions, so that before any training
    the network gives the same as on samples that were pooled beforehand. The skip connection from the input to the last
    scale of the decoder has the pooled image.

    Further input channels (`AUX_CHANNELS`) enter the first convolution with weights of 0. RA blocks start at `BLEND`,
    learned for each channel. The image is blended with the average of first passes, whose errors are different
    (`AVERAGE_BLEND`), by a share that training can make vary by pixel. There are some thousands of parameters beside
    the backbone's 0.32 M ("small"), 0.92 M ("base") or 3.85 M ("large").
    """

    def __init__(self, config: RobustUNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = [convolutions[-1] for convolutions in ENCODERS[config.size]]
        self.backbone = OidnUNet(OidnUNetConfig(9, config.size))
        self.aux_conv = nn.Conv2d(AUX_CHANNELS, ENCODERS[config.size][0][0], 3, padding=1, bias=False)
        self.robust_average = nn.ModuleDict(
            {str(scale): ChannelAverage(widths[scale], BLEND) for scale in sorted(config.ra_scales)}
        )
        self.average_blend = nn.Conv2d(DECODERS[config.size][-1][-1], 1, 1)
        nn.init.zeros_(self.aux_conv.weight)
        nn.init.zeros_(self.average_blend.weight)
        blend = AVERAGE_BLEND[config.size]
        nn.init.constant_(cast(Tensor, self.average_blend.bias), log(blend / (1 - blend)))

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this."""
        return self.backbone.multiple

    @property
    def frames(self) -> int:
        """Length of the windows, T."""
        return self.config.frames

    def forward(self, frames: Tensor, shared: Tensor, static: Tensor) -> tuple[Tensor, Tensor]:
        """Make the image of the centre from `PackedInputs`: ``(N, 3, H, W)`` on the transfer curve, and ``(N, 1, H,
        W)`` in (0, 1), the share of the average of first passes.

        Raises ValueError if frames are not the model's, or height or width is no multiple of 16.
        """
        self.expect_frames(len(frames) // len(shared))
        check_size("frames", static, self.multiple)
        return self.decode(self.encode_and_fuse(frames, shared), static)

    def expect_frames(self, frames: int) -> None:
        """Raise ValueError unless a window of so many frames is the model's."""
        if frames != self.frames:
            raise ValueError(f"frames: expected {self.frames}, got {frames}")

    @property
    def _last_fused(self) -> int:
        """Coarsest scale with an RA block, behind which only the centre is left; −1 without any."""
        return max(self.config.ra_scales, default=-1)

    def encode_and_fuse(self, frames: Tensor, shared: Tensor) -> Tensor:
        """Run the finest scale of the encoder and its RA block, at any even height; a row depends on two on each side.

        Returns the input of the next scale, ``(T·N, width, H / 2, W / 2)``, or of one frame where all are fused.
        """
        count, last = self.frames, self._last_fused
        first, aux, layout = self.backbone.first, self.aux_conv.weight, torch.channels_last
        frames = frames if last >= 0 else frames.chunk(count)[count // 2]
        frames, shared = (part.to(first.weight.dtype, memory_format=layout) for part in (frames, shared))
        frame_weight = torch.cat([first.weight[:, :3], aux[:, 3:4]], 1).contiguous(memory_format=layout)
        shared_weight = torch.cat([first.weight[:, 3:], aux[:, :3], aux[:, 4:]], 1).contiguous(memory_format=layout)
        # Ten of a frame's 14 channels are the same in all frames: they are convolved once, and added behind the block,
        # because an average of frames that have a term in common is that term plus the average of the rest.
        common = functional.conv2d(shared, shared_weight, first.bias, padding=1)
        x = convolve(frames, frame_weight, None, relu=False)
        if "0" in self.robust_average:
            x = self.robust_average["0"](x, count, last == 0, common)
        else:
            x = torch.relu(x + common.repeat(len(frames) // len(shared), 1, 1, 1))
        return halve(cast(Stage, self.backbone.encoder[0]).after_first(x))

    def decode(self, x: Tensor, static: Tensor) -> tuple[Tensor, Tensor]:
        """Run all layers behind `encode_and_fuse`; the image and the share as of `forward`."""
        count, coarsest = self.frames, len(self.backbone.encoder) - 1
        skips = [static]
        for scale in range(1, coarsest + 1):
            if scale < coarsest:
                # The decoder gets the centre's features, into which the other frames' are fused.
                skips.append(x.chunk(count)[count // 2] if scale <= self._last_fused else x)
            (x,) = in_strips(partial(self._encode_scale, scale), 2, x)
        image, blend = self.backbone.decode(x, skips, self._head)
        return image, blend

    def _head(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Image and share of the average from features of the finest scale."""
        weight, bias = self.average_blend.weight, cast(Tensor, self.average_blend.bias)
        if torch.is_grad_enabled() or bool(weight.any()):
            logits = self.average_blend(features.to(weight.dtype)).float()
        else:  # as in the shipped weights
            logits = bias.float().view(1, 1, 1, 1).expand(len(features), 1, *features.shape[2:]).contiguous()
        return self.backbone.project(features), torch.sigmoid(logits)

    def _encode_scale(self, scale: int, x: Tensor) -> list[Tensor]:
        """Run a scale of the encoder, and halve its output except at the coarsest scale."""
        x = self.backbone.encoder[scale](x)
        if str(scale) in self.robust_average:
            x = self.robust_average[str(scale)](x, self.frames, self._last_fused == scale)
        return [x if scale == len(self.backbone.encoder) - 1 else halve(x)]


def denoise_window(
    model: RobustUNet,
    window: UNetWindow,
    run: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]] | None = None,
    *,
    borders: Borders = ((0, 0), (0, 0)),
    residual: Callable[[slice], NDArray[np.float32]] | None = None,
) -> UNetOutput:
    """Run a model, or with gradients `run` where it is wrapped, on an aligned window; the output has the window's size.

    `borders` are the pixels by which the window is mirrored beyond its borders. `residual` makes rows (T, h, W, 3) of
    the residual of a single window on a CPU, which is then never in memory as a whole. Without gradients all work at
    full size runs in strips (`network.strips`), so that the features of all frames are never in memory at once; on a
    CPU the inputs are packed in one pass (`network.cpu.input_packing`). Raises ValueError if the window has another
    number of frames.
    """
    model.expect_frames(window.confidence.shape[1])
    height, width = window.modulation.shape[-2:]
    sizes = zip((height, width), borders, strict=True)
    rows, columns = (np.pad(np.arange(size), border, mode="reflect") for size, border in sizes)

    def pack_rows(rows: NDArray[np.int64]) -> PackedInputs:
        return pack_inputs(_select(window, rows, columns))

    if torch.is_grad_enabled():
        *inputs, average = pack_rows(rows)
        encoded, blend = (model if run is None else run)(*inputs)
    else:
        pack = packer(window, columns, residual) if can_pack(window) else pack_rows

        def encode(rows: Tensor) -> list[Tensor]:
            frames, shared, static, average = pack(rows[:, 0].numpy())
            # In bfloat16 the skip connection takes two thirds of the memory of its inputs.
            return [model.encode_and_fuse(frames, shared), model.backbone.input_skip(static), average]

        inputs = in_strips(encode, 2, torch.from_numpy(rows)[:, None], all_frames=True)
        average = inputs.pop()
        encoded, blend = model.decode(inputs.pop(0), inputs.pop(0))  # freed as they are used
    (top, _), (left, _) = borders
    encoded, blend, average = (x[..., top : top + height, left : left + width] for x in (encoded, blend, average))

    def mix(encoded: Tensor, blend: Tensor, average: Tensor, modulation: Tensor) -> list[Tensor]:
        # Irradiance is blended: on the curve a mean of two images would be darker than they are.
        light = decode(encoded.float()) / (modulation * window.gain.view(-1, 1, 1, 1))
        return [light + blend * (average.clamp_min(0) - light)]

    (irradiance,) = in_strips(mix, 0, encoded, blend, average, window.modulation)
    return UNetOutput(irradiance, window)


def _select(window: UNetWindow, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> UNetWindow:
    """Rows and columns of a window, by number."""
    device = window.modulation.device
    places = [torch.from_numpy(index).to(device) for index in (rows, columns)]
    layers = {
        name: layer.index_select(-2, places[0]).index_select(-1, places[1])
        for name, layer in window._asdict().items()
        if layer is not None and layer.ndim > 1
    }
    return window._replace(**layers)


def start_from_oidn(model: RobustUNet) -> RobustUNet:
    """Load the weights of OIDN's network of its size into a model (`network.oidn_weights.load_oidn`); returns it."""
    model.backbone.load_state_dict(load_oidn(OIDN_BACKBONES[model.config.size]).state_dict())
    return model


def for_inference(model: RobustUNet, bfloat16: bool) -> RobustUNet:
    """Make a model channels last, without gradients, with `bfloat16` rounded (`round_unet`), in place; return it."""
    model.eval().requires_grad_(False)
    if bfloat16:
        model.backbone = round_unet(model.backbone)
        model.aux_conv.weight.data = round_taps(model.aux_conv.weight)
    return channels_last(model)


def channels_last(model: Module) -> Module:
    """Convert the weights of all convolutions to the memory format of their activations, channels last; in place."""
    for parameter in model.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.to(memory_format=torch.channels_last)
    return model
