"""Weights in bfloat16: how far pictures are from those in float32, and what rounding keeps."""

from importlib.util import find_spec

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from network import unet
from network.bfloat16 import round_unet
from network.cpu import convolution
from network.oidn_weights import build_unet, load_oidn
from network.unet import OidnUNet
from tests.network.oidn_like import compressed, decibels, denoise, made_up_unet, scene


@pytest.fixture
def made_up() -> OidnUNet:
    return made_up_unet()


@pytest.mark.oidn
@pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed")
@pytest.mark.parametrize("name", ["rt_hdr_alb_nrm_small", "rt_hdr_alb_nrm", "rt_hdr_calb_cnrm_large"])
def test_bfloat16_changes_little(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    exact = load_oidn(name)
    layers = scene(96, 96)
    wanted, rounded = denoise(exact, *layers), denoise(round_unet(exact), *layers)
    # Layer by layer, as each rounds what it is given.
    monkeypatch.setattr(convolution, "_FUSED", frozenset())
    monkeypatch.setattr(unet, "can_upsample", lambda *_: False)
    monkeypatch.setattr(unet, "can_project", lambda _: False)
    plain = denoise(as_they_are(exact), *layers)
    monkeypatch.setattr(nn.Conv2d, "_conv_forward", convolve_exactly)
    emulated = denoise(round_unet(exact), *layers)
    error, exact_sums, naive = (decibels(compressed(x), compressed(wanted)) for x in (rounded, emulated, plain))
    # With sums in float32 as with the weights cast as they are, so that no processor's units decide: 63.4 to 64.4
    # dB, where those weights give 59.5 to 62.0.
    assert exact_sums > naive + 2
    # AVX2, AVX-512 with and without bfloat16, and AMX add up in orders of their own: 0.3 to 1.3 dB less.
    assert error > exact_sums - 1.5
    assert abs(float(emulated.mean() / wanted.mean()) - 1) < 4e-3  # 0.23 % measured
    assert abs(float(rounded.mean() / wanted.mean()) - 1) < 1e-2  # 0.7 % was measured without bf16 units


def convolve_exactly(layer: nn.Conv2d, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """The convolution of a layer, summed in float32 and rounded to the type of what it is given."""
    return functional.conv2d(x.float(), weight.float(), bias.float(), padding=1).to(x.dtype)


def as_they_are(model: OidnUNet) -> OidnUNet:
    """The weights cast to bfloat16, and nothing done about it."""
    plain = build_unet({name: value.clone() for name, value in model.state_dict().items()})
    for layer in plain.convolutions:
        for parameter in layer.parameters():
            parameter.data = parameter.data.bfloat16().float()
        layer.register_forward_pre_hook(lambda _, inputs: (inputs[0].bfloat16().float(),))
    return plain


def test_rounding_leaves_the_trunk_alone(made_up: OidnUNet) -> None:
    before = {name: value.clone() for name, value in made_up.state_dict().items()}
    rounded = round_unet(made_up)
    assert rounded.first.weight.dtype == torch.bfloat16
    assert rounded.last.weight.dtype == torch.float32
    assert list(before) == list(made_up.state_dict())
    for name, value in made_up.state_dict().items():
        assert torch.equal(value, before[name])


def test_rounded_taps_keep_their_sums(made_up: OidnUNet) -> None:
    exact, rounded = (model.first.weight.detach().double() for model in (made_up, round_unet(made_up)))
    # Half a step of the least tap, in place of that of the greatest: a sum may lie anywhere between.
    error = (rounded - exact).sum((2, 3)).abs()
    naive = (exact.bfloat16().double() - exact).sum((2, 3)).abs()
    assert float(error.mean()) < 0.1 * float(naive.mean())
    # No tap moves by more than a step of its own and the error of those before it.
    assert float((rounded - exact).abs().max()) <= 2 * float(exact.abs().max()) * 2**-8
