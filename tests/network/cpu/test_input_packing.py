"""Inputs packed in one pass are those of plain operations."""

# ruff: noqa: E402 - nothing of network can be imported before it is known that torch is there

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from network import robust_unet
from network.cpu.input_packing import can_pack, packer
from network.robust_unet import RobustUNet, RobustUNetConfig, denoise_window, pack_inputs
from network.windows import UNetWindow

pytestmark = pytest.mark.neural

T, H, W = 5, 37, 41


def make_window(batch: int = 2, frames: int = T) -> UNetWindow:
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
    return UNetWindow(
        estimate,
        residual,
        confidence,
        0.1 + uniform(3, H, W),
        torch.linspace(0.5, 2, batch),
        torch.linspace(0.2, 0.7, batch),
        1.4 * uniform(3, H, W) - 0.2,
        2.4 * uniform(3, H, W) - 1.2,
    )


def part_of(window: UNetWindow, rows: object, columns: object) -> UNetWindow:
    """Some rows and columns of all layers."""
    layers = (x if x is None or x.ndim == 1 else x[..., rows, :][..., columns] for x in window)
    return UNetWindow(*layers)


@pytest.mark.parametrize("frames", [1, 3, 5])
def test_it_is_what_plain_operations_make(frames: int) -> None:
    window = make_window(frames=frames)
    found, wanted = packer(window, np.arange(W))(np.arange(H)), pack_inputs(window)
    # Two libraries' powers and logarithms, and sums in another order: the last bits of numbers up to 1, which the
    # difference between a frame and the mean of all has as well, and of light as bright as the window's.
    for layer, exact in zip(found[:3], wanted[:3], strict=True):
        torch.testing.assert_close(layer, exact, rtol=0, atol=2e-6)
    torch.testing.assert_close(found.average, wanted.average, rtol=2e-5, atol=1e-6)


def test_rows_and_columns_are_taken_from_where_it_is_said() -> None:
    window = make_window()
    whole = packer(window, np.arange(W))(np.arange(H))
    rows, columns = np.array([2, 1, 0, 0, 30]), np.array([5, 4, 40])
    for part, layer in zip(packer(window, columns)(rows), whole, strict=True):
        assert torch.equal(part, layer[:, :, rows][..., columns])


def test_without_guides_they_are_the_same_everywhere() -> None:
    window = make_window()._replace(albedo=None, normal=None)
    for inputs in (packer(window, np.arange(W))(np.arange(H)), pack_inputs(window)):
        assert bool((inputs.shared[:, :6] == 0.5).all())
        assert bool((inputs.static[:, 3:] == 0.5).all())


@pytest.mark.parametrize("guided", [False, True])
def test_a_picture_with_borders_is_that_of_a_mirrored_window_without_them(guided: bool) -> None:
    """By plain operations with gradients, and by one pass without."""
    window = make_window(batch=1)
    window = window if guided else window._replace(albedo=None, normal=None)
    torch.manual_seed(0)
    model = RobustUNet(RobustUNetConfig(T, "small")).eval().requires_grad_(False)
    model.backbone.last.bias.fill_(0.3)  # else much of an untrained picture is black
    borders = (16, 64 - 16 - H), (0, 48 - W)
    rows, columns = (np.pad(np.arange(n), b, mode="reflect") for n, b in zip((H, W), borders, strict=True))
    wanted = denoise_window(model, part_of(window, rows, columns))
    inner = ..., slice(16, 16 + H), slice(0, W)
    for grad in (False, True):
        with torch.set_grad_enabled(grad):
            found = denoise_window(model, window, borders=borders)
        # Up to the transfer curve's last bits, where the picture is bright.
        torch.testing.assert_close(found.irradiance, wanted.irradiance[inner], rtol=1e-4, atol=1e-5)
        assert found.parts()[0].shape == window.first_pass.shape


def test_it_is_taken_where_it_can_be() -> None:
    """Without gradients, and in float32."""
    window = part_of(make_window(batch=1), slice(32), slice(32))
    model = RobustUNet(RobustUNetConfig(T, "small")).eval()
    with patch.object(robust_unet, "packer", wraps=packer) as taken:
        denoise_window(model, window)
        assert not taken.called
        with torch.no_grad():
            denoise_window(model, window)
            assert taken.call_count == 1
            double = UNetWindow(*(layer.double() for layer in window))
            assert not can_pack(double)
            denoise_window(model, double)
        assert taken.call_count == 1
