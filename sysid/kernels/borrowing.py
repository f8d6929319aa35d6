"""Compiled functions that do not count references to the arrays they are given.

Numba counts the references to each array by atomic instructions, at each call of a function that
takes it. They took a third of the time of compiled searches. The caller of a function holds its
arguments until it returns, so they need no counts inside.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from numba.core import cgutils, ir, types
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.ir_utils import build_definitions
from numba.core.types.containers import BaseTuple
from numba.core.untyped_passes import FixupArgs
from numba.extending import intrinsic

from sysid.core.jit import jit_compile

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compile_borrowing(function: _Function) -> _Function:
    """Compile as `jit_compile` does, with all arrays and tuples among the arguments borrowed.

    The function must not return one of them, nor a part of one: nobody would hold its memory.
    """
    return jit_compile(function, _BorrowingCompiler)


def _type_borrow(typing_context: Any, value: Any) -> Any:
    """Return an array, or a tuple with its arrays, without counts."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _drop_counts(context, builder, value, values[0])

    return value(value), generate


_borrow: Any = intrinsic(_type_borrow)


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


@register_pass(mutates_CFG=False, analysis_only=False)
class _BorrowArguments(FunctionPass):  # type: ignore[misc]
    """Write ``x = borrow(x)`` for each argument at the head of a function."""

    _name = "borrow_arguments"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        """Change the instructions of a function before their types are inferred."""
        blocks = state.func_ir.blocks
        entry = blocks[min(blocks)]
        entry.body = [
            written
            for statement in entry.body
            for written in _borrow_argument(statement, entry.scope, state.args)
        ]
        state.func_ir._definitions = build_definitions(blocks)
        return True


def _borrow_argument(statement: Any, scope: Any, kinds: Any) -> list[Any]:
    """Write a statement again; where it reads an argument, that is borrowed."""
    argument = getattr(statement, "value", None)
    if not isinstance(argument, ir.Arg):
        return [statement]
    if not isinstance(kinds[argument.index], types.Array | BaseTuple):
        return [statement]
    loc = statement.loc
    function = scope.redefine("$borrow", loc)
    counted = scope.redefine(f"$counted_{argument.name}", loc)
    return [
        ir.Assign(argument, counted, loc),
        ir.Assign(ir.Global("borrow", _borrow, loc), function, loc),
        ir.Assign(ir.Expr.call(function, (counted,), (), loc), statement.target, loc),
    ]


class _BorrowingCompiler(CompilerBase):  # type: ignore[misc]
    """Numba's compiler, with borrowed arguments."""

    def define_pipelines(self) -> list[Any]:
        """Add the pass behind the one that reads the function."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_BorrowArguments, FixupArgs)
        passes.finalize()
        return [passes]
