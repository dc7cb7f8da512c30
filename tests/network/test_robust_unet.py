"""The final stage: what its frames are, where they meet, and what it is before any training."""

# ruff: noqa: E402 - nothing of network can be imported before it is known that torch is there

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch.nn import functional

from network import unet as trunk
from network.models import denoise_tile, filter_window, for_inference
from network.robust_unet import KEEP, RobustUNet, RobustUNetConfig, realise, start_from_oidn
from network.unet import find_library, load_oidn, pu_forward, pu_inverse
from nlm.pooling import pool_samples

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


def make_window(t: int = 5, h: int = 32, w: int = 48) -> dict[str, torch.Tensor]:
    """A picture of waves under noise, seen by frames that are trusted here and there."""
    y, x = torch.meshgrid(torch.linspace(0, 3, h), torch.linspace(0, 4, w), indexing="ij")
    clean = (1.2 + torch.sin(2 * x + y) * torch.cos(3 * y))[None, None, None].expand(1, t, 3, h, w)
    noisy = clean * -uniform(1, t, 3, h, w, seed=1).clamp_min(1e-3).log()  # exponential: skewed, mean 1
    confidence = (uniform(1, t, 1, h, w, seed=2) + 0.2).clamp(max=1)
    confidence[:, t // 2] = 1
    return {
        "estimate": clean,
        "residual": noisy - clean,
        "confidence": confidence,
        "albedo": torch.full((1, t, 3, h, w), 0.5),
        "normal": torch.zeros(1, t, 3, h, w),
        "modulation": torch.full((1, 3, h, w), 0.6),
        "exposure": torch.ones(1),
        "gain": torch.full((1,), 0.3),
        "clean": clean[:, 0] * 0.6,
    }


NAMES = ("estimate", "residual", "confidence", "modulation", "exposure", "gain")


def realised(window: dict[str, torch.Tensor]):
    return realise(**{name: window[name] for name in NAMES})


def small(frames: int = 5, scales: tuple[int, ...] = (0,)) -> RobustUNet:
    torch.manual_seed(0)
    model = RobustUNet(RobustUNetConfig(frames, "small", scales)).eval().requires_grad_(False)
    model.trunk.last.bias.fill_(0.3)  # else much of an untrained picture is black
    return model


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    a, b = a / (1 + a), b / (1 + b)
    return float(-10 * (a - b).square().mean().log10())


# What enters


def test_the_frames_are_what_is_gathered_by_hand() -> None:
    window = make_window()
    window["residual"][0, 1, :, 4, 4] = 1e4  # a firefly, held to six times the light in both
    found = realised(window)
    frames, residuals = (window[name][0].permute(0, 2, 3, 1).numpy() for name in ("estimate", "residual"))
    by_hand = pool_samples(frames, residuals, window["confidence"][0, :, 0].numpy(), 1.0)
    gathered = found.parts.sum(1)[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(gathered, by_hand.image, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.samples[0, 0].numpy() * 5, by_hand.samples, rtol=1e-4)
    average = pu_inverse(found.average) / found.scale
    np.testing.assert_allclose(average[0].permute(1, 2, 0).numpy(), by_hand.average, rtol=1e-3)


def test_the_mean_of_the_frames_is_the_gathered_picture() -> None:
    """On the transfer curve, which is concave: the mean of noisy frames would be darker than their light."""
    found = realised(make_window())
    torch.testing.assert_close(found.frames.mean(1), found.picture, rtol=0, atol=1e-6)
    assert float(found.frames.std(1).mean()) > 0.03  # and they are noisy, each by itself


def test_a_frame_without_confidence_shows_the_centres_noise() -> None:
    window = make_window()
    window["confidence"][:, [0, 1, 3, 4]] = 0
    found = realised(window)
    for t in (0, 1, 3, 4):
        torch.testing.assert_close(found.frames[:, t], found.frames[:, 2], rtol=0, atol=1e-6)
    torch.testing.assert_close(found.samples, torch.full_like(found.samples, 1 / 5))


def test_where_no_frame_is_trusted_the_centre_is() -> None:
    window = make_window()
    window["confidence"][:] = 0
    window["residual"][:, 2, :, :, 10:] = 0
    found = realised(window)
    assert bool(torch.isfinite(found.frames).all())
    noisy = (window["estimate"] + window["residual"])[:, 2]
    torch.testing.assert_close(found.parts.sum(1)[..., 10:], noisy[..., 10:])


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_it_scales_with_the_radiance(scale: float) -> None:
    window, model = make_window(), small()
    other = {n: v * scale if n in ("estimate", "residual", "exposure") else v for n, v in window.items()}
    other["gain"] = window["gain"] / scale
    images = [denoise_tile(model, values)[0] for values in (window, other)]
    torch.testing.assert_close(images[1], images[0] * scale, rtol=1e-3, atol=1e-4 * scale)


# The network


@needs_oidn
def test_untrained_it_is_as_good_as_gathering_by_hand() -> None:
    """And without its blocks it is not: the frames meet in them."""
    window = make_window(h=64, w=96)
    model = start_from_oidn(small())
    found = realised(window)
    guides = window["albedo"][:, 2], window["normal"][:, 2]
    still = torch.cat([found.picture, guides[0], guides[1] * 0.5 + 0.5], 1)
    alone, known = start_from_oidn(small(scales=())), torch.zeros(1, 5, 5, 64, 96)
    by_hand = found.picture[:, None].expand_as(found.frames)
    seen = [
        net(frames, still, known)[0] for net, frames in ((model, found.frames), (alone, by_hand), (alone, found.frames))
    ]
    quality = [psnr(pu_inverse(image.clamp_min(0)) / 0.3, window["clean"]) for image in seen]
    assert quality[0] > quality[1] - 0.3
    assert quality[0] > quality[2] + 0.5


@needs_oidn
def test_its_trunk_is_oidns() -> None:
    model = start_from_oidn(small())
    wanted = load_oidn("rt_hdr_alb_nrm_small").state_dict()
    assert all(torch.equal(value, wanted[name]) for name, value in model.trunk.state_dict().items())


def test_the_picture_is_half_the_networks_before_training() -> None:
    model, window = small(), make_window()
    found = realised(window)
    guides = window["albedo"][:, 2], window["normal"][:, 2]
    still = torch.cat([found.picture, guides[0], guides[1] * 0.5 + 0.5], 1)
    seen, keep = model(found.frames, still, torch.zeros(1, 5, 5, 32, 48))
    torch.testing.assert_close(keep, torch.full_like(keep, KEEP["small"]))
    light = pu_inverse(seen.clamp_min(0)) / found.scale
    wanted = 0.5 * (light + found.estimate)
    torch.testing.assert_close(denoise_tile(model, window)[0], wanted, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("scales", [(), (0,), (0, 2), (1, 4), (0, 1, 2, 3, 4)])
def test_blocks_may_be_at_any_scale(scales: tuple[int, ...]) -> None:
    """The frames reach the last block, and no farther: another frame changes the picture if there is one."""
    model, window = small(scales=scales), make_window()
    found = realised(window)
    frames = found.frames.clone()
    frames[:, 0] += 0.2
    still, known = torch.rand(1, 9, 32, 48), torch.zeros(1, 5, 5, 32, 48)
    pictures = [model(values, still, known)[0] for values in (found.frames, frames)]
    assert bool((pictures[0] != pictures[1]).any()) == bool(scales)


def test_what_it_knows_enters_once_it_is_trained() -> None:
    model, found = small(), realised(make_window())
    still, known = torch.rand(1, 9, 32, 48), uniform(1, 5, 5, 32, 48, seed=5)
    before = [model(found.frames, still, value)[0] for value in (known, 0.5 * known)]
    assert torch.equal(*before)
    model.known.weight.data.fill_(0.1)
    after = [model(found.frames, still, value)[0] for value in (known, 0.5 * known)]
    assert not torch.equal(after[0], before[0])
    assert not torch.equal(*after)


def test_the_network_is_told_what_the_gather_knows() -> None:
    """Average, confidence and samples, in this order: weights are trained for it."""
    window, model = make_window(), small()
    given: list[tuple[torch.Tensor, ...]] = []
    model.meet = lambda *layers: given.append(layers) or torch.zeros(1, 32, 16, 24)  # type: ignore[method-assign]
    denoise_tile(model, window)
    ((own, alike),) = given
    found = realised(window)
    torch.testing.assert_close(own[:, 3:], found.confidence[0])
    torch.testing.assert_close(alike[:, 6:], torch.cat([found.average, found.samples], 1))


def test_what_frames_have_alike_is_convolved_once() -> None:
    """As if each frame had it, with weights that are trained."""
    model, found = small(), realised(make_window())
    model.known.weight.data.normal_(generator=torch.Generator().manual_seed(1))
    known = torch.cat([layer.expand(1, 5, -1, -1, -1) for layer in (found.average[:, None], found.confidence)], 2)
    known = torch.cat([known, found.samples[:, None].expand(1, 5, -1, -1, -1)], 2)
    still = torch.cat([found.picture, uniform(1, 6, 32, 48, seed=3)], 1)
    each = torch.cat([found.frames, still[:, None, 3:].expand(1, 5, -1, -1, -1), known], 2)[0]
    weight = torch.cat([model.trunk.first.weight, model.known.weight], 1)
    entered: list[torch.Tensor] = []
    model.average["0"].register_forward_pre_hook(lambda _, given: entered.append(given[0].clone()))
    model.meet(*model.lay_out(found.frames, still, known))
    wanted = functional.conv2d(each, weight, model.trunk.first.bias, padding=1)
    # Sums of 126 products of about 1, in another order.
    torch.testing.assert_close(entered[0], wanted, rtol=1e-4, atol=1e-4)


def test_strips_and_the_whole_are_one_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Running goes over some rows at a time, training over all."""
    window, model = make_window(), small(scales=(0, 1))
    with torch.enable_grad():
        whole = filter_window(model, window)
    monkeypatch.setattr(trunk, "ROWS", 12)
    strips = denoise_tile(model, window)[1]
    torch.testing.assert_close(strips.irradiance, whole.irradiance, rtol=1e-4, atol=1e-6)


@needs_oidn
def test_bfloat16_is_close() -> None:
    window = make_window(h=64, w=96)
    exact = denoise_tile(start_from_oidn(small()), window)[0]
    rounded = denoise_tile(for_inference(start_from_oidn(small()), True), window)[0]
    assert psnr(rounded, exact) > 50
    assert float(rounded.mean() / exact.mean()) == pytest.approx(1, abs=3e-3)


def test_without_guides_it_runs() -> None:
    window = make_window()
    _, picture, aovs = denoise_tile(small(), window | {"albedo": None, "normal": None})
    assert aovs is None
    parts, weights = picture.parts()
    torch.testing.assert_close(weights.sum(1), torch.ones_like(weights[:, 0]))
    torch.testing.assert_close(realised(window).picture, pu_forward((parts.sum(1) * 0.6 * 0.3).clamp_min(0)))


def test_what_does_not_fit_is_refused() -> None:
    model = small()
    with pytest.raises(ValueError, match="frames: expected 5, got 3"):
        model(torch.rand(1, 3, 3, 16, 16), torch.rand(1, 9, 16, 16), torch.rand(1, 3, 5, 16, 16))
    with torch.no_grad(), pytest.raises(ValueError, match="frames: expected 3, got 5"):
        denoise_tile(small(frames=3), make_window(5))
    with pytest.raises(ValueError, match="width that is a multiple of 16, got 20"):
        model(torch.rand(1, 5, 3, 16, 20), torch.rand(1, 9, 16, 20), torch.rand(1, 5, 5, 16, 20))
    with pytest.raises(ValueError, match="frames: expected an odd number"):
        RobustUNetConfig(4)
    with pytest.raises(ValueError, match="size: expected one of small, base, large"):
        RobustUNetConfig(size="huge")
    with pytest.raises(ValueError, match="ra_scales: expected scales 0 to 4"):
        RobustUNetConfig(ra_scales=(5,))
