"""Forward regression by orthogonal least squares (FROLS) on a triangular factor.

The selection follows Chen, Billings and Luo (1989). Each step takes the term whose part orthogonal
to the terms taken so far explains most of the remaining output. That share is its error-reduction
ratio. A forward choice is final, and past values of a smooth signal are similar. So an early choice
may represent several true terms.

With `exchange`, more terms than wanted are taken, and the least needed ones are removed. Then each
term in turn is replaced by the term that explains most in its place, until no replacement gains.
"""

from collections.abc import Sequence
from math import lgamma, log
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray
from sysid.models.model import TermRule

_DEPENDENT_SHARE = 1e-20  # of a column's squares: less is rounding, the column is dependent
_EXPLAINED_SHARE = 1e-24  # of the output's squares: less is rounding, the output is explained
_MIN_GAIN = 1e-6  # of the unexplained squares: an exchange must gain as much
_MAX_ROUNDS = 20
_MAX_BACKWARD_TERMS = 120  # limit on the terms of a backward selection
_MAX_OPERATIONS = 4e9  # of all exchanges together, about


class ForwardSelection(NamedTuple):
    """Terms in the order of selection.

    Attributes
    ----------
    order : tuple of int
    ratios : tuple of float
        Share of the output's squares that each explains in addition to those before it.
    unexplained_shares : tuple of float
        Share that remains with it. It is not 1 minus a sum, which loses all digits if it is small.
    """

    order: tuple[int, ...] = ()
    ratios: tuple[float, ...] = ()
    unexplained_shares: tuple[float, ...] = ()

    @property
    def unexplained_share(self) -> float:
        """Share of the output's squares that all terms leave unexplained."""
        return self.unexplained_shares[-1] if self.unexplained_shares else 1.0

    def keep_first(self, keep: int) -> "ForwardSelection":
        """Return the selection of the first terms only."""
        return ForwardSelection(
            self.order[:keep], self.ratios[:keep], self.unexplained_shares[:keep]
        )


def select_forward(
    triangle: FloatArray, keep: int, err: float | None = None, among: Sequence[int] | None = None
) -> ForwardSelection:
    """Select terms until there are `keep`, the unexplained share is below `err`, or none helps.

    Parameters
    ----------
    triangle : FloatArray, shape (M + 1, M + 1)
        R of the QR decomposition of [terms, output].
    keep : int
    err : float or None
    among : sequence of int or None
        Candidates; None: all.
    """
    remaining, target = triangle[:, :-1].copy(), triangle[:, -1].copy()
    whole, squares = float(target @ target), np.sum(np.square(remaining), axis=0)
    free = np.zeros(squares.size, dtype=np.bool_)
    free[list(range(squares.size) if among is None else among)] = True
    selection = ForwardSelection()
    stop = max(_EXPLAINED_SHARE, err or 0.0)
    while (
        len(selection.order) < keep
        and whole > 0
        and not (selection.unexplained_shares and selection.unexplained_share < stop)
    ):
        chosen = _find_best_term(remaining, target, free, squares)
        if chosen is None:
            break
        direction = remaining[:, chosen] / np.linalg.norm(remaining[:, chosen])
        part = float(direction @ target)
        target = target - part * direction
        selection = ForwardSelection(
            (*selection.order, chosen),
            (*selection.ratios, part * part / whole),
            (*selection.unexplained_shares, float(target @ target) / whole),
        )
        free[chosen] = False
        for _ in range(2):  # the second pass removes the rounding errors of the first
            remaining -= np.outer(direction, direction @ remaining)
    return selection


def _find_best_term(
    remaining: FloatArray, target: FloatArray, free: FloatArray, squares: FloatArray
) -> int | None:
    """Find the free column that explains most of the target; None if all are dependent."""
    norms = np.sum(np.square(remaining), axis=0)
    usable = free & (norms > _DEPENDENT_SHARE * squares) & (norms > 0)
    if not np.any(usable):
        return None
    gains = np.where(usable, np.square(remaining.T @ target) / np.where(usable, norms, 1.0), -1.0)
    return int(np.argmax(gains))


