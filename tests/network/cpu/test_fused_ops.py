"""Operations in one pass give what torch gives."""

import pytest
import torch

from network.cpu import fused_ops as fused


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(("count", "channels", "height", "width"), [(1, 32, 9, 21), (2, 64, 2, 1), (3, 5, 1, 7)])
def test_the_last_convolution(count: int, channels: int, height: int, width: int, dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    layer = torch.nn.Conv2d(channels, 3, 3, padding=1)
    x = torch.randn(count, channels, height, width).to(dtype)
    wanted = layer(x.float()).detach()
    assert not fused.can_project(x)  # with gradients: torch
    with torch.no_grad():
        assert fused.can_project(x)
        found = fused.convolve_to_rgb(x.to(memory_format=torch.channels_last), layer.weight, layer.bias)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)


def test_what_is_not_finite_stays_where_the_last_convolution_sees_it() -> None:
    x = torch.zeros(1, 4, 8, 8)
    x[0, 2, 3, 4] = torch.nan
    with torch.no_grad():
        found = fused.convolve_to_rgb(x, torch.ones(3, 4, 3, 3), torch.ones(3))
    assert torch.isnan(found[0, :, 2:5, 3:6]).all()
    assert torch.isfinite(found).sum() == 3 * (64 - 9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("channels", [3, 32])
def test_the_greatest_of_four_features(dtype: torch.dtype, channels: int) -> None:
    torch.manual_seed(0)
    x = torch.relu(torch.randn(2, channels, 6, 10)).to(dtype)
    x[:, :, :2, :2] = -0.0  # which no ReLU need remove
    wanted = fused.halve(x.requires_grad_())  # with gradients: torch
    with torch.no_grad():
        assert torch.equal(fused.halve(x), wanted)


def test_low_bits_of_the_first_channels_are_kept() -> None:
    torch.manual_seed(0)
    x = torch.cat([torch.randn(2, 9, 5, 7), torch.full((2, 9, 1, 7), 1 + 2**-8)], 2)  # and a tie
    wanted = fused.with_low_bits(x.requires_grad_())  # with gradients: torch
    with torch.no_grad():
        found = fused.with_low_bits(x)
    assert found.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(found, wanted)
    # The rounding errors of both halves are at most 2^-9 of what is rounded.
    torch.testing.assert_close(found[:, :3].float() + found[:, 9:].float(), x[:, :3], rtol=2**-17, atol=0)
