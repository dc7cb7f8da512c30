"""A 3×3 convolution with a quarter of the multiplications, for inference in float32 on CPUs.

Winograd's minimal filtering F(4×4, 3×3) makes 4×4 results of 6×6 features with 36 multiplications for two channels,
where the sum of products takes 144: features and weights are polynomials, which are multiplied by their values at six
points. Lavin and Gray 2016, "Fast Algorithms for Convolutional Neural Networks", https://arxiv.org/abs/1509.09308.

The values are multiplied as matrices, by BLAS. oneDNN has no such convolution on x86: `quality` takes 0.92 of its CPU
time at 1920×1080 on a Zen 3 (four pairs of runs, 0.88 to 0.98). All features of a tile take part in the rounding of
each result: with `quality`, a pixel changes the last bits of others within 126 pixels, where it is 96 otherwise.
"""

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from loops.parallel import Floats, run_bands

_SIZE, _STEP = 6, 4  # features and results on a side of a tile
# The points are 0, ±a, ±b and infinity. With these, rounding errors are at most twice those of the sum of products;
# with the usual points 0, ±1 and ±2 they are four times as large.
_A, _B = 0.5**0.5, 2**0.5
_POINTS = (0.0, _A, -_A, _B, -_B)
# Values of a polynomial at the points → its coefficients, one row each.
_COEFFICIENTS = np.array([[*(p**n for p in _POINTS), float(n == _STEP - 1)] for n in range(_STEP)], np.float32)
# On processors with AVX-512, where oneDNN multiplies twice as many numbers at a time, this was not measured.
_PAYS = torch.backends.cpu.get_cpu_capability() == "AVX2"
# With more channels too few tiles fit a cache for a product of matrices.
_MOST_CHANNELS = 128
# Fewest products of two channels: layers of 64 channels in the largest strips. With fewer, oneDNN is as fast.
_FEWEST_PRODUCTS = 2**29
_VALUES = 4096  # of the features of all tiles that are transformed together, for each of the places in a tile
# Numbers between two rows of features, and between two places in all tiles. Constants, since loops over numbers at
# unknown distances are not vectorised; no powers of two, whose multiples share a few lines of a cache.
_ROW = 4 * _VALUES + 4 * _MOST_CHANNELS + 16
_PLACE = _VALUES + 16

_A1, _A2, _A3 = (np.float32(_A**n) for n in range(1, 4))
_B1, _B2, _B3 = (np.float32(_B**n) for n in range(1, 4))
_PRODUCT, _SUM = np.float32(_A**2 * _B**2), np.float32(_A**2 + _B**2)
_UINT = np.uintp  # numba tests signed indices for counting from the end


def can_transform(x: Tensor, weight: Tensor) -> bool:
    """Whether `convolve_transformed` takes features ``(N, C, H, W)``, and saves time: float32, no gradients, AVX2."""
    return (
        _PAYS
        and x.dtype == weight.dtype == torch.float32
        and x.device.type == "cpu"
        and not torch.is_grad_enabled()
        and max(weight.shape[:2]) <= _MOST_CHANNELS
        and len(weight) * x[0].numel() >= _FEWEST_PRODUCTS
    )


