"""The paper's perceptual loss: distances in the latent space of VGG19, times SMAPE."""

import os
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from network.training.losses import smape

#: Convolutions of VGG19 by block (configuration E of Simonyan and Zisserman), each followed by a ReLU, each block but
#: the last by a maximum over 2×2. Up to the last convolution; the layers for classification are left out.
BLOCKS = ((64, 64), (128, 128), (256, 256, 256, 256), (512, 512, 512, 512), (512, 512, 512, 512))
#: Where torch hub keeps the weights that torchvision publishes, trained on ImageNet.
HUB_URL = "https://download.pytorch.org/models/vgg19-dcbb9e9d.pth"
#: Mean and standard deviation of the ImageNet images of that training, in [0, 1].
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class VGG19(nn.Module):
    """Convolutions of VGG19 (arXiv:1409.1556): images to features of two layers; parameters named as torchvision's."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before, block_ends = 3, []
        for block in BLOCKS:
            if layers:
                layers.append(nn.MaxPool2d(2))
            for width in block:
                layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()]
                before = width
            block_ends.append(len(layers))
        self.features = nn.Sequential(*layers)
        self.third_block_end = block_ends[2]
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Layer 4 of block 3 and of block 5, both after the ReLU, of ``(N, 3, H, W)`` in [0, 1], 16 pixels or more."""
        x = self.features[: self.third_block_end]((image - self.mean) / self.std)
        return x, self.features[self.third_block_end :](x)


def load_vgg19(source: str | os.PathLike[str]) -> VGG19:
    """Load the weights of VGG19 in torchvision's format, without gradients.

    The source is a state dict (.pth, of which only tensors are unpickled, or .safetensors), or "hub", which downloads
    torchvision's, 550 MB, once, to where torch hub keeps such files. Raises FileNotFoundError if there is no such file,
    and ValueError if it is no state dict of VGG19.
    """
    where = f"vgg {os.fspath(source)!r}"
    if source != "hub" and not Path(source).is_file():
        raise FileNotFoundError(f"{where}: no such file")
    try:
        if source == "hub":
            state = torch.hub.load_state_dict_from_url(HUB_URL, map_location="cpu", weights_only=True)
        elif Path(source).suffix == ".safetensors":
            state = load_file(source)
        else:
            state = torch.load(source, map_location="cpu", weights_only=True)
    except SafetensorError as error:
        raise ValueError(f"{where}: no safetensors file, or cut short ({error})") from error
    except Exception as error:  # torch raises errors of many classes for bad files
        raise ValueError(f"{where}: no state dict, or cut short ({error})") from error
    model = VGG19()
    for name, value in model.state_dict().items():
        found = state.get(name) if isinstance(state, dict) else None
        if not isinstance(found, Tensor) or found.shape != value.shape:
            got = tuple(found.shape) if isinstance(found, Tensor) else None
            raise ValueError(
                f"{where}: {name}: expected shape {tuple(value.shape)} as in torchvision's VGG19, got {got}"
            )
    model.load_state_dict({name: state[name].float() for name in model.state_dict()})
    return model.eval().requires_grad_(False)


class Perceptual(nn.Module):
    """``(L_VGG5,4 + L_VGG3,4) · L_SMAPE``, with L1 distances between features; a `network.training.losses.ImageLoss`.

    VGG19 takes images in [0, 1]: radiance is mapped by ``y = x / (1 + x)`` of the radiance over its scale, not
    negative. The sum and the product keep the magnitudes of the terms apart, as in the paper (Kalojanov and Thurston
    2023, section 5, equation 6; arXiv:1603.08155). Weights act on SMAPE, the one factor that is computed from pixels.
    """

    def __init__(self, vgg: VGG19) -> None:
        super().__init__()
        self.vgg = vgg

    def forward(self, prediction: Tensor, target: Tensor, scale: Tensor, weight: Tensor | None = None) -> Tensor:
        images = torch.cat([prediction, target]).relu() / torch.cat([scale, scale]).view(-1, 1, 1, 1)
        distance = torch.zeros_like(scale)
        for features in self.vgg(images / (1 + images)):
            of_prediction, of_target = features.chunk(2)
            distance = distance + (of_prediction - of_target).abs().mean((1, 2, 3))
        return distance * smape(prediction, target, scale, weight)
