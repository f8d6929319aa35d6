"""How likely a selected term belongs to the model, and how far rival selections move it.

A selection has errors of its own: a term that noise favoured looks as significant as a true one
(Leeb and Pötscher 2005). So its rivals are compared with it: sets that lack one of its terms, that
have another term instead, or that have one more (the neighbourhood of Madigan and York 1995), and
sets two such steps away. The extended criterion of Bayes gives the weight of each, as in Bayesian
model averaging (Hoeting et al. 1999). A term's probability is the weight of all sets that contain
it. The variance of its coefficient between these sets adds to the one that a standard error tells.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray
from sysid.models.model import TermRule
from sysid.selection.frols import compute_bic, select_terms

CERTAIN = 20.0 / 21.0
"""Probability of a term that belongs to the model: odds of 20 : 1, strong evidence (Kass and
Raftery 1995)."""

MOST_MOVE = 1.0
"""Largest deviation between selections, in standard errors: more, and most of the error is that of
the selection."""

_EXPANDED = 8  # sets one step away from which a second step is made
_MOST_RIVALS = 100  # that are weighed
_TINY = float(np.finfo(float).tiny)
_DEPENDENT_SHARE = 1e-12  # of a column's squares: less is rounding, the column is dependent


class TermOdds(NamedTuple):
    """Probability of a term, and the spread of its coefficient between selections.

    Attributes
    ----------
    probability : float
        Weight of the selections with the term, of all that were compared.
    move : float
        Root mean square move of the coefficient between these, in standard errors.
    rival : str
        The rival that counts most against the term, or else that moves it most; empty if none does.
    """

    probability: float
    move: float
    rival: str


def weigh_terms(
    triangle: FloatArray, chosen: Sequence[int], samples: int, labels: Sequence[str]
) -> list[TermOdds]:
    """Weigh each of the chosen terms against rival selections.

    Parameters
    ----------
    triangle : FloatArray, shape (M + 1, M + 1)
        R of the QR decomposition of [candidates, output], in which white noise remains.
    chosen : sequence of int
    samples : int
        Rows of the regression.
    labels : sequence of str
        Texts of the M candidates.
    """
    own, errors = _solve(triangle, list(chosen), samples)
    sets = _collect_rivals(triangle, frozenset(chosen), samples)
    rivals, weights = list(sets), np.array(list(sets.values()))
    values = np.full((len(rivals), len(chosen)), np.nan)
    for row, rival in enumerate(rivals):
        solution = dict(
            zip(order := sorted(rival), _solve(triangle, order, samples)[0], strict=True)
        )
        values[row] = [solution.get(i, np.nan) for i in chosen]
    found = []
    for i, term in enumerate(chosen):
        is_absent = np.isnan(values[:, i])
        probability = 1.0 - float(np.sum(weights[is_absent]))
        moves = np.where(is_absent, 0.0, values[:, i] - own[i]) / max(errors[i], _TINY)
        squared = weights * np.square(moves) / max(probability, _TINY)
        deciding = weights * is_absent if probability < CERTAIN else squared
        rival = rivals[int(np.argmax(deciding))]
        text = _describe(rival, set(chosen), term, labels) if rival != set(chosen) else ""
        found.append(TermOdds(probability, float(np.sqrt(np.sum(squared))), text))
    return found


def _solve(triangle: FloatArray, terms: list[int], samples: int) -> tuple[FloatArray, FloatArray]:
    """Solve the coefficients of some terms, and their standard errors."""
    matrix, target = triangle[:, terms], triangle[:, -1]
    inverse = np.linalg.pinv(matrix)
    solution = inverse @ target
    squares = float(np.sum(np.square(target - matrix @ solution)))
    variance = squares / max(samples - len(terms), 1)
    return solution, np.sqrt(np.sum(np.square(inverse), axis=1) * variance)


def _describe(rival: frozenset[int], chosen: set[int], term: int, labels: Sequence[str]) -> str:
    """Describe a rival as seen from one of the chosen terms."""
    added = [labels[i] for i in sorted(rival - chosen)]
    removed = ["it" if i == term else labels[i] for i in sorted(chosen - rival)]
    if not added:
        return f"without {' and '.join(removed)}"
    instead = f"instead of {' and '.join(removed)}" if removed else "besides"
    return f"with {' and '.join(added)} {instead}"


def _collect_rivals(
    triangle: FloatArray, chosen: frozenset[int], samples: int
) -> dict[frozenset[int], float]:
    """Collect the likeliest sets around the chosen one, with their weights, which sum to 1.

    The sets are those one step away from it or from the best set that is found, and one more step
    from the best of them. A first step that
    leaves a term out may lead through a poor set to a good one.
    """
    rule = TermRule(min(2 * len(chosen), triangle.shape[1] - 1), criterion="bic")
    best = frozenset(select_terms(triangle, rule, samples).order)
    found = _rate_neighbours(triangle, chosen, samples) | _rate_neighbours(triangle, best, samples)
    smaller = [one for one in found if len(one) < len(best)]
    others = [one for one in found if len(one) >= len(best) and one != best]
    for group in (smaller, others):
        for one in sorted(group, key=lambda one: (found[one], sorted(one)))[:_EXPANDED]:
            found |= _rate_neighbours(triangle, one, samples)
    ranked = sorted(found, key=lambda one: (found[one], sorted(one)))
    kept = [one for one in ranked[:_MOST_RIVALS] if one != chosen]
    values = np.array([found[one] for one in (chosen, *kept)])
    weights = np.exp(-0.5 * (values - np.min(values)))
    return dict(zip((chosen, *kept), (weights / np.sum(weights)).tolist(), strict=True))


def _rate_neighbours(
    triangle: FloatArray, chosen: frozenset[int], samples: int
) -> dict[frozenset[int], float]:
    """Rate a set and those that lack one of its terms, have another instead, or one more.

    Without term i the unexplained squares gain (vᵢᵀy)². Here vᵢ is the direction of term i that is
    orthogonal to the other terms, so that all exchanges follow from one projection.
    """
    terms, candidates = sorted(chosen), triangle.shape[1] - 1
    matrix, target = triangle[:, terms], triangle[:, -1]
    inverse = np.linalg.pinv(matrix)
    remaining = triangle - matrix @ (inverse @ triangle)
    left = float(remaining[:, -1] @ remaining[:, -1])
    lengths = np.linalg.norm(inverse, axis=1)
    directions = inverse / np.where(lengths > 0, lengths, 1.0)[:, None]
    own, along = directions @ target, directions @ triangle[:, :-1]
    norms = np.sum(np.square(remaining[:, :-1]), axis=0)
    products = remaining[:, :-1].T @ remaining[:, -1]
    least = _DEPENDENT_SHARE * np.sum(np.square(triangle[:, :-1]), axis=0)
    free = np.ones(candidates, dtype=np.bool_)
    free[terms] = False

    def rate(squares: FloatArray, count: int) -> FloatArray:
        share = np.maximum(squares, 0.0) / max(float(target @ target), _TINY)
        return compute_bic(share, count, samples, candidates)

    found = {chosen: float(rate(np.array(left), len(terms)))}
    for gained, sizes, inner, base in (
        (0.0, norms, products, chosen),
        *(
            (own[i] ** 2, norms + along[i] ** 2, products + along[i] * own[i], chosen - {term})
            for i, term in enumerate(terms)
        ),
    ):
        if base and base != chosen:
            found[base] = float(rate(np.array(left + gained), len(base)))
        usable = np.flatnonzero(free & (sizes > least) & (sizes > 0))
        if not usable.size:
            continue
        squares = left + gained - np.square(inner[usable]) / sizes[usable]
        rated = rate(squares, len(base) + 1)
        for place in np.argsort(rated, kind="stable")[:_MOST_RIVALS]:
            found[base | {int(usable[place])}] = float(rated[place])
    return found
