"""Weights as OIDN has them, made up; pictures to denoise, and how near two of them are."""

import struct

import numpy as np
import torch
from torch import Tensor

from hybrid.alignment.transfer import autoexposure
from network.oidn_weights import build_unet, read_tza
from network.unet import OidnUNet, OidnUNetConfig, denoise_color


def tza(tensors: dict[str, np.ndarray]) -> bytes:
    """A TZA file, written by its description; every tensor's values lie at a multiple of 64 bytes."""
    body, table = bytearray(64), struct.pack("<I", len(tensors))
    for name, value in tensors.items():
        kind, layout = "h" if value.dtype == np.float16 else "f", "x" if value.ndim == 1 else "oihw"
        table += struct.pack("<H", len(name)) + name.encode()
        table += struct.pack(f"<B{value.ndim}I", value.ndim, *value.shape)
        table += layout.encode() + kind.encode() + struct.pack("<Q", len(body))
        body += value.tobytes() + bytes(-value.nbytes % 64)
    struct.pack_into("<HBBQ", body, 0, 0x41D7, 2, 0, len(body))
    return bytes(body) + table


def weights_of(model: OidnUNet, seed: int = 2) -> dict[str, np.ndarray]:
    """Made-up values for every layer, of a size that keeps the picture's."""
    rng = np.random.default_rng(seed)
    return {
        name: rng.normal(0, np.sqrt(2 / max(np.prod(value.shape[1:]), 64)), tuple(value.shape)).astype(np.float16)
        for name, value in model.state_dict().items()
    }


def scene(height: int = 50, width: int = 70) -> list[Tensor]:
    """Color with noise, a lamp and a black corner, albedo, normal; each (1, 3, H, W)."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    albedo = np.where(((x // 9 + y // 11) % 2 == 0)[..., None], [0.8, 0.3, 0.2], [0.1, 0.4, 1.3])
    normal = np.dstack([np.sin(x / 20), np.cos(y / 9), np.cos(x / 20)])
    light = np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 300) + 40 * ((x - 12) ** 2 + (y - 12) ** 2 < 20)
    light[-20:, -20:] = 0
    color = albedo * light[..., None] * rng.gamma(2, 0.5, (height, width, 3))
    return [torch.from_numpy(v.astype(np.float32)).permute(2, 0, 1)[None] for v in (color, albedo, normal)]


def decibels(a: Tensor, b: Tensor) -> float:
    return float(-10 * torch.log10(torch.mean((a.double() - b.double()) ** 2)))


def compressed(x: Tensor) -> Tensor:
    return x / (1 + x)


def as_image(layer: Tensor) -> np.ndarray:
    return np.ascontiguousarray(layer[0].permute(1, 2, 0).numpy())


def as_tensor(image: np.ndarray) -> Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None]


def made_up_unet() -> OidnUNet:
    return build_unet(read_tza(tza(weights_of(OidnUNet(OidnUNetConfig(9, "small"))))))


def denoise(unet: OidnUNet, color: Tensor, *guides: Tensor) -> Tensor:
    """Denoise one picture at the exposure that OIDN gives it."""
    return denoise_color(unet, color, *guides, exposure=float(np.float32(autoexposure(as_image(color.nan_to_num(0))))))
