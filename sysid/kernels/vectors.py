"""Builder of LLVM vector instructions: arithmetic on several individuals at once, and memory.

A scalar value (time, inputs, numbers) is the same for all individuals. A vector has one value for
each individual. Scalars stay scalars until they are combined with a vector.

LLVM has no instructions for exp, log, pow, sin … and would call the scalar function for each lane.
GNU's libmvec computes 8 (AVX-512), 4 (AVX2) or 2 lanes in one call, within 4 units in the last
place. Lanes do not influence one another. Its symbols follow the x86-64 vector function ABI:
``_ZGV`` instruction set ``N`` lanes, one ``v`` for each argument, ``_`` name. Scalar calls remain
on other machines, and for functions that an older libmvec lacks.
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

_VECTOR_LIBRARY = "libmvec.so.1"


class VectorFunctions(NamedTuple):
    """Vector library of the machine: lanes in a call, and the symbol of each function."""

    lanes: int
    symbols: dict[str, str]


@cache
def load_vector_functions() -> VectorFunctions:
    """Load the vector functions of this machine, for use by compiled code."""
    none = VectorFunctions(1, {})
    if platform.machine() != "x86_64":
        return none
    try:
        library = ctypes.CDLL(_VECTOR_LIBRARY)
    except OSError:
        return none
    llvm.load_library_permanently(_VECTOR_LIBRARY)
    features = llvm.get_host_cpu_features()
    wide = (("avx512f", "e", 8), ("avx2", "d", 4), ("sse2", "b", 2))
    letter, lanes = next((isa, n) for feature, isa, n in wide if features.get(feature))
    counts = {function.llvm: function.fewest for function in FUNCTIONS.values()} | {"pow": 2}
    names = {name: f"_ZGV{letter}N{lanes}{'v' * count}_{name}" for name, count in counts.items()}
    return VectorFunctions(lanes, {n: s for n, s in names.items() if hasattr(library, s)})


LIBRARY_FUNCTIONS = ("erf",)
"""Functions of the C library for which LLVM has no intrinsic."""

DOUBLE, INT, BOOL = ir.DoubleType(), ir.IntType(64), ir.IntType(1)
_INT32 = ir.IntType(32)

FAST_MATH_FLAGS = ("nsz", "arcp")
"""Fast-math flags in use: any sign of zero, reciprocal for a division.

