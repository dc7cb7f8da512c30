"""OIDN's U-Net: OIDN's own pictures where pyoidn is installed."""

from importlib.util import find_spec

import pytest
import torch
from torch import nn

from network import unet
from network.bfloat16 import round_unet
from network.cpu import convolution
from network.oidn_weights import load_oidn
from network.unet import OidnUNet, OidnUNetConfig, denoise_albedo, denoise_normal
from tests.network.oidn_like import as_image, as_tensor, compressed, decibels, denoise, made_up_unet, scene

needs_oidn = [pytest.mark.oidn, pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed")]


@pytest.fixture
def made_up() -> OidnUNet:
    return made_up_unet()


class TestOidn:
    pytestmark = needs_oidn

    @pytest.mark.parametrize(
        ("name", "inputs", "quality", "clean"),
        [
            ("rt_hdr", 1, "high", False),
            ("rt_hdr_small", 1, "fast", False),
            ("rt_hdr_alb", 2, "high", False),
            ("rt_hdr_alb_small", 2, "fast", False),
            ("rt_hdr_alb_nrm", 3, "high", False),
            ("rt_hdr_alb_nrm_small", 3, "fast", False),
            ("rt_hdr_calb_cnrm", 3, "balanced", True),
            ("rt_hdr_calb_cnrm_small", 3, "fast", True),
            ("rt_hdr_calb_cnrm_large", 3, "high", True),
        ],
    )
    def test_gives_oidns_pictures(self, name: str, inputs: int, quality: str, clean: bool) -> None:
        from hybrid.denoising.oidn import denoise_oidn

        layers = scene()[:inputs]
        expected = denoise_oidn(*map(as_image, layers), quality=quality, clean=clean)  # type: ignore[arg-type]
        result = denoise(load_oidn(name), *layers)
        # 120 dB and more were measured; another network's picture is 40 to 60 dB away.
        assert decibels(compressed(result), compressed(as_tensor(expected))) > 90

    @pytest.mark.parametrize(("quality", "suffix"), [("high", "_large"), ("balanced", "")])
    def test_gives_oidns_guides(self, quality: str, suffix: str) -> None:
        from hybrid.denoising.oidn import _execute

        _, albedo, normal = scene()
        expected = _execute({"albedo": as_image(albedo)}, quality, "cpu")
        assert decibels(denoise_albedo(load_oidn(f"rt_alb{suffix}"), albedo), as_tensor(expected)) > 90
        expected = _execute({"normal": as_image(normal)}, quality, "cpu")
        assert decibels(denoise_normal(load_oidn(f"rt_nrm{suffix}"), normal), as_tensor(expected)) > 90


def test_parameters_are_as_many_as_oidn_says() -> None:
    counts = [
        sum(p.numel() for p in OidnUNet(OidnUNetConfig(9, size)).parameters()) for size in ("small", "base", "large")
    ]
    assert counts == [320035, 919811, 3848387]


def test_sides_must_be_multiples(made_up: OidnUNet) -> None:
    with pytest.raises(ValueError, match="expected a width that is a multiple of 16, got 20"):
        made_up(torch.zeros(1, 9, 16, 20))


@pytest.mark.parametrize("size", [(1, 1), (16, 33), (50, 70)])
def test_any_size(made_up: OidnUNet, size: tuple[int, int]) -> None:
    result = denoise(made_up, *(layer[..., : size[0], : size[1]] for layer in scene()))
    assert result.shape == (1, 3, *size)


def test_features_are_freed_as_they_are_used(made_up: OidnUNet) -> None:
    """Those at half the size, the largest, stayed in memory while the finest scale of the decoder ran."""
    with torch.inference_mode():
        bottleneck, skips = made_up.encode(torch.rand(1, made_up.config.inputs, 32, 32))
        left: list[int] = []
        made_up.decode(bottleneck, skips, lambda features: left.append(len(skips)) or [features])  # type: ignore[func-returns-value]
    assert left == [0]


def test_running_gives_what_training_sees(made_up: OidnUNet) -> None:
    """Without gradients sums are taken in another order (`network.cpu.upsample_conv`)."""
    picture = torch.rand(2, 9, 48, 32, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        running = made_up(picture)
    # The rounding of nine layers of some hundred products each; pictures are in [0, 1].
    torch.testing.assert_close(running, made_up(picture).detach(), rtol=0, atol=1e-5)


def test_pictures_of_a_batch_do_not_see_each_other(made_up: OidnUNet) -> None:
    layers = scene()
    alone = denoise(made_up, *layers)
    both = denoise(made_up, *(torch.cat([layer, layer.flip(3) * 3]) for layer in layers))
    # Float32 sums in another order, times 16 by the curve's exponential.
    torch.testing.assert_close(both[:1], alone, rtol=1e-3, atol=1e-5)


def test_a_scaled_picture_is_denoised_to_a_scaled_one(made_up: OidnUNet) -> None:
    color, *guides = scene()
    result = denoise(made_up, color, *guides)
    # Powers of two change nothing but the exposure's last bits.
    torch.testing.assert_close(denoise(made_up, 64 * color, *guides), 64 * result, rtol=1e-4, atol=1e-5)


def test_what_is_not_finite_does_not_spread(made_up: OidnUNet) -> None:
    color, albedo, normal = scene()
    clean = denoise(made_up, color.index_fill(2, torch.tensor([3]), 0), albedo, normal)
    for layer, value in ((color, torch.nan), (color, -torch.inf), (color, -5.0)):
        broken = layer.clone()
        broken[:, :, 3] = value
        torch.testing.assert_close(denoise(made_up, broken, albedo, normal), clean)
    color[0, :, 5, 5] = torch.inf
    albedo[0, :, 6, 6] = torch.nan
    normal[0, :, 7, 7] = torch.nan
    for model in (made_up, round_unet(made_up)):
        assert bool(denoise(model, color, albedo, normal).isfinite().all())


def test_black_stays_finite(made_up: OidnUNet) -> None:
    black = torch.zeros(1, 3, 20, 20)
    assert bool(denoise(made_up, black, black, black).isfinite().all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_fused_convolutions_give_the_same(made_up, dtype, monkeypatch):
    if dtype not in convolution._FUSED:
        pytest.skip(f"torch without oneDNN, or a processor without {dtype}")
    picture = torch.rand(1, made_up.config.inputs, 48, 64, generator=torch.Generator().manual_seed(1))
    running = round_unet(made_up) if dtype == torch.bfloat16 else made_up
    if dtype == torch.bfloat16:  # where something is added there is one rounding less than apart
        monkeypatch.setattr(unet, "can_upsample", lambda *_: False)
        monkeypatch.setattr(unet, "can_project", lambda _: False)
    apart: list[nn.Module] = []
    for layer in running.modules():
        if isinstance(layer, nn.ReLU):
            layer.register_forward_hook(lambda module, *_: apart.append(module))
    with torch.no_grad():
        fused = running(picture)
        assert not apart
        monkeypatch.setattr(convolution, "_FUSED", frozenset())
        expected = running(picture)
    assert apart
    if dtype == torch.bfloat16:
        assert torch.equal(fused, expected)
    else:
        # Torch has a loop of its own for the smallest pictures, which sums in another order.
        torch.testing.assert_close(fused, expected, rtol=0, atol=1e-5)
