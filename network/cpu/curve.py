"""OIDN's transfer curve by linear interpolation in tables, for inference on CPUs.

A power or a logarithm takes 14 ns, and torch computes both for each value; a table takes 1 to 3 ns. The upper bits of a
float32 are the index of its entry.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from loops.parallel import Floats, run_bands
from network.transfer import PU_LINE, PU_LOG, PU_WHITE, pu_forward, pu_inverse

_A, _WHITE = np.float32(PU_LINE), np.float32(PU_WHITE)
_E, _F, _G = map(np.float32, PU_LOG)
# Ends of the tables: below the first the curve is a line, beyond the last there is hardly any value.
_LEAST, _GREATEST = np.float32(2.0**-20), np.float32(2.0**16)
_LEAST_ENCODED, _GREATEST_ENCODED = np.float32(2.0**-11), np.float32(2)
# Bits below those of the entry. 512 entries for each power of two are as exact as the functions in float32; the inverse
# is steeper, and exact to 1e-5 with 1024.
_LOW_BITS, _LOW_BITS_ENCODED = np.uint32(14), np.uint32(13)
_FIRST, _FIRST_ENCODED = _LEAST.view(np.uint32), _LEAST_ENCODED.view(np.uint32)


def can_tabulate(x: Tensor) -> bool:
    """Whether `encode` and `decode` use their tables: float32 on a CPU, without gradients."""
    return x.dtype == torch.float32 and x.device.type == "cpu" and not torch.is_grad_enabled()


def encode(radiance: Tensor) -> Tensor:
    """Map radiance ``(N, C, H, W)``, at least 0, as `network.transfer.pu_forward`."""
    return _map(_encode, encoding_table(), radiance) if can_tabulate(radiance) else pu_forward(radiance)


def decode(encoded: Tensor) -> Tensor:
    """Map ``(N, C, H, W)`` as `network.transfer.pu_inverse`; negative values count as 0."""
    return _map(_decode, _decoding_table(), encoded) if can_tabulate(encoded) else pu_inverse(encoded.clamp_min(0))


def _map(loop: Callable[..., None], table: Floats, x: Tensor) -> Tensor:
    pixels = x.permute(0, 2, 3, 1).contiguous()
    mapped = torch.empty_like(pixels)
    rows = [layer.numpy().reshape(-1, layer.shape[2] * layer.shape[3]) for layer in (pixels, mapped)]
    run_bands(loop, len(rows[0]), rows[0], rows[0].view(np.uint32), table, rows[1])
    return mapped.permute(0, 3, 1, 2)


@lru_cache(maxsize=1)
def encoding_table() -> Floats:
    """Table of the transfer curve: value at each entry, and difference to the next entry, (K, 2)."""
    return _tabulate(pu_forward, _LEAST, _GREATEST, _LOW_BITS)


@lru_cache(maxsize=1)
def _decoding_table() -> Floats:
    return _tabulate(pu_inverse, _LEAST_ENCODED, _GREATEST_ENCODED, _LOW_BITS_ENCODED)


def _tabulate(function: Callable[[Tensor], Tensor], first: np.float32, last: np.float32, low_bits: np.uint32) -> Floats:
    ends = (int(value.view(np.uint32) >> low_bits) for value in (first, last))
    entries = np.arange(next(ends), next(ends) + 1, dtype=np.uint32)
    values = function(torch.from_numpy((entries << low_bits).view(np.float32).astype(np.float64))).numpy()
    return np.stack([values[:-1], np.diff(values)], axis=1).astype(np.float32)


@njit(cache=True, nogil=True, inline="always")
def _look_up(bits: Any, table: Any, first: Any, low_bits: Any) -> Any:
    """Interpolate at the float32 that has these bits; `first` are those of the table's first."""
    entry = (bits - first) >> low_bits
    low = bits & ((np.uint32(1) << low_bits) - np.uint32(1))
    fraction = np.float32(np.int32(low)) / np.float32(np.uint32(1) << low_bits)
    return table[entry, 0] + fraction * table[entry, 1]


@njit(cache=True, nogil=True)
def _encode(first: int, last: int, values: Floats, bits: NDArray[np.uint32], table: Floats, result: Floats) -> None:
    for y in range(first, last):
        for i in range(values.shape[1]):
            value = values[y, i]
            if value < _LEAST:
                result[y, i] = _A * value / _WHITE
            elif not value < _GREATEST:
                result[y, i] = (_E * np.log(value + _F) + _G) / _WHITE
            else:
                result[y, i] = _look_up(bits[y, i], table, _FIRST, _LOW_BITS)


@njit(cache=True, nogil=True)
def _decode(first: int, last: int, values: Floats, bits: NDArray[np.uint32], table: Floats, result: Floats) -> None:
    for y in range(first, last):
        for i in range(values.shape[1]):
            value = values[y, i]
            if value < _LEAST_ENCODED:
                result[y, i] = max(value, np.float32(0)) * _WHITE / _A
            elif not value < _GREATEST_ENCODED:
                result[y, i] = np.exp((value * _WHITE - _G) / _E) - _F
            else:
                result[y, i] = _look_up(bits[y, i], table, _FIRST_ENCODED, _LOW_BITS_ENCODED)