Never ``nnan`` or ``ninf``: the compiler could then remove the ``nan`` or ``inf`` that marks a
diverged simulation. Never ``reassoc``: sums stay in the order written, so that a lane's bits do
not depend on its neighbours. Never ``contract``: this module decides which products are fused with
a sum. The compiler would decide differently for 8 and for 16 lanes.
"""

# llvmlite is untyped
IrValue: TypeAlias = Any
IrFunction: TypeAlias = Any


class VectorBuilder:
    """Instruction builder for vectors of `width` individuals."""

    def __init__(self, function: IrFunction, width: int) -> None:
        self.function, self.width = function, width
        self.vector, self._ints = ir.VectorType(DOUBLE, width), ir.VectorType(INT, width)
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))

    def copy_with_width(self, width: int) -> "VectorBuilder":
        """Return a builder with another width that continues at the same position."""
        other = copy(self)
        other.width = width
        other.vector, other._ints = ir.VectorType(DOUBLE, width), ir.VectorType(INT, width)
        return other

    # ---- constants and shapes -------------------------------------------------------------
    @staticmethod
    def make_number(value: float) -> IrValue:
        """Make a scalar constant."""
        return ir.Constant(DOUBLE, float(value))

    @staticmethod
    def make_integer(value: int) -> IrValue:
        """Make a whole-number constant."""
        return ir.Constant(INT, value)

    def make_lane_numbers(self) -> IrValue:
        """Make the vector 0, 1, …, width - 1."""
        return ir.Constant(self._ints, list(range(self.width)))

    def splat(self, value: IrValue) -> IrValue:
        """Copy a scalar to every lane; a vector stays unchanged."""
        if isinstance(value.type, ir.VectorType):
            return value
        kind = ir.VectorType(value.type, self.width)
        if isinstance(value, ir.Constant):
            return ir.Constant(kind, [value.constant] * self.width)
        first_lane = self.builder.insert_element(
            ir.Constant(kind, ir.Undefined), value, ir.Constant(_INT32, 0)
        )
        zeros = ir.Constant(ir.VectorType(_INT32, self.width), [0] * self.width)
        return self.builder.shuffle_vector(first_lane, ir.Constant(kind, ir.Undefined), zeros)

    def match_shapes(self, *values: IrValue) -> list[IrValue]:
        """Convert all values to vectors if one of them is a vector."""
        if any(isinstance(v.type, ir.VectorType) for v in values):
            return [self.splat(v) for v in values]
        return list(values)

    # ---- arithmetic -----------------------------------------------------------------------
    def _emit_arithmetic(self, operation: str, a: IrValue, b: IrValue) -> IrValue:
        left, right = self.match_shapes(a, b)
        return getattr(self.builder, operation)(left, right, flags=FAST_MATH_FLAGS)

    def add(self, a: IrValue, b: IrValue) -> IrValue:
        """Emit a + b; a product is fused with the sum, in one rounding if the machine can."""
        for product, other in ((b, a), (a, b)):
            if _is_product(product):
                return self.call_intrinsic("fmuladd", *product.operands, other)
        return self._emit_arithmetic("fadd", a, b)

    def sub(self, a: IrValue, b: IrValue) -> IrValue:
        """Emit a - b; a product is fused with it as in a sum."""
        if _is_product(b):
            first, second = b.operands
            return self.call_intrinsic("fmuladd", self.builder.fneg(first), second, a)
        if _is_product(a):
            return self.call_intrinsic("fmuladd", *a.operands, self.builder.fneg(b))
        return self._emit_arithmetic("fsub", a, b)

    def mul(self, a: IrValue, b: IrValue) -> IrValue:
        """Emit a · b."""
        return self._emit_arithmetic("fmul", a, b)

    def div(self, a: IrValue, b: IrValue) -> IrValue:
        """Emit a / b."""
        return self._emit_arithmetic("fdiv", a, b)

    def rem(self, a: IrValue, b: IrValue) -> IrValue:
        """Emit the exact remainder of a / b, with the sign of a, as fmod."""
        return self._emit_arithmetic("frem", a, b)

    def compare(self, operator: str, a: IrValue, b: IrValue) -> IrValue:
        """Emit a comparison; false if either value is ``nan``, except ``!=``."""
        left, right = self.match_shapes(a, b)
        if operator == "!=":
            return self.builder.fcmp_unordered(operator, left, right)
        return self.builder.fcmp_ordered(operator, left, right)

    def select(self, condition: IrValue, a: IrValue, b: IrValue) -> IrValue:
        """Select a if the condition holds, else b."""
        if isinstance(condition.type, ir.VectorType):
            return self.builder.select(condition, self.splat(a), self.splat(b))
        left, right = self.match_shapes(a, b)
        return self.builder.select(condition, left, right)

    def test_any(self, conditions: IrValue) -> IrValue:
        """Emit whether a condition holds in any lane."""
        bits = self.builder.bitcast(conditions, ir.IntType(self.width))
        return self.builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    def interpolate(self, start: IrValue, fraction: IrValue, stop: IrValue) -> IrValue:
        """Emit start + fraction · (stop - start)."""
        return self.add(start, self.mul(fraction, self.sub(stop, start)))

    def call_intrinsic(self, name: str, *arguments: IrValue) -> IrValue:
        """Call an LLVM intrinsic lane by lane; vectors may use the machine's vector library."""
        values = self.match_shapes(*arguments)
        kind = values[0].type
        library = load_vector_functions()
        if name in library.symbols and isinstance(kind, ir.VectorType):
            return self._call_vector_function(library.symbols[name], library.lanes, values)
        if name in LIBRARY_FUNCTIONS:
            return self._call_library_function(name, values)
        suffix = f"v{self.width}f64" if isinstance(kind, ir.VectorType) else "f64"
        signature = ir.FunctionType(kind, [v.type for v in values])
        return self.builder.call(self._declare_function(f"llvm.{name}.{suffix}", signature), values)

    def _call_vector_function(self, symbol: str, width: int, values: list[IrValue]) -> IrValue:
        """Call a vector function of `width` lanes on the parts of wider vectors."""
        part = ir.VectorType(DOUBLE, width)
        function = self._declare_function(symbol, ir.FunctionType(part, [part] * len(values)))
        nothing = ir.Constant(self.vector, ir.Undefined)
        parts = []
        for first in range(0, self.width, width):
            chosen = _make_shuffle_mask(range(first, first + width))
            pieces = [self.builder.shuffle_vector(value, nothing, chosen) for value in values]
            parts.append(self.builder.call(function, pieces))
        return self._join_vectors(parts)

    def _call_library_function(self, name: str, values: list[IrValue]) -> IrValue:
        """Call a function of the C library, for each lane of vectors."""
        kind = values[0].type
        function = self._declare_function(name, ir.FunctionType(DOUBLE, [DOUBLE] * len(values)))
        if not isinstance(kind, ir.VectorType):
            return self.builder.call(function, values)
        result = ir.Constant(kind, ir.Undefined)
        for number in range(self.width):
            lane = ir.Constant(_INT32, number)
            parts = [self.builder.extract_element(value, lane) for value in values]
            result = self.builder.insert_element(result, self.builder.call(function, parts), lane)
        return result

    def _join_vectors(self, parts: list[IrValue]) -> IrValue:
        """Join vectors; neighbours join until one is left."""
        while len(parts) > 1:
            order = _make_shuffle_mask(range(2 * parts[0].type.count))
            parts = [
                self.builder.shuffle_vector(low, high, order)
                for low, high in zip(parts[::2], parts[1::2], strict=True)
            ]
        return parts[0]

    def split_fraction(self, value: IrValue) -> tuple[IrValue, IrValue]:
        """Split into floor, as whole numbers, and fraction."""
        floor = self.call_intrinsic("floor", value)
        return self.builder.fptosi(floor, self._ints), self.sub(value, floor)

    def clamp(self, value: IrValue, upper: IrValue) -> IrValue:
        """Clamp to [0, upper]; ``nan`` becomes 0, so that the value may address memory."""
        zero = self.make_number(0.0)
        positive = self.select(self.compare(">", value, zero), value, zero)
        return self.select(self.compare("<", positive, upper), positive, upper)

    # ---- memory ---------------------------------------------------------------------------
    def _compute_address(self, base: IrValue, index: IrValue) -> IrValue:
        return self.builder.gep(base, [index], inbounds=True, source_etype=DOUBLE)

    def load_double(self, base: IrValue, index: IrValue) -> IrValue:
        """Load the double at ``base[index]``."""
        return self.builder.load(self._compute_address(base, index), typ=DOUBLE)

    def load_integer(self, base: IrValue, index: IrValue) -> IrValue:
        """Load the whole number at ``base[index]``."""
        return self.builder.load(self._compute_address(base, index), typ=INT)

    def load_row(self, base: IrValue, index: IrValue) -> IrValue:
        """Load the vector of doubles that begins at ``base[index]``."""
        return self.builder.load(self._compute_address(base, index), typ=self.vector, align=8)

    def store_row(self, value: IrValue, base: IrValue, index: IrValue) -> None:
        """Store a vector of doubles at ``base[index]``."""
        self.builder.store(self.splat(value), self._compute_address(base, index), align=8)

    def store_columns(self, values: list[IrValue], base: IrValue, index: IrValue) -> None:
        """Store one vector of doubles, or two whose values alternate, at ``base[index]``."""
        row = self.splat(values[0])
        if len(values) == 2:
            pairs = [lane + side for lane in range(self.width) for side in (0, self.width)]
            row = self.builder.shuffle_vector(row, self.splat(values[1]), _make_shuffle_mask(pairs))
        self.builder.store(row, self._compute_address(base, index), align=8)

    def compute_addresses(self, base: IrValue, index: IrValue) -> IrValue:
        """Compute the addresses of ``base[index]`` for a vector of indices."""
        start = self.splat(self.builder.ptrtoint(base, INT))
        return self.builder.add(start, self.builder.shl(index, self.splat(self.make_integer(3))))

    def gather(self, addresses: IrValue, shift: IrValue) -> IrValue:
        """Load the doubles at `addresses`, each shifted by `shift` doubles.

        Each lane has its own load. The processor's gather is slower if its microcode guards
        against data leaks (docs/performance.md), and nowhere much faster.
        """
        b = self.builder
        step = b.shl(shift, self.make_integer(3))
        gathered = ir.Constant(self.vector, ir.Undefined)
        for number in range(self.width):
            lane = ir.Constant(_INT32, number)
            start = b.inttoptr(b.extract_element(addresses, lane), ir.PointerType())
            address = b.gep(start, [step], source_etype=ir.IntType(8))
            gathered = b.insert_element(gathered, b.load(address, typ=DOUBLE, align=8), lane)
        return gathered

    def gather_pairs(self, addresses: IrValue, shift: IrValue) -> list[IrValue]:
        """Load two doubles in a row at each of the addresses, each shifted by `shift` doubles."""
        b = self.builder
        step = b.shl(shift, self.make_integer(3))
        pair = ir.VectorType(DOUBLE, 2)
        parts = []
        for number in range(self.width):
            start = b.inttoptr(
                b.extract_element(addresses, ir.Constant(_INT32, number)), ir.PointerType()
            )
            address = b.gep(start, [step], source_etype=ir.IntType(8))
            parts.append(b.load(address, typ=pair, align=8))
        whole = self._join_vectors(parts)
        nothing = ir.Constant(whole.type, ir.Undefined)
        masks = [_make_shuffle_mask(range(side, 2 * self.width, 2)) for side in (0, 1)]
        return [b.shuffle_vector(whole, nothing, mask) for mask in masks]

    def copy_rows(self, base: IrValue, target: IrValue, source: IrValue, doubles: IrValue) -> None:
        """Copy doubles inside one array; the two parts must not overlap."""
        pointer = ir.PointerType()
        signature = ir.FunctionType(ir.VoidType(), [pointer, pointer, INT, BOOL])
        copy = self._declare_function("llvm.memcpy.p0.p0.i64", signature)
        size = self.builder.shl(doubles, self.make_integer(3))
        addresses = [self._compute_address(base, target), self._compute_address(base, source)]
        self.builder.call(copy, [*addresses, size, ir.Constant(BOOL, 0)])

    # ---- control --------------------------------------------------------------------------
    def branch(
        self,
        condition: IrValue,
        body: Callable[[], Sequence[IrValue]],
        otherwise: Sequence[IrValue],
    ) -> list[IrValue]:
        """Return the values of `body` if the scalar condition holds, else `otherwise`."""
        before = self.builder.block
        inside = self.function.append_basic_block("then")
        after = self.function.append_basic_block("join")
        self.builder.cbranch(condition, inside, after)
        self.builder.position_at_end(inside)
        values = body()
        last = self.builder.block
        self.builder.branch(after)
        self.builder.position_at_end(after)
        merged = []
        for new, old in zip(values, otherwise, strict=True):
            phi = self.builder.phi(new.type)
            phi.add_incoming(new, last)
            phi.add_incoming(old, before)
            merged.append(phi)
        return merged

    def _declare_function(self, name: str, signature: ir.FunctionType) -> IrFunction:
        module = self.function.module
        declared = module.globals.get(name)
        return declared if declared is not None else ir.Function(module, signature, name)


