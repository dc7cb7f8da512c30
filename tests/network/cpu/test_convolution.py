"""A convolution with what is added to it and its ReLU is what the three are one after the other."""

import pytest
import torch
from torch.nn import functional

from network.cpu import convolution
from network.cpu.convolution import can_fuse, convolve


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_it_is_all_three(dtype: torch.dtype, fused: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    random = torch.Generator().manual_seed(1)
    x, weight, bias, added = (
        torch.randn(*size, generator=random).to(dtype) for size in ((2, 6, 9, 11), (8, 6, 3, 3), (8,), (2, 8, 9, 11))
    )
    added = added.contiguous(memory_format=torch.channels_last)
    alone = functional.conv2d(x.double(), weight.double(), bias.double(), padding=1)
    if not fused:
        monkeypatch.setattr(convolution, "_FUSED", frozenset())
    with torch.no_grad():
        assert can_fuse(x) <= fused
        for before, expected in ((None, alone), (added, alone + added)):
            found = convolve(x, weight, bias, None if before is None else before.clone())
            assert found.dtype == dtype
            # Sums of 54 products; in bfloat16 what comes out is rounded to 8 bits, once or twice.
            tolerance = {"rtol": 1e-2, "atol": 6e-2} if dtype == torch.bfloat16 else {"rtol": 1e-5, "atol": 1e-5}
            torch.testing.assert_close(found.double(), torch.relu(expected), **tolerance)


def test_with_gradients_it_is_not_one_operation() -> None:
    assert not can_fuse(torch.zeros(1, 3, 4, 4))
