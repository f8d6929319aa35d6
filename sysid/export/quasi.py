"""Polynomials in s with dead times: sums of c s^p e^(-s d); in z⁻¹ with p = 0 and d in samples."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

Quasi: TypeAlias = Mapping[tuple[int, float], float]
"""(p, d): coefficient."""

_CANCELLED = 1e-13


def added(first: Quasi, second: Quasi, factor: float = 1.0) -> Quasi:
    """Sum with a multiple of another; what is left of terms that cancel is left out."""
    found = dict(first)
    for key, value in second.items():
        before, change = found.get(key, 0.0), factor * value
        total = before + change
        if abs(total) > _CANCELLED * (abs(before) + abs(change)):
            found[key] = total
        else:
            found.pop(key, None)
    return found


def product(first: Quasi, second: Quasi) -> Quasi:
    """Product of two."""
    found: Quasi = {}
    for (power, delay), value in first.items():
        shifted = {(power + p, delay + d): value * v for (p, d), v in second.items()}
        found = added(found, shifted)
    return found


def determinant(matrix: Sequence[Sequence[Quasi]]) -> Quasi:
    """Determinant of a small square matrix, by its first row."""
    if not matrix:
        return {(0, 0.0): 1.0}
    found: Quasi = {}
    for j, entry in enumerate(matrix[0]):
        if entry:
            minor = [[*row[:j], *row[j + 1 :]] for row in matrix[1:]]
            found = added(found, product(entry, determinant(minor)), -1.0 if j % 2 else 1.0)
    return found


def replaced(
    matrix: Sequence[Sequence[Quasi]], j: int, column: Sequence[Quasi]
) -> list[list[Quasi]]:
    """The matrix with another column j."""
    return [[*row[:j], one, *row[j + 1 :]] for row, one in zip(matrix, column, strict=True)]


def by_delay(found: Quasi) -> list[tuple[float, list[float]]]:
    """Coefficients of falling powers for each dead time, the shortest dead time first."""
    parts: dict[float, dict[int, float]] = {}
    for (power, delay), value in found.items():
        parts.setdefault(delay, {})[power] = value
    return [
        (delay, [powers.get(p, 0.0) for p in range(max(powers), -1, -1)])
        for delay, powers in sorted(parts.items())
    ]
