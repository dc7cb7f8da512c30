"""The robust average, and the Robust Average block with one weight per channel, which connects the frames of a window.

Frames are stacked along the batch, ``(T·N, C, H, W)``, all samples of the first frame first: splitting them is a view.
"""

from collections.abc import Sequence
from math import log
from typing import Any

import torch
from torch import Tensor, nn

from network.cpu.fused_ops import blend_channels, can_blend
from network.cpu.training_ops import BlendChannels


def ravg(frames: Sequence[Tensor]) -> Tensor:
    """Mean of tensors of one shape after discarding the minimum and the maximum of each element.

    Returns the mean of two frames, and a single frame itself. Raises ValueError without frames.
    ``ravg(S) = (Σ x − max(S) − min(S)) / (|S| − 2)`` for ``|S| ≥ 3``, computed without forming ``Σ x``: beside
    an outlier of 1e6 the subtraction would leave nothing of the other values in half precision. Where several
    values are equally extreme, one of them gets the gradient. Kalojanov and Thurston 2023, "Robust Average Networks for
    Monte Carlo Denoising", section 3, equation 1.
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
    """ravg of three frames or more. Autograd through its minima and maxima costs three times as much."""

    @staticmethod
    def forward(ctx: Any, *frames: Tensor) -> Tensor:
        low, high = torch.minimum(frames[0], frames[1]), torch.maximum(frames[0], frames[1])
        total = torch.zeros_like(low)
        for frame in frames[2:]:
            # The middle one of (low, frame, high) can no longer be extreme: add it to the sum.
            total += torch.minimum(frame, high).maximum(low)
            low, high = torch.minimum(low, frame), torch.maximum(high, frame)
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(low, high, *frames)
        return total.div_(len(frames) - 2)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        low, high, *frames = ctx.saved_tensors
        share = gradient / (len(frames) - 2)
        gradients = [share.clone() for _ in frames]
        # One frame is the minimum and another the maximum; among equal frames the first and the last.
        for extreme, order in ((low, range(len(frames))), (high, reversed(range(len(frames))))):
            left = torch.ones_like(share)
            for i in order:
                taken = torch.empty_like(share)
                torch.eq(frames[i], extreme, out=taken).mul_(left)
                left -= taken
                gradients[i].addcmul_(taken, share, value=-1)
        return tuple(gradients)


class _MeanOfMiddleTwo(torch.autograd.Function):
    """ravg of four frames, the case of every step of a five-frame window.

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


class ChannelAverage(nn.Module):
    """Robust Average block with one weight per channel, at first `blend`, the same in all pixels.

    For each frame i, outermost frames first and the centre last, with the results of the earlier steps in place:
    ``a = ravg(x_j, j ≠ i)``, ``x_i ← (1 − w) x_i + w a``, with ``w = sigmoid(b)``, b learned. Without gradients, on a
    CPU, the block is one pass over memory (`network.cpu.fused_ops`), where torch needs one for each of forty
    operations.

    Behind the first convolution of a pretrained backbone, weights that two 1×1 convolutions predicted in each pixel, as
    those of `network.paper.blocks.RobustAverage`, varied by less than 0.05 about 0.8 once they were trained, and the
    pictures were 0.01 dB worse.
    """

    def __init__(self, channels: int, blend: float) -> None:
        super().__init__()
        self.blend = nn.Parameter(torch.full((channels,), log(blend / (1 - blend))))

    def forward(self, x: Tensor, frames: int, centre: bool = False, common: Tensor | None = None) -> Tensor:
        """Blend ``(T·N, C, H, W)`` over time; with `centre`, return ``(N, C, H, W)`` of the centre frame alone.

        With `common` ``(N, C, H, W)`` that is added to each frame returned, and a ReLU follows.
        """
        weight, order = torch.sigmoid(self.blend), outermost_first(frames)
        if can_blend(x, frames):
            returned = [frames // 2] if centre else list(range(frames))
            if not torch.is_grad_enabled():
                return blend_channels(x, frames, order, weight, returned, common)
            if x.dtype == weight.dtype == torch.float32:
                blended: Tensor = BlendChannels.apply(x, frames, order, weight, returned, common)  # type: ignore[no-untyped-call]
                return blended
        state, weight = list(x.chunk(frames)), weight.to(x.dtype)[:, None, None]
        for i in order if frames > 1 else ():
            state[i] = torch.lerp(state[i], ravg(state[:i] + state[i + 1 :]), weight)
        images = [state[frames // 2]] if centre else state
        if common is not None:
            images = [torch.relu(image + common) for image in images]
        return torch.cat(images)


def outermost_first(frames: int) -> list[int]:
    """Order in which a Robust Average block visits the frames of a window: 0, 4, 1, 3, 2 for five."""
    return sorted(range(frames), key=lambda i: (-abs(i - frames // 2), i))
