"""Kernels, losses, metrics and the network at their limits: finite, normalised, local."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.seldom import seldom

torch = pytest.importorskip("torch")

from hybrid.alignment.transfer import measure_exposure  # noqa: E402
from hybrid.comparison import metrics  # noqa: E402
from network import robust_unet  # noqa: E402
from network.checkpoint import load_model, shipped_weights  # noqa: E402
from network.paper import models as paper  # noqa: E402
from network.paper.inputs import KernelWindow  # noqa: E402
from network.paper.kernels import apply_kernels, mean_of, predict_kernel  # noqa: E402
from network.paper.ravg import ravg  # noqa: E402
from network.presets import build_preset  # noqa: E402
from network.robust_average import UNetWindow  # noqa: E402
from network.training import losses  # noqa: E402
from network.training.perceptual import VGG19, Perceptual  # noqa: E402

pytestmark = pytest.mark.neural
EXAMPLES = 40
anything = settings(max_examples=EXAMPLES, deadline=None, derandomize=True)

RAW = {
    "all below": -1.0,
    "all nought": 0.0,
    "denormal": 1e-42,
    "at the threshold": 0.5 / 125,
    "equal": 1.0,
    "half's limit": 6.5e4,
    "where exp overflows": 89.0,
    "1e30": 1e30,
    "-1e30": -1e30,
}


@pytest.mark.parametrize("spread", [0.0, 1.0])
@pytest.mark.parametrize("level", RAW.values(), ids=RAW)
def test_kernels_are_convex_whatever_they_are_made_of(level, spread):
    torch.manual_seed(0)
    weights = torch.full((1, 125, 3, 4), level) * (1 + spread * torch.rand(1, 125, 3, 4))
    weights.requires_grad_()
    kernel = predict_kernel(weights, centre=62)
    assert bool(torch.isfinite(kernel).all())
    assert float(kernel.detach().min()) >= 0
    # 125 roundings
    torch.testing.assert_close(kernel.sum(1), torch.ones(1, 3, 4), rtol=0, atol=2e-5)
    numerators, denominators = apply_kernels(kernel, torch.rand(1, 5, 3, 3, 4) * 1e6)
    image = mean_of(numerators, denominators, torch.zeros(1, 3, 3, 4))
    image.sum().backward()
    assert bool(torch.isfinite(image).all())
    assert bool(torch.isfinite(weights.grad).all())


@anything
@given(st.integers(0, 2**32 - 1), st.integers(1, 7), st.sampled_from([1e-42, 1.0, 1e6, 1e30]))
def test_the_robust_average_is_in_range_in_any_precision(seed, frames, scale):
    generator = torch.Generator().manual_seed(seed)
    window = torch.randn(frames, 4, 4, generator=generator) * scale
    for dtype in (torch.float32, torch.bfloat16):
        x = window.to(dtype)
        average = ravg(x.unbind(0))
        assert bool((average >= x.min(0).values).all())
        assert bool((average <= x.max(0).values).all())


LOSSES = {"l1": losses.l1, "smape": losses.smape, "relmse": losses.relmse}
PICTURES = {
    "nought": (0.0, 0.0),
    "equal": (1.0, 1.0),
    "firefly in the target": (1.0, 1e6),
    "firefly in the prediction": (1e6, 1.0),
    "negative": (-1.0, 1.0),
    "denormal": (1e-42, 0.0),
    "1e18": (1e18, 1.0),
}


def check_loss(loss, pair, size, scales):
    prediction = torch.full((len(scales), 3, size, size), pair[0], requires_grad=True)
    target = torch.full_like(prediction, pair[1], requires_grad=False)
    target[:, :, 0, 0] = pair[0]
    value = loss(prediction, target, torch.tensor(scales))
    value.sum().backward()
    assert bool(torch.isfinite(value).all())
    assert bool(torch.isfinite(prediction.grad).all())


@pytest.mark.parametrize("pair", PICTURES.values(), ids=PICTURES)
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_losses_and_their_gradients_are_finite(loss, pair):
    check_loss(loss, pair, 8, [1.0, 1e-3])


@pytest.fixture(scope="module")
def perceptual():
    """The loss of VGG19 with random weights, which keep the features' size."""
    generator = torch.Generator().manual_seed(0)
    vgg = VGG19()
    with torch.no_grad():
        for parameter in vgg.parameters():
            fan = parameter[0].numel() if parameter.ndim == 4 else 100
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * (2 / fan) ** 0.5)
    return Perceptual(vgg)


