"""Gradients that are made in one pass are those of torch."""

# ruff: noqa: E402 - nothing of network can be imported before it is known that torch is there

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from loops import parallel
from network import robust_average
from network.cpu import training_ops
from network.robust_average import ChannelAverage

pytestmark = pytest.mark.neural


def differentiate(
    frames: int, channels: int, centre: bool, added: bool, least: float = 0.1
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Output of a block whose inputs are multiples of `least`, and gradients of features, weight and what is added."""
    torch.manual_seed(0)
    block = ChannelAverage(channels, 0.8)
    with torch.no_grad():
        block.blend.uniform_(-2, 2)
    width = 2 * (training_ops._VALUES // channels) + 7
    x = (torch.randn(2 * frames, channels, 5, width) / least).round() * least
    common = torch.randn(2, channels, 5, width) if added else None
    given = [x, block.blend, *([] if common is None else [common])]
    for tensor in given:
        tensor.requires_grad_()
    result = block(x.to(memory_format=torch.channels_last), frames, centre, common)
    return result.detach(), list(torch.autograd.grad(result, given, torch.randn_like(result)))


@pytest.mark.parametrize("added", [False, True])
@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize("channels", [24, 3, 600])
@pytest.mark.parametrize("frames", [3, 5, 7])
def test_gradients_are_those_of_torch(
    frames: int, channels: int, centre: bool, added: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, gradients = differentiate(frames, channels, centre, added, 1e-6)
    monkeypatch.setattr(robust_average, "can_blend", lambda *_: False)
    wanted, expected = differentiate(frames, channels, centre, added, 1e-6)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)
    for gradient, value in zip(gradients, expected, strict=True):
        # Where two frames differ by less than a rounding error, another one may be the extreme.
        wrong = (gradient - value).abs() > 1e-4 * value.abs().mean() + 1e-4 * value.abs()
        assert float(wrong.float().mean()) < 1e-4
        assert float(value.abs().mean()) > 0.01


@pytest.mark.parametrize("frames", [3, 5, 7])
def test_of_equal_frames_one_is_the_extreme(frames: int) -> None:
    """A shift of all frames shifts the average alike: gradients of a window sum to that of the result."""
    _, (of_features, _) = differentiate(frames, 8, True, False, 1.0)
    sums = of_features.unflatten(0, (frames, 2)).sum(0)
    _, (of_few, _) = differentiate(frames, 8, True, False, 100.0)  # all are zero, and equal
    torch.testing.assert_close(of_few.unflatten(0, (frames, 2)).sum(0), sums, rtol=0, atol=1e-5)
    assert float(sums.abs().mean()) > 0.1


def test_the_gradient_does_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    both = []
    for threads in (1, 3):
        monkeypatch.setattr(parallel, "thread_count", lambda threads=threads: threads)
        both.append(differentiate(5, 24, True, True)[1])
    for one, other in zip(*both, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_the_block_takes_the_fused_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it a training is half as fast, and nothing else tells."""
    calls = []
    real = training_ops._gradients
    monkeypatch.setattr(training_ops, "_gradients", lambda *given: calls.append(1) or real(*given))
    differentiate(5, 8, True, True)
    assert calls == [1]
