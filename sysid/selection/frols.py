"""Forward regression by orthogonal least squares, on a triangle of inner products.

The selection is that of Chen, Billings and Luo (1989): each step takes the term whose part
orthogonal to those already taken explains most of what is left of the output, and its
error-reduction ratio is that share. A forward choice cannot be taken back, and past values of a
smooth signal look alike, so that an early choice may stand for several true terms. Hence, with
`exchange`, more terms than wanted are taken and those that are needed least given back; and each
term in turn gives way to the one that explains most in its stead, until none does better.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray
from sysid.models.model import TermRule

_DEPENDENT_SHARE = (
    1e-20  # of a column's squares: less is rounding, the column depends on the others
)
_EXPLAINED_SHARE = 1e-24  # of the output's squares: less is rounding, nothing is left to explain
_LEAST_GAIN = 1e-6  # of what is unexplained: an exchange that gains less is not made
_MOST_ROUNDS = 20
_MOST_BACKWARD = 120  # terms from which some are given back
_MOST_OPERATIONS = 4e9  # of all exchanges together, about


class ForwardSelection(NamedTuple):
    """Terms in the order of selection.

    Attributes
    ----------
    order : tuple of int
    ratios : tuple of float
        Share of the output's squares that each explains beyond those before it.
    left : tuple of float
        Share that is left with it: not from 1 less a sum, which has no digits where little is.
    """

    order: tuple[int, ...] = ()
    ratios: tuple[float, ...] = ()
    unexplained_shares: tuple[float, ...] = ()

    @property
    def unexplained(self) -> float:
        """Share of the output's squares that all of them leave."""
        return self.unexplained_shares[-1] if self.unexplained_shares else 1.0

    def keep_first(self, keep: int) -> "ForwardSelection":
        """Only the first terms."""
        return ForwardSelection(
            self.order[:keep], self.ratios[:keep], self.unexplained_shares[:keep]
        )


def select_forward(
    triangle: FloatArray, keep: int, err: float | None = None, among: Sequence[int] | None = None
) -> ForwardSelection:
    """Take terms until `keep` are taken, the unexplained share is below `err`, or none helps.

    Parameters
    ----------
    triangle : FloatArray, shape (M + 1, M + 1)
        R of the QR decomposition of [terms, output].
    keep : int
    err : float or None
    among : sequence of int or None
        Candidates; None: all.
    """
    left, target = triangle[:, :-1].copy(), triangle[:, -1].copy()
    whole, squares = float(target @ target), np.sum(np.square(left), axis=0)
    free = np.zeros(squares.size, dtype=np.bool_)
    free[list(range(squares.size) if among is None else among)] = True
    found = ForwardSelection()
    stop = max(_EXPLAINED_SHARE, err or 0.0)
    while (
        len(found.order) < keep
        and whole > 0
        and not (found.unexplained_shares and found.unexplained < stop)
    ):
        chosen = _find_best_term(left, target, free, squares)
        if chosen is None:
            break
        direction = left[:, chosen] / np.linalg.norm(left[:, chosen])
        part = float(direction @ target)
        target = target - part * direction
        found = ForwardSelection(
            (*found.order, chosen),
            (*found.ratios, part * part / whole),
            (*found.unexplained_shares, float(target @ target) / whole),
        )
        free[chosen] = False
        for _ in range(2):  # twice is enough: the second pass takes out what rounding left
            left -= np.outer(direction, direction @ left)
    return found


def _find_best_term(
    left: FloatArray, target: FloatArray, free: FloatArray, squares: FloatArray
) -> int | None:
    """The free column that explains most of the target; None if all depend on those taken."""
    norms = np.sum(np.square(left), axis=0)
    usable = free & (norms > _DEPENDENT_SHARE * squares) & (norms > 0)
    if not np.any(usable):
        return None
    gains = np.where(usable, np.square(left.T @ target) / np.where(usable, norms, 1.0), -1.0)
    return int(np.argmax(gains))


def exchange_terms(triangle: FloatArray, order: Sequence[int]) -> tuple[int, ...]:
    """The terms after exchanges, each of which explains more than the term it replaces."""
    chosen = list(order)
    least = _compute_unexplained(triangle, chosen)
    squares = np.sum(np.square(triangle[:, :-1]), axis=0)
    floor = _EXPLAINED_SHARE * float(triangle[:, -1] @ triangle[:, -1])
    one_round = 4 * max(len(chosen), 1) ** 2 * triangle.shape[1] ** 2
    for _ in range(min(_MOST_ROUNDS, int(_MOST_OPERATIONS / one_round))):
        before = least
        for place in range(len(chosen)):
            others = chosen[:place] + chosen[place + 1 :]
            left = _orthogonalise(triangle, others)
            free = np.ones(squares.size, dtype=np.bool_)
            free[others] = False
            better = _find_best_term(left[:, :-1], left[:, -1], free, squares)
            if better is None or better == chosen[place] or least <= floor:
                continue
            value = _compute_unexplained(triangle, [*others, better])
            if value < (1.0 - _LEAST_GAIN) * least:
                chosen[place], least = better, value
        if least == before:
            break
    return tuple(chosen)