@pytest.mark.parametrize("pair", PICTURES.values(), ids=PICTURES)
def test_the_perceptual_loss_and_its_gradient_are_finite(perceptual, pair):
    check_loss(perceptual, pair, 32, [1.0])


def run(model, window: dict[str, torch.Tensor]) -> torch.Tensor:
    """The irradiance of a window."""
    if isinstance(model, robust_unet.RobustUNet):
        names = ("estimate", "residual", "confidence", "modulation", "exposure", "gain")
        return model(UNetWindow(*(window[name] for name in names))).irradiance
    inputs = KernelWindow(window["color"], window["confidence"], window["exposure"])
    return paper.filter_window(model, inputs).irradiance


def hard_window(level: float) -> dict[str, torch.Tensor]:
    """Noise around a level with one firefly, frames that are trusted or not, and estimates that lack the firefly."""
    torch.manual_seed(1)
    color = torch.rand(1, 5, 3, 32, 32) * level
    estimate = color.mean((-2, -1), keepdim=True).expand_as(color)
    color[0, 2, :, 5, 5] = 1e6
    confidence = torch.randint(0, 2, (1, 5, 1, 32, 32)).float()
    exposure = torch.tensor([measure_exposure(color[0].movedim(1, -1).reshape(-1, 32, 3).numpy())])
    return {
        "color": color,
        "estimate": estimate,
        "residual": color - estimate,
        "confidence": confidence,
        "modulation": torch.ones(1, 3, 32, 32),
        "exposure": exposure,
        "gain": 0.18 / exposure,
    }


@pytest.mark.parametrize("preset", ["balanced", "unet"])
@pytest.mark.parametrize("level", [0.0, 1e-42, 1e6])
def test_the_gradient_of_the_whole_network_is_finite(level, preset):
    model, window = build_preset(preset), hard_window(level)
    image = run(model, window)
    losses.relmse(image, window["color"][:, 2], window["exposure"]).sum().backward()
    assert bool(torch.isfinite(image).all())
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    assert len(gradients) > 10
    assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)


@pytest.mark.parametrize("bfloat16", [False, *seldom(True)], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("preset", [None, "balanced", "quality"], ids=["unet", "balanced", "quality"])
def test_a_firefly_changes_little_around_it_and_nothing_far_away(preset, bfloat16):
    """92 pixels are what a unet can see in theory, 112 what a trunk can."""
    torch.manual_seed(0)
    if preset is None:
        model = paper.for_inference(build_preset("unet"), bfloat16)
    else:
        model = robust_unet.for_inference(load_model(shipped_weights(preset)), bfloat16)
    frames = model.frames
    color, half = torch.rand(1, frames, 3, 48, 192), torch.full((1,), 0.5)
    estimate, confidence = torch.full_like(color, 0.5), torch.ones(1, frames, 1, 48, 192)
    window = {"color": color, "estimate": estimate, "confidence": confidence, "exposure": half, "gain": half}
    window |= {"residual": color - estimate, "modulation": torch.ones(1, 3, 48, 192)}
    with torch.inference_mode():
        plain = run(model, window)
    for name in ("color", "residual"):
        window[name][0, 1, :, 30, 20] += 1e4
    with torch.inference_mode():
        change = (run(model, window) - plain).abs().amax((0, 1, 2))
    assert float(change.max()) > 0
    assert preset is None or float(change.max()) < 3  # six times the light, in one frame of five or seven
    assert not bool(change[20 + 112 :].any())


IMAGES = {
    "nought": np.zeros((16, 16, 3), np.float32),
    "constant": np.full((16, 16, 3), 0.5, np.float32),
    "firefly": np.where(np.arange(256).reshape(16, 16, 1) == 7, np.float32(1e6), np.float32(0.5)).repeat(3, -1),
    "denormal": np.full((16, 16, 3), 1e-42, np.float32),
    "negative": np.full((16, 16, 3), -1, np.float32),
}


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
def test_metrics_are_numbers(image):
    reference = IMAGES["constant"]
    assert metrics.psnr(image, reference) > 0
    assert np.isfinite(metrics.ssim(image, reference))
    assert metrics.relmse(image, reference) >= 0
    assert 0 <= metrics.smape(image, reference) <= 1
    assert metrics.psnr(reference, reference) == np.inf
    black = np.zeros_like(reference)
    assert np.isfinite(metrics.relmse(image, black))
    assert np.isfinite(metrics.smape(image, black))
