"""Sums of products as vector instructions, for Numba code.

LLVM does not join four running sums into one vector by itself. The sums and their order are the
same as those of a plain loop, so the bits are too.
"""

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.core.types.containers import UniTuple
from numba.extending import intrinsic

N_SUMS = 4


def _sum_products(typing_context: Any, first: Any, second: Any, count: Any) -> Any:
    """Return four sums of products; entry m belongs to sum m % 4, and `count` is one of 4, 8, …."""
    for array in (first, second):
        if not (isinstance(array, types.Array) and array.ndim == 1 and array.layout == "C"):
            raise TypingError(f"need one-dimensional contiguous arrays, found {array}")
    sums = UniTuple(types.float64, N_SUMS)
    return sums(first, second, types.intp), _generate_sums


def _generate_sums(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    kinds, count = signature.args, values[2]
    data = [context.make_array(kinds[i])(context, builder, values[i]).data for i in range(2)]
    vector = ir.VectorType(ir.DoubleType(), N_SUMS)
    sums = cgutils.alloca_once_value(builder, ir.Constant(vector, [0.0] * N_SUMS))
    zero, step = ir.Constant(count.type, 0), ir.Constant(count.type, N_SUMS)
    with cgutils.for_range_slice(builder, zero, count, step) as (index, _):
        first, second = (
            builder.load(
                builder.bitcast(builder.gep(pointer, [index]), vector.as_pointer()), align=8
            )
            for pointer in data
        )
        builder.store(builder.fadd(builder.load(sums), builder.fmul(first, second)), sums)
    total = builder.load(sums)
    parts = [builder.extract_element(total, ir.Constant(ir.IntType(32), i)) for i in range(N_SUMS)]
    return context.make_tuple(builder, signature.return_type, parts)


sum_products: Any = intrinsic(_sum_products)
