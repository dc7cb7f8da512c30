"""Operations in one pass give what torch gives."""

# ruff: noqa: E402 - nothing of network can be imported before it is known that torch is there

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from network import robust_average
from network.cpu import fused_ops as fused
from network.robust_average import ChannelAverage, outermost_first

pytestmark = pytest.mark.neural


def block_and_features(
    frames: int, dtype: torch.dtype = torch.float32, channels: int = 24
) -> tuple[ChannelAverage, torch.Tensor]:
    torch.manual_seed(0)
    block = ChannelAverage(channels, 0.8)
    with torch.no_grad():
        block.blend.uniform_(-2, 2)  # so that blends differ from channel to channel
    # Two windows, a width that is no multiple of what is done at a time, and more than one of those.
    x = torch.randn(2 * frames, channels, 5, 2 * (fused._VALUES // channels) + 7).to(dtype)
    return block, x.to(memory_format=torch.channels_last)


@pytest.mark.parametrize("channels", [24, 3, 600])
@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize("frames", [3, 5, 7])
def test_it_gives_what_torch_gives(frames: int, centre: bool, channels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    block, x = block_and_features(frames, channels=channels)
    with torch.no_grad():
        found = block(x, frames, centre)
        monkeypatch.setattr(robust_average, "can_blend", lambda *_: False)
        wanted = block(x, frames, centre)
    assert found.shape == wanted.shape
    assert found.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(found, wanted.detach(), rtol=0, atol=1e-5)
    given = x[frames // 2 * 2 : frames // 2 * 2 + 2] if centre else x
    assert float((found - given).abs().mean()) > 0.1  # it does something


@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize("frames", [1, 3, 5, 7])
def test_a_common_term_commutes_with_the_block(frames: int, centre: bool) -> None:
    """Added to all frames beforehand or to the results, it gives the same; a ReLU follows."""
    block, x = block_and_features(frames)
    common = torch.randn(2, *x.shape[1:], generator=torch.Generator().manual_seed(2))
    wanted = torch.relu(block(x + common.repeat(frames, 1, 1, 1), frames, centre)).detach()
    torch.testing.assert_close(block(x, frames, centre, common).detach(), wanted, rtol=0, atol=1e-5)
    with torch.no_grad():
        torch.testing.assert_close(block(x, frames, centre, common), wanted, rtol=0, atol=1e-5)
    assert float((wanted == 0).float().mean()) > 0.1


@pytest.mark.parametrize("frames", [5, 7])
def test_in_bfloat16_it_is_nearer_to_exact_than_torch_is(frames: int) -> None:
    block, x = block_and_features(frames, torch.bfloat16)
    exact = block(x.float(), frames).detach()
    slow = block(x, frames).detach().float()
    with torch.no_grad():
        quick = block(x, frames)
    assert quick.dtype == torch.bfloat16
    # One rounding, at the end: half a step of 2^-8.
    assert float(((quick.float() - exact).abs() / exact.abs().clamp_min(0.05)).max()) < 2**-8
    assert float((quick.float() - exact).square().mean()) < float((slow - exact).square().mean())


def test_it_is_taken_where_it_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[int] = []

    def spy(x: torch.Tensor, frames: int, *_: object) -> torch.Tensor:
        taken.append(frames)
        return x

    monkeypatch.setattr(robust_average, "blend_channels", spy)
    block, x = block_and_features(5)
    block(x, 5)
    assert not taken  # a gradient may be asked for
    with torch.no_grad():
        block(x, 5)
        assert taken == [5]
        with torch.autocast("cpu", torch.bfloat16):
            block(x.bfloat16(), 5)
        block(x.half(), 5)
        block(x[:4], 2)  # the mean of one other frame
    assert taken == [5]


def test_the_order_is_that_of_the_block() -> None:
    """Another order gives another picture: each frame is blended with what those before it have become."""
    block, x = block_and_features(5)
    with torch.no_grad():
        weight = torch.sigmoid(block.blend)
        right = fused.blend_channels(x, 5, outermost_first(5), weight, range(5))
        wrong = fused.blend_channels(x, 5, range(5), weight, range(5))
        torch.testing.assert_close(block(x, 5), right)
    assert float((right - wrong).abs().max()) > 0.01


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
    wanted = fused.with_low_bits(x.requires_grad_(), 3)  # with gradients: torch
    with torch.no_grad():
        found = fused.with_low_bits(x, 3)
    assert found.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(found, wanted)
    # The rounding errors of both halves are at most 2^-9 of what is rounded.
    torch.testing.assert_close(found[:, :3].float() + found[:, 9:].float(), x[:, :3], rtol=2**-17, atol=0)
