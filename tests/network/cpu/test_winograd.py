"""A convolution by values at points gives the sum of products."""

import pytest
import torch
from torch.nn import functional

from loops.parallel import limit_loops, thread_count
from network.cpu import winograd
from network.cpu.convolution import convolve
from network.cpu.winograd import can_transform, convolve_interleaved, convolve_transformed


def layers(size: tuple[int, int], channels: int, outputs: int, taps: int = 3, batch: int = 1) -> list[torch.Tensor]:
    random = torch.Generator().manual_seed(sum(size))
    x = torch.randn(batch, channels, *size, generator=random).contiguous(memory_format=torch.channels_last)
    weight = torch.randn(outputs, channels, taps, taps, generator=random) / (taps**2 * channels) ** 0.5
    larger = (batch, outputs, *(length + 3 - taps for length in size))
    bias, added = torch.randn(outputs, generator=random), torch.randn(larger, generator=random)
    return [x, weight, bias, added.contiguous(memory_format=torch.channels_last)]


@pytest.mark.parametrize("taps", [3, 2])
@pytest.mark.parametrize("relu", [True, False])
@pytest.mark.parametrize(
    ("size", "channels", "outputs"),
    [((1, 1), 8, 16), ((1, 9), 16, 16), ((8, 4), 64, 32), ((13, 31), 24, 48), ((5, 300), 128, 64), ((9, 800), 8, 16)],
)
def test_it_is_the_sum_of_products(size: tuple[int, int], channels: int, outputs: int, relu: bool, taps: int) -> None:
    """Sizes with and without a rest beside the tiles, in one and in several chunks."""
    x, weight, bias, added = layers(size, channels, outputs, taps, batch=2)
    plain = functional.conv2d(x.double(), weight.double(), padding=1)
    shifted = plain + bias.double()[:, None, None] + added.double()
    with torch.no_grad():
        bare = convolve_transformed(x, weight, None, relu=relu)
        found = convolve_transformed(x, weight, bias, added, relu=relu)
    if relu:
        plain, shifted = torch.relu(plain), torch.relu(shifted)
    # Sums of up to 1,152 products of float32, of about 1: errors are up to 1.1e-5.
    torch.testing.assert_close(bare.double(), plain, rtol=0, atol=2e-5)
    torch.testing.assert_close(found.double(), shifted, rtol=0, atol=2e-5)
    assert found.data_ptr() == added.data_ptr()
    assert bare.is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize(("size", "outputs"), [((1, 1), 16), ((3, 9), 8), ((4, 4), 48), ((13, 31), 32), ((6, 400), 16)])
def test_the_results_of_four_pixels_are_interleaved(size: tuple[int, int], outputs: int) -> None:
    (height, width), (x, weight, _, _) = size, layers(size, 24, 4 * outputs, 2, batch=2)
    parts = functional.conv2d(x.double(), weight.double(), padding=1).unflatten(1, (2, 2, outputs))
    expected = torch.empty(2, outputs, 2 * height, 2 * width, dtype=torch.double)
    for row in range(2):
        for column in range(2):
            part = parts[:, row, column, :, row : row + height, column : column + width]
            expected[..., row::2, column::2] = part
    with torch.no_grad():
        found = convolve_interleaved(x, weight)
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=2e-5)
    assert found.is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize("taps", [3, 2])
def test_its_points_round_little(taps: int) -> None:
    """Errors are 7.8e-7 and 6.7e-7; with the usual points 0, ±1, ±2 and 0, ±1, 2 they are 1.6e-6 and 9.7e-7."""
    x, weight, _, _ = layers((64, 96), 64, 64, taps)
    exact = functional.conv2d(x.double(), weight.double(), padding=1)
    with torch.no_grad():
        found = convolve_transformed(x, weight, None, relu=False)
    assert float((found.double() - exact).square().mean().sqrt()) < 9e-7


@pytest.mark.parametrize("relu", [True, False])
def test_nan_stays_nan(relu: bool) -> None:
    x, weight, bias, _ = layers((8, 8), 8, 16)
    x[0, 3, 4, 4] = float("nan")
    with torch.no_grad():
        assert convolve_transformed(x, weight, bias, relu=relu)[0, :, 3:6, 3:6].isnan().all()


def test_the_number_of_threads_changes_no_bit() -> None:
    x, weight, bias, _ = layers((21, 900), 16, 32)
    before, found = thread_count(), []
    try:
        for count in (1, 2, 5):
            limit_loops(count)
            with torch.no_grad():
                found.append(convolve_transformed(x, weight, bias, relu=True))
    finally:
        limit_loops(before)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


def test_large_layers_of_float32_take_it(monkeypatch: pytest.MonkeyPatch) -> None:
    x, weight, bias, _ = layers((16, 24), 8, 16)
    monkeypatch.setattr(winograd, "PAYS", True)
    with torch.no_grad():
        assert not can_transform(x, weight)
        monkeypatch.setattr(winograd, "_FEWEST_FEATURES", 8 * 16 * 24)
        assert can_transform(x, weight)
        assert not can_transform(x.bfloat16(), weight.bfloat16())
        assert not can_transform(x[:, :, :15], weight)
        expected = convolve_transformed(x, weight, bias, relu=True)
        assert torch.equal(convolve(x, weight, bias), expected)
        monkeypatch.setattr(winograd, "_FEWEST_FEATURES", 0)
        assert not can_transform(x[:, :7], weight[:, :7])
        assert not can_transform(x, weight[:15])
        monkeypatch.setattr(winograd, "PAYS", False)
        assert not can_transform(x, weight)
        monkeypatch.setattr(winograd, "PAYS", True)
    assert not can_transform(x, weight)  # with gradients
