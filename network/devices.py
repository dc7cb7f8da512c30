"""What torch computes on, by the names that OIDN has too."""

from __future__ import annotations

import torch

from network.training.config import DEVICES


def find_device(name: str) -> tuple[str, torch.device]:
    """Find a device of torch.

    Parameters
    ----------
    name : str
        One of `network.training.config.DEVICES`; "auto": the first that is there of cuda, hip, sycl, cpu. Metal, which
        nobody has run, is taken by its name alone.

    Returns
    -------
    tuple of str and torch.device
        Its name, and the device.

    Raises
    ------
    ValueError
        If it is not there; names those that are.
    """
    there = {**_accelerators(), "cpu": torch.device("cpu")}
    if name == "auto":
        return next((kind, device) for kind, device in there.items() if kind != "metal")
    if name not in there:
        known = name in DEVICES
        what = "one that torch can use here" if known else "one that there is"
        raise ValueError(f"device is {name!r}, expected {what}: auto, {', '.join(there)}")
    return name, there[name]


def has_bfloat16(device: torch.device) -> bool:
    """Whether a device computes in bfloat16 faster than in float32.

    Parameters
    ----------
    device : torch.device
        Of processors those with AVX-512 bf16 or AMX do.

    Returns
    -------
    bool
    """
    if device.type != "cpu":
        return device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def _accelerators() -> dict[str, torch.device]:
    """Those that torch can use here."""
    found = {}
    if torch.cuda.is_available():  # torch calls AMD's so too
        found["hip" if torch.version.hip else "cuda"] = torch.device("cuda")
    if torch.xpu.is_available():
        found["sycl"] = torch.device("xpu")
    if torch.backends.mps.is_available():
        found["metal"] = torch.device("mps")
    return found
