"""Calls of kernels from Numba code; the generator of kernels needs no Numba."""

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


def _call_kernel(
    typing_context: Any,
    address: Any,
    theta: Any,
    ints: Any,
    ints_begin: Any,
    floats: Any,
    floats_begin: Any,
    work: Any,
    predictions: Any,
    first_row: Any,
    loss: Any,
) -> Any:
    """Call the kernel at `address` for one experiment, from Numba code.

    The arguments are arrays, not addresses, so that the arrays stay alive during the call.
    `theta` (K, stride), `predictions` (M, stride) and the other arrays are contiguous. The
    experiment's numbers begin at ``ints[ints_begin]`` and ``floats[floats_begin]``. Its
    predictions are stored in the rows from `first_row`. If `predictions` has no rows, none are
    stored.
    """
    signature = types.void(
        types.int64,
        theta,
        ints,
        types.int64,
        floats,
        types.int64,
        work,
        predictions,
        types.int64,
        loss,
    )

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        arrays = {
            i: context.make_array(kind)(context, builder, value)
            for i, (kind, value) in enumerate(zip(signature.args, values, strict=True))
            if isinstance(kind, types.Array)
        }

        def extent(position: int, axis: int) -> Any:
            return builder.extract_value(arrays[position].shape, axis)

        def load_shifted(position: int, index: Any) -> Any:
            return builder.gep(arrays[position].data, [index])

        stride, rows, columns = extent(1, 1), extent(7, 0), extent(7, 1)
        none = builder.icmp_signed("==", rows, rows.type(0))
        first = load_shifted(7, builder.mul(values[8], columns))
        target = builder.select(none, first.type(None), first)
        arguments = [
            stride,
            arrays[1].data,
            stride,
            load_shifted(2, values[3]),
            load_shifted(4, values[5]),
            arrays[6].data,
            target,
            columns,
            arrays[9].data,
        ]
        integers = ir.FunctionType(ir.VoidType(), [a.type for a in arguments])
        function = builder.inttoptr(values[0], integers.as_pointer())
        builder.call(function, arguments)
        return context.get_dummy_value()

    return signature, generate


call_kernel: Any = intrinsic(_call_kernel)
