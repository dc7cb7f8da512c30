from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch.nn import functional

from network.training.losses import smape
from network.training.perceptual import Perceptual, load_vgg19

#: Convolutions of torchvision's vgg19().features: index in the sequence, channels in and out.
CONVOLUTIONS = {
    0: (3, 64), 2: (64, 64),
    5: (64, 128), 7: (128, 128),
    10: (128, 256), 12: (256, 256), 14: (256, 256), 16: (256, 256),
    19: (256, 512), 21: (512, 512), 23: (512, 512), 25: (512, 512),
    28: (512, 512), 30: (512, 512), 32: (512, 512), 34: (512, 512),
}  # fmt: skip
POOLED_BEFORE = (5, 10, 19, 28)


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    """A state dict as torchvision writes it, of random weights that keep the features' size."""
    generator = torch.Generator().manual_seed(0)
    state = {}
    for index, (before, after) in CONVOLUTIONS.items():
        scale = (2 / (9 * before)) ** 0.5
        state[f"features.{index}.weight"] = torch.randn(after, before, 3, 3, generator=generator) * scale
        state[f"features.{index}.bias"] = torch.randn(after, generator=generator) * 0.1
    return state


def picture(seed: int) -> torch.Tensor:
    return torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(seed))


def by_functions(state: dict[str, torch.Tensor], x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Convolution, ReLU and maximum, one after the other, from the table above."""
    x = (x - torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)) / torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)
    third = x
    for index in CONVOLUTIONS:
        if index in POOLED_BEFORE:
            x = functional.max_pool2d(x, 2)
        x = functional.conv2d(x, state[f"features.{index}.weight"], state[f"features.{index}.bias"], padding=1).relu()
        third = x if index == 16 else third
    return third, x


def test_weights_in_torchvisions_format_are_read_and_mean_the_same(state, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    # With the classifier, which is read over, and in the format of torch.save.
    torch.save({**state, "classifier.0.weight": torch.zeros(4, 4)}, tmp_path / "vgg19.pth")
    vgg = load_vgg19(tmp_path / "vgg19.pth")
    assert sum(p.numel() for p in vgg.parameters()) == 20_024_384  # of the published network, to conv5_4
    assert not any(p.requires_grad for p in vgg.parameters())
    for got, expected in zip(vgg(picture(0)), by_functions(state, picture(0)), strict=True):
        # Sixteen convolutions in float32, which libraries may sum in another order.
        torch.testing.assert_close(got, expected, rtol=1e-3, atol=1e-4)

    save_file(state, tmp_path / "vgg19.safetensors")
    again = load_vgg19(tmp_path / "vgg19.safetensors")
    assert all(torch.equal(p, q) for p, q in zip(vgg.parameters(), again.parameters(), strict=True))


def test_the_loss_is_the_papers_equation(state, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    save_file(state, tmp_path / "vgg19.safetensors")
    loss = Perceptual(load_vgg19(tmp_path / "vgg19.safetensors"))
    prediction, target, scale = picture(1) * 3, picture(2) * 3, torch.tensor([0.5, 2.0])
    curve = [image / scale.view(-1, 1, 1, 1) for image in (prediction, target)]
    features = [by_functions(state, image / (1 + image)) for image in curve]
    distance = sum((a - b).abs().mean((1, 2, 3)) for a, b in zip(*features, strict=True))
    torch.testing.assert_close(
        loss(prediction, target, scale), distance * smape(prediction, target, scale), rtol=1e-3, atol=0
    )

    torch.testing.assert_close(loss(prediction * 8, target * 8, scale * 8), loss(prediction, target, scale))
    assert loss(target, target, scale).tolist() == [0, 0]
    prediction.requires_grad_()
    (gradient,) = torch.autograd.grad(loss(prediction, target, scale).sum(), prediction)
    assert bool(gradient.isfinite().all())
    assert bool((gradient != 0).any())


def test_what_is_no_vgg19_is_an_error(state, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(FileNotFoundError, match=r"vgg .*none\.pth.*no such file"):
        load_vgg19(tmp_path / "none.pth")
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(ValueError, match=r"text\.pth.*no state dict, or cut short"):
        load_vgg19(tmp_path / "text.pth")
    (tmp_path / "text.safetensors").write_text("no weights")
    with pytest.raises(ValueError, match=r"text\.safetensors.*no safetensors file, or cut short"):
        load_vgg19(tmp_path / "text.safetensors")
    # A model of another width, and one without some of the layers.
    torch.save({"features.0.weight": torch.zeros(32, 3, 3, 3)}, tmp_path / "other.pth")
    with pytest.raises(ValueError, match=r"features\.0\.weight: expected shape \(64, 3, 3, 3\).*got \(32, 3, 3, 3\)"):
        load_vgg19(tmp_path / "other.pth")
    few = {name: value for name, value in state.items() if not name.startswith("features.3")}
    torch.save(few, tmp_path / "few.pth")
    with pytest.raises(ValueError, match=r"features\.30\.weight: expected shape .* got None"):
        load_vgg19(tmp_path / "few.pth")


def test_nothing_but_tensors_is_unpickled(tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self):  # type: ignore[no-untyped-def]
            return (Path.touch, (tmp_path / "harm",))

    torch.save({"features.0.weight": Harm()}, tmp_path / "harm.pth")
    with pytest.raises(ValueError, match="no state dict"):
        load_vgg19(tmp_path / "harm.pth")
    assert not (tmp_path / "harm").exists()
