"""What is laid out in one pass is what plain operations make."""

# ruff: noqa: E402 - nothing of network can be imported before it is known that torch is there

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from network import robust_unet
from network import unet as trunk
from network.cpu.input_packing import ALIKE, OWN, _curve, _on_curve, can_lay_out, entering
from network.robust_unet import KNOWN, RobustUNet, RobustUNetConfig, denoise_window, realise

pytestmark = pytest.mark.neural

T, H, W = 5, 37, 41


def make_window(batch: int = 2, frames: int = T) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
    """Frames from black to the sun, with pixels that no frame is trusted at, a firefly, and light below nothing."""
    random = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(batch, *shape, generator=random)

    light = 10 ** (8 * uniform(1, 3, H, W) - 5)
    estimate = light * (0.9 + 0.2 * uniform(frames, 3, H, W))
    residual = estimate * (2 * uniform(frames, 3, H, W) - 1.2)
    residual[:, -1, :, 3, 4] = 1e6
    estimate[:, :, :, 5] = 0
    confidence = uniform(frames, 1, H, W)
    confidence[:, :, :, :, 7] = 0
    window = {
        "estimate": estimate,
        "residual": residual,
        "confidence": confidence,
        "modulation": 0.1 + uniform(3, H, W),
        "exposure": torch.linspace(0.5, 2, batch),
        "gain": torch.linspace(0.2, 0.7, batch),
    }
    return window, 1.4 * uniform(3, H, W) - 0.2, 2.4 * uniform(3, H, W) - 1.2


@pytest.mark.parametrize("frames", [1, 3, 5])
def test_it_is_what_plain_operations_make(frames: int) -> None:
    window, albedo, normal = make_window(frames=frames)
    found = realise(**window)
    guides = albedo.clamp(0, 1), normal.clamp(-1, 1) * 0.5 + 0.5
    still = torch.cat([found.picture, *guides], 1)
    model = RobustUNet(RobustUNetConfig(frames, "small"))
    wanted = model.lay_out(found.frames, still, robust_unet._known(found))
    assert [layer.shape[1] for layer in wanted] == [OWN, ALIKE]
    assert OWN + ALIKE == 3 + 6 + KNOWN
    rows, columns = np.arange(H), np.arange(W)
    layers = entering(window, albedo, normal, columns)(rows)
    # Two libraries' powers and logarithms, and sums in another order: the last bits of numbers up to 1, which the
    # difference between a frame and the mean of all has as well, and of light as bright as the window's.
    for layer, exact in zip(layers[:3], (*wanted, still), strict=True):
        torch.testing.assert_close(layer, exact, rtol=0, atol=2e-6)
    torch.testing.assert_close(layers[3], found.estimate, rtol=2e-5, atol=1e-6)


def test_rows_and_columns_are_taken_from_where_it_is_said() -> None:
    window, albedo, normal = make_window()
    whole = entering(window, albedo, normal, np.arange(W))(np.arange(H))
    rows, columns = np.array([2, 1, 0, 0, 30]), np.array([5, 4, 40])
    for part, layer in zip(entering(window, albedo, normal, columns)(rows), whole, strict=True):
        assert torch.equal(part, layer[:, :, rows][..., columns])


def test_without_guides_they_are_the_same_everywhere() -> None:
    window, _, _ = make_window()
    _, alike, still, _ = entering(window, None, None, np.arange(W))(np.arange(H))
    assert bool((alike[:, :6] == 0.5).all())
    assert bool((still[:, 3:] == 0.5).all())


@pytest.mark.parametrize("guided", [False, True])
def test_a_picture_with_borders_is_that_of_a_mirrored_window_without_them(guided: bool) -> None:
    """By plain operations with gradients, and by one pass without."""
    window, *guides = make_window(batch=1)
    given = guides if guided else [None, None]
    torch.manual_seed(0)
    model = RobustUNet(RobustUNetConfig(T, "small")).eval().requires_grad_(False)
    model.trunk.last.bias.fill_(0.3)  # else much of an untrained picture is black
    borders = (16, 64 - 16 - H), (0, 48 - W)
    rows, columns = (np.pad(np.arange(n), b, mode="reflect") for n, b in zip((H, W), borders, strict=True))
    larger = {name: layer if layer.ndim == 1 else layer[..., rows, :][..., columns] for name, layer in window.items()}
    wanted = denoise_window(model, larger, *(None if g is None else g[..., rows, :][..., columns] for g in given))
    inner = ..., slice(16, 16 + H), slice(0, W)
    for grad in (False, True):
        with torch.set_grad_enabled(grad):
            found = denoise_window(model, window, *given, borders=borders)
        # Up to the transfer curve's last bits, where the picture is bright.
        torch.testing.assert_close(found.irradiance, wanted.irradiance[inner], rtol=1e-4, atol=1e-5)
        assert found.parts()[0].shape == window["estimate"].shape


def test_it_is_taken_where_it_can_be() -> None:
    """Without gradients, and in float32."""
    window, *guides = make_window(batch=1)
    cut = {name: layer if layer.ndim == 1 else layer[..., :32, :32] for name, layer in window.items()}
    small = [guide[..., :32, :32] for guide in guides]
    model = RobustUNet(RobustUNetConfig(T, "small")).eval()
    with patch.object(robust_unet, "entering", wraps=entering) as taken:
        denoise_window(model, cut, *small)
        assert not taken.called
        with torch.no_grad():
            denoise_window(model, cut, *small)
            assert taken.call_count == 1
            double = {name: layer.double() for name, layer in cut.items()}
            assert not can_lay_out(*double.values())
            denoise_window(model, double, *small)
        assert taken.call_count == 1


def test_the_curve_is_as_exact_as_float32() -> None:
    """From nothing to beyond the sun; at the ends of the table, and where the pieces of the curve meet."""
    ends = np.float32([2.0**-20, 2.0**16])
    special = [0, *ends, *np.nextafter(ends, np.float32(0)), *trunk.PU_CURVE[:2], 1e9, 3e38]
    light = np.concatenate([np.geomspace(1e-12, 1e12, 5000), special]).astype(np.float32)
    value = np.empty(1, np.float32)
    found = [_on_curve(y, _curve(), value, value.view(np.uint32)) for y in light]
    exact = trunk.pu_forward(torch.from_numpy(light.astype(np.float64))).numpy()
    # What is computed in float32 is as far away.
    np.testing.assert_allclose(found, exact, rtol=3e-7, atol=1.5e-7)
