"""Writes vector instructions of LLVM: arithmetic on several individuals at once, and memory.

A value is either the same for all individuals (a scalar: time, inputs, numbers) or one per
individual (a vector). Scalars stay scalars until they meet a vector.

Vector versions of exp, log, pow, sin …, where the machine's C library has them.

LLVM has no instructions for these functions and would call the scalar one for each lane. GNU's
libmvec computes 8 (AVX-512), 4 (AVX2) or 2 lanes in one call, within 4 units in the last place;
lanes do not influence one another. Its symbols are named by the x86-64 vector function ABI:
``_ZGV`` instruction set ``N`` lanes, one ``v`` for each argument, ``_`` name. Elsewhere, and for
functions an older libmvec lacks, the scalar calls stay.
"""

import ctypes
import platform
from collections.abc import Callable, Sequence
from copy import copy
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import llvmlite.binding as llvm
from llvmlite import ir

from sysid.language.functions import FUNCTIONS

_LIBRARY = "libmvec.so.1"


class VectorFunctions(NamedTuple):
    """What the machine offers: lanes a call, and the symbol of each function that is there."""

    lanes: int
    symbols: dict[str, str]


@cache
def vector_functions() -> VectorFunctions:
    """The vector functions of this machine, loaded so that compiled code finds them."""
    none = VectorFunctions(1, {})
    if platform.machine() != "x86_64":
        return none
    try:
        library = ctypes.CDLL(_LIBRARY)
    except OSError:
        return none
    llvm.load_library_permanently(_LIBRARY)
    features = llvm.get_host_cpu_features()
    wide = (("avx512f", "e", 8), ("avx2", "d", 4), ("sse2", "b", 2))
    letter, lanes = next((isa, n) for feature, isa, n in wide if features.get(feature))
    counts = {one.llvm: one.fewest for one in FUNCTIONS.values()} | {"pow": 2}
    names = {name: f"_ZGV{letter}N{lanes}{'v' * count}_{name}" for name, count in counts.items()}
    return VectorFunctions(lanes, {n: s for n, s in names.items() if hasattr(library, s)})


DOUBLE, INT, BOOL = ir.DoubleType(), ir.IntType(64), ir.IntType(1)
_INT32 = ir.IntType(32)

FLAGS = ("nsz", "arcp")
"""Fast-math flags in use: any sign of zero, reciprocal for a division.

Never ``nnan`` or ``ninf``: with them the compiler may drop the very ``nan`` or ``inf`` by which a
diverged simulation is known. Nor ``reassoc``: sums stay in the order written, so that a lane's
bits do not depend on how the compiler arranges its neighbours. Nor ``contract``: which products
are fused with a sum is said here, else the compiler decides, for 8 lanes otherwise than for 16.
"""

# llvmlite is untyped
Value: TypeAlias = Any
Function: TypeAlias = Any