def exchange_terms(triangle: FloatArray, order: Sequence[int]) -> tuple[int, ...]:
    """Exchange terms, each for one that explains more, and return the result."""
    chosen = list(order)
    least = _compute_unexplained(triangle, chosen)
    squares = np.sum(np.square(triangle[:, :-1]), axis=0)
    floor = _EXPLAINED_SHARE * float(triangle[:, -1] @ triangle[:, -1])
    one_round = 4 * max(len(chosen), 1) ** 2 * triangle.shape[1] ** 2
    for _ in range(min(_MAX_ROUNDS, int(_MAX_OPERATIONS / one_round))):
        before = least
        for position in range(len(chosen)):
            others = chosen[:position] + chosen[position + 1 :]
            remaining = _orthogonalise(triangle, others)
            free = np.ones(squares.size, dtype=np.bool_)
            free[others] = False
            better = _find_best_term(remaining[:, :-1], remaining[:, -1], free, squares)
            if better is None or better == chosen[position] or least <= floor:
                continue
            value = _compute_unexplained(triangle, [*others, better])
            if value < (1.0 - _MIN_GAIN) * least:
                chosen[position], least = better, value
        if least == before:
            break
    return tuple(chosen)


def _orthogonalise(triangle: FloatArray, taken: Sequence[int]) -> FloatArray:
    """Orthogonalise all columns to those taken."""
    if not taken:
        return triangle
    basis = np.linalg.qr(triangle[:, list(taken)])[0]
    remaining = triangle - basis @ (basis.T @ triangle)
    orthogonal: FloatArray = remaining - basis @ (basis.T @ remaining)
    return orthogonal


def _compute_unexplained(triangle: FloatArray, taken: Sequence[int]) -> float:
    remaining = _orthogonalise(triangle, taken)[:, -1]
    return float(remaining @ remaining)


def solve_coefficients(
    triangle: FloatArray, taken: Sequence[int], ridge: float = 0.0
) -> FloatArray:
    """Solve the least-squares coefficients (M,) of the taken terms; zero for the others.

    Columns are scaled to length 1; `ridge` is added to their squares. Dependent terms get the
    shortest solution.
    """
    coefficients = np.zeros(triangle.shape[1] - 1)
    if not taken:
        return coefficients
    matrix, target = triangle[:, list(taken)], triangle[:, -1]
    lengths = np.linalg.norm(matrix, axis=0)
    lengths = np.where(lengths > 0, lengths, 1.0)
    matrix = matrix / lengths
    if ridge > 0:
        matrix = np.vstack([matrix, np.sqrt(ridge) * np.eye(len(taken))])
        target = np.concatenate([target, np.zeros(len(taken))])
    coefficients[list(taken)] = np.linalg.lstsq(matrix, target, rcond=1e-12)[0] / lengths
    return coefficients


def select_backward(triangle: FloatArray, order: Sequence[int]) -> dict[int, tuple[int, ...]]:
    """Select a set for each number of terms: from all of `order`, remove the least needed in turn.

    Removing term i increases the unexplained squares by aᵢ² / (G⁻¹)ᵢᵢ, with the inner products G of
    the terms.
    """
    taken = tuple(order)
    sets = {len(taken): taken}
    while len(taken) > 1:
        taken = _remove_term(triangle, taken)
        sets[len(taken)] = taken
    return sets


def _remove_term(triangle: FloatArray, taken: tuple[int, ...]) -> tuple[int, ...]:
    """Remove the least needed term."""
    basis, upper = np.linalg.qr(triangle[:, list(taken)])
    inverse = np.linalg.pinv(upper)
    solution = inverse @ (basis.T @ triangle[:, -1])
    spread = np.sum(np.square(inverse), axis=1)
    least = int(np.argmin(np.square(solution) / np.where(spread > 0, spread, 1.0)))
    return taken[:least] + taken[least + 1 :]


def select_terms(triangle: FloatArray, rule: TermRule, samples: int) -> ForwardSelection:
    """Select the terms by a rule, in the order in which they explain most.

    With `exchange`, sets of neighbouring sizes are compared after their exchanges: sequential
    replacement (Miller, Subset Selection in Regression, 2nd ed. 2002, ch. 3). A rule for a number
    of terms takes those that the criterion of Bayes demands first.
    """
    if not rule.exchange:
        selection = select_forward(triangle, rule.keep, rule.err)
        shares, candidates = selection.unexplained_shares, triangle.shape[1] - 1
        return selection.keep_first(_count_terms(shares, rule, samples, candidates))
    best = _select_by_exchange(triangle, rule.demand, samples)
    if rule.is_fixed_number:
        best = extend_terms(triangle, best, rule.keep)
    return select_forward(triangle, len(best), among=best)


