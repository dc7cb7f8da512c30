"""Weights of Intel Open Image Denoise (OIDN), read from the library that the package ``pyoidn`` installs.

They are those of RenderKit/oidn-weights, Apache-2.0 (see NOTICE). None of them is part of this module.
"""

import hashlib
import importlib.util
import mmap
import struct
from itertools import chain
from math import prod
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from network.unet import ENCODERS, OidnUNet, OidnUNetConfig

#: Bytes and SHA-256 of each network in version 2.5.1.
OIDN_WEIGHTS = {
    "rt_hdr": (1830792, "a097e8fe9b1ba71ec43cde3e6df3fcf54fa4f8f2f4dd41eac01d0a76a16261e3"),
    "rt_hdr_small": (634568, "c9171947f2bceb4367725b7a0d5b4e0d663ac44108386af42f1b49e4361952e7"),
    "rt_hdr_alb": (1835976, "a8e4fbbd3a794e0098f88e23882faf5459840bda5b0ff39f22bcaaf2cfd03b5a"),
    "rt_hdr_alb_small": (638024, "1f3839dfc949e969bc5ad4d600e85bfa96187e0cb5ffee2f4715c791e6221fba"),
    "rt_hdr_alb_nrm": (1841160, "e586ef2ff48d7fbb7611986405220ed8fc5c13ca79bfc40be4dc742fbf959e1a"),
    "rt_hdr_alb_nrm_small": (641480, "980ea307e7825cae23ed8b1addf8de62ece84b61094795a5631ebf1c91b2e1a7"),
    "rt_hdr_calb_cnrm": (1841160, "d0057057bd76c64e3e67b449728ef8f4fd2f11ccfb74c1e59b9d50dafd50ee0e"),
    "rt_hdr_calb_cnrm_small": (641480, "a6c43bfdbff01bdd8a9c777e139720f9e58b872a50c8db07079bddd007482dc5"),
    "rt_hdr_calb_cnrm_large": (7698439, "08130cdc4f33b7a513d0073757f089ac830f900613bb5bad72ca42c52b934465"),
    "rt_alb": (1830792, "752c9a8d57884d660ae375a7c853cad8a44f77d559bb282f0ef39f8e758601a4"),
    "rt_alb_large": (7684615, "a8efbe6eed511f41c8f5ff9145923214cefb0703cf91a3b00a1dc131ade1600a"),
    "rt_nrm": (1830792, "fb8f7f5571332b602406f88a0b570d809dd3c06aebb530f5d048828f57490bc7"),
    "rt_nrm_large": (7684615, "8ac7705ec5ac303116b40ad2f0880cd741ed1f4280828bf2f18f7635c3377257"),
}
# First bytes of a TZA file: magic and version.
_TZA = struct.pack("<HBB", 0x41D7, 2, 0)


def read_tza(data: bytes) -> dict[str, Tensor]:
    """Read the tensors of a TZA file, OIDN's archive of weights: float32, in the order of the file, that of the layers.

    All little-endian. Magic 0x41D7 (uint16), version (2 × uint8, 2.0), offset of the table (uint64); in the table the
    number of tensors (uint32), and for each the length of its name (uint16), the name, the number of dimensions
    (uint8), sizes (uint32), layout (a letter each), type (``f`` or ``h``), offset of the values (uint64). Nothing is
    checked: files are known by their digest.
    """
    (position,) = struct.unpack_from("<Q", data, len(_TZA))

    def take(form: str) -> tuple[Any, ...]:
        nonlocal position
        values = struct.unpack_from(f"<{form}", data, position)
        position += struct.calcsize(f"<{form}")
        return values

    tensors: dict[str, Tensor] = {}
    for _ in range(*take("I")):
        (name,) = take(f"{take('H')[0]}s")
        shape = take(f"{take('B')[0]}I")
        _, kind, start = take(f"{len(shape)}scQ")
        dtype = torch.float32 if kind == b"f" else torch.float16
        values = data[start : start + prod(shape) * dtype.itemsize]
        tensors[name.decode()] = torch.frombuffer(bytearray(values), dtype=dtype).float().view(shape)
    return tensors


def build_unet(tensors: dict[str, Tensor]) -> OidnUNet:
    """Build the U-Net, in float32, that the tensors of a TZA file belong to: a small, base or large one."""
    found = [tuple(value.shape) for value in tensors.values()]
    with torch.device("meta"):  # where networks take no memory
        unets = [OidnUNet(OidnUNetConfig(found[0][1], size)) for size in ENCODERS]
    unet = next(unet for unet in unets if [tuple(value.shape) for value in unet.state_dict().values()] == found)
    unet.load_state_dict(dict(zip(unet.state_dict(), tensors.values(), strict=True)), assign=True)
    return unet


def load_oidn(name: str) -> OidnUNet:
    """Load a network of OIDN, one of `OIDN_WEIGHTS`, in float32; ValueError or FileNotFoundError if it is not there."""
    if name not in OIDN_WEIGHTS:
        raise ValueError(f"OIDN's weights: expected one of {', '.join(OIDN_WEIGHTS)}, got {name!r}")
    path = find_library()
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as library:
        return build_unet(read_tza(_find_blob(library, name, path)))


def find_library() -> Path:
    """Path of the library of ``pyoidn`` that holds the weights; FileNotFoundError without one."""
    spec = importlib.util.find_spec("pyoidn")
    folders = [] if spec is None else spec.submodule_search_locations or []
    found = sorted(chain.from_iterable(Path(folder).rglob("*OpenImageDenoise_core.*") for folder in folders))
    if not found:
        raise FileNotFoundError("OIDN's weights: expected libOpenImageDenoise_core of the package pyoidn, found none")
    return found[0]


def _find_blob(library: mmap.mmap, name: str, path: Path) -> bytes:
    """Bytes of a network's weights, found in the library by their SHA-256."""
    size, digest = OIDN_WEIGHTS[name]
    start = library.find(_TZA)
    while start >= 0:
        blob = library[start : start + size]
        if len(blob) == size and hashlib.sha256(blob).hexdigest() == digest:
            return blob
        start = library.find(_TZA, start + 1)
    raise ValueError(f"OIDN's weights: expected {name} of OIDN 2.5.1 in {path.name}, found none of that SHA-256")
