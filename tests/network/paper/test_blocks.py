import pytest
import torch
from torch.nn import functional

from network.paper.blocks import ResidualBlock, RobustAverage, TemporalModule
from network.robust_average import outermost_first


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_residual_block_is_the_identity_plus_two_convolutions() -> None:
    block = ResidualBlock(4).double()
    x = random(2, 4, 6, 5)
    hidden = functional.conv2d(x.relu(), block.first.weight, block.first.bias, padding=1).relu()
    expected = x + functional.conv2d(hidden, block.second.weight, block.second.bias, padding=1)
    torch.testing.assert_close(block(x), expected)


def ravg_by_sorting(frames: torch.Tensor) -> torch.Tensor:
    """The equation, read literally: drop the smallest and the largest, average the rest."""
    return frames.sort(0).values[1:-1].mean(0)


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


def test_robust_average_block_of_one_frame_is_the_identity() -> None:
    x = random(2, 4, 6, 5, dtype=torch.float32)
    assert RobustAverage(4)(x, 1) is x


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
