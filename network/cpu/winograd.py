"""Convolutions with a quarter of the multiplications, for inference in float32 on CPUs.

Winograd's minimal filtering makes 4×4 results of 3×3 taps with 36 multiplications for two channels, where the sum of
products takes 144, and of 2×2 taps with 25 in place of 64: features and taps are polynomials, which are multiplied by
their values at a few points. Lavin and Gray 2016, "Fast Algorithms for Convolutional Neural Networks",
https://arxiv.org/abs/1509.09308. oneDNN has no such convolution on x86.

It takes 0.4 to 0.6 of oneDNN's time on a Zen 3, less the more channels there are. All features of a tile take part in
the rounding of each result.
"""

from typing import Any

import numpy as np
import torch
from numba import njit, types
from numba.extending import intrinsic
from torch import Tensor

from loops.parallel import Floats, run_bands
from network.cpu.vectors import COLUMNS, LANES, PAYS, ROWS, Code, multiply_block

_STEP = 4  # results on a side of a tile
# Points by the number of taps, beside infinity; opposite ones are neighbours and share sums. Rounding errors are 1.8
# and 3.3 times those of the sum of products; with the usual points 0, ±1, ±2 and 0, ±1, 2 they are 3.8 and 4.8 times.
_POINTS = {3: (0.0, 0.5**0.5, -(0.5**0.5), 2**0.5, -(2**0.5)), 2: (0.0, 0.75, -0.75, 2.0)}
# Fewest features of an image, about those of 32 channels at 1920×48, a strip of all frames. Smaller layers would gain,
# but are a small part of a large frame, and the coarsest would carry rounding far: a tile of theirs is 64 pixels.
_FEWEST_FEATURES = 5 * 2**19
# Features of the tiles that are transformed together, in each of their places: with their products they fit a cache.
_VALUES = 768
_PADDING = 16  # numbers between places, whose distance would often be a power of two: those share lines of a cache


def can_transform(x: Tensor, weight: Tensor) -> bool:
    """Whether `convolve_transformed` takes features ``(N, C, H, W)`` and taps ``(O, C, K, K)``, and saves time."""
    return (
        PAYS
        and x.dtype == weight.dtype == torch.float32
        and x.device.type == "cpu"
        and not torch.is_grad_enabled()
        and len(weight) % COLUMNS == 0
        and x.shape[1] % LANES == 0
        and x[0].numel() >= _FEWEST_FEATURES
    )


def convolve_transformed(
    x: Tensor, weight: Tensor, bias: Tensor | None, added: Tensor | None = None, *, relu: bool
) -> Tensor:
    """Convolve ``(N, C, H, W)`` by ``(O, C, K, K)``, add, overwriting `added` (channels last), apply a ReLU.

    C is a multiple of 8, O of 16, K is 3 or 2. Features beyond the borders count as 0, with K = 2 those of one row and
    column on each side: the result is then a row and a column larger. It is channels last.
    """
    kept = added is not None
    if added is None:
        height, width = (length + 3 - len(weight[0, 0]) for length in x.shape[2:])
        added = torch.empty(len(x), len(weight), height, width, memory_format=torch.channels_last)
    _run(x, weight, bias, added, relu=relu, kept=kept)
    return added


