"""The final stage: what its frames are, where they meet, and what it is before any training."""

# ruff: noqa: E402 - nothing of network can be imported before it is known that torch is there

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch.nn import functional

from network import strips as strips_module
from network.oidn_weights import find_library, load_oidn
from network.robust_unet import (
    AVERAGE_BLEND,
    RobustUNet,
    RobustUNetConfig,
    denoise_window,
    for_inference,
    pack_inputs,
    pool_samples,
    start_from_oidn,
)
from network.transfer import pu_forward, pu_inverse
from network.windows import UNetWindow
from nlm import pooling

pytestmark = pytest.mark.neural


def library_is_there() -> bool:
    try:
        find_library()
    except FileNotFoundError:
        return False
    return True


needs_oidn = pytest.mark.skipif(not library_is_there(), reason="pyoidn is not installed")


def uniform(*shape: int, seed: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def make_window(t: int = 5, h: int = 32, w: int = 48) -> UNetWindow:
    """A picture of waves under noise, seen by frames that are trusted here and there."""
    y, x = torch.meshgrid(torch.linspace(0, 3, h), torch.linspace(0, 4, w), indexing="ij")
    clean = (1.2 + torch.sin(2 * x + y) * torch.cos(3 * y))[None, None, None].expand(1, t, 3, h, w)
    noisy = clean * -uniform(1, t, 3, h, w, seed=1).clamp_min(1e-3).log()  # exponential: skewed, mean 1
    confidence = (uniform(1, t, 1, h, w, seed=2) + 0.2).clamp(max=1)
    confidence[:, t // 2] = 1
    guides = torch.full((1, 3, h, w), 0.5), torch.zeros(1, 3, h, w)
    modulation, gain = torch.full((1, 3, h, w), 0.6), torch.full((1,), 0.3)
    return UNetWindow(clean, noisy - clean, confidence, modulation, torch.ones(1), gain, *guides)


def image_of(model: RobustUNet, window: UNetWindow) -> torch.Tensor:
    """The irradiance of a window, as running makes it."""
    with torch.no_grad():
        return denoise_window(model, window).irradiance


def small(frames: int = 5, scales: tuple[int, ...] = (0,)) -> RobustUNet:
    torch.manual_seed(0)
    model = RobustUNet(RobustUNetConfig(frames, "small", scales)).eval().requires_grad_(False)
    model.backbone.last.bias.fill_(0.3)  # else much of an untrained picture is black
    return model


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    a, b = a / (1 + a), b / (1 + b)
    return float(-10 * (a - b).square().mean().log10())


# Inputs


def test_the_frames_are_what_is_gathered_by_hand() -> None:
    window = make_window()
    window.residual[0, 1, :, 4, 4] = 1e4  # a firefly, held to six times the light in both
    found = pool_samples(window)
    frames, residuals = (layer[0].permute(0, 2, 3, 1).numpy() for layer in window[:2])
    by_hand = pooling.pool_samples(frames, residuals, window.confidence[0, :, 0].numpy(), 1.0)
    gathered = found.parts.sum(1)[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(gathered, by_hand.image, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.samples[0, 0].numpy() * 5, by_hand.samples, rtol=1e-4)
    for average, tolerance in ((found.average, 1e-5), (pu_inverse(found.encoded_average) / (0.6 * 0.3), 1e-3)):
        np.testing.assert_allclose(average[0].permute(1, 2, 0).numpy(), by_hand.average, rtol=tolerance)


def test_the_mean_of_the_frames_is_the_gathered_picture() -> None:
    """On the transfer curve, which is concave: the mean of noisy frames would be darker than their light."""
    found = pool_samples(make_window())
    torch.testing.assert_close(found.frames.mean(1), found.pooled, rtol=0, atol=1e-6)
    assert float(found.frames.std(1).mean()) > 0.03  # and they are noisy, each by itself


def test_a_frame_without_confidence_shows_the_centres_noise() -> None:
    window = make_window()
    window.confidence[:, [0, 1, 3, 4]] = 0
    found = pool_samples(window)
    for t in (0, 1, 3, 4):
        torch.testing.assert_close(found.frames[:, t], found.frames[:, 2], rtol=0, atol=1e-6)
    torch.testing.assert_close(found.samples, torch.full_like(found.samples, 1 / 5))


def test_where_no_frame_is_trusted_the_centre_is() -> None:
    window = make_window()
    window.confidence[:] = 0
    window.residual[:, 2, :, :, 10:] = 0
    found = pool_samples(window)
    assert bool(torch.isfinite(found.frames).all())
    noisy = (window.first_pass + window.residual)[:, 2]
    torch.testing.assert_close(found.parts.sum(1)[..., 10:], noisy[..., 10:])


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_it_scales_with_the_radiance(scale: float) -> None:
    window, model = make_window(), small()
    light = {name: getattr(window, name) * scale for name in ("first_pass", "residual", "exposure")}
    other = window._replace(**light, gain=window.gain / scale)
    images = [image_of(model, values) for values in (window, other)]
    torch.testing.assert_close(images[1], images[0] * scale, rtol=1e-3, atol=1e-4 * scale)


# The network


@needs_oidn
def test_untrained_it_is_as_good_as_gathering_by_hand() -> None:
    """And without its blocks it is not: the frames meet in them."""
    window = make_window(h=64, w=96)
    found, inputs = pool_samples(window), pack_inputs(window)
    model, alone = start_from_oidn(small()), start_from_oidn(small(scales=()))
    by_hand = inputs.frames.clone()
    by_hand[:, :3] = found.pooled
    cases = (model, inputs.frames), (alone, by_hand), (alone, inputs.frames)
    encoded = [network(frames, inputs.shared, inputs.static)[0] for network, frames in cases]
    clean = window.first_pass[:, 0] * 0.6
    quality = [psnr(pu_inverse(image.clamp_min(0)) / 0.3, clean) for image in encoded]
    assert quality[0] > quality[1] - 0.3
    assert quality[0] > quality[2] + 0.5


@needs_oidn
def test_its_backbone_is_oidns() -> None:
    model = start_from_oidn(small())
    wanted = load_oidn("rt_hdr_alb_nrm_small").state_dict()
    assert all(torch.equal(value, wanted[name]) for name, value in model.backbone.state_dict().items())


def test_the_picture_is_half_the_networks_before_training() -> None:
    model, window = small(), make_window()
    inputs = pack_inputs(window)
    encoded, blend = model(*inputs[:3])
    torch.testing.assert_close(blend, torch.full_like(blend, AVERAGE_BLEND["small"]))
    wanted = 0.5 * (pu_inverse(encoded.clamp_min(0)) / (0.6 * 0.3) + inputs.average)
    torch.testing.assert_close(image_of(model, window), wanted, rtol=1e-5, atol=1e-6)


def test_a_trained_share_of_the_average_varies_by_pixel() -> None:
    """Weights of nothing are not computed with; others are, in running as in training."""
    model, window = small(), make_window()
    model.average_blend.weight.data.normal_(generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        running = model(*pack_inputs(window)[:3])[1]
    assert float(running.std()) > 0.01
    with torch.enable_grad():
        torch.testing.assert_close(model(*pack_inputs(window)[:3])[1], running, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("scales", [(), (0,), (0, 2), (1, 4), (0, 1, 2, 3, 4)])
def test_blocks_may_be_at_any_scale(scales: tuple[int, ...]) -> None:
    """The frames reach the last block, and no farther: another frame changes the picture if there is one."""
    model, inputs = small(scales=scales), pack_inputs(make_window())
    changed = inputs.frames.clone()
    changed[0, :3] += 0.2
    images = [model(frames, inputs.shared, inputs.static)[0] for frames in (inputs.frames, changed)]
    assert bool((images[0] != images[1]).any()) == bool(scales)


def test_aux_features_enter_once_they_are_trained() -> None:
    model, inputs = small(), pack_inputs(make_window())
    halved = inputs.shared.clone()
    halved[:, 6:] *= 0.5
    before = [model(inputs.frames, shared, inputs.static)[0] for shared in (inputs.shared, halved)]
    assert torch.equal(*before)
    model.aux_conv.weight.data.fill_(0.1)
    after = [model(inputs.frames, shared, inputs.static)[0] for shared in (inputs.shared, halved)]
    assert not torch.equal(after[0], before[0])
    assert not torch.equal(*after)


def test_inputs_are_in_the_order_that_weights_are_trained_for() -> None:
    window = make_window()
    found, inputs = pool_samples(window), pack_inputs(window)
    torch.testing.assert_close(inputs.frames, torch.cat([found.frames, found.confidence], 2)[0])
    guides = torch.cat([window.albedo, window.normal * 0.5 + 0.5], 1)
    torch.testing.assert_close(inputs.shared, torch.cat([guides, found.encoded_average, found.samples], 1))
    torch.testing.assert_close(inputs.static, torch.cat([found.pooled, guides], 1))


def test_shared_channels_are_convolved_once() -> None:
    """As if each frame had them, with weights that are trained."""
    window = make_window()._replace(albedo=uniform(1, 3, 32, 48, seed=3), normal=uniform(1, 3, 32, 48, seed=4))
    model, found, inputs = small(), pool_samples(window), pack_inputs(window)
    model.aux_conv.weight.data.normal_(generator=torch.Generator().manual_seed(1))
    shared = [inputs.shared[:, :6], found.encoded_average]
    parts = [found.frames[0], *(layer.expand(5, -1, -1, -1) for layer in shared), found.confidence[0]]
    each = torch.cat([*parts, found.samples.expand(5, -1, -1, -1)], 1)
    weight = torch.cat([model.backbone.first.weight, model.aux_conv.weight], 1)
    entered: list[torch.Tensor] = []
    # The terms of each frame, and those that frames share, which the block adds to its result.
    model.robust_average["0"].register_forward_pre_hook(lambda _, given: entered.append(given[0] + given[3]))
    model.encode_and_fuse(inputs.frames, inputs.shared)
    wanted = functional.conv2d(each, weight, model.backbone.first.bias, padding=1)
    # Sums of 126 products of about 1, in another order.
    torch.testing.assert_close(entered[0], wanted, rtol=1e-4, atol=1e-4)


def test_strips_and_the_whole_are_one_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Running goes over some rows at a time, training over all."""
    window, model = make_window(), small(scales=(0, 1))
    with torch.enable_grad():
        whole = denoise_window(model, window).irradiance
    monkeypatch.setattr(strips_module, "ROWS", 16)
    torch.testing.assert_close(image_of(model, window), whole, rtol=1e-4, atol=1e-6)


@needs_oidn
def test_bfloat16_is_close() -> None:
    window = make_window(h=64, w=96)
    exact = image_of(start_from_oidn(small()), window)
    rounded = image_of(for_inference(start_from_oidn(small()), True), window)
    assert psnr(rounded, exact) > 50
    assert float(rounded.mean() / exact.mean()) == pytest.approx(1, abs=3e-3)


def test_without_guides_it_runs() -> None:
    window = make_window()._replace(albedo=None, normal=None)
    with torch.no_grad():
        parts, weights = denoise_window(small(), window).parts()
    torch.testing.assert_close(weights.sum(1), torch.ones_like(weights[:, 0]))
    torch.testing.assert_close(pool_samples(window).pooled, pu_forward((parts.sum(1) * 0.6 * 0.3).clamp_min(0)))


def test_windows_that_do_not_fit_are_refused() -> None:
    model = small()
    with pytest.raises(ValueError, match="frames: expected 5, got 3"):
        model(torch.rand(3, 4, 16, 16), torch.rand(1, 10, 16, 16), torch.rand(1, 9, 16, 16))
    with torch.no_grad(), pytest.raises(ValueError, match="frames: expected 3, got 5"):
        denoise_window(small(frames=3), make_window(5))
    with pytest.raises(ValueError, match="width that is a multiple of 16, got 20"):
        model(torch.rand(5, 4, 16, 20), torch.rand(1, 10, 16, 20), torch.rand(1, 9, 16, 20))
    with pytest.raises(ValueError, match="frames: expected an odd number"):
        RobustUNetConfig(4)
    with pytest.raises(ValueError, match="size: expected one of small, base, large"):
        RobustUNetConfig(size="huge")
    with pytest.raises(ValueError, match="ra_scales: expected scales 0 to 4"):
        RobustUNetConfig(ra_scales=(5,))
