"""The robust average of the paper: the mean of some tensors without the least and the greatest value."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


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
