"""The final stage: what it makes of a window before any training, and in which precision."""

import pytest
import torch

from network import strips as strips_module
from network.oidn_weights import find_library, load_oidn
from network.robust_average import UNetWindow, pool
from network.robust_unet import AVERAGE_BLEND, MIRRORED, RobustUNet, RobustUNetConfig, for_inference, start_from_oidn
from network.unet import denoise_color
from tests.network.test_robust_average import make_window, uniform


def library_is_there() -> bool:
    try:
        find_library()
    except FileNotFoundError:
        return False
    return True


needs_oidn = pytest.mark.skipif(not library_is_there(), reason="pyoidn is not installed")


def image_of(model: RobustUNet, window: UNetWindow) -> torch.Tensor:
    """The irradiance of a window, without gradients."""
    with torch.no_grad():
        return model(window).irradiance


def small(frames: int = 5) -> RobustUNet:
    torch.manual_seed(0)
    model = RobustUNet(RobustUNetConfig(frames, "small")).eval().requires_grad_(False)
    model.backbone.last.bias.fill_(0.3)  # else much of an untrained image is black
    return model


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    a, b = a / (1 + a), b / (1 + b)
    return float(-10 * (a - b).square().mean().log10())


def test_the_image_is_the_networks_and_the_average_by_their_shares() -> None:
    """The U-Net runs once, on the pooled image as radiance, with the guides of the centre."""
    model = small()
    window = make_window()._replace(albedo=uniform(1, 3, 32, 48, seed=3), normal=uniform(1, 3, 32, 48, seed=4))
    pooled = pool(window, window.confidence)
    guides, border = (window.albedo, window.normal), (MIRRORED, MIRRORED)
    with torch.no_grad():
        denoised = denoise_color(model.backbone, pooled.image * 0.6, *guides, exposure=0.3, borders=(border, border))
    share = AVERAGE_BLEND["small"]
    wanted = (1 - share) * denoised / 0.6 + share * pooled.average
    torch.testing.assert_close(image_of(model, window), wanted, rtol=1e-5, atol=1e-6)


@needs_oidn
def test_samples_of_all_frames_are_worth_more_than_those_of_one() -> None:
    """The image of the centre alone in place of the block loses what the neighbours know."""
    window, model = make_window(h=64, w=96), start_from_oidn(small())
    alone = torch.zeros_like(window.confidence)
    alone[:, 2] = 1
    clean = window.first_pass[:, 2]
    images = [image_of(model, window._replace(confidence=confidence)) for confidence in (window.confidence, alone)]
    assert psnr(images[0], clean) > psnr(images[1], clean) + 1


def test_a_trained_block_changes_the_image() -> None:
    window, model = make_window(), small()
    before = image_of(model, window)
    torch.nn.init.normal_(model.robust_average.correction[-1].weight, std=0.5)
    assert float((image_of(model, window) - before).abs().mean()) > 1e-3


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_it_scales_with_the_radiance(scale: float) -> None:
    window, model = make_window(), small()
    light = {name: getattr(window, name) * scale for name in ("first_pass", "residual", "exposure")}
    other = window._replace(**light, gain=window.gain / scale)
    images = [image_of(model, values) for values in (window, other)]
    torch.testing.assert_close(images[1], images[0] * scale, rtol=1e-3, atol=1e-4 * scale)


@needs_oidn
def test_its_backbone_is_oidns() -> None:
    model = start_from_oidn(small())
    wanted = load_oidn("rt_hdr_alb_nrm_small").state_dict()
    assert all(torch.equal(value, wanted[name]) for name, value in model.backbone.state_dict().items())


def test_strips_and_the_whole_are_one_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without gradients the network runs on some rows at a time, with them on all."""
    window, model = make_window(), small()
    with torch.enable_grad():
        whole = model(window).irradiance
    monkeypatch.setattr(strips_module, "ROWS", 16)
    torch.testing.assert_close(image_of(model, window), whole, rtol=1e-4, atol=1e-6)


@needs_oidn
def test_bfloat16_is_close() -> None:
    window = make_window(h=64, w=96)
    exact = image_of(start_from_oidn(small()), window)
    rounded = image_of(for_inference(start_from_oidn(small()), True), window)
    assert psnr(rounded, exact) > 50
    assert float(rounded.mean() / exact.mean()) == pytest.approx(1, abs=3e-3)


def test_missing_guides_are_gray_and_without_direction() -> None:
    window, model = make_window(), small()  # whose guides are 0.5 and 0
    assert torch.equal(image_of(model, window), image_of(model, window._replace(albedo=None, normal=None)))


def test_windows_and_configurations_that_do_not_fit_are_refused() -> None:
    with torch.no_grad(), pytest.raises(ValueError, match="frames: expected 3, got 5"):
        small(frames=3)(make_window(5))
    with pytest.raises(ValueError, match="frames: expected an odd number"):
        RobustUNetConfig(4)
    with pytest.raises(ValueError, match="size: expected one of none, small, base, large"):
        RobustUNetConfig(size="huge")
