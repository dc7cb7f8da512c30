import pytest
import torch

from network.paper.ravg import ravg
from tests.network.paper.test_blocks import random, ravg_by_sorting


@pytest.mark.parametrize("count", [3, 4, 5, 6, 7])
def test_ravg_is_the_mean_without_minimum_and_maximum(count: int) -> None:
    frames = random(count, 2, 3, 4, 5)
    # Float64 sums of a few values of size 1: rounding only.
    torch.testing.assert_close(ravg(frames.unbind(0)), ravg_by_sorting(frames), rtol=1e-12, atol=1e-12)


def test_ravg_of_one_and_two_frames() -> None:
    a, b = random(2, 3, 4).unbind(0)
    assert torch.equal(ravg([a]), a)
    torch.testing.assert_close(ravg([a, b]), (a + b) / 2)


def test_ravg_of_no_frame_is_an_error() -> None:
    with pytest.raises(ValueError, match="frames: expected at least one"):
        ravg([])


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6])
def test_ravg_gradient(count: int) -> None:
    frames = [f.clone().requires_grad_() for f in random(count, 4, 3, seed=2).unbind(0)]
    assert torch.autograd.gradcheck(lambda *x: ravg(x), frames)


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_ravg_gradient_of_equal_values_is_a_subgradient(count: int) -> None:
    """Adding the same to all frames adds it to the mean, so the gradients sum to 1 even where values tie."""
    values = torch.tensor([[0.0, 1.0, 0.0, 2.0], [0.0, 1.0, 1.0, 2.0], [0.0, 0.0, 1.0, 1.0]], dtype=torch.float64)
    frames = [values[i % 3].clone().requires_grad_() for i in range(count)]
    gradients = torch.stack(torch.autograd.grad(ravg(frames).sum(), frames))
    torch.testing.assert_close(gradients.sum(0), torch.ones(4, dtype=torch.float64))
    assert bool((gradients >= 0).all())


def test_ravg_works_where_only_some_frames_need_a_gradient() -> None:
    frames = list(random(4, 6).unbind(0))
    frames[2] = frames[2].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(ravg(frames).sum(), frames[2])
    middle = torch.stack(frames).argsort(0).argsort(0)[2]  # its rank among the four
    assert torch.equal(gradient, torch.where((middle == 1) | (middle == 2), 0.5, 0.0).double())