def extend_terms(triangle: FloatArray, chosen: Sequence[int], keep: int) -> tuple[int, ...]:
    """Extend a set to `keep` terms, each the one that explains most of the rest."""
    remaining = _orthogonalise(triangle, chosen)
    lost = np.sum(np.square(remaining), axis=0) <= _DEPENDENT_SHARE * np.sum(
        np.square(triangle), axis=0
    )
    remaining = np.where(lost, 0.0, remaining)
    others = [i for i in range(triangle.shape[1] - 1) if i not in chosen]
    return (*chosen, *select_forward(remaining, keep - len(chosen), among=others).order)


def _select_by_exchange(triangle: FloatArray, rule: TermRule, samples: int) -> tuple[int, ...]:
    """Select by a rule that compares numbers of terms."""
    forward = select_forward(triangle, min(2 * rule.keep + 2, max(rule.keep, _MAX_BACKWARD_TERMS)))
    candidates = triangle.shape[1] - 1
    wanted = _count_terms(forward.unexplained_shares, rule, samples, candidates)
    taken = forward.order[: 2 * wanted + 2]
    backward_sets = select_backward(triangle, taken) if len(taken) <= _MAX_BACKWARD_TERMS else {}
    sets = [
        [taken[:k], backward_sets.get(k, taken[:k])]
        for k in range(1, min(rule.keep, len(taken)) + 1)
    ]
    whole = float(triangle[:, -1] @ triangle[:, -1])
    shares = [min(_compute_unexplained(triangle, terms) for terms in pair) / whole for pair in sets]
    number = _count_terms(shares, rule, samples, candidates)
    if number == 0:
        return ()
    exchanged = [exchange_terms(triangle, terms) for terms in sets[number - 1]]
    best = min(exchanged, key=lambda terms: _compute_unexplained(triangle, terms))
    return _leave_out_terms(triangle, best, rule, samples)


def _leave_out_terms(
    triangle: FloatArray, chosen: tuple[int, ...], rule: TermRule, samples: int
) -> tuple[int, ...]:
    """Leave out the least needed term and exchange the others, as long as the rule gains."""
    whole, candidates = float(triangle[:, -1] @ triangle[:, -1]), triangle.shape[1] - 1

    def rate(terms: tuple[int, ...]) -> tuple[float, ...]:
        share = _compute_unexplained(triangle, terms) / whole
        return rate_terms(rule, share, len(terms), samples, candidates)

    while len(chosen) > 1:
        fewer = exchange_terms(triangle, _remove_term(triangle, chosen))
        if rate(fewer) >= rate(chosen):
            break
        chosen = fewer
    return chosen


def _count_terms(shares: Sequence[float], rule: TermRule, samples: int, candidates: int) -> int:
    """Count the terms that a rule requires; `shares`: unexplained with 1, 2, … terms."""
    sufficient = [
        k for k, share in enumerate(shares, 1) if share < max(_EXPLAINED_SHARE, rule.err or 0.0)
    ]
    number = min(sufficient, default=len(shares))
    if rule.criterion == "none" or number == 0:
        return number
    values = [
        compute_bic(share, k, samples, candidates) for k, share in enumerate(shares[:number], 1)
    ]
    return int(np.argmin(values)) + 1


def compute_bic(share: float | FloatArray, terms: int, samples: int, candidates: int) -> FloatArray:
    """Compute the extended Bayesian information criterion of Chen and Chen (2008), γ = 1.

    n ln S + k ln n + 2 ln (M over k), with the unexplained share S of k terms out of M candidates.
    The last part pays for the search among many: all numbers of terms are as likely beforehand, and
    so are all sets of one size (Scott and Berger 2010).
    """
    sets = lgamma(candidates + 1) - lgamma(terms + 1) - lgamma(candidates - terms + 1)
    fit = samples * np.log(np.maximum(share, _EXPLAINED_SHARE))
    return np.asarray(fit + terms * log(max(samples, 1)) + 2.0 * sets)


def rate_terms(
    rule: TermRule, share: float, terms: int, samples: int, candidates: int
) -> tuple[float, ...]:
    """Rate a set of terms by a rule, for comparison with another; smaller is better.

    With `criterion` the rating is that criterion. With `err` the fewest terms that leave less win.
    Otherwise, and for equal numbers of terms, the unexplained share decides.
    """
    if rule.criterion == "bic":
        return (float(compute_bic(share, terms, samples, candidates)),)
    is_enough = share < max(_EXPLAINED_SHARE, rule.err or 0.0)
    return (0.0, float(terms), share) if is_enough else (1.0, share)
