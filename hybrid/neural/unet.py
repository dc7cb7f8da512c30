"""OIDN's networks in torch, called as OIDN is: the same pictures, in bfloat16 in about 0.6 of the time.

On processors without bfloat16 they run in float32, in 0.7 (high) to 0.9 (fast) of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybrid.neural.tiling import image_of, tiles
from hybrid.oidn import Quality
from network.checkpoint import load_model, shipped_weights
from network.devices import has_bfloat16
from network.robust_unet import RobustUNet
from network.unet import Trunk, autoexposure, denoise_albedo, denoise_normal, denoise_picture, load_oidn, round_trunk

Array = NDArray[np.float32]

# Pixels of context around a tile: nothing farther away changes a picture, with any of the networks.
HALO = 112
# Side of a tile, so that memory does not grow with the frame: 1920×1080 is one, 3840×2160 are four.
TILE = 2048


def denoise_unet(
    color: Array,
    albedo: Array | None = None,
    normal: Array | None = None,
    *,
    quality: Quality = "high",
    prefilter: Quality | None = None,
    clean: bool = False,
) -> Array:
    """Denoise one frame with OIDN's networks; in bfloat16 63 to 66 dB from OIDN's own picture.

    Where its weights are not found it raises as `network.unet.load_oidn`; see `has_unet`.

    Parameters
    ----------
    color, albedo, normal, quality, prefilter, clean : array, str or bool
        As for `hybrid.oidn.denoise_oidn`.

    Returns
    -------
    (H, W, 3) array of float32
        Linear radiance.
    """
    guides = {name: layer for name, layer in (("albedo", albedo), ("normal", normal)) if layer is not None}
    if prefilter is not None:
        guides = prefilter_guides(guides, prefilter)
    layers = [_tensor(layer) for layer in (color, *guides.values())]
    reliable = (clean or prefilter is not None) and len(layers) == 3
    name = "rt_hdr" + ("", "_alb", "_calb_cnrm" if reliable else "_alb_nrm")[len(layers) - 1]
    if quality == "fast":
        name += "_small"
    elif quality == "high" and reliable:
        name += "_large"
    exposure = autoexposure(layers[0])

    def run_color(trunk: Trunk, *parts: Tensor) -> Tensor:
        return denoise_picture(trunk, *parts, exposure=exposure)

    return image_of(_tiled(run_color, _network(name), layers))


def prefilter_guides(guides: Mapping[str, Array], quality: Quality = "balanced") -> dict[str, Array]:
    """Take the noise out of guides, each by itself, with OIDN's networks.

    Where its weights are not found it raises as `network.unet.load_oidn`; see `has_unet`.

    Parameters
    ----------
    guides : mapping of str to (H, W, 3) array
        "albedo" and "normal", or one of them.
    quality : str
        "high" takes the large networks.

    Returns
    -------
    dict of str to (H, W, 3) array of float32
        The same, without noise.
    """
    size = "_large" if quality == "high" else ""
    filters: dict[str, tuple[str, Callable[..., Tensor]]] = {
        "albedo": ("rt_alb", denoise_albedo),
        "normal": ("rt_nrm", denoise_normal),
    }
    found = {}
    for name, layer in guides.items():
        weights, run = filters[name]
        found[name] = image_of(_tiled(run, _network(weights + size), [_tensor(layer)]))
    return found


def bundled_preset(quality: Quality) -> str:
    """The preset whose trunk stands for OIDN of this quality where it is not installed."""
    return "fast" if quality == "fast" else "balanced"


def denoise_bundled(
    color: Array, albedo: Array | None = None, normal: Array | None = None, *, quality: Quality = "high"
) -> Array:
    """Denoise one frame with a trunk of the final stage, which needs nothing installed beside torch.

    Parameters
    ----------
    color, albedo, normal : array
        As for `hybrid.oidn.denoise_oidn`.
    quality : str
        Which trunk: that of `bundled_preset`.

    Returns
    -------
    (H, W, 3) array of float32
        Linear radiance.
    """
    half = np.full_like(color, 0.5)
    # As where a shot has no such guide (`network.robust_unet.denoise_window`): a normal of 0 is a half to a trunk.
    layers = [color, half if albedo is None else albedo, np.zeros_like(color) if normal is None else normal]
    tensors = [_tensor(layer) for layer in layers]
    exposure = autoexposure(tensors[0])

    def run(trunk: Trunk, *parts: Tensor) -> Tensor:
        return denoise_picture(trunk, *parts, exposure=exposure)

    return image_of(_tiled(run, _bundled(bundled_preset(quality)), tensors))


@lru_cache
def _bundled(preset: str) -> Trunk:
    return _for_running(cast(RobustUNet, load_model(shipped_weights(preset))).trunk)


def _for_running(trunk: Trunk) -> Trunk:
    """In bfloat16 where the processor has it; elsewhere oneDNN may refuse it."""
    if has_bfloat16(torch.device("cpu")):
        return round_trunk(trunk)
    return trunk.eval().requires_grad_(False)


def has_unet() -> bool:
    """Whether the installed OIDN is of a version whose networks are known."""
    try:
        _network("rt_hdr_alb_nrm_small")
    except (FileNotFoundError, ValueError):
        return False
    return True


@lru_cache
def _network(name: str) -> Trunk:
    return _for_running(load_oidn(name))


def _tensor(image: Array) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]


def _tiled(run: Callable[..., Tensor], trunk: Trunk, layers: list[Tensor]) -> Tensor:
    height, width = layers[0].shape[2:]
    result = torch.empty_like(layers[0])
    for inner, outer, offset in tiles(slice(0, height), height, width, TILE, HALO, trunk.multiple):
        result[..., *inner] = run(trunk, *(layer[..., *outer] for layer in layers))[..., *offset]
    return result
