"""Arrays without reference counts, for Numba code that passes them on many times.

Numba counts the references to each array by atomic instructions, at each call of a function that
takes it. They took a third of the time of compiled searches. The caller of a function holds its
arguments until it returns, so they need no counts inside.
"""

from typing import Any

from numba.core import cgutils, types
from numba.core.types.containers import BaseTuple
from numba.extending import intrinsic


def _borrow(typing_context: Any, value: Any) -> Any:
    """Return arguments of the calling function, named tuples and their arrays, without counts.

    Only arguments may be borrowed. The caller holds them until the function returns, but nobody
    holds an array that the function itself has made.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _drop_counts(context, builder, value, values[0])

    return value(value), generate


def _drop_counts(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()
    if isinstance(kind, BaseTuple):
        parts = cgutils.unpack_tuple(builder, value, len(kind))
        dropped = [
            _drop_counts(context, builder, part_kind, part)
            for part_kind, part in zip(kind, parts, strict=True)
        ]
        return context.make_tuple(builder, kind, dropped)
    return value


borrow: Any = intrinsic(_borrow)
