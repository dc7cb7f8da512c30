"""Devices of torch by the names that OIDN uses, and whether they compute in bfloat16."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

DEVICES = ("auto", "cpu", "cuda", "hip", "sycl", "metal")


def find_device(name: str) -> tuple[str, torch.device]:
    """Find a device, one of `DEVICES`, and its name; ValueError, with those available, if it is not.

    "auto" is the first available of cuda, hip, sycl and cpu; Metal, on which this is untested, has to be named.
    """
    import torch  # here, so that `DEVICES` is available without torch

    available = {**_accelerators(), "cpu": torch.device("cpu")}
    if name == "auto":
        return next((kind, device) for kind, device in available.items() if kind != "metal")
    if name not in available:
        expected = "one that torch can use here" if name in DEVICES else "one that there is"
        raise ValueError(f"device is {name!r}, expected {expected}: auto, {', '.join(available)}")
    return name, available[name]


def has_bfloat16(device: torch.device) -> bool:
    """Whether a device computes in bfloat16 faster than in float32: CPUs with AVX-512 bf16 or AMX, and most GPUs."""
    import torch

    if device.type != "cpu":
        return device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
    # oneDNN may be held to fewer instructions than the processor has: bfloat16 then takes ten times as long.
    if not (torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()):
        return False
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def _accelerators() -> dict[str, torch.device]:
    """Accelerators that torch can use here."""
    import torch

    found = {}
    if torch.cuda.is_available():  # torch calls AMD's GPUs cuda too
        found["hip" if torch.version.hip else "cuda"] = torch.device("cuda")
    if torch.xpu.is_available():
        found["sycl"] = torch.device("xpu")
    if torch.backends.mps.is_available():
        found["metal"] = torch.device("mps")
    return found
