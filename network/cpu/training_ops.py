"""The Robust Average block with gradients as one pass over memory, for training on CPUs.

With torch's own operations the block took two thirds of the time of a training step.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from loops.parallel import Floats, Places, run_bands
from network.cpu.fused_ops import blend_channels

_VALUES = 512  # processed together, about: all states and gradients of a window fit the second-fastest cache


class BlendChannels(torch.autograd.Function):
    """`network.cpu.fused_ops.blend_channels` of float32 features, with gradients of all tensors."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, frames: int, order: Sequence[int], weight: Tensor, returned: Sequence[int],
        common: Tensor | None,
    ) -> Tensor:  # fmt: skip
        """See `network.cpu.fused_ops.blend_channels`."""
        result = blend_channels(x, frames, order, weight, returned, common)
        ctx.window = frames, order, returned
        ctx.save_for_backward(x, weight, None if common is None else result)
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the features, of the weight, and of what is added."""
        x, weight, result = ctx.saved_tensors
        frames, order, returned = ctx.window
        of_common = None
        if result is not None:
            gradient = torch.where(result > 0, gradient, 0)
            of_common = gradient.unflatten(0, (len(returned), -1)).sum(0)
        of_x, of_weight = _gradients(x, frames, order, weight, returned, gradient)
        return of_x, None, None, of_weight, None, of_common


def _gradients(
    x: Tensor, frames: int, order: Sequence[int], weight: Tensor, returned: Sequence[int], gradient: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients of features (T·N, C, H, W) and weight (C,), from those of the frames returned."""
    pixels, given = (t.permute(0, 2, 3, 1).contiguous() for t in (x, gradient))
    batch, (height, width, channels) = len(x) // frames, pixels.shape[1:]
    result = torch.empty_like(pixels)
    rows = [t.detach().numpy().reshape(-1, batch * height, width * channels) for t in (pixels, given, result)]
    tiled = np.tile(weight.detach().numpy(), max(_VALUES // channels, 1))
    # One sum for each row, so that it does not depend on the number of threads.
    sums = np.zeros((batch * height, len(tiled)), np.float32)
    run_bands(_differentiate, batch * height, *rows, np.asarray(order), np.asarray(returned), tiled, sums)
    of_weight = sums.reshape(-1, channels).sum(0, dtype=np.float64).astype(np.float32)
    return result.permute(0, 3, 1, 2), torch.from_numpy(of_weight)


# Rows are separate arrays, and few in each loop: the compiler vectorises a loop only over arrays that it knows to be
# contiguous, and only if few pairs of them must be found apart.
@njit(nogil=True)
def _add_middle(x: Any, low: Any, high: Any, total: Any) -> None:
    for p in range(len(x)):
        total[p] += max(low[p], min(x[p], high[p]))
        low[p], high[p] = min(low[p], x[p]), max(high[p], x[p])


@njit(nogil=True)
def _order(a: Any, b: Any, low: Any, high: Any) -> None:
    for p in range(len(a)):
        low[p], high[p] = min(a[p], b[p]), max(a[p], b[p])


@njit(nogil=True)
def _average(state: Any, skipped: int, low: Any, high: Any, total: Any) -> None:
    """Least and greatest of the frames but one, and the sum of the others; of two frames the sum of both."""
    T = len(state)
    first, second = (1 if skipped == 0 else 0), (1 if skipped > 1 else 2)
    _order(state[first], state[second], low, high)
    total[:] = 0
    if T == 3:
        _add(total, low)
        _add(total, high)
    for j in range(second + 1, T):
        if j != skipped:
            _add_middle(state[j], low, high, total)


@njit(nogil=True)
def _step(state: Any, difference: Any, total: Any, share: Any, scale: Any) -> None:
    for p in range(len(state)):
        away = scale * total[p] - state[p]
        difference[p] = away
        state[p] += share[p] * away


@njit(nogil=True)
def _step_back(gradient: Any, share: Any, passed: Any) -> None:
    for p in range(len(gradient)):
        part = gradient[p] * share[p]
        passed[p] = part
        gradient[p] -= part


@njit(nogil=True)
def _add_product(sums: Any, a: Any, b: Any) -> None:
    for p in range(len(sums)):
        sums[p] += a[p] * b[p]


@njit(nogil=True)
def _scale(values: Any, scale: Any) -> None:
    for p in range(len(values)):
        values[p] *= scale


@njit(nogil=True)
def _add(values: Any, added: Any) -> None:
    for p in range(len(values)):
        values[p] += added[p]


@njit(nogil=True)
def _take_back(gradient: Any, state: Any, extreme: Any, left: Any) -> None:
    """The gradient of an extreme, which is in no average; the first of equal frames is it."""
    for p in range(len(gradient)):
        taken = left[p] * np.float32(state[p] == extreme[p])
        left[p] -= taken
        gradient[p] -= taken


@njit(cache=True, nogil=True)
def _differentiate(
    first: int, stop: int, source: Floats, given: Floats, result: Floats, order: Places, returned: Places,
    share: Floats, sums: Floats,
) -> None:  # fmt: skip
    T, row, size = len(source), source.shape[2], len(share)
    scale = np.float32(0.5) if T == 3 else np.float32(1) / np.float32(T - 3)
    state, difference, gradient = (
        np.zeros((T, size), np.float32),
        np.zeros((T, size), np.float32),
        np.zeros((T, size), np.float32),
    )
    low, high, total = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    passed, left = np.empty(size, np.float32), np.empty(size, np.float32)
    for y in range(first, stop):
        for start in range(0, row, size):
            # Beyond the end of a row the gradient is 0.
            part = slice(start, min(start + size, row))
            n = part.stop - start
            for t in range(T):
                state[t][:n] = source[t, y][part]
                gradient[t] = 0
            for k in range(len(returned)):
                gradient[returned[k]][:n] = given[k, y][part]
            for i in order:
                _average(state, i, low, high, total)
                _step(state[i], difference[i], total, share, scale)
            for i in order[::-1]:
                state[i][:n] = source[i, y][part]
                _add_product(sums[y], gradient[i], difference[i])
                _step_back(gradient[i], share, passed)
                _scale(passed, scale)
                for j in range(T):
                    if j != i:
                        _add(gradient[j], passed)
                if T > 3:
                    _average(state, i, low, high, total)
                    left[:] = passed
                    for j in range(T):
                        if j != i:
                            _take_back(gradient[j], state[j], low, left)
                    left[:] = passed
                    for j in range(T - 1, -1, -1):
                        if j != i:
                            _take_back(gradient[j], state[j], high, left)
            for t in range(T):
                result[t, y][part] = gradient[t][:n]
