import torch

from network.paper.inputs import KernelWindow, network_inputs


def uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def window() -> dict[str, torch.Tensor]:
    """A made-up aligned window."""
    return {
        "color": uniform(1, 3, 3, 8, 12),
        "albedo": uniform(1, 3, 3, 8, 12, seed=1),
        "normal": uniform(1, 3, 3, 8, 12, seed=2) * 2 - 1,
        "confidence": uniform(1, 3, 1, 8, 12, seed=3),
    }


def test_channels_and_their_order() -> None:
    data = window()
    features = network_inputs(KernelWindow(**data, exposure=torch.tensor([0.5])))
    layers = [torch.log1p(data["color"] / 0.5), torch.log1p(data["albedo"]), data["normal"], data["confidence"]]
    torch.testing.assert_close(features, torch.cat(layers, 2))


def test_what_is_missing_is_zero() -> None:
    data = window()
    features = network_inputs(KernelWindow(data["color"], data["confidence"], torch.ones(1)))
    assert not bool(features[:, :, 3:9].any())


def test_extreme_radiance_stays_finite_and_moderate() -> None:
    data = window()
    data["color"][0, 0, 0, 0] = torch.tensor([1e6, -3.0, 0.0] * 4)
    features = network_inputs(KernelWindow(**data, exposure=torch.tensor([0.5])))
    assert float(features.max()) < 16  # log1p(2e6) = 14.5
    assert float(features[:, :, :3].min()) == 0


def test_what_is_given_is_not_written_to() -> None:
    data = window()
    copies = {name: value.clone() for name, value in data.items()}
    network_inputs(KernelWindow(**data, exposure=torch.tensor([0.5])))
    assert all(torch.equal(value, copies[name]) for name, value in data.items())
