"""Term selection by the error of the free run instead of the error one step ahead.

A term that helps to predict the next sample may not help a simulation, which never reads the
measured output again. Measured past values carry the noise of the sensor, and one step ahead wrong
terms make up for it. So the error of the simulation decides (Piroddi and Spinelli 2003), and the
selection is iterated (Guo, Guo, Billings and Wei 2015). Near a good model the free run is linear in
the coefficients. Its slopes with respect to the coefficients of all candidates, also of absent
ones, are the columns of a regression. The target is the unexplained part of the free run.

Terms are selected from these columns and the coefficients refined, until the selection stays the
same. It starts from the terms of one step ahead, and from the linear ones. Noise inside the plant
colours the error of the free run. So at last the columns are whitened by an autoregression. The
result is the best round by the criterion of the rule and the variance of the innovations. The error
alone cannot decide, because rounds differ in the number of terms, and more terms nearly always
leave less.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.models.model import TermRule
from sysid.residuals.series import iterate_parts
from sysid.search.refine import refine_candidates
from sysid.selection.autoregression import Autoregression, fit_autoregression
from sysid.selection.frols import (
    ForwardSelection,
    extend_terms,
    rate_terms,
    select_forward,
    select_terms,
)
from sysid.selection.regression import BLOCK_ROWS, find_lag_parameters, fold_rows
from sysid.selection.starts import find_equation_error_starts
from sysid.simulation.problem import Problem

MAX_SLOPES = 40_000_000
"""Limit on samples times candidates: 320 MB."""

_MAX_ROUNDS = 6
_BATCH_SIZE = 16  # simulations that a kernel runs in parallel
_DIFFERENCE_STEP = 1e-6  # of a coefficient's range


class FreeRunSelection(NamedTuple):
    """A set of terms fitted in a free run.

    Attributes
    ----------
    forward_selection : ForwardSelection
        The terms in the order in which they explain most.
    coefficients : FloatArray, shape (M,)
    lags : dict of str to float
    triangle : FloatArray, shape (M + 1, M + 1)
        R of the QR decomposition of [slopes, target] at the fit, whitened.
    plain_triangle : FloatArray, shape (M + 1, M + 1)
        The same, not whitened.
    samples : int
        Innovations of the noise.
    innovation_variance : float
        Their mean square, that of n innovations times n^(p/n): the criterion of Bayes then pays
        for the p coefficients of the noise.
    noise_order : int
        Order p of the autoregressive noise; 0: white.
    """

    forward_selection: ForwardSelection
    coefficients: FloatArray
    lags: dict[str, float]
    triangle: FloatArray
    plain_triangle: FloatArray
    samples: int
    innovation_variance: float
    noise_order: int


def fits_in_memory(whole: Problem) -> bool:
    """Whether samples times candidates stay below `MAX_SLOPES`."""
    return whole.n_scored * len(whole.model.terms) <= MAX_SLOPES


class FreeRunSelector:
    """Selector of the terms that explain most of the free run.

    Each set of terms that is tried is fitted in a free run, once. The best by the rule is taken.

    Raises
    ------
    InvalidSettings
        If samples times candidates exceed `MAX_SLOPES`.
    """

    def __init__(self, whole: Problem, rule: TermRule) -> None:
        """Take a problem whose model has all candidates, and its lags as a selection."""
        terms = len(whole.model.terms)
        if not fits_in_memory(whole):
            raise InvalidSettings(
                "/model/terms/error",
                f"{terms} candidates on {whole.n_scored} samples are too many to select by the "
                f"simulation. Use at most {MAX_SLOPES // terms} samples, or error: one-step",
            )
        self._whole, self._rule = whole, rule
        self._demand = rule.demand if rule.exchange else rule
        self._power = _compute_output_power(whole)
        self._tried: dict[frozenset[int], FreeRunSelection | None] = {}

    def select(self, starts: Sequence[Sequence[int]]) -> FreeRunSelection | None:
        """Select from each of the starts by the plain error, then from the best by the whitened.

        None if no free run from there stays finite.
        """
        for start in starts:
            self._iterate(start, is_white=True)
        best = self._find_best()
        if best is not None and best.noise_order:
            self._iterate(best.forward_selection.order, is_white=False)
            best = self._find_best()
        if best is not None and self._demand is not self._rule:
            extended = extend_terms(best.triangle, best.forward_selection.order, self._rule.keep)
            best = self.try_terms(extended) or best
        return best

    def try_terms(self, chosen: Sequence[int]) -> FreeRunSelection | None:
        """Fit the terms in a free run and linearise it there; None if it does not stay finite."""
        key = frozenset(chosen)
        if key not in self._tried:
            values = _fit_free_run(self._whole, chosen)
            found = None if values is None else _linearise(self._whole, chosen, values)
            self._tried[key] = found
        return self._tried[key]

    def _iterate(self, chosen: Sequence[int], *, is_white: bool) -> None:
        """Select from the slopes at each fit, until that was tried before."""
        for round_number in range(_MAX_ROUNDS):
            if not chosen or (round_number and frozenset(chosen) in self._tried):
                break
            tried = self.try_terms(chosen)
            if tried is None:
                break
            triangle = tried.plain_triangle if is_white else tried.triangle
            chosen = select_terms(triangle, self._demand, tried.samples).order

    def _find_best(self) -> FreeRunSelection | None:
        found = [one for one in self._tried.values() if one is not None]
        return min(found, key=self._rate, default=None)

    def _rate(self, one: FreeRunSelection) -> tuple[float, ...]:
        share, terms = one.innovation_variance / self._power, len(one.forward_selection.order)
        candidates = len(self._whole.model.terms)
        return rate_terms(self._demand, share, terms, one.samples, candidates)


def _compute_output_power(problem: Problem) -> float:
    """Compute the mean square of the scored output."""
    squares = np.square(problem.evaluator.measured[problem.scored_rows])
    return max(float(np.mean(squares)), np.finfo(float).tiny)


def _fit_free_run(whole: Problem, chosen: Sequence[int]) -> dict[str, float] | None:
    """Fit the chosen terms in a free run: values of all parameters, zero of the other terms."""
    model = whole.model
    names = {model.terms[i].coefficient_name for i in chosen}
    absent = {
        parameter.name: {
            "lower": min(parameter.lower, -1.0),
            "upper": max(parameter.upper, 1.0),
            "scale": "linear",
            "fixed": 0.0,
        }
        for parameter in model.parameters
        if parameter.name.startswith("a[") and parameter.name not in names
    }
    reduced = whole.rebuild(parameters={**whole.settings.parameters, **absent})
    starts = find_equation_error_starts(reduced, GeneticAlgorithm()).values
    if not starts:
        return None
    free = reduced.free_parameters
    start = np.array([starts[0].get(p.name, 0.5 * (p.lower + p.upper)) for p in free])
    refined = refine_candidates(reduced, [start])[0]
    theta = start if refined is None else refined.theta
    fixed = {
        parameter.name: parameter.fixed
        for parameter in reduced.all_parameters
        if parameter.fixed is not None
    }
    return {**fixed, **dict(zip(reduced.free_names, theta.tolist(), strict=True))}


def _linearise(
    whole: Problem, chosen: Sequence[int], values: Mapping[str, float]
) -> FreeRunSelection | None:
    """Linearise the free run in the coefficients of all candidates, and whiten its error."""
    theta = np.array([values[name] for name in whole.free_names])
    terms, rows = whole.model.terms, whole.scored_rows
    simulated = whole.predict(theta[None])[0]
    residuals = (whole.evaluator.measured - simulated)[rows]
    if not np.all(np.isfinite(residuals)):
        return None
    lags = sorted(find_lag_parameters(whole.model))
    names = [name for name in lags if name in whole.free_names]
    slopes = _compute_slopes(
        whole, theta, simulated, [*names, *(term.coefficient_name for term in terms)]
    )
    coefficients = np.array([values.get(term.coefficient_name, 0.0) for term in terms])
    target = residuals + slopes[:, len(names) :] @ coefficients
    columns = np.column_stack([slopes, target])
    parts = _list_even_parts(whole)
    noise = fit_autoregression([residuals[part] for part in parts])

    def fold(errors: Autoregression) -> FloatArray:
        folded = np.zeros((0, columns.shape[1]))
        for part in parts:
            for block in errors.whiten(columns[part], BLOCK_ROWS):
                folded = fold_rows(folded, block)
        short = max(columns.shape[1] - folded.shape[0], 0)
        return np.vstack([folded, np.zeros((short, folded.shape[1]))])[len(names) :, len(names) :]

    triangle = fold(noise)
    selection = select_forward(triangle, len(chosen), among=chosen)
    if not selection.order:
        return None  # no term has an effect on the free run
    innovations = np.concatenate(
        [e for part in parts for e in noise.whiten(residuals[part], residuals.size)]
    )
    price = innovations.size ** (noise.order / innovations.size)
    return FreeRunSelection(
        selection,
        coefficients,
        {name: values[name] for name in lags},
        triangle,
        fold(Autoregression(np.zeros(0))) if noise.order else triangle,
        innovations.size,
        price * float(np.mean(np.square(innovations))),
        noise.order,
    )


def _list_even_parts(problem: Problem) -> list[slice]:
    """List the series of scored samples without gaps."""
    parts = []
    for part in iterate_parts(problem):
        steps = np.diff(part.times)
        period = float(np.median(steps)) if steps.size else 1.0
        ends = [0, *(np.flatnonzero(steps > 1.5 * period) + 1).tolist(), part.times.size]
        first = part.rows.start
        parts += [slice(first + a, first + b) for a, b in pairwise(ends)]
    return parts


def _compute_slopes(
    whole: Problem, theta: FloatArray, simulated: FloatArray, names: Sequence[str]
) -> FloatArray:
    """Compute the slopes of the scored output (n, N) with respect to parameters by name.

    Those of parameters that are not free, or whose change makes the run diverge, are zero.
    """
    columns, rows = {name: d for d, name in enumerate(whole.free_names)}, whole.scored_rows
    slopes = np.zeros((rows.size, len(names)))
    free = [i for i, name in enumerate(names) if name in columns]
    for first in range(0, len(free), _BATCH_SIZE):
        batch = free[first : first + _BATCH_SIZE]
        individuals = np.repeat(theta[None], len(batch), axis=0)
        steps = np.empty(len(batch))
        for row, i in enumerate(batch):
            d = columns[names[i]]
            steps[row] = _DIFFERENCE_STEP * (whole.evaluator.upper[d] - whole.evaluator.lower[d])
            individuals[row, d] += steps[row]
        with np.errstate(over="ignore", invalid="ignore"):
            slope = (whole.predict(individuals) - simulated)[:, rows] / steps[:, None]
        slopes[:, batch] = np.where(np.all(np.isfinite(slope), axis=1)[:, None], slope, 0.0).T
    return slopes
