"""Instructions on vectors do in a compiled loop what their names say."""

import math
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

from network.cpu.vectors import COLUMNS, LANES, ROWS, Code, multiply_block


@intrinsic
def calculate(_: Any, values: Any, distance: Any, result: Any) -> Any:
    """Write results of all arithmetic on three vectors one after the other."""

    def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        code = Code(context, builder, signature)
        source, target = code.data(0, args[0]), code.data(2, args[2])
        a, b, c = (code.load(source, (n, args[1])) for n in range(3))
        results = code.add(a, b), code.subtract(a, b), code.larger(a, b), code.fma(a, b, c)
        results += code.spread(code.number(source, (1, 2))), code.combine((0.0, -0.5, 1.0), (a, b, c))
        for n, vector in enumerate(results):
            code.store(vector, target, (n, LANES))
        return context.get_dummy_value()

    return types.void(values, distance, result), write


@njit
def run_calculate(values: Any, distance: int, result: Any) -> None:
    calculate(values, distance, result)


@njit
def run_multiply(values: Any, start: int, row: int, length: int, taps: Any, products: Any, products_row: int) -> None:
    multiply_block(values, start, row, length, taps, COLUMNS, products, 3, products_row)


def test_arithmetic() -> None:
    a, b, c = values = np.random.default_rng(1).standard_normal((3, LANES)).astype(np.float32)
    a[5] = np.nan
    padded, result = np.zeros((3, LANES + 3), np.float32), np.zeros((6, LANES), np.float32)
    padded[:, :LANES] = values
    run_calculate(padded, LANES + 3, result)
    larger = np.where(a < b, b, a)
    fused = np.float32(np.float64(a) * b + c)  # the product of two float32 is exact
    expected = [a + b, a - b, larger, fused, np.full(LANES, a[2]), np.float32(np.float64(c) - 0.5 * b)]
    np.testing.assert_array_equal(result[[0, 1, 2, 4]], np.float32([expected[n] for n in (0, 1, 2, 4)]))
    # The sums of float64 are rounded before they are rounded to float32.
    np.testing.assert_allclose(result[[3, 5]], np.float32([fused, expected[5]]), rtol=2e-7)


def test_products_of_a_block() -> None:
    """Six rows, which overlap, by the second block of sixteen columns, beside the places of others."""
    random = np.random.default_rng(2)
    values, taps = random.standard_normal(100).astype(np.float32), random.standard_normal(1000).astype(np.float32)
    products = np.full(ROWS * (COLUMNS + 4) + 3, np.inf, np.float32)
    run_multiply(values, 7, 5, 20, taps, products, COLUMNS + 4)
    rows = np.stack([values[7 + 5 * r :][:20] for r in range(ROWS)]).astype(np.float64)
    expected = rows @ taps[COLUMNS : 21 * COLUMNS].reshape(20, COLUMNS)
    found = products[3:].reshape(ROWS, COLUMNS + 4)
    # Twenty products of float32, whose sum is rounded after each of them.
    np.testing.assert_allclose(found[:, :COLUMNS], expected, rtol=0, atol=20 * math.ulp(8.0) * 2**29)
    assert np.isinf(found[:, COLUMNS:]).all()
    assert np.isinf(products[:3]).all()
