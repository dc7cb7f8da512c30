"""Instructions on vectors of float32 for loops that numba compiles, and a product of matrices made of them.

numba keeps no array in registers, and loops over the channels of one pixel are too short for the checks that precede
vectorised ones. Here the instructions are written in LLVM's language. Multiplications and additions are fused wherever
the code says so and nowhere else, so that results are the same to the bit on all processors.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

#: Numbers in a vector: a register of AVX2.
LANES = 8
#: Rows and columns that `multiply_block` makes: twelve sums, with two vectors of taps and a value 15 of 16 registers.
ROWS, COLUMNS = 6, 16
#: Whether this processor gains. With AVX-512 oneDNN multiplies twice as many numbers at a time: not measured.
PAYS = torch.backends.cpu.get_cpu_capability() == "AVX2"

_INDEX = ir.IntType(64)
_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_FIRST_LANES = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)


class Code:
    """Writes the instructions of one function that numba calls with arrays of float32 and places in them."""

    def __init__(self, context: Any, builder: Any, signature: Any) -> None:
        self.context, self.builder, self.types = context, builder, signature.args
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
        declare: Any = cgutils.get_or_insert_function
        self._fma = declare(builder.module, kind, f"llvm.fma.v{LANES}f32")

    def data(self, argument: int, array: Any) -> Any:
        """Address of the first number of the array that is the given argument of the function."""
        return self.context.make_array(self.types[argument])(self.context, self.builder, array).data

    def constant(self, number: float) -> Any:
        """Return a vector of one number."""
        return ir.Constant(_VECTOR, [float(np.float32(number))] * LANES)

    def number(self, address: Any, *steps: tuple[Any, Any]) -> Any:
        """Load the number that is count · distance numbers behind an address, for each of `steps`."""
        return self.builder.load(self._at(address, steps))

    def load(self, address: Any, *steps: tuple[Any, Any]) -> Any:
        """Load a vector, from where `number` loads."""
        return self.builder.load(self._vector_at(address, steps), align=4)

    def store(self, vector: Any, address: Any, *steps: tuple[Any, Any]) -> None:
        """Store a vector, to where `load` loads from."""
        self.builder.store(vector, self._vector_at(address, steps), align=4)

    def spread(self, number: Any) -> Any:
        """Return a vector of one number that was loaded or passed."""
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        one = self.builder.insert_element(undefined, number, ir.Constant(ir.IntType(32), 0))
        return self.builder.shuffle_vector(one, undefined, _FIRST_LANES)

    def fma(self, a: Any, b: Any, c: Any) -> Any:
        """Return a · b + c, rounded once."""
        return self.builder.call(self._fma, [a, b, c])

    def add(self, a: Any, b: Any) -> Any:
        return self.builder.fadd(a, b)

    def subtract(self, a: Any, b: Any) -> Any:
        return self.builder.fsub(a, b)

    def larger(self, a: Any, b: Any) -> Any:
        """Return the larger of two numbers, `a` where it is NaN."""
        return self.builder.select(self.builder.fcmp_ordered("<", a, b), b, a)

    def combine(self, factors: Sequence[float], vectors: Sequence[Any]) -> Any:
        """Add vectors times constants, those times 1 first; at least one constant is not 0."""
        terms = sorted((pair for pair in zip(factors, vectors, strict=True) if pair[0]), key=lambda pair: pair[0] != 1)
        (factor, total), *others = terms
        if factor != 1:
            total = self.builder.fmul(self.constant(factor), total)
        for factor, vector in others:
            total = self.add(total, vector) if factor == 1 else self.fma(self.constant(factor), vector, total)
        return total

    def _at(self, address: Any, steps: Sequence[tuple[Any, Any]]) -> Any:
        for count, distance in steps:
            count, distance = (ir.Constant(_INDEX, n) if isinstance(n, int) else n for n in (count, distance))
            address = self.builder.gep(address, [self.builder.mul(count, distance)])
        return address

    def _vector_at(self, address: Any, steps: Sequence[tuple[Any, Any]]) -> Any:
        return self.builder.bitcast(self._at(address, steps), _VECTOR.as_pointer())


def _multiply_block(
    _: Any, values: Any, start: Any, row: Any, length: Any, taps: Any, first: Any, products: Any, place: Any,
    products_row: Any,
) -> Any:  # fmt: skip
    """Multiply `ROWS` rows of `length` values by taps of `COLUMNS` columns, and write the products.

    Rows of values are `row` numbers apart, those of products `products_row`. Taps of one value after the other, each of
    all columns, begin at `first`.
    """

    def write(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        _, start, row, length, _, first, _, place, products_row = args
        code = Code(context, builder, signature)
        source, weight, target = (code.data(n, args[n]) for n in (0, 4, 6))
        vectors = range(COLUMNS // LANES)
        # The compiler keeps variables that are never indexed in registers.
        new: Any = cgutils.alloca_once
        sums = [[new(builder, _VECTOR) for _ in vectors] for _ in range(ROWS)]
        for total in (total for rows in sums for total in rows):
            builder.store(code.constant(0), total)
        with cgutils.for_range(builder, length, intp=_INDEX) as loop:
            here = [code.load(weight, (1, first), (loop.index, COLUMNS), (v, LANES)) for v in vectors]
            for r in range(ROWS):
                value = code.spread(code.number(source, (1, start), (r, row), (loop.index, 1)))
                for v in vectors:
                    builder.store(code.fma(value, here[v], builder.load(sums[r][v])), sums[r][v])
        for r in range(ROWS):
            for v in vectors:
                code.store(builder.load(sums[r][v]), target, (1, place), (r, products_row), (v, LANES))
        return context.get_dummy_value()

    return types.void(values, start, row, length, taps, first, products, place, products_row), write


multiply_block: Any = intrinsic(_multiply_block)
