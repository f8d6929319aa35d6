"""How likely a selected term belongs to the model, and how far rival selections move it.

A selection has errors of its own: a term that noise favoured looks as significant as a true one
(Leeb and Pötscher 2005). So its rivals are compared with it: sets that lack one of its terms, that
have another term instead, or that have one more (the neighbourhood of Madigan and York 1995), and
sets two such steps away. The extended criterion of Bayes gives the weight of each, as in Bayesian
model averaging (Hoeting et al. 1999). A term's probability is the weight of all sets that contain
it. Sets that contain it may still give it another coefficient than its interval tells.
"""

from collections.abc import Collection, Sequence
from math import erf, sqrt
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray
from sysid.models.model import TermRule
from sysid.selection.frols import compute_bic, select_terms

CERTAIN = 20.0 / 21.0
"""Weight of what is certain: odds of 20 : 1, strong evidence (Kass and Raftery 1995)."""

LEAST_COVERAGE = 0.70
"""Of a 95 % interval over all selections. Of 1,147 coefficients of `benchmarks.selection` (output
noise, seeds from 730,000), 94 % of the intervals above held the truth, and 12 of the 14 below."""

_LIMIT_95 = 1.96  # standard errors
_EXPANDED = 8  # sets one step away from which a second step is made
_MOST_RIVALS = 100  # sets of one size around another
_LEAST_WEIGHT = 1e-3  # of a rival that may move a coefficient
_MOST_NAMES = 3  # of terms in a text
_TINY = float(np.finfo(float).tiny)
_DEPENDENT_SHARE = 1e-12  # of a column's squares: less is rounding, the column is dependent


class TermOdds(NamedTuple):
    """How certain a term and its coefficient are, by the selections that were compared.

    Attributes
    ----------
    probability : float
        Weight of the selections with the term.
    coverage : float
        Probability that the 95 % interval of its coefficient holds, over all selections.
    rival : str
        The likeliest other selection: the change in words. Empty if both are certain.
    """

    probability: float
    coverage: float
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
    sets, taken = _collect_rivals(triangle, frozenset(chosen), samples), set(chosen)
    own = _solve(triangle, taken, samples)
    rivals = [rival for rival, weight in sets.items() if weight > _LEAST_WEIGHT]
    solved = [_solve(triangle, rival, samples) for rival in rivals]
    found = []
    for term in chosen:
        probability = sum(weight for rival, weight in sets.items() if term in rival)
        missed = [  # the weight of each rival, times its share outside the interval
            sets[rival] * (_compute_miss(own[term], solution[term]) if term in rival else 1.0)
            for rival, solution in zip(rivals, solved, strict=True)
        ]
        coverage = 1.0 - sum(missed)
        lacks_term = probability < CERTAIN
        doubts = [
            (miss, i)
            for i, (rival, miss) in enumerate(zip(rivals, missed, strict=True))
            if (term not in rival if lacks_term else rival != taken)
        ]
        is_open = doubts and (lacks_term or coverage < LEAST_COVERAGE)
        rival = rivals[max(doubts)[1]] if is_open else None
        text = "" if rival is None else _describe(rival, taken, term, labels)
        found.append(TermOdds(probability, coverage, text))
    return found


def _compute_miss(own: tuple[float, float], other: tuple[float, float]) -> float:
    """Compute the share of another estimate's distribution outside the own 95 % interval."""
    (center, error), (mean, deviation) = own, other
    scale = sqrt(2.0) * max(deviation, _TINY)
    low, high = center - _LIMIT_95 * error, center + _LIMIT_95 * error
    return 1.0 - 0.5 * (erf((high - mean) / scale) - erf((low - mean) / scale))


def _solve(
    triangle: FloatArray, terms: Collection[int], samples: int
) -> dict[int, tuple[float, float]]:
    """Solve the coefficients of some terms: each with its standard error."""
    matrix, target = triangle[:, list(terms)], triangle[:, -1]
    inverse = np.linalg.pinv(matrix)
    solution = inverse @ target
    squares = float(np.sum(np.square(target - matrix @ solution)))
    variance = squares / max(samples - len(terms), 1)
    errors = np.sqrt(np.sum(np.square(inverse), axis=1) * variance)
    return dict(zip(terms, zip(solution.tolist(), errors.tolist(), strict=True), strict=True))


def _describe(rival: frozenset[int], chosen: set[int], term: int, labels: Sequence[str]) -> str:
    """Describe a rival as seen from one of the chosen terms, which comes first if it is absent."""
    added = _join([labels[i] for i in sorted(rival - chosen)])
    absent = sorted(chosen - rival, key=lambda i: (i != term, i))
    removed = _join(["it" if i == term else labels[i] for i in absent])
    if not added:
        return f"without {removed}"
    return f"with {added} instead of {removed}" if removed else f"with {added} besides"


def _join(names: list[str]) -> str:
    """Join at most three names, and count the others."""
    shown = names[:_MOST_NAMES]
    more = len(names) - len(shown)
    return " and ".join([*shown, f"{more} more"] if more else shown)


def _collect_rivals(
    triangle: FloatArray, chosen: frozenset[int], samples: int
) -> dict[frozenset[int], float]:
    """Collect the likeliest sets around the chosen one, with their weights, which sum to 1.

    The sets are those one step away from it or from the best set that is found, and one more step
    from the likeliest of them. A first step that leaves a term out may lead through a poor set to a
    good one.
    """
    rule = TermRule(min(2 * len(chosen), triangle.shape[1] - 1), criterion="bic")
    best = frozenset(select_terms(triangle, rule, samples).order)
    found = _rate_neighbours(triangle, chosen, samples) | _rate_neighbours(triangle, best, samples)
    smaller = [one for one in found if len(one) < len(best)]
    others = [one for one in found if len(one) >= len(best) and one != best]
    for group in (smaller, others):
        for one in sorted(group, key=lambda one: (found[one], sorted(one)))[:_EXPANDED]:
            found |= _rate_neighbours(triangle, one, samples)
    values = np.array(list(found.values()))
    weights = np.exp(-0.5 * (values - np.min(values)))
    return dict(zip(found, (weights / np.sum(weights)).tolist(), strict=True))


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
