import numpy as np
import pytest
import torch

from network.robust_average import MOST, RobustAverage, UNetWindow, outermost_first, pool
from nlm import pooling


def uniform(*shape: int, seed: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def make_window(t: int = 5, h: int = 32, w: int = 48) -> UNetWindow:
    """An image of waves under noise, in frames that are trusted here and there."""
    y, x = torch.meshgrid(torch.linspace(0, 3, h), torch.linspace(0, 4, w), indexing="ij")
    clean = (1.2 + torch.sin(2 * x + y) * torch.cos(3 * y))[None, None, None].expand(1, t, 3, h, w)
    noisy = clean * -uniform(1, t, 3, h, w, seed=1).clamp_min(1e-3).log()  # exponential: skewed, mean 1
    first_pass = clean * (1 + 0.02 * (uniform(1, t, 3, h, w, seed=3) - 0.5))
    confidence = (uniform(1, t, 1, h, w, seed=2) + 0.2).clamp(max=1)
    confidence[:, t // 2] = 1
    guides = torch.full((1, 3, h, w), 0.5), torch.zeros(1, 3, h, w)
    modulation, gain = torch.full((1, 3, h, w), 0.6), torch.full((1,), 0.3)
    return UNetWindow(first_pass, noisy - first_pass, confidence, modulation, torch.ones(1), gain, *guides)


def trained(bias: float | None = None) -> RobustAverage:
    """A block whose correction is the same everywhere, or varies from pixel to pixel."""
    torch.manual_seed(0)
    block = RobustAverage().eval().requires_grad_(False)
    if bias is None:
        torch.nn.init.normal_(block.correction[-1].weight, std=0.5)
    else:
        block.correction[-1].bias.fill_(bias)
    return block


def recursion(window: UNetWindow, corrections: dict[int, torch.Tensor]) -> torch.Tensor:
    """The recursion of the docstring, literally, on the frames' images of the centre."""
    images = pool(window, window.confidence).parts * window.confidence.sum(1, keepdim=True) / window.confidence
    order = outermost_first(images.shape[1])
    x, total = images[:, order[0]], window.confidence[:, order[0]]
    for s in order[1:]:
        own = window.confidence[:, s]
        w = torch.sigmoid((total / own).log() + corrections[s])
        x, total = (1 - w) * images[:, s] + w * x, own + total * corrections[s].exp()
    return x


def test_the_outermost_frames_come_first_and_the_centre_last() -> None:
    assert outermost_first(5) == [0, 4, 1, 3, 2]
    assert outermost_first(3) == [0, 2, 1]
    assert outermost_first(1) == [0]


def test_with_f_0_it_is_the_mean_by_confidence() -> None:
    """With and without gradients; and as pooled in one pass over memory, with a firefly that is limited in both."""
    window, block = make_window(), RobustAverage()
    window.residual[0, 1, :, 4, 4] = 1e4
    weights = block(window)  # computed, as in training
    torch.testing.assert_close(weights, window.confidence)
    with torch.no_grad():
        assert block(window) is window.confidence
    pooled = pool(window, weights.detach())
    frames, residuals = (layer[0].permute(0, 2, 3, 1).numpy() for layer in window[:2])
    expected = pooling.pool_samples(frames, residuals, window.confidence[0, :, 0].numpy(), 1.0)
    for found, wanted in ((pooled.image, expected.image), (pooled.average, expected.average)):
        np.testing.assert_allclose(found[0].permute(1, 2, 0).numpy(), wanted, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(pooled.parts.sum(1), pooled.image)
    torch.testing.assert_close(pooled.share.sum(1), torch.ones_like(pooled.share[:, 0]))


@pytest.mark.parametrize("frames", [1, 3, 5, 7])
def test_weights_give_the_result_of_the_recursion(frames: int) -> None:
    """With corrections of each step that differ."""
    window, block, seen = make_window(frames), trained(), {}
    order = iter(outermost_first(frames)[1:])
    correct = block._correct

    def keep(features: torch.Tensor) -> torch.Tensor:
        f = correct(features)
        seen[next(order)] = f
        return f

    block._correct = keep  # type: ignore[method-assign]
    image = pool(window, block(window)).image
    torch.testing.assert_close(image, recursion(window, seen), rtol=1e-4, atol=1e-5)
    plain = pool(window, window.confidence).image
    assert (frames == 1) == bool(torch.equal(image, plain))
    assert all(float(f.abs().max()) <= MOST for f in seen.values())


def test_a_correction_takes_the_centre_or_the_others() -> None:
    """f of −4 at every step leaves the later frame, the centre at last; f of 4 the frames that were visited first."""
    window = make_window()._replace(confidence=torch.ones(1, 5, 1, 32, 48))
    least, most = (pool(window, trained(bias)(window)).share.mean((0, 2, 3, 4)) for bias in (-1e6, 1e6))
    assert float(least[2]) > 0.97
    assert float(most[2]) < 0.01
    assert float(most[0] + most[4]) > 0.97


@pytest.mark.parametrize("bias", [None, 3.0, -3.0])
def test_neighbours_of_no_confidence_leave_the_single_frame(bias: float | None) -> None:
    window, block = make_window(), trained(bias)
    window.confidence[:, [0, 1, 3, 4]] = 0
    pooled = pool(window, block(window))
    centre = pool(window._replace(confidence=torch.ones(1, 5, 1, 32, 48)), torch.eye(5)[2].view(1, 5, 1, 1, 1))
    torch.testing.assert_close(pooled.image, centre.image)
    torch.testing.assert_close(pooled.average, window.first_pass[:, 2])


def test_where_no_frame_is_trusted_the_first_pass_of_the_centre_is() -> None:
    window = make_window()
    window.confidence[:] = 0
    for block in (RobustAverage(), trained()):
        pooled = pool(window, block(window))
        torch.testing.assert_close(pooled.image, window.first_pass[:, 2])
        torch.testing.assert_close(pooled.average, window.first_pass[:, 2])


@pytest.mark.parametrize("scale", [2**-14, 2**14])
def test_weights_do_not_depend_on_the_unit_of_light(scale: float) -> None:
    window, block = make_window(), trained()
    light = {name: getattr(window, name) * scale for name in ("first_pass", "residual", "exposure")}
    other = window._replace(**light, gain=window.gain / scale)
    torch.testing.assert_close(block(other), block(window))


def test_gradients_reach_the_correction_and_are_finite() -> None:
    window, block = make_window(), RobustAverage()
    window.confidence[:, 0] = 0
    window.residual[0, 2, :, 3, 3] = 1e6
    image = pool(window, block(window)).image
    (image - window.first_pass[:, 2]).square().mean().backward()
    last = block.correction[-1]
    assert float(last.weight.grad.abs().max()) > 0
    assert all(bool(torch.isfinite(value.grad).all()) for value in block.parameters())
