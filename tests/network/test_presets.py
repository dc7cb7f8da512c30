import pytest
import torch

from network.presets import PRESETS, build_preset


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_models_of_any_window_length(name: str) -> None:
    sizes = {"fast": 4_300, "balanced": 930_000, "quality": 3_900_000, "unet": 250_000, "multiscale": 1_700_000}
    sizes |= {"paper": 3_600_000, "paper-tkpcn": 3_400_000, "ra": 580_000, "tkpcn": 580_000}
    sizes |= {"ra-small": 150_000, "tkpcn-small": 150_000}
    for frames in (3, 5):
        model = build_preset(name, frames, seed=1)
        assert model.frames == frames
        assert sum(p.numel() for p in model.parameters()) < sizes[name]


def test_presets_are_reproducible_and_leave_the_global_generator_alone() -> None:
    torch.manual_seed(1)
    expected = torch.rand(1)
    torch.manual_seed(1)
    first, second, other = (build_preset("unet", seed=seed) for seed in (3, 3, 4))
    assert torch.equal(torch.rand(1), expected)
    assert torch.equal(first.stem.weight, second.stem.weight)
    assert not torch.equal(first.stem.weight, other.stem.weight)


def test_without_a_length_windows_are_as_long_as_usual() -> None:
    assert [build_preset(name).frames for name in ("fast", "quality")] == [5, 7]


@pytest.mark.parametrize("size", ["", "-small"])
def test_the_papers_network_and_its_baseline_are_of_equal_size(size: str) -> None:
    ra, baseline = (sum(p.numel() for p in build_preset(name + size).parameters()) for name in ("ra", "tkpcn"))
    assert baseline == pytest.approx(ra, rel=0.02)
