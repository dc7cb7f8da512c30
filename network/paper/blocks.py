"""Building blocks: the robust average, the Robust Average block that connects the frames, the residual block.

Frames are stacked in time along the batch: ``(T·N, C, H, W)``, all samples of the first frame, then all of the
second. Spatial layers see a larger batch and need not know about time; splitting into frames is a view.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import log
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from network.cpu.fused_ops import blend_channels, can_blend


def ravg(frames: Sequence[Tensor]) -> Tensor:
    """Mean of tensors after discarding the minimum and the maximum of each element.

    Parameters
    ----------
    frames : sequence of Tensor
        At least one tensor, all of one shape. For a tensor with a time axis, pass ``x.unbind(axis)``.

    Returns
    -------
    Tensor
        Of the shape of one frame. Of two frames the mean, of one itself.

    Raises
    ------
    ValueError
        If there is no frame.

    Notes
    -----
    ``ravg(S) = (Σ x − max(S) − min(S)) / (|S| − 2)`` for ``|S| ≥ 3``, computed without forming ``Σ x``: beside
    an outlier of 1e6 the subtraction would leave nothing of the other values in half precision. Where several
    values are equally extreme, one of them gets the gradient.

    References
    ----------
    Kalojanov and Thurston 2023, "Robust Average Networks for Monte Carlo Denoising", section 3, equation 1.
    """
    if len(frames) == 0:
        raise ValueError("frames: expected at least one tensor, got none")
    if len(frames) == 1:
        return frames[0]
    if len(frames) == 2:
        return torch.lerp(frames[0], frames[1], 0.5)
    kind = _MeanOfMiddleTwo if len(frames) == 4 else _MeanOfInner
    average: Tensor = kind.apply(*frames)  # type: ignore[no-untyped-call]
    return average


class _MeanOfInner(torch.autograd.Function):
    """ravg of three frames or more; see ``ravg``. Autograd through its minima and maxima costs three times as much."""

    @staticmethod
    def forward(ctx: Any, *frames: Tensor) -> Tensor:
        low, high = torch.minimum(frames[0], frames[1]), torch.maximum(frames[0], frames[1])
        total = torch.zeros_like(low)
        for frame in frames[2:]:
            # Of (low, frame, high) the middle one can no longer be extreme: it joins the sum.
            total += torch.minimum(frame, high).maximum(low)
            low, high = torch.minimum(low, frame), torch.maximum(high, frame)
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(low, high, *frames)
        return total.div_(len(frames) - 2)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        low, high, *frames = ctx.saved_tensors
        share = gradient / (len(frames) - 2)
        found = [share.clone() for _ in frames]
        # One frame is least and another greatest: of equal ones the first and the last. What the others get is theirs.
        for extreme, order in ((low, range(len(frames))), (high, reversed(range(len(frames))))):
            left = torch.ones_like(share)
            for i in order:
                taken = torch.empty_like(share)
                torch.eq(frames[i], extreme, out=taken).mul_(left)
                left -= taken
                found[i].addcmul_(taken, share, value=-1)
        return tuple(found)


class _MeanOfMiddleTwo(torch.autograd.Function):
    """ravg of four frames, the case of every step of a five-frame window; see ``ravg``.

    Sorted pairs (a, b) and (c, d) give the two middle values directly. Autograd through six minima and maxima
    costs ten times this backward pass, which keeps four 0/1 masks in the data's own type (so that every pass
    over memory is vectorised) and sends half the gradient to each of the two frames that were averaged.
    """

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
        low_ab, high_ab = torch.minimum(a, b), torch.maximum(a, b)
        low_cd, high_cd = torch.minimum(c, d), torch.maximum(c, d)
        mean = torch.maximum(low_ab, low_cd).add_(torch.minimum(high_ab, high_cd)).mul_(0.5)
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(
                low_ab.ge_(low_cd),  # the lower middle value came from (a, b)
                high_ab.le_(high_cd),  # the upper middle value came from (a, b)
                low_cd.copy_(a).le_(b),
                high_cd.copy_(c).le_(d),
            )
        return mean

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        lower_from_ab, upper_from_ab, a_is_lower, c_is_lower = ctx.saved_tensors
        half = gradient * 0.5
        # Every value below is 0, half or gradient, so the sums and differences are exact in any precision.
        lower_ab, upper_ab = half * lower_from_ab, half * upper_from_ab
        lower_cd, upper_cd = half - lower_ab, half - upper_ab
        to_a = torch.lerp(upper_ab, lower_ab, a_is_lower)
        to_c = torch.lerp(upper_cd, lower_cd, c_is_lower)
        return to_a, lower_ab.add_(upper_ab).sub_(to_a), to_c, lower_cd.add_(upper_cd).sub_(to_c)


class ResidualBlock(nn.Module):
    """``x + conv(relu(conv(x)))``, without normalisation, at constant width.

    Parameters
    ----------
    channels : int
        Width of input, output and hidden layer.
    kernel_size : int
        Odd size of both convolutions.

    References
    ----------
    He et al. 2016, "Deep Residual Learning for Image Recognition", doi:10.1109/CVPR.2016.90.
    """

    def __init__(self, channels: int, kernel_size: int = 3) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, kernel_size, padding=kernel_size // 2)
        self.second = nn.Conv2d(channels, channels, kernel_size, padding=kernel_size // 2)

    def forward(self, x: Tensor) -> Tensor:
        """Add what two convolutions make of the features.

        Parameters
        ----------
        x : Tensor
            ``(N, C, H, W)``.

        Returns
        -------
        Tensor
            As x.
        """
        return x + cast(Tensor, self.second(torch.relu(self.first(torch.relu(x)))))


class RobustAverage(nn.Module):
    """Robust Average block: blends each frame with the robust average of the others, by learned weights.

    Parameters
    ----------
    channels : int
        Width of the features.
    kernel_size : int
        Odd size of the convolutions that predict the weights.

    Notes
    -----
    For each frame i, outermost frames first and the centre last, with the results of the earlier steps in place:
    ``a = ravg(x_j, j ≠ i)``, ``w = sigmoid(conv(relu(conv([x_i, a]))))``, ``x_i ← (1 − w) x_i + w a``, one weight
    per pixel. The parameters are shared over the steps. ``w → 0`` makes the block the identity.

    The first convolution acts on the concatenation of x_i and a; it is held as two halves. As each frame is
    excluded before it has been changed, the half on x_i runs on all frames at once, and nothing is concatenated.

    References
    ----------
    Kalojanov and Thurston 2023, section 3.
    """

    def __init__(self, channels: int, kernel_size: int = 3) -> None:
        super().__init__()
        padding = kernel_size // 2
        self.on_frame = nn.Conv2d(channels, channels, kernel_size, padding=padding)
        self.on_average = nn.Conv2d(channels, channels, kernel_size, padding=padding, bias=False)
        self.weight = nn.Conv2d(channels, 1, kernel_size, padding=padding)

    def forward(self, x: Tensor, frames: int, centre: bool = False) -> Tensor:
        """Blend over time.

        Parameters
        ----------
        x : Tensor
            ``(T·N, C, H, W)``, time first.
        frames : int
            T. With one frame there is nothing to average: the block is the identity.
        centre : bool
            Whether the centre frame alone is asked for.

        Returns
        -------
        Tensor
            As x, or ``(N, C, H, W)``.
        """
        if frames == 1:
            return x
        of_frame = self.on_frame(x).chunk(frames)
        state = list(x.chunk(frames))
        for i in outermost_first(frames):
            average = ravg(state[:i] + state[i + 1 :])
            weight = torch.sigmoid(self.weight(torch.relu(of_frame[i] + self.on_average(average))))
            state[i] = torch.lerp(state[i], average, weight)
        return state[frames // 2] if centre else torch.cat(state)


class ChannelAverage(nn.Module):
    """Robust Average block whose weights are one for each channel, the same in all pixels.

    Parameters
    ----------
    channels : int
        Width of the features.
    blend : float
        In (0, 1): the weights of the average until training changes them.

    Notes
    -----
    As `RobustAverage`, with ``w = sigmoid(b)``, b learned. Where no gradient is asked for, on a processor, the block is
    one pass over memory (`network.cpu.fused_ops`), where torch needs one for each of forty operations.

    Behind the first convolution of a trunk that knows how to denoise, weights that two convolutions of 1×1 predicted in
    each pixel varied by less than 0.05 about 0.8 once they were trained, and the pictures were 0.01 dB worse.
    """

    def __init__(self, channels: int, blend: float) -> None:
        super().__init__()
        self.blend = nn.Parameter(torch.full((channels,), log(blend / (1 - blend))))

    def forward(self, x: Tensor, frames: int, centre: bool = False) -> Tensor:
        """Blend over time, as `RobustAverage.forward`."""
        if frames == 1:
            return x
        weight, order = torch.sigmoid(self.blend), outermost_first(frames)
        if not torch.is_grad_enabled() and can_blend(x, frames):
            return blend_channels(x, frames, order, weight, [frames // 2] if centre else range(frames))
        state, weight = list(x.chunk(frames)), weight.to(x.dtype)[:, None, None]
        for i in order:
            state[i] = torch.lerp(state[i], ravg(state[:i] + state[i + 1 :]), weight)
        return state[frames // 2] if centre else torch.cat(state)


class UNet(nn.Module):
    """U-Net shared over the frames, connected in time by RA blocks on the way down.

    Parameters
    ----------
    inputs : int
        Channels it reads.
    widths : sequence of int
        Channels of each scale, finest first.
    ra_scales : sequence of int
        Scales with an RA block.

    Notes
    -----
    One residual block per scale and direction; strided convolution down; 1×1 convolution, nearest neighbour and
    addition up.
    """

    def __init__(self, inputs: int, widths: Sequence[int], ra_scales: Sequence[int]) -> None:
        super().__init__()
        self.stem = nn.Conv2d(inputs, widths[0], 3, padding=1)
        self.encode = nn.ModuleList(ResidualBlock(width) for width in widths)
        self.average = nn.ModuleDict({str(scale): RobustAverage(widths[scale]) for scale in ra_scales})
        self.down = nn.ModuleList(nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in pairwise(widths))
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairwise(widths))
        self.decode = nn.ModuleList(ResidualBlock(width) for width in widths[:-1])

    def scales(self, x: Tensor, frames: int) -> list[Tensor]:
        """Features of every scale.

        Parameters
        ----------
        x : Tensor
            ``(T·N, inputs, H, W)``, time first.
        frames : int
            T.

        Returns
        -------
        list of Tensor
            ``(T·N, width, h, w)``, finest first, after the ReLU.
        """
        x = self.stem(x)
        scales: list[Tensor] = []
        for scale, block in enumerate(self.encode):
            if scale:
                x = self.down[scale - 1](x)
            x = block(x)
            if str(scale) in self.average:
                x = self.average[str(scale)](x, frames)
            scales.append(x)
        for scale in reversed(range(len(self.decode))):
            up = functional.interpolate(self.up[scale](scales[scale + 1]), scale_factor=2.0, mode="nearest")
            scales[scale] = self.decode[scale](scales[scale] + up)
        return [torch.relu(x) for x in scales]


class TemporalModule(nn.Module):
    """Temporal module of Vogels et al. 2018: convolutions on the features of all frames together.

    Parameters
    ----------
    channels : int
        Width of the features of a frame.
    frames : int
        T.
    blocks : int
        Residual blocks on what is common to the frames.
    kernel_size : int
        Odd size of the convolutions.

    Notes
    -----
    The features of all frames, concatenated, become features of the window; those pass the residual blocks, and a 1×1
    convolution gives each frame its own again, from which its kernel is predicted. What Robust Average blocks do at
    many depths with one set of parameters, this does once, at the end, with weights for each position in the window.

    References
    ----------
    Vogels et al. 2018, "Denoising with Kernel Prediction and Asymmetric Loss Functions", section 5.2,
    doi:10.1145/3197517.3201388.
    """

    def __init__(self, channels: int, frames: int, blocks: int = 2, kernel_size: int = 3) -> None:
        super().__init__()
        self.join = nn.Conv2d(frames * channels, channels, kernel_size, padding=kernel_size // 2)
        self.blocks = nn.ModuleList(ResidualBlock(channels, kernel_size) for _ in range(blocks))
        self.split = nn.Conv2d(channels, frames * channels, 1)

    def forward(self, x: Tensor, frames: int) -> Tensor:
        """Mix the frames.

        Parameters
        ----------
        x : Tensor
            ``(T·N, C, H, W)``, time first.
        frames : int
            T.

        Returns
        -------
        Tensor
            As x.
        """
        window = self.join(torch.cat(torch.relu(x).chunk(frames), 1))
        for block in self.blocks:
            window = block(window)
        return torch.cat(self.split(torch.relu(window)).chunk(frames, 1))


def outermost_first(frames: int) -> list[int]:
    """Order in which a Robust Average block visits a window: 0, 4, 1, 3, 2 for five frames.

    Parameters
    ----------
    frames : int
        T.

    Returns
    -------
    list of int
        Indices of the frames.
    """
    return sorted(range(frames), key=lambda i: (-abs(i - frames // 2), i))
