"""The final stage: a U-Net that knows how to denoise, whose frames meet in Robust Average blocks before it does.

The trunk is OIDN's (`network.unet`). Each frame of an aligned window enters as a noisy realisation of the centre; RA
blocks, the first behind the first convolution at full resolution, let the samples of the frames meet; one decoder makes
the picture of the centre.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import log
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from network.cpu.convolution import convolve
from network.cpu.input_packing import RESIDUAL_LIMIT, can_lay_out, entering
from network.paper.blocks import ChannelAverage
from network.unet import (
    DECODERS,
    ENCODERS,
    Convolutions,
    Trunk,
    TrunkConfig,
    in_strips,
    load_oidn,
    pu_forward,
    pu_inverse,
    round_taps,
    round_trunk,
)

#: Channels that a frame has beside those of OIDN's networks: the gathered average, confidence, samples gathered.
KNOWN = 5
#: Weight of the average in an RA block before any training.
BLEND = 0.8
#: Share of the average of estimates in the picture before any training, by the trunk's size: the better a trunk's
#: picture, the less. Found on four shots at two noise levels (docs/experiments.md).
KEEP = {"small": 0.5, "base": 0.4, "large": 0.25}


@dataclass(frozen=True)
class RobustUNetConfig:
    """Sizes of a `RobustUNet`."""

    frames: int = 5  # T, odd; the window
    size: str = "base"  # of network.unet.ENCODERS
    ra_scales: tuple[int, ...] = (0,)  # 0: behind the first convolution; s: behind the convolutions of scale s
    clean_guides: bool = False  # whether the trunk relies on its guides: where they have noise they are filtered first

    def __post_init__(self) -> None:
        if self.frames < 1 or self.frames % 2 == 0:
            raise ValueError(f"frames: expected an odd number >= 1, got {self.frames}")
        if self.size not in ENCODERS:
            raise ValueError(f"size: expected one of {', '.join(ENCODERS)}, got {self.size!r}")
        scales = range(len(ENCODERS[self.size]))
        if not set(self.ra_scales) <= set(scales):
            raise ValueError(f"ra_scales: expected scales 0 to {len(scales) - 1}, got {self.ra_scales}")


@dataclass(frozen=True)
class Realisations:
    """A window whose frames are noisy pictures of its centre, and what they give by hand.

    Attributes
    ----------
    frames : Tensor
        ``(N, T, 3, H, W)`` on OIDN's transfer curve, with noise of their own; their mean is `picture`.
    picture : Tensor
        ``(N, 3, H, W)``, the samples of all frames gathered (`nlm.pooling`), on the same curve.
    average : Tensor
        ``(N, 3, H, W)``, the gated average of the estimates, on the same curve.
    confidence : Tensor
        ``(N, T, 1, H, W)``; 1 for the centre where no frame has any.
    samples : Tensor
        ``(N, 1, H, W)`` in (0, 1]: frames' worth of samples gathered, over T.
    parts : Tensor
        ``(N, T, 3, H, W)``: what each frame gives of the gathered irradiance, which is their sum.
    estimate : Tensor
        ``(N, 3, H, W)``: average of the estimates, irradiance.
    scale : Tensor
        ``(N, 3, H, W)``: what irradiance is multiplied by before the transfer curve.
    """

    frames: Tensor
    picture: Tensor
    average: Tensor
    confidence: Tensor
    samples: Tensor
    parts: Tensor
    estimate: Tensor
    scale: Tensor


def realise(
    estimate: Tensor, residual: Tensor, confidence: Tensor, modulation: Tensor, exposure: Tensor, gain: Tensor
) -> Realisations:
    """Make of each frame of a window a noisy realisation of its centre.

    Parameters
    ----------
    estimate, residual : Tensor
        ``(N, T, 3, H, W)`` irradiance, as for `nlm.pooling.pool_samples`.
    confidence : Tensor
        ``(N, T, 1, H, W)``, at least 0.
    modulation : Tensor
        ``(N, 3, H, W)``; radiance is irradiance times modulation.
    exposure : Tensor
        ``(N,)``, positive, of the irradiance.
    gain : Tensor
        ``(N,)``, positive: OIDN's exposure of the whole picture (`network.unet.autoexposure`).

    Returns
    -------
    Realisations
        Float32.

    Notes
    -----
    With e the estimates, r' the residuals held to six times the light, c the confidence,

        G = Σ c e / Σ c,    b = G + Σ c r' / Σ c,    x_s = P(G + c_s r'_s + (1 − c_s) r'_t),

    P the transfer curve, t the centre: a frame that is not trusted shows the centre's noise. All x_s are then shifted
    by P(b) − mean x_s. Noise on a concave curve has a mean that is too dark: without the shift, pictures of a few
    samples lost up to 5 dB.
    """
    centre = confidence.shape[1] // 2
    total = confidence.sum(1, keepdim=True)
    alone = torch.zeros_like(confidence)
    alone[:, centre] = 1
    confidence = torch.where(total > 0, confidence, alone)
    share = confidence / confidence.sum(1, keepdim=True)
    limit = RESIDUAL_LIMIT * (estimate.mean(2, keepdim=True).clamp_min(0) + exposure.view(-1, 1, 1, 1, 1))
    held = residual * (limit / torch.maximum(residual.mean(2, keepdim=True).abs(), limit))
    parts = share * (estimate + held)
    average, gathered = (share * estimate).sum(1), parts.sum(1)
    scale = modulation * gain.view(-1, 1, 1, 1)
    own = held[:, centre, None]
    frames = pu_forward(((average[:, None] + own + confidence * (held - own)) * scale[:, None]).clamp_min_(0))
    picture = pu_forward((gathered * scale).clamp_min(0))
    frames += (picture - frames.mean(1))[:, None]
    samples = share.square().sum(1).reciprocal() / share.shape[1]
    average_seen = pu_forward((average * scale).clamp_min(0))
    return Realisations(frames, picture, average_seen, confidence, samples, parts, average, scale)


@dataclass(frozen=True)
class Picture:
    """What a `RobustUNet` made of a window.

    Attributes
    ----------
    irradiance : Tensor
        ``(N, 3, H, W)``, at least 0.
    window : mapping of str to Tensor
        What it was made from, as `realise` takes it.
    """

    irradiance: Tensor
    window: Mapping[str, Tensor]

    def parts(self) -> tuple[Tensor, Tensor]:
        """What each frame gives of the gathered picture, ``(N, T, 3, H, W)``, and its share, ``(N, T, 1, H, W)``."""
        found = realise(**self.window)
        return found.parts, found.confidence / found.confidence.sum(1, keepdim=True)


class RobustUNet(nn.Module):
    """OIDN's U-Net over a window of frames, connected by RA blocks.

    Parameters
    ----------
    config : RobustUNetConfig
        0.32 M parameters ("small"), 0.92 M ("base") or 3.85 M ("large"), and some thousands for what is new.

    Notes
    -----
    The frames share the encoder up to the last RA block; what follows it sees the centre alone. The first block stands
    *before* the first ReLU: averages of what a convolution makes are what it makes of averages, so that before any
    training the network does what it would with frames gathered by hand. The skip connection from the input to the
    last scale of the decoder has the gathered picture.

    Further input channels (`KNOWN`) enter the first convolution with weights of 0. Blocks start at a blend of `BLEND`,
    learned for each channel, and the picture as a mixture of the network's and the average of estimates, whose errors
    are different ones (`KEEP`), predicted pixel by pixel once it is trained.
    """

    def __init__(self, config: RobustUNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = [convolutions[-1] for convolutions in ENCODERS[config.size]]
        self.trunk = Trunk(TrunkConfig(9, config.size))
        self.known = nn.Conv2d(KNOWN, ENCODERS[config.size][0][0], 3, padding=1, bias=False)
        self.average = nn.ModuleDict(
            {str(scale): ChannelAverage(widths[scale], BLEND) for scale in sorted(config.ra_scales)}
        )
        self.keep = nn.Conv2d(DECODERS[config.size][-1][-1], 1, 1)
        nn.init.zeros_(self.known.weight)
        nn.init.zeros_(self.keep.weight)
        keep = KEEP[config.size]
        nn.init.constant_(cast(Tensor, self.keep.bias), log(keep / (1 - keep)))

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this."""
        return self.trunk.multiple

    def forward(self, frames: Tensor, still: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
        """Make the picture of the centre.

        Parameters
        ----------
        frames : Tensor
            ``(N, T, 3, H, W)`` from `realise`.
        still : Tensor
            ``(N, 9, H, W)``: the gathered picture, and albedo and normal of the centre in [0, 1].
        known : Tensor
            ``(N, T, 5, H, W)``: gathered average, confidence, samples; all but confidence are those of the window.

        Returns
        -------
        picture : Tensor
            ``(N, 3, H, W)`` on the transfer curve.
        keep : Tensor
            ``(N, 1, H, W)`` in (0, 1): share of the average of estimates.

        Raises
        ------
        ValueError
            If frames are not the model's, or height or width is no multiple of 16.
        """
        self.expect(frames.shape[1])
        for name, length in zip(("height", "width"), still.shape[2:], strict=True):
            if length == 0 or length % self.multiple:
                raise ValueError(f"frames: expected a {name} that is a multiple of {self.multiple}, got {length}")
        return self.finish(self.meet(*self.lay_out(frames, still, known)), still)

    def expect(self, frames: int) -> None:
        """Raise ValueError unless a window of so many frames is the model's."""
        if frames != self.config.frames:
            raise ValueError(f"frames: expected {self.config.frames}, got {frames}")

    def lay_out(self, frames: Tensor, still: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
        """Lay what is known of each frame side by side, and what all have alike; as for `forward`.

        Returns
        -------
        own : Tensor
            ``(T·N, 4, H, W)``, time first: picture, confidence.
        alike : Tensor
            ``(N, 10, H, W)``: albedo, normal, gathered average, samples.
        """
        own = torch.cat([frames, known[:, :, 3:4]], 2).transpose(0, 1).flatten(0, 1)
        return own, torch.cat([still[:, 3:], known[:, 0, :3], known[:, 0, 4:]], 1)

    def meet(self, own: Tensor, alike: Tensor) -> Tensor:
        """Run the finest scale of the encoder, in whose midst the frames meet. A row depends on two on each side.

        Parameters
        ----------
        own, alike : Tensor
            From `lay_out`, or `network.cpu.input_packing.entering`, of any even height.

        Returns
        -------
        Tensor
            What enters the next scale, ``(T·N, width, H / 2, W / 2)``, or ``(N, width, H / 2, W / 2)`` where all
            frames have met.
        """
        count, last = self.config.frames, max(self.config.ra_scales, default=-1)
        first, known, layout = self.trunk.first, self.known.weight, torch.channels_last
        own = own if last >= 0 else own.chunk(count)[count // 2]
        own, alike = (part.to(first.weight.dtype, memory_format=layout) for part in (own, alike))
        of_own = torch.cat([first.weight[:, :3], known[:, 3:4]], 1).contiguous(memory_format=layout)
        of_alike = torch.cat([first.weight[:, 3:], known[:, :3], known[:, 4:]], 1).contiguous(memory_format=layout)
        # Convolved once for all frames: of 14 channels that a frame has, ten are those of all.
        once = functional.conv2d(alike, of_alike, first.bias, padding=1).permute(0, 2, 3, 1)
        added = once.repeat(len(own) // len(alike), 1, 1, 1).permute(0, 3, 1, 2)
        x = convolve(own, of_own, None, added, relu=False)
        if "0" in self.average:
            x = self.average["0"](x, count, last == 0)
        return functional.max_pool2d(cast(Convolutions, self.trunk.encoder[0]).after_first(x), 2)

    def finish(self, x: Tensor, still: Tensor) -> tuple[Tensor, Tensor]:
        """Run all that follows `meet`, as for `forward`.

        Parameters
        ----------
        x : Tensor
            From `meet`.
        still : Tensor
            As for `forward`.

        Returns
        -------
        picture, keep : Tensor
            As of `forward`.
        """
        trunk, count, last = self.trunk, self.config.frames, max(self.config.ra_scales, default=-1)
        skips, coarsest = [still], len(trunk.encoder) - 1
        for scale in range(1, coarsest + 1):
            if scale < coarsest:
                # What enters a scale is handed on to the decoder: the centre's, which has the others' in it.
                skips.append(x.chunk(count)[count // 2] if scale <= last else x)
            (x,) = in_strips(partial(self._encode, scale), 2, x)

        def finish(features: Tensor) -> tuple[Tensor, Tensor]:
            keep = torch.sigmoid(self.keep(features.to(self.keep.weight.dtype)).float())
            return trunk.finish(features), keep

        picture, keep = trunk.decode(x, skips, finish)
        return picture, keep

    def _encode(self, scale: int, x: Tensor) -> list[Tensor]:
        """Run a scale of the encoder but the finest, and halve what comes out, but of the coarsest."""
        last = max(self.config.ra_scales, default=-1)
        x = self.trunk.encoder[scale](x)
        if str(scale) in self.average:
            x = self.average[str(scale)](x, self.config.frames, last == scale)
        return [x if scale == len(self.trunk.encoder) - 1 else functional.max_pool2d(x, 2)]


#: Pixels that a picture is mirrored by beyond its borders, to a trunk else darkness: 0.7 dB within 8 pixels of one, and
#: a flat picture stays flat to 0.4 %, where its rim came out a third too dark. Crops in training are mirrored alike.
MIRRORED = 16
#: By how many pixels a picture is mirrored beyond its borders: rows before and after, columns before and after.
Borders = tuple[tuple[int, int], tuple[int, int]]


def denoise_window(
    model: RobustUNet,
    window: Mapping[str, Tensor],
    albedo: Tensor | None,
    normal: Tensor | None,
    run: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]] | None = None,
    *,
    borders: Borders = ((0, 0), (0, 0)),
) -> Picture:
    """Run a model on an aligned window.

    Parameters
    ----------
    model : RobustUNet
        The model.
    window : mapping of str to Tensor
        As `realise` takes it.
    albedo, normal : Tensor, optional
        ``(N, 3, H, W)``: the centre's guides, albedo in [0, 1], normals in [−1, 1]; without, the same everywhere.
    run : callable, optional
        Stands for the model where it is wrapped.
    borders : pairs of int
        By how many pixels the window is mirrored beyond its borders before the model sees it.

    Returns
    -------
    Picture
        Float32, of the size of the window.

    Raises
    ------
    ValueError
        If the window has not the model's frames.

    Notes
    -----
    Without gradients all that is done at full size is done some rows at a time (`network.unet.in_strips`): no more of
    all frames' features is ever there, and what is there fits the caches of a processor. On a processor what enters is
    laid out in one pass (`network.cpu.input_packing`).
    """
    model.expect(window["confidence"].shape[1])
    height, width = window["modulation"].shape[-2:]
    sizes = zip((height, width), borders, strict=True)
    rows, columns = (np.pad(np.arange(size), border, mode="reflect") for size, border in sizes)

    def realised(rows: NDArray[np.int64]) -> tuple[Realisations, Tensor]:
        """Of these rows the frames, and what stands still beside them, in plain operations."""
        missing = torch.full_like(window["modulation"], 0.5)
        guides = torch.cat(
            [
                missing if albedo is None else albedo.clamp(0, 1),
                missing if normal is None else normal.clamp(-1, 1) * 0.5 + 0.5,
            ],
            1,
        )
        layers = [window[name] for name in ("estimate", "residual", "confidence", "modulation")]
        places = [torch.from_numpy(index).to(guides.device) for index in (rows, columns)]
        *given, guides = (layer.index_select(-2, places[0]).index_select(-1, places[1]) for layer in (*layers, guides))
        found = realise(*given, window["exposure"], window["gain"])  # type: ignore[call-arg]
        return found, torch.cat([found.picture, guides], 1)

    def lay_out(rows: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        found, still = realised(rows)
        return *model.lay_out(found.frames, still, _known(found)), still, found.estimate

    if torch.is_grad_enabled():
        found, still = realised(rows)
        seen, keep = (model if run is None else run)(found.frames, still, _known(found))
        average = found.estimate
    else:
        quick = can_lay_out(*window.values(), *(guide for guide in (albedo, normal) if guide is not None))
        lay_out_rows = entering(window, albedo, normal, columns) if quick else lay_out

        def enter(rows: Tensor) -> list[Tensor]:
            own, alike, still, average = lay_out_rows(rows[:, 0].numpy())
            return [model.meet(own, alike), still, average]

        features, still, average = in_strips(enter, 2, torch.from_numpy(rows)[:, None], of_frames=True)
        seen, keep = model.finish(features, still)
        del features, still
    (top, _), (left, _) = borders
    seen, keep, average = (layer[..., top : top + height, left : left + width] for layer in (seen, keep, average))

    def mix(seen: Tensor, keep: Tensor, average: Tensor, modulation: Tensor) -> list[Tensor]:
        # Light on both sides of the mixture: on the curve a mean of two pictures would be darker than they are.
        light = pu_inverse(seen.float().clamp_min(0)) / (modulation * window["gain"].view(-1, 1, 1, 1))
        return [light + keep * (average.clamp_min(0) - light)]

    (irradiance,) = in_strips(mix, 0, seen, keep, average, window["modulation"])
    return Picture(irradiance, window)


def _known(found: Realisations) -> Tensor:
    """What the network is told of each frame beside its picture and guides, ``(N, T, 5, H, W)``."""
    frames = found.frames.shape[1]
    average, samples = (layer[:, None].expand(-1, frames, -1, -1, -1) for layer in (found.average, found.samples))
    return torch.cat([average, found.confidence, samples], 2)


#: OIDN's networks that a model of each size starts from. The first two bear guides with noise; the third, whose guides
#: must have none, is the only large one that there is.
OIDN_TRUNKS = {"small": "rt_hdr_alb_nrm_small", "base": "rt_hdr_alb_nrm", "large": "rt_hdr_calb_cnrm_large"}


def start_from_oidn(model: RobustUNet) -> RobustUNet:
    """Give a model the weights of OIDN's network of its size (`network.unet.load_oidn`, which says what it raises).

    Parameters
    ----------
    model : RobustUNet
        Is changed.

    Returns
    -------
    RobustUNet
        The same.
    """
    model.trunk.load_state_dict(load_oidn(OIDN_TRUNKS[model.config.size]).state_dict())
    return model


def round_robust(model: RobustUNet) -> RobustUNet:
    """Lay a model out for processors that have bfloat16 (`network.unet.round_trunk`); the model is changed."""
    model.trunk = round_trunk(model.trunk)
    model.known.weight.data = round_taps(model.known.weight)
    return model
