"""The network beside per-frame estimates: how much of each frame to believe, and of what the estimates have missed.

`Stabilizer` predicts a weight for the estimate of each frame of an aligned window, and, at several resolutions, how
much of the residual (noisy − estimate, averaged with the same weights) is light and not noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from network.blocks import UNet
from network.inputs import CHANNELS, ESTIMATE_CHANNELS
from network.kernels import check_threshold, double, halve, mean_of, softmax_kernel

#: The residual of a pixel counts up to so many times its brightness and the exposure: fireflies that have passed.
RESIDUAL_LIMIT = 4.0
#: A frame's weight may leave the confidence's by a factor of e to this: free to do more, a network that has seen few
#: moving shadows averages across them.
WEIGHT_BOUND = 0.15
#: A share lies between the logistic function of minus and plus this: what saturates no longer learns.
SHARE_BOUND = 6.0


@dataclass(frozen=True)
class StabilizerConfig:
    """Sizes of a `Stabilizer`."""

    frames: int = 5  # T, odd; the window
    cell: int = 4  # pixels in each direction that the finest scale has one of, a power of two
    widths: tuple[int, ...] = (16, 32, 48)  # channels of each scale, finest first
    ra_scales: tuple[int, ...] = (0, 1, 2)  # of these, the ones with an RA block
    threshold: float = 0.05  # t·T: a frame of less than this part of the mean weight has none

    def __post_init__(self) -> None:
        if self.frames < 1 or self.frames % 2 == 0:
            raise ValueError(f"frames: expected an odd number >= 1, got {self.frames}")
        if self.cell not in (1, 2, 4, 8):
            raise ValueError(f"cell: expected 1, 2, 4 or 8, got {self.cell}")
        if not self.widths or min(self.widths) < 1:
            raise ValueError(f"widths: expected at least one positive width, got {self.widths}")
        if self.widths[0] % self.cell**2:
            raise ValueError(f"widths: expected the first to be a multiple of {self.cell**2}, got {self.widths[0]}")
        if not set(self.ra_scales) <= set(range(len(self.widths))):
            raise ValueError(f"ra_scales: expected scales 0 to {len(self.widths) - 1}, got {self.ra_scales}")
        check_threshold(self.threshold)


@dataclass(frozen=True)
class Stabilized:
    """What weights and shares made of a window, frame by frame: the images of any of its frames are sums of these.

    Attributes
    ----------
    estimates, residuals : Tensor
        ``(N, T, C, H, W)``, each frame's times its weight.
    denominators : Tensor
        ``(N, T, 1, H, W)``, the weights.
    shares : tuple of Tensor
        ``(N, 1, H / 2^s, W / 2^s)`` in [0, 1], finest first: how much of each band of the residual is added.

    Notes
    -----
    ``o = Σ w_t e_t / Σ w_t + S(Σ w_t r_t / Σ w_t)``; S takes the residual apart into a Laplacian pyramid (Burt and
    Adelson 1983), multiplies each band by its share and puts it together again. It is the shrinkage of an unbiased
    estimate towards a biased one (James and Stein 1961; for rendering Gu et al. 2022, doi:10.1145/3550454.3555496),
    with shares that are learned.
    """

    estimates: Tensor
    residuals: Tensor
    denominators: Tensor
    shares: tuple[Tensor, ...]

    def image(self, fallback: Tensor, frames: Sequence[int] | None = None, epsilon: float = 1e-6) -> Tensor:
        """Image that some frames give together.

        Parameters
        ----------
        fallback : Tensor
            ``(N, C, H, W)``, as for `network.kernels.mean_of`.
        frames : sequence of int, optional
            Which; all without.
        epsilon : float
            As for `network.kernels.mean_of`.

        Returns
        -------
        Tensor
            ``(N, C, H, W)``.
        """
        chosen = slice(None) if frames is None else list(frames)
        estimates, residuals, weights = (
            sums[:, chosen] for sums in (self.estimates, self.residuals, self.denominators)
        )
        residual = mean_of(residuals, weights, torch.zeros_like(fallback), epsilon)
        return mean_of(estimates, weights, fallback, epsilon) + shrink(residual, self.shares)

    def apply(self, layers: Tensor) -> Tensor:
        """Average other layers of the window with the frames' weights.

        Parameters
        ----------
        layers : Tensor
            ``(N, T, C, H, W)``.

        Returns
        -------
        Tensor
            ``(N, C, H, W)``.
        """
        return mean_of(layers * self.denominators, self.denominators, layers[:, layers.shape[1] // 2])

    def parts(self) -> tuple[Tensor, Tensor]:
        """What each frame contributes, ``(N, T, C, H, W)``, and its weight, ``(N, T, 1, H, W)``; they sum to 1."""
        total = self.denominators.sum(1, keepdim=True)
        frames = total.new_empty(self.residuals.shape[:2])
        residuals = (self.residuals / total).flatten(0, 1)
        shares = tuple(share.repeat_interleave(frames.shape[1], 0) for share in self.shares)
        return self.estimates / total + shrink(residuals, shares).unflatten(0, frames.shape), self.denominators / total


def shrink(residual: Tensor, shares: Sequence[Tensor]) -> Tensor:
    """Multiply the bands of a Laplacian pyramid by shares.

    Parameters
    ----------
    residual : Tensor
        ``(N, C, H, W)``.
    shares : sequence of Tensor
        ``(N, 1, H / 2^s, W / 2^s)``, finest first; as many as there are bands.

    Returns
    -------
    Tensor
        As residual.
    """
    share, *coarser = shares
    if not coarser:
        return share * residual
    low = halve(residual)
    # The band is what the coarser ones lack: share · (residual − U low) + U (shrunk low).
    return share * residual + double(shrink(low, coarser)) - share * double(low)


class Stabilizer(UNet):
    """U-Net on cells of pixels, shared over the frames, connected in time by RA blocks on the way down.

    Parameters
    ----------
    config : StabilizerConfig
        Sizes.

    Notes
    -----
    A feature of the finest scale is that of a cell of pixels; its channels are shared out to the pixels where those
    are asked for. A frame's weight is ``c e^h``, c its confidence and h in [−0.15, 0.15] predicted, normalised over the
    frames and thresholded (η_t, section 4 of the paper): training starts from the gated average. The shares are found
    from the centre frame's features, and from the size of the residual and of its noise at their scale. Scales are
    those finer than a cell, those of the network, and one coarser. They start at 5 % at the coarsest, and each at
    three fifths of the next coarser.
    """

    def __init__(self, config: StabilizerConfig) -> None:
        widths = config.widths
        super().__init__(CHANNELS + ESTIMATE_CHANNELS, widths, config.ra_scales, config.cell)
        self.config = config
        self.weight = nn.Conv2d(widths[0], config.cell**2, 3, padding=1)
        # Features of a share: those of its scale, and four of the residual. Finer than a cell they are its parts.
        sources = [*(widths[0] // part**2 for part in self.finer), *widths, widths[-1]]
        self.shares = nn.ModuleList(
            nn.Sequential(nn.Conv2d(width + 4, 16, 3, padding=1), nn.ReLU(), nn.Conv2d(16, 1, 1)) for width in sources
        )
        with torch.no_grad():
            self.weight.weight.mul_(0.1)
            cast(Tensor, self.weight.bias).zero_()
            for scale, head in enumerate(self.shares):
                last = cast(nn.Conv2d, cast(nn.Sequential, head)[-1])
                last.weight.mul_(0.1)
                nn.init.constant_(cast(Tensor, last.bias), 0.5 * (scale + 1 - len(sources)) - 3)

    @property
    def multiple(self) -> int:
        """Height and width must be multiples of this."""
        return int(self.config.cell * 2 ** len(self.config.widths))

    @property
    def finer(self) -> list[int]:
        """How many times finer than a cell the bands are that are finer, the finest first: cell, …, 4, 2."""
        return [2**k for k in range(self.config.cell.bit_length() - 1, 0, -1)]

    def forward(
        self,
        features: Tensor,
        color: Tensor,
        estimate: Tensor,
        confidence: Tensor,
        exposure: Tensor,
        threshold: float | None = None,
    ) -> Stabilized:
        """Stabilize an aligned window.

        Parameters
        ----------
        features : Tensor
            ``(N, T, 16, H, W)`` from `network.inputs.network_inputs`.
        color, estimate : Tensor
            ``(N, T, 3, H, W)`` irradiance; color is mixed with the centre's by confidence.
        confidence : Tensor
            ``(N, T, 1, H, W)``.
        exposure : Tensor
            ``(N,)``.
        threshold : float, optional
            t·T in [0, 1). Default: the configured one.

        Returns
        -------
        Stabilized
            Weights and shares, applied.

        Raises
        ------
        ValueError
            If frames or channels are not the model's, or height or width is no multiple of `multiple`.
        """
        config, centre = self.config, self.config.frames // 2
        expected = (config.frames, CHANNELS + ESTIMATE_CHANNELS)
        if features.ndim != 5 or tuple(features.shape[1:3]) != expected:
            raise ValueError(f"features: expected (N, {expected[0]}, {expected[1]}, H, W), got {tuple(features.shape)}")
        for name, length in zip(("height", "width"), features.shape[3:], strict=True):
            if length == 0 or length % self.multiple:
                raise ValueError(f"features: expected a {name} that is a multiple of {self.multiple}, got {length}")
        stacked = features.transpose(0, 1).flatten(0, 1)  # time first
        scales = self.scales(stacked.to(dtype=self.stem.weight.dtype, memory_format=torch.channels_last), config.frames)
        logits = _bounded(functional.pixel_shuffle(self.weight(scales[0]), config.cell).float(), WEIGHT_BOUND)
        # 1e-3: a pixel without confidence in any frame (even the centre was not finite) averages them all.
        logits = logits.unflatten(0, (config.frames, -1)).transpose(0, 1) + (confidence.float() + 1e-3).log()
        logits = logits.squeeze(2)
        cut = (config.threshold if threshold is None else check_threshold(threshold)) / config.frames
        weights = softmax_kernel(logits, color.new_full((1, 1, 1, 1), cut), centre=centre).unsqueeze(2)
        middle = estimate[:, centre, None]
        residual = color - (middle + confidence * (estimate - middle))
        limit = RESIDUAL_LIMIT * (estimate.clamp_min(0) + exposure.view(-1, 1, 1, 1, 1))
        residual = weights * torch.minimum(torch.maximum(residual, -limit), limit)
        own = [scale.unflatten(0, (config.frames, -1))[centre] for scale in scales]
        own = [*(functional.pixel_shuffle(own[0], part) for part in self.finer), *own]
        own.append(functional.avg_pool2d(own[-1], 2))
        shares: list[Tensor] = []
        size = exposure.reciprocal().view(-1, 1, 1, 1)
        mean, variance = residual.sum(1), residual.square().sum(1).mean(1, keepdim=True)
        for head, of_scale in zip(self.shares, own, strict=True):
            if shares:
                mean, variance = halve(mean), halve(variance) / 4
            # Ten times: both are a few hundredths of the exposure. 1e-8, a deviation of 1e-4: a root has no slope at 0.
            noise = (variance * size**2 + 1e-8).sqrt()
            seen = torch.cat([(10 * mean.abs() * size).log1p(), (10 * noise).log1p()], 1)
            logit = head(torch.cat([of_scale, seen.to(of_scale.dtype)], 1)).float()
            shares.append(torch.sigmoid(_bounded(logit, SHARE_BOUND)))
        return Stabilized(weights * estimate, residual, weights, tuple(shares))


def _bounded(x: Tensor, bound: float) -> Tensor:
    """x, bounded smoothly to ±bound."""
    return bound * torch.tanh(x / bound)