def _orthogonalise(triangle: FloatArray, taken: Sequence[int]) -> FloatArray:
    """All columns less their parts in the span of those taken."""
    if not taken:
        return triangle
    basis = np.linalg.qr(triangle[:, list(taken)])[0]
    left = triangle - basis @ (basis.T @ triangle)
    found: FloatArray = left - basis @ (basis.T @ left)
    return found


def _compute_unexplained(triangle: FloatArray, taken: Sequence[int]) -> float:
    left = _orthogonalise(triangle, taken)[:, -1]
    return float(left @ left)


def solve_coefficients(
    triangle: FloatArray, taken: Sequence[int], ridge: float = 0.0
) -> FloatArray:
    """Least-squares coefficients (M,) with the taken terms, zero for the others.

    Columns are scaled to length 1; `ridge` is added to their squares. Of terms that depend on
    each other the shortest solution is given.
    """
    found = np.zeros(triangle.shape[1] - 1)
    if not taken:
        return found
    matrix, target = triangle[:, list(taken)], triangle[:, -1]
    lengths = np.linalg.norm(matrix, axis=0)
    lengths = np.where(lengths > 0, lengths, 1.0)
    matrix = matrix / lengths
    if ridge > 0:
        matrix = np.vstack([matrix, np.sqrt(ridge) * np.eye(len(taken))])
        target = np.concatenate([target, np.zeros(len(taken))])
    found[list(taken)] = np.linalg.lstsq(matrix, target, rcond=1e-12)[0] / lengths
    return found


def select_backward(triangle: FloatArray, order: Sequence[int]) -> dict[int, tuple[int, ...]]:
    """Of each number of terms a set: from all of `order`, the least needed given back in turn.

    Giving back term i leaves aᵢ² / (G⁻¹)ᵢᵢ more, G the inner products of the terms.
    """
    taken = list(order)
    found = {len(taken): tuple(taken)}
    while len(taken) > 1:
        basis, upper = np.linalg.qr(triangle[:, taken])
        inverse = np.linalg.pinv(upper)
        solution = inverse @ (basis.T @ triangle[:, -1])
        spread = np.sum(np.square(inverse), axis=1)
        taken.pop(int(np.argmin(np.square(solution) / np.where(spread > 0, spread, 1.0))))
        found[len(taken)] = tuple(taken)
    return found


def select_terms(triangle: FloatArray, rule: TermRule, samples: int) -> ForwardSelection:
    """The terms by a rule, in the order in which they explain most."""
    if not rule.exchange:
        found = select_forward(triangle, rule.keep, rule.err)
        return found.keep_first(_count_terms(found.unexplained_shares, rule, samples))
    taken = select_forward(triangle, min(2 * rule.keep + 2, max(rule.keep, _MOST_BACKWARD))).order
    given_back = select_backward(triangle, taken) if len(taken) <= _MOST_BACKWARD else {}
    sets = [
        [taken[:k], given_back.get(k, taken[:k])] for k in range(1, min(rule.keep, len(taken)) + 1)
    ]
    whole = float(triangle[:, -1] @ triangle[:, -1])
    left = [min(_compute_unexplained(triangle, one) for one in pair) / whole for pair in sets]
    number = _count_terms(left, rule, samples)
    better = [exchange_terms(triangle, one) for one in sets[number - 1]] if number else [()]
    best = min(better, key=lambda one: _compute_unexplained(triangle, one))
    return select_forward(triangle, number, among=best)


def _count_terms(left: Sequence[float], rule: TermRule, samples: int) -> int:
    """How many terms a rule asks for; `left`: the share unexplained with 1, 2, … terms.

    ``bic``: as many as have the least n ln(S / n) + k ln n, S the squares left with k terms.
    """
    enough = [
        k for k, share in enumerate(left, 1) if share < max(_EXPLAINED_SHARE, rule.err or 0.0)
    ]
    number = min(enough, default=len(left))
    if rule.criterion == "none" or number == 0:
        return number
    values = [_compute_bic(share, k, samples) for k, share in enumerate(left[:number], 1)]
    return int(np.argmin(values)) + 1


def _compute_bic(share: float, terms: int, samples: int) -> float:
    return float(samples * np.log(max(share, _EXPLAINED_SHARE)) + terms * np.log(max(samples, 1)))


def rate_terms(rule: TermRule, share: float, terms: int, samples: int) -> tuple[float, ...]:
    """How good a set of terms is by a rule, to be compared with another's; smaller is better.

    With `criterion` that criterion; with `err` the fewest terms that leave less than it; else,
    and of as many terms, what they leave.
    """
    if rule.criterion == "bic":
        return (_compute_bic(share, terms, samples),)
    is_enough = share < max(_EXPLAINED_SHARE, rule.err or 0.0)
    return (0.0, float(terms), share) if is_enough else (1.0, share)
