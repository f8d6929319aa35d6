"""Selecting terms by the error of the free run instead of the error one step ahead.

A term that helps to predict the next sample need not help a simulation, which never sees the
measured output again. Near a good model the free run is linear in the coefficients: its slopes
with respect to those of all candidates, also of those that are zero now, are the columns of a
regression on what the free run has not explained. Terms are selected from these columns, the
coefficients refined, and so on until the selection stays. Of all rounds the best by the rule's own
criterion is taken: they may differ in the number of terms, and more terms nearly always leave less.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.models.model import Model, Selection, TermRule
from sysid.search.refine import refine_candidates
from sysid.selection.frols import ForwardSelection, rate_terms, select_forward, select_terms
from sysid.selection.regression import BLOCK_ROWS, find_lag_parameters, fold_rows
from sysid.selection.starts import find_equation_error_starts
from sysid.simulation.problem import Problem

MOST_SLOPES = 40_000_000
"""Samples times candidates: 320 MB."""

_MOST_ROUNDS = 6
_BATCH_SIZE = 16  # simulations at once, as many as a kernel runs side by side
_DIFFERENCE_STEP = 1e-6  # of a coefficient's range

ParameterChanges = Mapping[str, Mapping[str, Any]]


class FreeRunSelection(NamedTuple):
    """A selection, its coefficients (T,), lags, and the RMS of its free run."""

    forward_selection: ForwardSelection
    coefficients: FloatArray
    lags: dict[str, float]
    rms: float


def select_by_free_run(
    model: Model,
    rule: TermRule,
    records: Sequence[Record],
    changes: ParameterChanges,
    skip: int,
    first: Sequence[int],
    lags: Mapping[str, float],
) -> FreeRunSelection | None:
    """The terms that explain most of the free run, beginning with those in `first` and `lags`.

    None if no free run with these stays finite.

    Raises
    ------
    InvalidSettings
        If there are too many candidates for so many samples.
    """
    candidates = replace(model, rule=None, selection=Selection((), lags))
    whole = Problem.build(candidates, records, parameters=changes, skip=skip)
    _check_size(whole)
    chosen, best = tuple(first), None
    least: tuple[float, ...] = (np.inf,)
    power = _compute_output_power(whole)
    seen: set[frozenset[int]] = set()
    for _ in range(_MOST_ROUNDS):
        if frozenset(chosen) in seen:
            break
        seen.add(frozenset(chosen))
        fitted = _fit_free_run(whole, candidates, changes, chosen)
        if fitted is None:
            break
        values, rms = fitted
        triangle = _factor_slopes(whole, values)
        value = rate_terms(rule, rms * rms / power, len(chosen), whole.n_scored)
        if best is None or value < least:
            best, least = _order_terms(whole, triangle, chosen, values, rms), value
        chosen = select_terms(triangle, rule, whole.n_scored).order
    return best


def _compute_output_power(problem: Problem) -> float:
    """Mean square of the scored output, in the units of the RMS."""
    weight = problem.evaluator.weight
    scored = weight > 0
    squares = np.square(weight[scored] * problem.evaluator.measured[scored])
    return max(float(np.mean(squares)), np.finfo(float).tiny)


def _check_size(problem: Problem) -> None:
    terms = len(problem.model.terms)
    if problem.n_scored * terms > MOST_SLOPES:
        raise InvalidSettings(
            "/model/terms/error",
            f"{terms} candidates on {problem.n_scored} samples are too many to select by the "
            f"simulation; at most {MOST_SLOPES // terms} samples, or take error: one-step",
        )


def _fit_free_run(
    whole: Problem, candidates: Model, changes: ParameterChanges, chosen: Sequence[int]
) -> tuple[dict[str, float], float] | None:
    """Values of all parameters, those of terms not chosen zero, and the RMS of the free run."""
    names = {candidates.terms[i].coefficient_name for i in chosen}
    absent = {
        one.name: {
            "lower": min(one.lower, -1.0),
            "upper": max(one.upper, 1.0),
            "scale": "linear",
            "fixed": 0.0,
        }
        for one in candidates.parameters
        if one.name.startswith("a[") and one.name not in names
    }
    part = whole.rebuild(parameters={**changes, **absent})
    starts = find_equation_error_starts(part, GeneticAlgorithm()).values
    if not starts:
        return None
    begin = np.array(
        [[starts[0].get(p.name, 0.5 * (p.lower + p.upper)) for p in part.free_parameters]]
    )
    refined = refine_candidates(part, [begin[0]])[0]
    theta = begin[0] if refined is None else refined.theta
    values = dict(zip(part.free_names, theta.tolist(), strict=True))
    rms = float(part.evaluate_fitness(theta[None])[0])
    fixed = {one.name: one.fixed for one in part.all_parameters if one.fixed is not None}
    return {**fixed, **values}, rms


def _factor_slopes(whole: Problem, values: Mapping[str, float]) -> FloatArray:
    """R of the QR decomposition of [slopes, what they are to explain], (M + 1, M + 1)."""
    terms = whole.model.terms
    theta = np.array([values[name] for name in whole.free_names])
    columns = {name: d for d, name in enumerate(whole.free_names)}
    scored = whole.evaluator.weight > 0
    here = whole.predict(theta[None])[0]
    slopes = np.zeros((int(np.count_nonzero(scored)), len(terms)))
    sought = [i for i, term in enumerate(terms) if term.coefficient_name in columns]
    for first in range(0, len(sought), _BATCH_SIZE):
        batch = sought[first : first + _BATCH_SIZE]
        moved = np.repeat(theta[None], len(batch), axis=0)
        steps = np.empty(len(batch))
        for row, i in enumerate(batch):
            d = columns[terms[i].coefficient_name]
            steps[row] = _DIFFERENCE_STEP * (whole.evaluator.upper[d] - whole.evaluator.lower[d])
            moved[row, d] += steps[row]
        with np.errstate(over="ignore", invalid="ignore"):
            slope = (whole.predict(moved) - here)[:, scored] / steps[:, None]
        slopes[:, batch] = np.where(np.all(np.isfinite(slope), axis=1)[:, None], slope, 0.0).T
    coefficients = np.array([values.get(term.coefficient_name, 0.0) for term in terms])
    target = (whole.evaluator.measured - here)[scored] + slopes @ coefficients
    folded = np.zeros((0, len(terms) + 1))
    for first in range(0, target.size, BLOCK_ROWS):
        rows = slice(first, first + BLOCK_ROWS)
        folded = fold_rows(folded, np.column_stack([slopes[rows], target[rows]]))
    return folded


def _order_terms(
    whole: Problem,
    triangle: FloatArray,
    chosen: Sequence[int],
    values: Mapping[str, float],
    rms: float,
) -> FreeRunSelection:
    """The chosen terms in the order in which they explain most."""
    terms = whole.model.terms
    found = select_forward(triangle, len(chosen), among=chosen)
    coefficients = np.array([values.get(term.coefficient_name, 0.0) for term in terms])
    lags = {name: values[name] for name in sorted(find_lag_parameters(whole.model))}
    return FreeRunSelection(found, coefficients, lags, rms)
