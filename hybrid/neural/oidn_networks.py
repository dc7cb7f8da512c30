"""OIDN's networks in torch, called as `hybrid.denoising.oidn` calls OIDN.

In bfloat16 they take about 0.6 of OIDN's time, in float32 0.9 to 1.0.
"""

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import cast

import numpy as np
import torch
from torch import Tensor

from hybrid.alignment.transfer import BLACK, measure_gain
from hybrid.denoising.oidn import Quality
from hybrid.files.frame import Array
from hybrid.neural.tiling import image_of, tensor_of, tiles
from network.bfloat16 import round_unet
from network.checkpoint import load_model, shipped_weights
from network.devices import has_bfloat16
from network.oidn_weights import load_oidn
from network.robust_unet import RobustUNet
from network.unet import OidnUNet, denoise_albedo, denoise_color, denoise_normal

BUNDLED = "balanced"  # the preset whose backbone replaces OIDN where OIDN is not installed
HALO = 112  # pixels of context around a tile: nothing farther away changes more than the last bits of an image
SCRATCH = 210  # bytes for each pixel of a tile in bfloat16; measured in float32, with the free memory between blocks
TILE = 2048  # side of a tile, so that memory does not grow with the frame: 1920×1080 is one, 3840×2160 are four


def first_pass_memory(shape: tuple[int, int]) -> int:
    """Bytes that a network of quality "fast" takes while it runs on frames of this height and width."""
    height, width = (min(side, TILE + 2 * HALO) for side in shape)
    return SCRATCH * height * width * (1 if has_bfloat16(torch.device("cpu")) else 2)


def torch_backend(device: str, *, exact: bool) -> Callable[..., Array] | None:
    """Function that replaces OIDN for the first pass; None where OIDN has to run: on GPUs, and in float32 (`exact`)."""
    return denoise_unet if device == "cpu" and not exact and has_oidn_networks() else None


def denoise_unet(
    color: Array,
    albedo: Array | None = None,
    normal: Array | None = None,
    *,
    quality: Quality = "high",
    prefilter: Quality | None = None,
    clean: bool = False,
) -> Array:
    """Denoise one frame with OIDN's networks; in bfloat16 63 to 66 dB from OIDN's own image.

    Parameters are those of `hybrid.denoising.oidn.denoise_oidn`. Without OIDN's weights it raises as
    `network.oidn_weights.load_oidn`; see `has_oidn_networks`.
    """
    guides = {name: layer for name, layer in (("albedo", albedo), ("normal", normal)) if layer is not None}
    if prefilter is not None:
        guides = prefilter_guides(guides, prefilter)
    reliable = (clean or prefilter is not None) and len(guides) == 2
    name = "rt_hdr" + ("", "_alb", "_calb_cnrm" if reliable else "_alb_nrm")[len(guides)]
    if quality == "fast":
        name += "_small"
    elif quality == "high" and reliable:
        name += "_large"
    run = partial(denoise_color, exposure=_exposure(color))
    return _run_tiled(run, _network(name), [color, *guides.values()])


def prefilter_guides(guides: Mapping[str, Array], quality: Quality = "balanced") -> dict[str, Array]:
    """Denoise "albedo" and "normal", each by itself, with OIDN's networks, at "high" quality the large ones."""
    size = "_large" if quality == "high" else ""
    filters: dict[str, tuple[str, Callable[..., Tensor]]] = {
        "albedo": ("rt_alb", denoise_albedo),
        "normal": ("rt_nrm", denoise_normal),
    }
    return {
        name: _run_tiled(filters[name][1], _network(filters[name][0] + size), [layer]) for name, layer in guides.items()
    }


def denoise_alpha(alpha: Array) -> Array:
    """Denoise alpha (H, W, 1) in [0, 1] as gray: with OIDN's network of albedo, or else the bundled network."""
    gray = np.repeat(np.clip(alpha, 0, 1), 3, axis=-1)
    clean = prefilter_guides({"albedo": gray})["albedo"] if has_oidn_networks() else denoise_bundled(gray)
    return np.asarray(np.clip(clean.mean(axis=-1, keepdims=True), 0, 1), np.float32)


def denoise_bundled(
    color: Array, albedo: Array | None = None, normal: Array | None = None, *, quality: Quality = "high"
) -> Array:
    """Denoise one frame with the backbone of `BUNDLED`, which needs only torch and is of every quality."""
    # Missing guides are 0.5 to a backbone, as in `network.robust_unet.RobustUNet`; a normal of 0 is 0.5 to it.
    albedo = np.full_like(color, 0.5) if albedo is None else albedo
    normal = np.zeros_like(color) if normal is None else normal
    run = partial(denoise_color, exposure=_exposure(color))
    return _run_tiled(run, _bundled(), [color, albedo, normal])


def has_oidn_networks() -> bool:
    """Whether the installed OIDN is of a version whose networks are known."""
    try:
        _network("rt_hdr_alb_nrm_small")
    except (FileNotFoundError, ValueError):
        return False
    return True


@lru_cache
def _network(name: str) -> OidnUNet:
    return _for_inference(load_oidn(name))


@lru_cache
def _bundled() -> OidnUNet:
    backbone = cast(RobustUNet, load_model(shipped_weights(BUNDLED))).backbone
    return _for_inference(cast(OidnUNet, backbone))


def _for_inference(unet: OidnUNet) -> OidnUNet:
    """In bfloat16 where the processor computes in it; elsewhere oneDNN may refuse it."""
    return round_unet(unet) if has_bfloat16(torch.device("cpu")) else unet.eval().requires_grad_(False)


def _exposure(color: Array) -> float:
    # OIDN excludes 1e-8 whatever the exposure, so that dark pictures depend on their unit.
    return float(np.float32(measure_gain(np.asarray(color, np.float32), dark=BLACK)))


def _run_tiled(run: Callable[..., Tensor], unet: OidnUNet, layers: list[Array]) -> Array:
    """Run a network on layers (H, W, 3) tile by tile."""
    tensors = [tensor_of(np.ascontiguousarray(layer, np.float32)[None], copied=False)[:, 0] for layer in layers]
    height, width = tensors[0].shape[2:]
    result = torch.empty_like(tensors[0])
    for inner, outer, offset in tiles(slice(0, height), height, width, TILE, HALO, unet.multiple):
        with torch.inference_mode():
            result[..., *inner] = run(unet, *(layer[..., *outer] for layer in tensors))[..., *offset]
    return image_of(result)