class Lanes:
    """An instruction builder that knows vectors of `width` individuals."""

    def __init__(self, function: Function, width: int) -> None:
        self.function, self.width = function, width
        self.vector, self._ints = ir.VectorType(DOUBLE, width), ir.VectorType(INT, width)
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))

    def of_width(self, width: int) -> "Lanes":
        """A builder of other vectors that goes on where this one writes."""
        other = copy(self)
        other.width = width
        other.vector, other._ints = ir.VectorType(DOUBLE, width), ir.VectorType(INT, width)
        return other

    # ---- constants and shapes -------------------------------------------------------------
    @staticmethod
    def number(value: float) -> Value:
        """A scalar constant."""
        return ir.Constant(DOUBLE, float(value))

    @staticmethod
    def integer(value: int) -> Value:
        """A whole number."""
        return ir.Constant(INT, value)

    def lane_numbers(self) -> Value:
        """0, 1, …, width - 1."""
        return ir.Constant(self._ints, list(range(self.width)))

    def splat(self, value: Value) -> Value:
        """The scalar in every lane; a vector as it is."""
        if isinstance(value.type, ir.VectorType):
            return value
        kind = ir.VectorType(value.type, self.width)
        if isinstance(value, ir.Constant):
            return ir.Constant(kind, [value.constant] * self.width)
        one = self.builder.insert_element(
            ir.Constant(kind, ir.Undefined), value, ir.Constant(_INT32, 0)
        )
        zeros = ir.Constant(ir.VectorType(_INT32, self.width), [0] * self.width)
        return self.builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), zeros)

    def same_shape(self, *values: Value) -> list[Value]:
        """All as vectors if one of them is."""
        if any(isinstance(v.type, ir.VectorType) for v in values):
            return [self.splat(v) for v in values]
        return list(values)

    # ---- arithmetic -----------------------------------------------------------------------
    def _float(self, operation: str, a: Value, b: Value) -> Value:
        left, right = self.same_shape(a, b)
        return getattr(self.builder, operation)(left, right, flags=FLAGS)

    def add(self, a: Value, b: Value) -> Value:
        """Sum of a and b; a product is fused with it, in one rounding where the machine can."""
        for product, other in ((b, a), (a, b)):
            if _is_product(product):
                return self.intrinsic("fmuladd", *product.operands, other)
        return self._float("fadd", a, b)

    def sub(self, a: Value, b: Value) -> Value:
        """Difference of a and b; a product is fused with it as in a sum."""
        if _is_product(b):
            first, second = b.operands
            return self.intrinsic("fmuladd", self.builder.fneg(first), second, a)
        if _is_product(a):
            return self.intrinsic("fmuladd", *a.operands, self.builder.fneg(b))
        return self._float("fsub", a, b)

    def mul(self, a: Value, b: Value) -> Value:
        """Product of a and b."""
        return self._float("fmul", a, b)

    def div(self, a: Value, b: Value) -> Value:
        """Quotient of a and b."""
        return self._float("fdiv", a, b)

    def compare(self, operator: str, a: Value, b: Value) -> Value:
        """A comparison; false where either is ``nan``, except ``!=``."""
        left, right = self.same_shape(a, b)
        if operator == "!=":
            return self.builder.fcmp_unordered(operator, left, right)
        return self.builder.fcmp_ordered(operator, left, right)

    def select(self, condition: Value, a: Value, b: Value) -> Value:
        """A where the condition holds, b elsewhere."""
        if isinstance(condition.type, ir.VectorType):
            return self.builder.select(condition, self.splat(a), self.splat(b))
        left, right = self.same_shape(a, b)
        return self.builder.select(condition, left, right)

    def between(self, start: Value, fraction: Value, stop: Value) -> Value:
        """Start + fraction · (stop - start)."""
        return self.add(start, self.mul(fraction, self.sub(stop, start)))

    def intrinsic(self, name: str, *arguments: Value) -> Value:
        """A function LLVM knows, lane by lane; vectors may go to the machine's vector library."""
        values = self.same_shape(*arguments)
        kind = values[0].type
        offered = vector_functions()
        if name in offered.symbols and isinstance(kind, ir.VectorType):
            return self._in_parts(offered.symbols[name], offered.lanes, values)
        suffix = f"v{self.width}f64" if isinstance(kind, ir.VectorType) else "f64"
        signature = ir.FunctionType(kind, [v.type for v in values])
        return self.builder.call(self._declared(f"llvm.{name}.{suffix}", signature), values)

    def _in_parts(self, symbol: str, width: int, values: list[Value]) -> Value:
        """A vector function of `width` lanes, called on the parts of wider vectors."""
        part = ir.VectorType(DOUBLE, width)
        function = self._declared(symbol, ir.FunctionType(part, [part] * len(values)))
        nothing = ir.Constant(self.vector, ir.Undefined)
        parts = []
        for first in range(0, self.width, width):
            chosen = _positions(range(first, first + width))
            pieces = [self.builder.shuffle_vector(one, nothing, chosen) for one in values]
            parts.append(self.builder.call(function, pieces))
        while len(parts) > 1:  # neighbours join until one vector is left
            width = parts[0].type.count
            order = _positions(range(2 * width))
            parts = [
                self.builder.shuffle_vector(low, high, order)
                for low, high in zip(parts[::2], parts[1::2], strict=True)
            ]
        return parts[0]

    def whole_and_fraction(self, value: Value) -> tuple[Value, Value]:
        """Floor as whole numbers, and what remains."""
        floor = self.intrinsic("floor", value)
        return self.builder.fptosi(floor, self._ints), self.sub(value, floor)

    def clamped(self, value: Value, upper: Value) -> Value:
        """Inside [0, upper]; 0 where the value is ``nan``, so that it may address memory."""
        zero = self.number(0.0)
        positive = self.select(self.compare(">", value, zero), value, zero)
        return self.select(self.compare("<", positive, upper), positive, upper)

    # ---- memory ---------------------------------------------------------------------------
    def _address(self, base: Value, index: Value) -> Value:
        return self.builder.gep(base, [index], inbounds=True, source_etype=DOUBLE)

    def load(self, base: Value, index: Value) -> Value:
        """The double at ``base[index]``."""
        return self.builder.load(self._address(base, index), typ=DOUBLE)

    def load_int(self, base: Value, index: Value) -> Value:
        """The whole number at ``base[index]``."""
        return self.builder.load(self._address(base, index), typ=INT)

    def load_row(self, base: Value, index: Value) -> Value:
        """The vector of doubles that begins at ``base[index]``."""
        return self.builder.load(self._address(base, index), typ=self.vector, align=8)

    def store_row(self, value: Value, base: Value, index: Value) -> None:
        """Store a vector of doubles from ``base[index]`` on."""
        self.builder.store(self.splat(value), self._address(base, index), align=8)

    def addresses(self, base: Value, index: Value) -> Value:
        """Addresses of ``base[index]`` for a vector of indices, to add a common shift to."""
        start = self.splat(self.builder.ptrtoint(base, INT))
        return self.builder.add(start, self.builder.shl(index, self.splat(self.integer(3))))

    def gather(self, addresses: Value, shift: Value) -> Value:
        """The doubles at `addresses`, each `shift` doubles further.

        One load for each lane, not the processor's gather: that is slower where its microcode
        guards against leaks of data (docs/performance.md), and nowhere faster by much.
        """
        b = self.builder
        step = b.shl(shift, self.integer(3))
        found = ir.Constant(self.vector, ir.Undefined)
        for number in range(self.width):
            lane = ir.Constant(_INT32, number)
            start = b.inttoptr(b.extract_element(addresses, lane), ir.PointerType())
            place = b.gep(start, [step], source_etype=ir.IntType(8))
            found = b.insert_element(found, b.load(place, typ=DOUBLE, align=8), lane)
        return found

    def copy_rows(self, base: Value, target: Value, source: Value, doubles: Value) -> None:
        """Copy doubles inside one array; the two parts do not overlap."""
        pointer = ir.PointerType()
        signature = ir.FunctionType(ir.VoidType(), [pointer, pointer, INT, BOOL])
        copy = self._declared("llvm.memcpy.p0.p0.i64", signature)
        size = self.builder.shl(doubles, self.integer(3))
        places = [self._address(base, target), self._address(base, source)]
        self.builder.call(copy, [*places, size, ir.Constant(BOOL, 0)])

    # ---- control --------------------------------------------------------------------------
    def branch(
        self, condition: Value, body: Callable[[], Sequence[Value]], otherwise: Sequence[Value]
    ) -> list[Value]:
        """Values of `body` where the scalar condition holds, else `otherwise`."""
        before = self.builder.block
        inside = self.function.append_basic_block("then")
        after = self.function.append_basic_block("join")
        self.builder.cbranch(condition, inside, after)
        self.builder.position_at_end(inside)
        made = body()
        last = self.builder.block
        self.builder.branch(after)
        self.builder.position_at_end(after)
        merged = []
        for new, old in zip(made, otherwise, strict=True):
            phi = self.builder.phi(new.type)
            phi.add_incoming(new, last)
            phi.add_incoming(old, before)
            merged.append(phi)
        return merged

    def _declared(self, name: str, signature: ir.FunctionType) -> Function:
        module = self.function.module
        known = module.globals.get(name)
        return known if known is not None else ir.Function(module, signature, name)


