"""Null and weak directions of the parameters, and the combinations that remain identifiable.

The rows of `null` (m, D) span the directions along which the output does not change. They fall
into blocks that have no parameter in common. In a block of M parameters and m directions, M - m
combinations are constant along all directions. They follow from the reduced echelon form R of the
directions with the pivots i. For every other parameter j

    e_j - Σ_i R_ij e_i        is orthogonal to all directions.

Applied to ln θ with rational entries this is a product of powers (``A_m*k_b/J``). Applied to θ it
is a sum (``T + L``). The sum near the estimate is used if neither is rational, or if a negative
estimate would get a fractional power.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import sqrt

import numpy as np

from sysid.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class IdentifiableCombination:
    """A combination that the data determine, though not each of its parameters.

    Attributes
    ----------
    members : tuple of str
        Names of the parameters of the combination.
    expression : str
        A product of powers, such as ``A_m*k_b/J``, or else a sum, such as ``T + L``.
    value : float
        Estimate of the combination; its unit follows from its parameters.
    stderr : float or None
        Standard error of `value`, in the same unit.
    is_local : bool
        Whether the combination holds near the estimate only, as a sum in place of
        ``K*exp(-E/300)``.
    """

    members: tuple[str, ...]
    expression: str
    value: float
    stderr: float | None
    is_local: bool = False

    @property
    def text(self) -> str:
        """The expression, and where it holds."""
        return f"{self.expression} (near the estimate)" if self.is_local else self.expression


_LINK_TOLERANCE = 1e-4  # parameters with a weaker link are not moved together: it is rounding
_PIVOT_TOLERANCE = 1e-3  # of the largest entry of its column
_FRACTION_TOLERANCE, _MAX_DENOMINATOR, _MAX_FRACTION = 1e-3, 4, 6


@dataclass(frozen=True, slots=True, eq=False)
class ParameterBlock:
    """Parameters that some directions move together.

    Attributes
    ----------
    members : IntArray, shape (M,)
    basis : FloatArray, shape (m, M)
        The directions, in the members' coordinates in [0, 1].
    """

    members: IntArray
    basis: FloatArray

    @property
    def has_no_combination(self) -> bool:
        """Whether no combination remains: as many directions as parameters, or one parameter."""
        return bool(self.members.size < 2 or self.basis.shape[0] >= self.members.size)


def find_blocks(null: FloatArray, member: BoolArray) -> tuple[ParameterBlock, ...]:
    """Find the blocks of orthonormal directions (m, D) over the parameters in `member`."""
    if not member.any():
        return ()
    products = np.abs(null.T @ null)
    lengths = np.sqrt(np.maximum(np.diag(products), np.finfo(float).tiny))
    linked = products > _LINK_TOLERANCE * np.outer(lengths, lengths)
    blocks, remaining = [], list(np.flatnonzero(member))
    while remaining:
        block = [remaining.pop(0)]
        for d in block:  # grows during the iteration
            near = [other for other in remaining if linked[d, other]]
            block += near
            remaining = [other for other in remaining if other not in near]
        members = np.array(sorted(block), dtype=np.int64)
        _, size, rows = np.linalg.svd(null[:, members], full_matrices=False)
        # A direction lies completely in its own block, and not at all in another.
        blocks.append(ParameterBlock(members, rows[size > 0.5]))
    return tuple(blocks)


def express_combinations(
    block: ParameterBlock,
    names: Sequence[str],
    theta: FloatArray,
    scale: FloatArray,
    covariance: FloatArray,
) -> tuple[IdentifiableCombination, ...]:
    """Express the identifiable combinations of a block.

    Parameters
    ----------
    names : sequence of str, length D
    theta, scale : FloatArray, shape (D,)
        Estimate, and ∂θ/∂p at the point p in [0, 1].
    covariance : FloatArray, shape (D, D)
        Covariance of θ in its units, without the part along the directions.
    """
    if block.has_no_combination:
        return ()
    value, unit = theta[block.members], scale[block.members]
    has_logarithm = bool(np.all(value != 0.0))
    per_point = unit / value if has_logarithm else np.ones(value.size)
    entries = np.array(list(_iterate_orthogonal(block.basis * per_point)))
    small = _find_negligible(entries * per_point)
    powers = _round_powers(entries, value, small) if has_logarithm else None
    sums = np.where(small, 0.0, entries / (value if has_logarithm else unit))
    sums = sums / _get_leading(sums)
    terms = _round_to_fractions(sums, small, unit)
    if powers is not None and (terms is None or powers[1] <= terms[1]):
        texts = [(e, _format_product([names[d] for d in block.members], e)) for e in powers[0]]
        products = [(text, float(np.prod(value**e)), e / value) for e, text in texts]
        combinations = [(text, total, total * slope) for text, total, slope in products]
        is_local = False
    else:
        is_local = terms is None
        factors = sums if terms is None else terms[0]
        combinations = [
            (_format_sum([names[d] for d in block.members], c), float(c @ value), c)
            for c in factors
        ]
    return tuple(
        _make_combination(block, names, covariance, is_local, *combination)
        for combination in combinations
    )


def _make_combination(
    block: ParameterBlock,
    names: Sequence[str],
    covariance: FloatArray,
    is_local: bool,
    text: str,
    value: float,
    slope: FloatArray,
) -> IdentifiableCombination:
    inside = covariance[np.ix_(block.members, block.members)]
    stderr = sqrt(max(float(slope @ inside @ slope), 0.0))
    members = tuple(names[d] for d, s in zip(block.members, slope, strict=True) if s != 0.0)
    return IdentifiableCombination(members, text, value, stderr, is_local)


def _iterate_orthogonal(rows: FloatArray) -> Iterator[FloatArray]:
    """Iterate over combinations orthogonal to all rows, each with one parameter that is no pivot.

    Pivots are the parameters that most directions move, in the order of the model.
    """
    simple = _reduce_rows(rows, range(rows.shape[1]))[0]
    counts = np.count_nonzero(np.abs(simple) > _PIVOT_TOLERANCE, axis=0)
    reduced, pivots = _reduce_rows(rows, np.argsort(-counts, kind="stable").tolist())
    for j in range(rows.shape[1]):
        if j not in pivots:
            entry = np.zeros(rows.shape[1])
            entry[j], entry[pivots] = 1.0, -reduced[:, j]
            yield _orient_combination(entry)


def _reduce_rows(rows: FloatArray, columns: Sequence[int]) -> tuple[FloatArray, list[int]]:
    """Compute the reduced echelon form, with the pivots in the order of `columns`."""
    rows = rows / np.max(np.abs(rows), axis=1, keepdims=True)
    pivots: list[int] = []
    for column in columns:
        done = len(pivots)
        if done == rows.shape[0]:
            break
        best = done + int(np.argmax(np.abs(rows[done:, column])))
        size = float(np.max(np.abs(rows[done:])))
        if abs(float(rows[best, column])) <= _PIVOT_TOLERANCE * size:
            continue
        rows[[done, best]] = rows[[best, done]]
        rows[done] /= rows[done, column]
        others = np.arange(rows.shape[0]) != done
        rows[others] -= np.outer(rows[others, column], rows[done])
        pivots.append(column)
    return rows[: len(pivots)], pivots


def _orient_combination(entry: FloatArray) -> FloatArray:
    """Return the combination or its inverse, whichever has fewer negative entries."""
    large = np.abs(entry) > _PIVOT_TOLERANCE
    return -entry if np.sum(entry[large] < 0) > np.sum(entry[large] > 0) else entry


def _find_negligible(parts: FloatArray) -> BoolArray:
    """Find the parameters with almost no part in a combination; two always have one.

    The measure is the change of the combination over a parameter's range. Factors alone have units,
    and a small factor of a large parameter matters.
    """
    second = np.sort(np.abs(parts), axis=1)[:, -2:-1]
    return np.asarray(np.abs(parts) < _PIVOT_TOLERANCE * second)


def _get_leading(sums: FloatArray) -> FloatArray:
    """Get the first entry of each row that is not 0, so that sums begin with a plain name."""
    return np.take_along_axis(sums, np.argmax(sums != 0.0, axis=1)[:, None], axis=1)


def _round_to_fractions(
    entries: FloatArray, small: BoolArray, unit: FloatArray | None = None
) -> tuple[FloatArray, float] | None:
    """Round the entries to small fractions; return them and the error, or None if it is large.

    None also if rounding would drop a parameter that is not `small`. With `unit`, the ranges (M,)
    of the members, the entries are factors of a sum that begins with 1. The error is then that of
    the sum.
    """
    nearest = np.array(
        [[float(Fraction(v).limit_denominator(_MAX_DENOMINATOR)) for v in row] for row in entries]
    )
    if np.any((nearest == 0.0) & ~small):
        return None
    errors = np.abs(nearest - entries)
    if unit is not None:
        first = np.argmax(entries != 0.0, axis=1)
        errors = errors * np.maximum(1.0, np.abs(unit / unit[first][:, None]))
    error = float(np.max(errors))
    return (
        (nearest, error)
        if error < _FRACTION_TOLERANCE and np.max(np.abs(nearest)) <= _MAX_FRACTION
        else None
    )


def _round_powers(
    entries: FloatArray, value: FloatArray, small: BoolArray
) -> tuple[FloatArray, float] | None:
    """Round powers of `value` (M,) likewise; None also if a power is not a real number."""
    rounded = _round_to_fractions(entries, small)
    if rounded is None:
        return None
    fractional = rounded[0] != np.rint(rounded[0])
    return None if np.any(fractional & (value < 0)) else rounded


def _format_product(names: Sequence[str], powers: FloatArray) -> str:
    above = [_format_power(name, p) for name, p in zip(names, powers, strict=True) if p > 0]
    below = [_format_power(name, -p) for name, p in zip(names, powers, strict=True) if p < 0]
    top = "*".join(above) or "1"
    if not below:
        return top
    return f"{top}/{below[0]}" if len(below) == 1 else f"{top}/({'*'.join(below)})"


def _format_power(name: str, power: float) -> str:
    return name if power == 1.0 else f"{name}**{power:g}"


def _format_sum(names: Sequence[str], factors: FloatArray) -> str:
    text = ""
    for name, factor in zip(names, factors, strict=True):
        if factor == 0.0:
            continue
        digits = f"{abs(factor):.4g}"
        size = name if digits == "1" else f"{digits}*{name}"
        sign = ("-" if factor < 0 else "") if not text else (" - " if factor < 0 else " + ")
        text += sign + size
    return text


# Squared share from which a parameter belongs to a direction: to a weak direction, and to one
# without any effect, which is computed to many digits.
_WEAK_SHARE, NULL_SHARE = 0.05, 1e-5
_VAGUE_DEVIATION = 0.5  # of the range: a larger standard error is vague


@dataclass(frozen=True, slots=True, eq=False)
class SingularDirections:
    """Singular directions (D, D) of the sensitivities to the point in [0, 1].

    The output does not change along the `null` directions. The data say little about the `weak`
    ones. `is_null_member` marks the parameters that null directions move. `is_vague` marks those
    with a large standard error.
    """

    rows: FloatArray
    null: BoolArray
    weak: BoolArray
    is_null_member: BoolArray
    is_vague: BoolArray


def classify_directions(
    singular: FloatArray,
    rows: FloatArray,
    null: BoolArray,
    moved: BoolArray,
    covariance: FloatArray,
    noise: float,
) -> SingularDirections:
    """Classify the singular directions (D, D) by a covariance (D, D) of the point.

    Parameters
    ----------
    singular : FloatArray, shape (D,)
    null : BoolArray, shape (D,)
    moved : BoolArray, shape (D,)
        Parameters that a direction without effect certainly moves, however little.
    noise : float
        Standard deviation of the noise.
    """
    spread = np.sqrt(np.maximum(np.einsum("id,de,ie->i", rows, covariance, rows), 0.0))
    weak = ~null & ((spread >= _VAGUE_DEVIATION) | (noise >= _VAGUE_DEVIATION * singular))
    member = np.any(rows[null] ** 2 > NULL_SHARE, axis=0) | moved
    return SingularDirections(rows, null, weak, member, np.diag(covariance) >= _VAGUE_DEVIATION**2)


def find_unidentified(directions: SingularDirections) -> tuple[ParameterBlock, ...]:
    """Find blocks of parameters along null directions, then blocks along weak ones."""
    null_blocks = find_blocks(directions.rows[directions.null], directions.is_null_member)
    weak = directions.rows[directions.weak]
    # A parameter with any component along a null direction is not identifiable.
    has_part = np.any(weak**2 > _WEAK_SHARE, axis=0) | directions.is_vague
    member = has_part & ~directions.is_null_member
    weak_blocks = find_blocks(weak, member)
    empty_blocks = [block for block in weak_blocks if not block.basis.size]
    alone = [d for block in empty_blocks for d in block.members if directions.is_vague[d]]
    single_blocks = tuple(ParameterBlock(np.array([d]), np.zeros((0, 1))) for d in alone)
    return null_blocks + tuple(block for block in weak_blocks if block.basis.size) + single_blocks
