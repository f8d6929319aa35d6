"""Term selection by the error of the free run instead of the error one step ahead.

A term that helps to predict the next sample may not help a simulation, which never reads the
measured output again. Near a good model the free run is linear in the coefficients. Its slopes with
respect to the coefficients of all candidates, also of absent ones, are the columns of a regression.
The target is the unexplained part of the free run.

Terms are selected from these columns and the coefficients refined, until the selection stays the
same. The result is the best round by the criterion of the rule. The error alone cannot decide,
because rounds differ in the number of terms, and more terms nearly always leave less.
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

MAX_SLOPES = 40_000_000
"""Limit on samples times candidates: 320 MB."""

_MAX_ROUNDS = 6
_BATCH_SIZE = 16  # simulations that a kernel runs in parallel
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
    """Select the terms that explain most of the free run, starting from `first` and `lags`.

    None if no free run from there stays finite.

    Raises
    ------
    InvalidSettings
        If samples times candidates exceed `MAX_SLOPES`.
    """
    candidates = replace(model, rule=None, selection=Selection((), lags))
    whole = Problem.build(candidates, records, parameters=changes, skip=skip)
    _check_size(whole)
    chosen, best = tuple(first), None
    best_value: tuple[float, ...] = (np.inf,)
    power = _compute_output_power(whole)
    tried: set[frozenset[int]] = set()
    for _ in range(_MAX_ROUNDS):
        if frozenset(chosen) in tried:
            break
        tried.add(frozenset(chosen))
        fitted = _fit_free_run(whole, candidates, changes, chosen)
        if fitted is None:
            break
        values, rms = fitted
        triangle = _factor_slopes(whole, values)
        value = rate_terms(rule, rms * rms / power, len(chosen), whole.n_scored)
        if best is None or value < best_value:
            best, best_value = _order_terms(whole, triangle, chosen, values, rms), value
        chosen = select_terms(triangle, rule, whole.n_scored).order
    return best


def _compute_output_power(problem: Problem) -> float:
    """Compute the mean square of the scored output, in the units of the RMS."""
    weight = problem.evaluator.weight
    scored = weight > 0
    squares = np.square(weight[scored] * problem.evaluator.measured[scored])
    return max(float(np.mean(squares)), np.finfo(float).tiny)


def _check_size(problem: Problem) -> None:
    terms = len(problem.model.terms)
    if problem.n_scored * terms > MAX_SLOPES:
        raise InvalidSettings(
            "/model/terms/error",
            f"{terms} candidates on {problem.n_scored} samples are too many to select by the "
            f"simulation. Use at most {MAX_SLOPES // terms} samples, or error: one-step",
        )


def _fit_free_run(
    whole: Problem, candidates: Model, changes: ParameterChanges, chosen: Sequence[int]
) -> tuple[dict[str, float], float] | None:
    """Fit the chosen terms in a free run: values of all parameters (others zero) and the RMS."""
    names = {candidates.terms[i].coefficient_name for i in chosen}
    absent = {
        parameter.name: {
            "lower": min(parameter.lower, -1.0),
            "upper": max(parameter.upper, 1.0),
            "scale": "linear",
            "fixed": 0.0,
        }
        for parameter in candidates.parameters
        if parameter.name.startswith("a[") and parameter.name not in names
    }
    reduced = whole.rebuild(parameters={**changes, **absent})
    starts = find_equation_error_starts(reduced, GeneticAlgorithm()).values
    if not starts:
        return None
    start = np.array(
        [[starts[0].get(p.name, 0.5 * (p.lower + p.upper)) for p in reduced.free_parameters]]
    )
    refined = refine_candidates(reduced, [start[0]])[0]
    theta = start[0] if refined is None else refined.theta
    values = dict(zip(reduced.free_names, theta.tolist(), strict=True))
    rms = float(reduced.evaluate_fitness(theta[None])[0])
    fixed = {
        parameter.name: parameter.fixed
        for parameter in reduced.all_parameters
        if parameter.fixed is not None
    }
    return {**fixed, **values}, rms


def _factor_slopes(whole: Problem, values: Mapping[str, float]) -> FloatArray:
    """Compute R of the QR decomposition of [slopes, target], (M + 1, M + 1)."""
    terms = whole.model.terms
    theta = np.array([values[name] for name in whole.free_names])
    columns = {name: d for d, name in enumerate(whole.free_names)}
    scored = whole.evaluator.weight > 0
    simulated = whole.predict(theta[None])[0]
    slopes = np.zeros((int(np.count_nonzero(scored)), len(terms)))
    free_terms = [i for i, term in enumerate(terms) if term.coefficient_name in columns]
    for first in range(0, len(free_terms), _BATCH_SIZE):
        batch = free_terms[first : first + _BATCH_SIZE]
        individuals = np.repeat(theta[None], len(batch), axis=0)
        steps = np.empty(len(batch))
        for row, i in enumerate(batch):
            d = columns[terms[i].coefficient_name]
            steps[row] = _DIFFERENCE_STEP * (whole.evaluator.upper[d] - whole.evaluator.lower[d])
            individuals[row, d] += steps[row]
        with np.errstate(over="ignore", invalid="ignore"):
            slope = (whole.predict(individuals) - simulated)[:, scored] / steps[:, None]
        slopes[:, batch] = np.where(np.all(np.isfinite(slope), axis=1)[:, None], slope, 0.0).T
    coefficients = np.array([values.get(term.coefficient_name, 0.0) for term in terms])
    target = (whole.evaluator.measured - simulated)[scored] + slopes @ coefficients
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
    """Order the chosen terms by how much they explain."""
    terms = whole.model.terms
    selection = select_forward(triangle, len(chosen), among=chosen)
    coefficients = np.array([values.get(term.coefficient_name, 0.0) for term in terms])
    lags = {name: values[name] for name in sorted(find_lag_parameters(whole.model))}
    return FreeRunSelection(selection, coefficients, lags, rms)
