"""The robust average and the blocks built on it."""

# ruff: noqa: E402 - nothing of network can be imported before it is known that torch is there

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from torch.nn import functional

from network.paper.blocks import ChannelAverage, ResidualBlock, RobustAverage, TemporalModule, outermost_first, ravg

pytestmark = pytest.mark.neural


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def ravg_by_sorting(frames: torch.Tensor) -> torch.Tensor:
    """The equation, read literally: drop the smallest and the largest, average the rest."""
    return frames.sort(0).values[1:-1].mean(0)


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


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_ravg_does_not_depend_on_the_order(count: int) -> None:
    frames = random(count, 50)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(ravg(frames[order].unbind(0)), ravg(frames.unbind(0)), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("count", [3, 4, 5])
@pytest.mark.parametrize("outlier", [1e6, -1e6])
def test_ravg_in_bfloat16_is_not_harmed_by_an_outlier(count: int, outlier: float) -> None:
    frames = torch.full((count, 8), 0.75, dtype=torch.bfloat16)
    frames[1] = outlier
    # 0.75 has an exact bfloat16; Σ − max − min would have lost it beside 1e6, whose bfloat16 spacing is 4096.
    assert torch.equal(ravg(frames.unbind(0)), torch.full((8,), 0.75, dtype=torch.bfloat16))


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


def test_residual_block_is_the_identity_plus_two_convolutions() -> None:
    block = ResidualBlock(4).double()
    x = random(2, 4, 6, 5)
    hidden = functional.conv2d(x.relu(), block.first.weight, block.first.bias, padding=1).relu()
    expected = x + functional.conv2d(hidden, block.second.weight, block.second.bias, padding=1)
    torch.testing.assert_close(block(x), expected)


def test_the_outermost_frames_come_first_and_the_centre_last() -> None:
    assert outermost_first(5) == [0, 4, 1, 3, 2]
    assert outermost_first(3) == [0, 2, 1]
    assert outermost_first(1) == [0]


def blend_by_the_book(block: RobustAverage, frames: list[torch.Tensor]) -> list[torch.Tensor]:
    """The paper's figure: concatenate the excluded frame and the average, predict weights, blend, go on."""
    kernel = torch.cat([block.on_frame.weight, block.on_average.weight], 1)
    for i in outermost_first(len(frames)):
        others = torch.stack([f for j, f in enumerate(frames) if j != i])
        average = ravg_by_sorting(others) if len(others) > 2 else others.mean(0)
        both = torch.cat([frames[i], average], 1)
        hidden = functional.conv2d(both, kernel, block.on_frame.bias, padding=1).relu()
        weight = functional.conv2d(hidden, block.weight.weight, block.weight.bias, padding=1).sigmoid()
        frames[i] = (1 - weight) * frames[i] + weight * average
    return frames


@pytest.mark.parametrize("count", [2, 3, 5, 7])
def test_robust_average_block_against_the_naive_one(count: int) -> None:
    torch.manual_seed(0)
    block = RobustAverage(4).double()
    frames = random(count, 2, 4, 6, 5, seed=3)
    expected = torch.cat(blend_by_the_book(block, list(frames.unbind(0))))
    torch.testing.assert_close(block(frames.flatten(0, 1), count), expected)


def test_robust_average_block_gradient_reaches_all_parameters() -> None:
    torch.manual_seed(0)
    block = RobustAverage(3).double()
    x = random(5, 3, 3, 4, seed=4).requires_grad_()
    names, parameters = zip(*block.named_parameters(), strict=True)

    def run(x: torch.Tensor, *values: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(block, dict(zip(names, values, strict=True)), (x, 5))

    assert torch.autograd.gradcheck(run, (x, *parameters))


def test_robust_average_block_can_be_the_identity() -> None:
    block = RobustAverage(4)
    torch.nn.init.constant_(block.weight.bias, -200)  # sigmoid(-200) is below the smallest float32
    x = random(5, 4, 6, 5, dtype=torch.float32)
    assert torch.equal(block(x, 5), x)


def test_robust_average_block_can_replace_a_frame_by_the_others() -> None:
    block = RobustAverage(4)
    torch.nn.init.constant_(block.weight.bias, 200)
    x = random(5, 4, 6, 5, dtype=torch.float32)
    expected = ravg([x[i : i + 1] for i in range(1, 5)])
    torch.testing.assert_close(block(x, 5)[:1], expected)  # the first visited: the others are still as they were


def test_robust_average_block_keeps_a_still_sequence() -> None:
    torch.manual_seed(0)
    block = RobustAverage(4)
    x = random(1, 4, 6, 5, dtype=torch.float32).expand(5, -1, -1, -1)
    torch.testing.assert_close(block(x, 5), x)  # blending equal values leaves float32 rounding


def test_robust_average_block_sees_the_other_frames_as_a_set() -> None:
    """The first frame visited is blended with an average of unchanged frames, in which order plays no part."""
    torch.manual_seed(0)
    block = RobustAverage(4).double()
    x = random(5, 4, 6, 5)
    torch.testing.assert_close(block(x[[0, 3, 1, 4, 2]], 5)[0], block(x, 5)[0])


def test_robust_average_block_keeps_samples_of_a_batch_apart() -> None:
    torch.manual_seed(0)
    block = RobustAverage(4).double()
    x = random(5, 2, 4, 6, 5)
    both = block(x.flatten(0, 1), 5).unflatten(0, (5, 2))
    torch.testing.assert_close(both[:, 1], block(x[:, 1], 5))


def test_robust_average_block_of_one_frame_is_the_identity() -> None:
    x = random(2, 4, 6, 5, dtype=torch.float32)
    assert RobustAverage(4)(x, 1) is x


@pytest.mark.parametrize("count", [2, 3, 5, 7])
def test_channel_average_against_the_naive_one(count: int) -> None:
    block = ChannelAverage(4, 0.8).double()
    torch.nn.init.uniform_(block.blend, -2, 2)
    frames = random(count, 2, 4, 6, 5, seed=3)
    expected, weight = list(frames.unbind(0)), block.blend.sigmoid()[:, None, None]
    for i in outermost_first(count):
        others = torch.stack([f for j, f in enumerate(expected) if j != i])
        average = ravg_by_sorting(others) if len(others) > 2 else others.mean(0)
        expected[i] = (1 - weight) * expected[i] + weight * average
    torch.testing.assert_close(block(frames.flatten(0, 1), count), torch.cat(expected))


def test_channel_average_begins_where_it_is_told_to_and_learns() -> None:
    block = ChannelAverage(3, 0.8).double()
    torch.testing.assert_close(block.blend.sigmoid(), torch.full((3,), 0.8).double())
    x = random(5, 3, 3, 4, seed=4).requires_grad_()

    def run(x: torch.Tensor, blend: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(block, {"blend": blend}, (x, 5))

    assert torch.autograd.gradcheck(run, (x, block.blend))


@pytest.mark.parametrize("frames", [1, 3, 5])
def test_temporal_module_against_the_naive_one(frames: int) -> None:
    """All frames' features side by side, two residual blocks, one linear map to each frame's features."""
    torch.manual_seed(0)
    module = TemporalModule(4, frames).double()
    x = random(frames, 2, 4, 6, 5, seed=3)
    for sample in range(2):
        side_by_side = x[:, sample].relu().flatten(0, 1)[None]
        window = functional.conv2d(side_by_side, module.join.weight, module.join.bias, padding=1)
        for block in module.blocks:
            window = block(window)
        for frame in range(frames):
            own = slice(4 * frame, 4 * frame + 4)
            expected = functional.conv2d(window.relu(), module.split.weight[own], module.split.bias[own])
            got = module(x.flatten(0, 1), frames).unflatten(0, (frames, 2))[frame, sample]
            torch.testing.assert_close(got, expected[0])