def convolve_transformed(
    x: Tensor, weight: Tensor, bias: Tensor | None, added: Tensor | None = None, *, relu: bool
) -> Tensor:
    """Convolve ``(N, C, H, W)`` by ``(O, C, 3, 3)``, add, overwriting `added` (channels last), apply a ReLU.

    C and O are at most 128. Features beyond the borders count as 0. The result is channels last.
    """
    count, _, height, width = x.shape
    pixels = x.permute(0, 2, 3, 1).contiguous().numpy()
    if added is None:
        result = np.zeros((count, height, width, len(weight)), np.float32)
    else:
        result = added.permute(0, 2, 3, 1).numpy()
    offset = np.zeros(len(weight), np.float32) if bias is None else bias.numpy()
    tiles = -(-width // _STEP)
    chunks = -(-tiles // (_VALUES // max(weight.shape[:2])))
    together = -(-tiles // chunks)  # as many in each chunk
    floor, kept = np.float32(0 if relu else -np.inf), np.float32(added is not None)
    units = count * -(-height // _STEP) * chunks
    run_bands(_convolve, units, pixels, _transform_weight(weight), offset, floor, kept, result, together)
    return torch.from_numpy(result).permute(0, 3, 1, 2)


def _transform_weight(weight: Tensor) -> Floats:
    """Values of weights ``(O, C, 3, 3)`` at the points, over the products of their distances: ``(36, C, O)``."""
    matrix = np.zeros((_SIZE, 3))
    for n, point in enumerate(_POINTS):
        distances = np.prod([point - other for other in _POINTS if other != point])
        matrix[n] = point ** np.arange(3) / distances
    matrix[-1, -1] = 1
    taps = weight.permute(2, 3, 1, 0).numpy().reshape(9, -1)
    values: Floats = (np.kron(matrix, matrix) @ taps).astype(np.float32)
    return values.reshape(_SIZE**2, weight.shape[1], weight.shape[0])


# Inlined, since distances between places have to be constants.
@njit(nogil=True, forceinline=True)
def _evaluate(source: Any, start: Any, stride: Any, length: Any, target: Any, place: Any, distance: Any) -> None:
    """Write the values at the points of polynomials, whose coefficients are `stride` apart."""
    s1, s2, s3, s4, s5 = stride, _UINT(2) * stride, _UINT(3) * stride, _UINT(4) * stride, _UINT(5) * stride
    for p in range(length):
        n = start + p
        d0, d1, d2 = source[n], source[n + s1], source[n + s2]
        d3, d4, d5 = source[n + s3], source[n + s4], source[n + s5]
        even_a, odd_a = d4 - _B2 * d2, _A1 * (d3 - _B2 * d1)
        even_b, odd_b = d4 - _A2 * d2, _B1 * (d3 - _A2 * d1)
        n = place + p
        target[n] = _PRODUCT * d0 - _SUM * d2 + d4
        target[n + distance] = even_a + odd_a
        target[n + _UINT(2) * distance] = even_a - odd_a
        target[n + _UINT(3) * distance] = even_b + odd_b
        target[n + _UINT(4) * distance] = even_b - odd_b
        target[n + _UINT(5) * distance] = _PRODUCT * d1 - _SUM * d3 + d5


@njit(nogil=True, forceinline=True)
def _interpolate(values: Any, length: Any, target: Any, place: Any) -> None:
    """Write the coefficients of polynomials from their values at the points."""
    for p in range(length):
        a, b = values[p + _UINT(_PLACE)], values[p + _UINT(2 * _PLACE)]
        c, d = values[p + _UINT(3 * _PLACE)], values[p + _UINT(4 * _PLACE)]
        even_a, odd_a, even_b, odd_b = a + b, a - b, c + d, c - d
        n = place + p
        target[n] = values[p] + even_a + even_b
        target[n + _UINT(_PLACE)] = _A1 * odd_a + _B1 * odd_b
        target[n + _UINT(2 * _PLACE)] = _A2 * even_a + _B2 * even_b
        target[n + _UINT(3 * _PLACE)] = _A3 * odd_a + _B3 * odd_b + values[p + _UINT(5 * _PLACE)]


@njit(nogil=True, forceinline=True)
def _finish(
    values: Any, source: Any, length: Any, factors: Any, target: Any, place: Any, bias: Any, floor: Any, kept: Any
) -> None:
    """Write a pixel: one coefficient of values in six rows, the bias, `kept` times what is there, at least `floor`."""
    f0, f1, f2, f3, f4, f5 = factors
    for c in range(length):
        n = source + c
        a, b = values[n + _UINT(4 * _PLACE)], values[n + _UINT(8 * _PLACE)]
        total = f0 * values[n] + f1 * a + f2 * b
        a, b = values[n + _UINT(12 * _PLACE)], values[n + _UINT(16 * _PLACE)]
        total += f3 * a + f4 * b + f5 * values[n + _UINT(20 * _PLACE)]
        target[place + c] = max(total + (bias[c] + kept * target[place + c]), floor)


@njit(nogil=True, forceinline=True)
def _gather(pixels: Any, top: Any, left: Any, rows: Any, length: Any) -> None:
    """Copy the six rows of a few tiles, 0 beyond the borders."""
    height, width, channels = pixels.shape
    start, stop = max(left, 0), min(left + length // channels, width)
    for r in range(_SIZE):
        row = rows[r * length : (r + 1) * length]
        row[:] = np.float32(0)
        if 0 <= top + r < height:
            inside = pixels[top + r, start:stop]
            row[(start - left) * channels : (stop - left) * channels] = inside.reshape(inside.size)


@njit(cache=True, nogil=True)
def _convolve(
    first: int, last: int, pixels: Floats, weight: Floats, bias: Floats, floor: Any, kept: Any, result: Floats,
    together: int,
) -> None:  # fmt: skip
    # A unit is `together` tiles of a row of tiles, whatever the threads: the same bits with any number of them.
    _, height, width, channels = pixels.shape
    outputs = len(bias)
    tiles, below = -(-width // _STEP), -(-height // _STEP)
    chunks = -(-tiles // together)
    C, D = _UINT(channels), _UINT(outputs)
    in_rows, places = np.empty(_SIZE * _ROW, np.float32), np.empty(_SIZE * _PLACE, np.float32)
    products, values = np.empty(_SIZE * _PLACE, np.float32), np.empty(_SIZE * _STEP * _PLACE, np.float32)
    border = np.empty(_SIZE * (_STEP * together + 2) * channels, np.float32)
    for unit in range(first, last):
        image, rest = divmod(unit, below * chunks)
        y, x = rest // chunks * _STEP, rest % chunks * together * _STEP
        count = min(together, tiles - rest % chunks * together)
        length = (_STEP * count + 2) * channels
        if x > 0 and y > 0 and x - 1 + length // channels <= width and y - 1 + _SIZE <= height:
            flat = pixels[image].reshape(height * width * channels)
            place, stride = _UINT(((y - 1) * width + x - 1) * channels), _UINT(width * channels)
            _evaluate(flat, place, stride, _UINT(length), in_rows, _UINT(0), _UINT(_ROW))
        else:
            _gather(pixels[image], y - 1, x - 1, border, length)
            _evaluate(border, _UINT(0), _UINT(length), _UINT(length), in_rows, _UINT(0), _UINT(_ROW))
        for r in range(_SIZE):
            for n in range(_UINT(count)):
                _evaluate(in_rows, _UINT(r * _ROW) + n * _UINT(_STEP) * C, C, C, places, n * C, _UINT(_PLACE))
            for n in range(_SIZE):
                given = places[n * _PLACE : n * _PLACE + count * channels].reshape(count, channels)
                made = products[n * _PLACE : n * _PLACE + count * outputs].reshape(count, outputs)
                np.dot(given, weight[r * _SIZE + n], made)
            _interpolate(products, _UINT(count) * D, values, _UINT(r * _STEP * _PLACE))
        target = result[image].reshape(height * width * outputs)
        for r in range(min(_STEP, height - y)):
            row = _COEFFICIENTS[r]
            factors = row[0], row[1], row[2], row[3], row[4], row[5]
            for n in range(min(_STEP * count, width - x)):
                source = _UINT(n % _STEP * _PLACE + n // _STEP * outputs)
                place = _UINT(((y + r) * width + x + n) * outputs)
                _finish(values, source, D, factors, target, place, bias, floor, kept)
