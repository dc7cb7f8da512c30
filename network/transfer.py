"""Transfer curves of Intel Open Image Denoise: perceptually uniform (PU) for radiance, sRGB for albedo."""

from math import log

import torch
from torch import Tensor

#: The greatest float32.
LARGEST = torch.finfo(torch.float32).max
# A fit of the PU2 curve of Aydin, Mantiuk and Seidel 2008, doi:10.1117/12.765095, normalised at 100 cd/m², from OIDN's
# training/color.py: a line up to Y0, a power up to Y1, a logarithm above.
_A, _B, _C, _D, _E, _F, _G = (
    1.41283765e03, 1.64593172e00, 4.31384981e-01, -2.94139609e-03, 1.92653254e-01, 6.26026094e-03, 9.98620152e-01
)  # fmt: skip
_Y0, _Y1, _X0, _X1 = 1.57945760e-06, 3.22087631e-02, 2.23151711e-03, 3.70974749e-01
# Value of the greatest half, 65504, before normalisation to 1.
_WHITE = _E * log(65504 + _F) + _G
#: Slope of the line, coefficients of the logarithm, and normalisation of `pu_forward`, for compiled loops.
PU_LINE, PU_LOG, PU_WHITE = _A, (_E, _F, _G), _WHITE


def pu_forward(radiance: Tensor) -> Tensor:
    """Map radiance in [0, ∞), 0.18 being middle gray, to the PU scale; 65504, the greatest half, becomes 1."""
    curved = torch.where(radiance <= _Y1, _B * radiance.clamp_min(_Y0) ** _C + _D, _E * (radiance + _F).log() + _G)
    return torch.where(radiance <= _Y0, _A * radiance, curved) / _WHITE


def pu_inverse(encoded: Tensor) -> Tensor:
    """Inverse of `pu_forward`."""
    x = encoded * _WHITE
    curved = torch.where(x <= _X1, ((x.clamp_min(_X0) - _D) / _B) ** (1 / _C), ((x - _G) / _E).exp() - _F)
    return torch.where(x <= _X0, x / _A, curved)


def srgb_forward(linear: Tensor) -> Tensor:
    """Map linear values in [0, 1] to sRGB (IEC 61966-2-1)."""
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def srgb_inverse(encoded: Tensor) -> Tensor:
    """Inverse of `srgb_forward`."""
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


def clip(x: Tensor, low: float, high: float) -> Tensor:
    """Clip to [low, high]; NaN becomes 0."""
    return x.nan_to_num(0, high, low).clamp(low, high)