def _is_product(value: Value) -> bool:
    return getattr(value, "opname", "") == "fmul"


def _positions(places: Sequence[int]) -> Value:
    """Which lanes a shuffle takes."""
    return ir.Constant(ir.VectorType(_INT32, len(places)), list(places))


class Loop:
    """A loop whose carried values are vectors or scalars in registers."""

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        self._before = lanes.builder.block
        self._head = lanes.function.append_basic_block("head")
        self._after = lanes.function.append_basic_block("after")
        self._carried: list[tuple[Value, Value]] = []
        lanes.builder.branch(self._head)
        lanes.builder.position_at_end(self._head)

    def carry(self, initial: Value) -> Value:
        """A value that each turn hands to the next; call before any other instruction."""
        phi = self.lanes.builder.phi(initial.type)
        phi.add_incoming(initial, self._before)
        return phi

    def update(self, carried: Value, value: Value) -> None:
        """Say what the next turn gets."""
        self._carried.append((carried, value))

    def leave_if(self, condition: Value) -> None:
        """Leave the loop here, in the middle of a turn."""
        stay = self.lanes.function.append_basic_block("stay")
        self.lanes.builder.cbranch(condition, self._after, stay)
        self.lanes.builder.position_at_end(stay)

    def repeat(self) -> None:
        """End of a turn; what follows is written behind the loop."""
        for carried, value in self._carried:
            carried.add_incoming(value, self.lanes.builder.block)
        self.lanes.builder.branch(self._head)
        self.lanes.builder.position_at_end(self._after)