def _is_product(value: IrValue) -> bool:
    return getattr(value, "opname", "") == "fmul"


def _make_shuffle_mask(lanes: Sequence[int]) -> IrValue:
    """Make the mask of the lanes that a shuffle takes."""
    return ir.Constant(ir.VectorType(_INT32, len(lanes)), list(lanes))


class KernelLoop:
    """Loop that carries vectors or scalars in registers."""

    def __init__(self, lanes: VectorBuilder) -> None:
        self.lanes = lanes
        self._before = lanes.builder.block
        self._head = lanes.function.append_basic_block("head")
        self._after = lanes.function.append_basic_block("after")
        self._carried: list[tuple[IrValue, IrValue]] = []
        lanes.builder.branch(self._head)
        lanes.builder.position_at_end(self._head)

    def carry(self, initial: IrValue) -> IrValue:
        """Create a carried value; call this before any other instruction of the loop."""
        phi = self.lanes.builder.phi(initial.type)
        phi.add_incoming(initial, self._before)
        return phi

    def update(self, carried: IrValue, value: IrValue) -> None:
        """Set the carried value of the next iteration."""
        self._carried.append((carried, value))

    def leave_if(self, condition: IrValue) -> None:
        """Leave the loop here if the condition holds."""
        stay = self.lanes.function.append_basic_block("stay")
        self.lanes.builder.cbranch(condition, self._after, stay)
        self.lanes.builder.position_at_end(stay)

    def repeat(self) -> None:
        """End the iteration; later instructions follow the loop."""
        for carried, value in self._carried:
            carried.add_incoming(value, self.lanes.builder.block)
        self.lanes.builder.branch(self._head)
        self.lanes.builder.position_at_end(self._after)
