"""A convolution without upsampling gives what plain operations give on upsampled features."""

import pytest
import torch
from torch.nn import functional

from network import unet
from network.bfloat16 import round_taps
from network.cpu.upsample_conv import can_upsample, convolve_upsampled, merge_taps
from network.unet import Stage


def features(size: tuple[int, int], batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(sum(size))
    height, width = size
    x = torch.randn(batch, 12, height, width, generator=random)
    return x, torch.randn(batch, 5, 2 * height, 2 * width, generator=random)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (6, 1), (9, 13)])
def test_it_is_the_convolution_of_enlarged_features(size: tuple[int, int]) -> None:
    x, skip = features(size)
    torch.manual_seed(0)
    stage = Stage(17, (8,))
    weight, bias = stage[0].weight.detach(), stage[0].bias.detach()
    both = torch.cat([functional.interpolate(x, scale_factor=2.0), skip], 1).double()
    expected = torch.relu(functional.conv2d(both, weight.double(), bias.double(), padding=1))
    found = convolve_upsampled(x, skip, merge_taps(weight, x.shape[1]), bias)
    # Sums of some hundred products of float32, of about 1.
    torch.testing.assert_close(found, expected.float(), rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (24, 32)])
def test_in_bfloat16_it_is_nearly_as_exact_as_plain_operations(size: tuple[int, int]) -> None:
    x, skip = features(size, batch=1)
    torch.manual_seed(0)
    stage = Stage(17, (8,)).requires_grad_(False)
    both = torch.cat([functional.interpolate(x, scale_factor=2.0), skip], 1)
    exact = torch.relu(functional.conv2d(both.double(), stage[0].weight.double(), stage[0].bias.double(), padding=1))
    stage.set_upsample_taps(x.shape[1], round_taps)
    stage.bfloat16()
    x, skip, both = (layer.bfloat16() for layer in (x, skip, both))
    with torch.no_grad():
        found, plain = stage.upsample(x, skip), stage(both)
    assert found.dtype == torch.bfloat16
    error, expected = (float((layer.double() - exact).square().mean()) for layer in (found, plain))
    # The upsampled features' part is rounded once before the rest is added to it, as the sum is afterwards.
    assert error < 2 * expected


def test_it_stands_for_plain_operations_where_it_can(monkeypatch: pytest.MonkeyPatch) -> None:
    x, skip = features((4, 6))
    stage, calls = Stage(17, (8, 8)), []
    monkeypatch.setattr(unet, "convolve_upsampled", lambda *layers: calls.append(layers) or convolve_upsampled(*layers))
    trained = stage.upsample(x, skip)
    assert not calls
    assert trained.requires_grad
    with torch.no_grad():
        torch.testing.assert_close(stage.upsample(x, skip), trained.detach(), rtol=1e-5, atol=2e-6)
    assert len(calls) == 1
    assert can_upsample(x, skip)
    assert not can_upsample(x, skip.bfloat16())
    assert not can_upsample(x.half(), skip.half())
