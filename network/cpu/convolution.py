"""A 3×3 convolution, what is added to it, and its ReLU: one operation where oneDNN has it. For running, on processors.

On CPUs torch's compiler makes one operation of them; called without it, it gives the same picture in four fifths of the
time, in bfloat16 to the bit in two thirds: the ReLU alone reads and writes all features once more.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor
from torch.nn import functional

# Of what type they are one operation: where oneDNN is built in, of what it takes on this processor. Elsewhere they run
# one after the other.
_FUSED: frozenset[torch.dtype] = frozenset()
if torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_convolution_pointwise"):
    _FUSED |= {torch.float32}
    if torch.ops.mkldnn._is_mkldnn_bf16_supported():
        _FUSED |= {torch.bfloat16}


def can_fuse(x: Tensor) -> bool:
    """Whether they are one operation on these features: on a processor, without gradients."""
    return x.dtype in _FUSED and not torch.is_grad_enabled() and x.device.type == "cpu"


def convolve(
    x: Tensor, weight: Tensor, bias: Tensor | None, added: Tensor | None = None, *, relu: bool = True
) -> Tensor:
    """Convolve, add, and apply a ReLU.

    Parameters
    ----------
    x : Tensor
        ``(N, C, H, W)``.
    weight, bias : Tensor
        Of the convolution: ``(O, C, 3, 3)``, and ``(O,)``.
    added : Tensor, optional
        ``(N, O, H, W)``, channels last: what is added to it, and where the result is written.
    relu : bool
        Whether there is a ReLU.

    Returns
    -------
    Tensor
        ``(N, O, H, W)``.
    """
    if not can_fuse(x):
        found = functional.conv2d(x, weight, bias, padding=1)
        found = found if added is None else added.add_(found)
        return torch.relu_(found) if relu else found
    one, name, rest = [1, 1], "relu" if relu else None, (list[float](), "")
    operation = weight, bias, one, one, one, 1  # padding, stride and dilation; groups
    if added is None:
        return cast(Tensor, torch.ops.mkldnn._convolution_pointwise(x, *operation, name or "none", *rest))
    x = x.contiguous(memory_format=torch.channels_last)  # as what is added lies
    return cast(Tensor, torch.ops.mkldnn._convolution_pointwise_.binary(added, x, *operation, "add", 1.0, name, *rest))