def convolve_interleaved(x: Tensor, weight: Tensor) -> Tensor:
    """Convolve ``(N, C, H, W)`` by taps ``(4·O, C, 2, 2)`` of the four pixels of a feature: ``(N, O, 2·H, 2·W)``.

    C and O are multiples of 8. Pixel (2i − r, 2j − c) is the result (i, j) of the taps of row r and column c, which
    are the (2r + c)-th O outputs of the whole convolution. The result is channels last.
    """
    height, width = x.shape[2:]
    result = torch.empty(len(x), len(weight) // 4, 2 * height, 2 * width, memory_format=torch.channels_last)
    _run(x, weight, None, result, side=2)
    return result


def _run(
    x: Tensor, weight: Tensor, bias: Tensor | None, result: Tensor, *, relu: bool = False, kept: bool = False,
    side: int = 1,
) -> None:  # fmt: skip
    """Write the convolution, plus what is in it if `kept`, into a result of side × side pixels for each place."""
    pixels = x.permute(0, 2, 3, 1).contiguous().numpy()
    outputs, channels, taps = weight.shape[:3]
    height, width = (length + 3 - taps for length in x.shape[2:])
    offset = np.zeros(outputs, np.float32) if bias is None else bias.numpy()
    tiles = -(-width // _STEP)
    chunks = -(-tiles // (ROWS * max(_VALUES // max(outputs, channels) // ROWS, 1)))
    together = -(-tiles // chunks)  # as many in each chunk
    floor = np.float32(0 if relu else -np.inf)
    values = _transform_weight(weight), offset
    units = len(x) * -(-height // _STEP) * chunks
    run_bands(_convolve, units, taps, pixels, *values, floor, kept, result.permute(0, 2, 3, 1).numpy(), together, side)


def _transform_weight(weight: Tensor) -> Floats:
    """Values of taps ``(O, C, K, K)`` at the points, over products of their distances: places, O / 16, C, 16."""
    outputs, channels, taps, _ = weight.shape
    points = _POINTS[taps]
    matrix = np.zeros((len(points) + 1, taps))
    for n, point in enumerate(points):
        matrix[n] = point ** np.arange(taps) / np.prod([point - other for other in points if other != point])
    matrix[-1, -1] = 1
    rows = torch.from_numpy(np.kron(matrix, matrix))
    values = (rows @ weight.permute(2, 3, 1, 0).reshape(taps**2, -1).double()).float()
    blocks = values.reshape(len(rows), channels, outputs // COLUMNS, COLUMNS)
    result: Floats = blocks.transpose(1, 2).reshape(-1).numpy()
    return result


def _evaluate(code: Code, points: tuple[float, ...], coefficients: list[Any]) -> list[Any]:
    """Values of polynomials at the points and at infinity, each times the products of distances to the other points."""
    values: list[Any] = []
    while (n := len(values)) < len(points):
        others = [point for point in points if abs(point) != abs(points[n])]
        if n and points[n + 1 : n + 2] == (-points[n],):
            factors = _polynomial(others, len(coefficients))
            moved = code.combine([0.0, *factors[:-1]], coefficients)
            scaled = code.combine([points[n] * factor for factor in factors], coefficients)
            values += [code.add(moved, scaled), code.subtract(moved, scaled)]
        else:
            values.append(code.combine(_polynomial(others, len(coefficients)), coefficients))
    return [*values, code.combine(_polynomial(points, len(coefficients)), coefficients)]


def _polynomial(roots: Any, length: int) -> list[float]:
    """Coefficients of the polynomial with these roots, from that of 1 on, exactly 0 where they round to it."""
    factors = np.zeros(length)
    factors[: len(roots) + 1] = np.poly(roots)[::-1]
    return [float(x) for x in np.where(abs(factors) < 1e-12, 0, factors)]


def _interpolate(code: Code, points: tuple[float, ...], values: list[Any]) -> list[Any]:
    """The first four coefficients of the polynomials with these values."""
    result = []
    pairs = {n for n in range(1, len(points) - 1) if points[n + 1] == -points[n]}
    sums = {n: (code.add(*values[n : n + 2]), code.subtract(*values[n : n + 2])) for n in pairs}
    for power in range(_STEP):
        factors, terms = [], []
        for n, point in enumerate(points):
            if n - 1 not in pairs:
                factors.append(point**power)
                terms.append(sums[n][power % 2] if n in pairs else values[n])
        result.append(code.combine([*factors, float(power == _STEP - 1)], [*terms, values[-1]]))
    return result


def _transformer(points: tuple[float, ...]) -> Any:
    """Make the function that writes the values at the points of the features of a tile, of eight channels."""
    size = len(points) + 1

    @intrinsic
    def transform(
        _: Any, pixels: Any, start: Any, row: Any, column: Any, values: Any, place: Any, distance: Any
    ) -> Any:
        def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            _, start, row, column, _, place, distance = args
            code = Code(context, builder, signature)
            source, target = code.data(0, args[0]), code.data(4, args[4])
            columns = [
                _evaluate(code, points, [code.load(source, (1, start), (r, row), (n, column)) for r in range(size)])
                for n in range(size)
            ]
            for r in range(size):
                for n, value in enumerate(_evaluate(code, points, [each[r] for each in columns])):
                    code.store(value, target, (1, place), (r * size + n, distance))
            return context.get_dummy_value()

        return types.void(pixels, start, row, column, values, place, distance), write

    return transform


def _finisher(points: tuple[float, ...]) -> Any:
    """Make the function that writes the results of a tile, of eight channels."""
    size = len(points) + 1

    @intrinsic
    def finish(
        _: Any, products: Any, start: Any, distance: Any, bias: Any, channel: Any, floor: Any, added: Any,
        added_place: Any, added_row: Any, added_column: Any, result: Any, place: Any, row: Any, column: Any,
    ) -> Any:  # fmt: skip
        def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            _, start, distance, _, channel, floor, _, added_place, added_row, added_column, _, place, row, column = args
            code = Code(context, builder, signature)
            source, offset, before, target = (code.data(n, args[n]) for n in (0, 3, 6, 10))
            rows = []
            for r in range(size):
                values = [code.load(source, (1, start), (r * size + n, distance)) for n in range(size)]
                rows.append(_interpolate(code, points, values))
            offset, least = code.load(offset, (1, channel)), code.spread(floor)
            for n in range(_STEP):
                for r, value in enumerate(_interpolate(code, points, [each[n] for each in rows])):
                    kept = code.load(before, (1, added_place), (r, added_row), (n, added_column))
                    total = code.larger(code.add(code.add(value, offset), kept), least)
                    code.store(total, target, (1, place), (r, row), (n, column))
            return context.get_dummy_value()

        return types.void(
            products, start, distance, bias, channel, floor, added, added_place, added_row, added_column, result, place,
            row, column,
        ), write  # fmt: skip

    return finish


_transform3, _transform2 = _transformer(_POINTS[3]), _transformer(_POINTS[2])
_finish3, _finish2 = _finisher(_POINTS[3]), _finisher(_POINTS[2])


@njit(cache=True, nogil=True)
def _convolve(
    first: int, last: int, taps: int, pixels: Floats, weight: Floats, bias: Floats, floor: Any, kept: bool,
    result: Floats, together: int, side: int,
) -> None:  # fmt: skip
    # A unit is `together` tiles of a row of tiles, whatever the threads: the same bits with any number of them.
    _, all_rows, all_columns, depth = result.shape
    height, width, outputs = all_rows // side + side - 1, all_columns // side + side - 1, depth * side * side
    _, in_height, in_width, channels = pixels.shape
    size = _STEP + taps - 1
    tiles, below = -(-width // _STEP), -(-height // _STEP)
    chunks, blocks = -(-tiles // together), outputs // COLUMNS
    padded = -(-together // ROWS) * ROWS
    distance, products_distance = padded * channels + _PADDING, padded * outputs + _PADDING
    values, products = np.zeros(size**2 * distance, np.float32), np.empty(size**2 * products_distance, np.float32)
    all_pixels, all_results = pixels.reshape(pixels.size), result.reshape(result.size)
    patch, piece = np.empty(size**2 * channels, np.float32), np.zeros(_STEP**2 * outputs, np.float32)
    nothing = np.zeros(LANES, np.float32)
    for unit in range(first, last):
        image, rest = divmod(unit, below * chunks)
        y, x = rest // chunks * _STEP, rest % chunks * together * _STEP
        count = min(together, tiles - rest % chunks * together)
        for t in range(count):
            top, left = image * in_height + y - 1, x + t * _STEP - 1
            if y > 0 and left >= 0 and y - 1 + size <= in_height and left + size <= in_width:
                source, start, row = all_pixels, (top * in_width + left) * channels, in_width * channels
            else:
                source, start, row = patch, 0, size * channels
                for r in range(size):
                    for n in range(size):
                        inside = 0 <= y - 1 + r < in_height and 0 <= left + n < in_width
                        place = ((top + r) * in_width + left + n) * channels
                        for c in range(channels):
                            patch[r * row + n * channels + c] = all_pixels[place + c] if inside else np.float32(0)
            for c in range(0, channels, LANES):
                if taps == 3:
                    _transform3(source, start + c, row, channels, values, t * channels + c, distance)
                else:
                    _transform2(source, start + c, row, channels, values, t * channels + c, distance)
        for n in range(size**2):
            for block in range(blocks):
                for t in range(0, count, ROWS):
                    multiply_block(
                        values, n * distance + t * channels, channels, channels,
                        weight, (n * blocks + block) * channels * COLUMNS,
                        products, n * products_distance + t * outputs + block * COLUMNS, outputs,
                    )  # fmt: skip
        for t in range(count):
            left = x + t * _STEP
            # The first and the last place have pixels of some outputs alone.
            least, beyond = side - 1, _STEP + side - 1
            inside = y >= least and left >= least and y + beyond <= height and left + beyond <= width
            rows, columns = min(_STEP, height - y), min(_STEP, width - left)
            target, target_row, column = piece, _STEP * outputs, outputs
            if inside:
                target, target_row, column = all_results, side * all_columns * depth, side * depth
            elif kept:
                start = ((image * height + y) * width + left) * outputs
                for r in range(rows):
                    for n in range(columns * outputs):
                        piece[r * target_row + n] = all_results[start + r * width * outputs + n]
            added, added_row, added_column = (target, target_row, column) if kept else (nothing, 0, 0)
            for c in range(0, outputs, LANES):
                place = c
                if inside:
                    down, right = c // depth // side, c // depth % side
                    first_row, first_column = image * all_rows + side * y - down, side * left - right
                    place = (first_row * all_columns + first_column) * depth + c % depth
                given = (added, place if kept else 0, added_row, added_column, target, place, target_row, column)
                if taps == 3:
                    _finish3(products, t * outputs + c, products_distance, bias, c, floor, *given)
                else:
                    _finish2(products, t * outputs + c, products_distance, bias, c, floor, *given)
            if not inside:
                for r in range(rows):
                    for n in range(columns):
                        for part in range(side * side):
                            i, j = side * (y + r) - part // side, side * (left + n) - part % side
                            if 0 <= i < all_rows and 0 <= j < all_columns:
                                start = ((image * all_rows + i) * all_columns + j) * depth
                                first_channel = r * target_row + n * outputs + part * depth
                                for c in range(depth):
                                    all_results[start + c] = piece[first_channel + c]
