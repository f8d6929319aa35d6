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
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.models.model import Model, TermRule
from sysid.residuals.series import iterate_parts
from sysid.search.refine import refine_candidates
from sysid.selection.autoregression import Autoregression, fit_autoregression
from sysid.selection.frols import (
    ForwardSelection,
    extend_terms,
    rate_terms,
    select_forward,
    select_terms,
    solve_coefficients,
)
from sysid.selection.regression import BLOCK_ROWS, find_lag_parameters, fold_rows
from sysid.selection.starts import DIVERGENCE_LIMIT, find_equation_error_starts
from sysid.simulation.problem import Problem

MAX_SLOPES = 40_000_000
"""Limit on samples times candidates: 320 MB."""

_MAX_ROUNDS = 6
_BATCH_SIZE = 16  # simulations that a kernel runs in parallel
_DIFFERENCE_STEP = 1e-6  # of a coefficient's range
_MAX_SLOPE = 1e50  # more, and the free run diverges; its squares would overflow
_TINY = float(np.finfo(float).tiny)
_START_STEP = 1e-5  # of the output's deviation


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
        Their mean square, times n^(p/n): so the criterion of Bayes pays for p coefficients of the
        noise, of lags and of the start.
    variance : float
        Mean square of the error of the free run.
    noise_order : int
        Order of the autoregressive noise; 0: white.
    """

    forward_selection: ForwardSelection
    coefficients: FloatArray
    lags: dict[str, float]
    triangle: FloatArray
    plain_triangle: FloatArray
    samples: int
    innovation_variance: float
    variance: float
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
        """Select from the starts by the plain error, then from the best by the whitened one.

        None if no free run from there stays finite. Once only white noise is left, no other start
        is made. A rule that names the error of the simulation does not whiten it.
        """
        best: FreeRunSelection | None = None
        for start in starts:
            if best is None or best.noise_order:
                self._iterate(start, is_white=True)
                best = self._find_best()
        if best is not None:
            self._iterate(self._reduce_order(best), is_white=True)
            best = self._find_best()
        if best is not None and best.noise_order and self._rule.error != "simulation":
            self._iterate(best.forward_selection.order, is_white=False)
            best = self._find_best()
        if best is not None and self._demand is not self._rule:
            extended = extend_terms(best.triangle, best.forward_selection.order, self._rule.keep)
            fitted = self.try_terms(extended, best)
            if fitted is not None:  # the terms besides are judged where they are not needed
                best = best._replace(
                    forward_selection=fitted.forward_selection,
                    coefficients=fitted.coefficients,
                    lags=fitted.lags,
                    innovation_variance=fitted.innovation_variance,
                )
        return best

    def try_terms(
        self, chosen: Sequence[int], near: FreeRunSelection | None = None
    ) -> FreeRunSelection | None:
        """Fit the terms in a free run and linearise it there; None if it does not stay finite.

        The fit starts from the linear solution of the set `near`, if that stays finite.
        """
        key = frozenset(chosen)
        if key not in self._tried:
            values = _fit_free_run(self._whole, chosen, near)
            found = None if values is None else _linearise(self._whole, chosen, values)
            self._tried[key] = found
        return self._tried[key]

    def _iterate(self, chosen: Sequence[int], *, is_white: bool) -> None:
        """Select from the slopes at each fit, until that was tried before."""
        tried: FreeRunSelection | None = None
        for round_number in range(_MAX_ROUNDS):
            if not chosen or (round_number and frozenset(chosen) in self._tried):
                break
            tried = self.try_terms(chosen, tried)
            if tried is None:
                break
            triangle = tried.plain_triangle if is_white else tried.triangle
            chosen = select_terms(triangle, self._demand, tried.samples).order

    def _reduce_order(self, one: FreeRunSelection) -> list[int]:
        """Replace the output's past value of the longest lag by those of shorter lags.

        A model multiplied by a factor 1 + c/q has more terms and the same free run (Söderström,
        Test of pole-zero cancellation, 1975). No removal of a single term leads back from there.
        """
        terms = self._whole.model.terms
        lags = {
            i: term.factors[0].offset
            for i, term in enumerate(terms)
            if len(term.factors) == 1
            and term.factors[0].kind == "state"
            and term.factors[0].delay is None
        }
        chosen = list(one.forward_selection.order)
        longest = max((lags[i] for i in chosen if i in lags), default=0)
        shorter = [i for i in lags if lags[i] < longest]
        kept = [i for i in chosen if lags.get(i) != longest]
        return [*kept, *(i for i in shorter if i not in kept)] if shorter else chosen

    def _find_best(self) -> FreeRunSelection | None:
        found = [one for one in self._tried.values() if one is not None]
        return min(found, key=self._rate, default=None)

    def _rate(self, one: FreeRunSelection) -> tuple[float, ...]:
        variance = one.variance if self._rule.error == "simulation" else one.innovation_variance
        terms, candidates = len(one.forward_selection.order), len(self._whole.model.terms)
        return rate_terms(self._demand, variance / self._power, terms, one.samples, candidates)


def _compute_output_power(problem: Problem) -> float:
    """Compute the mean square of the scored output."""
    squares = np.square(problem.evaluator.measured[problem.scored_rows])
    return max(float(np.mean(squares)), _TINY)


def _fit_free_run(
    whole: Problem, chosen: Sequence[int], near: FreeRunSelection | None
) -> dict[str, float] | None:
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
    theta = None if near is None else _refine(reduced, _solve_linear(model, chosen, near))
    if theta is None:
        starts = find_equation_error_starts(reduced, GeneticAlgorithm()).values
        theta = _refine(reduced, starts[0]) if starts else None
    if theta is None:
        return None
    fixed = {
        parameter.name: parameter.fixed
        for parameter in reduced.all_parameters
        if parameter.fixed is not None
    }
    return {**fixed, **dict(zip(reduced.free_names, theta.tolist(), strict=True))}


def _solve_linear(model: Model, chosen: Sequence[int], near: FreeRunSelection) -> dict[str, float]:
    """Solve the coefficients of some terms in the linear regression at another set."""
    solution = solve_coefficients(near.plain_triangle, chosen).tolist()
    return near.lags | {
        term.coefficient_name: value for term, value in zip(model.terms, solution, strict=True)
    }


def _refine(problem: Problem, start: Mapping[str, float]) -> FloatArray | None:
    """Refine a start (D,) inside the bounds; None if its free run does not stay finite."""
    theta = [
        min(max(start.get(p.name, 0.5 * (p.lower + p.upper)), p.lower), p.upper)
        for p in problem.free_parameters
    ]
    (refined,) = refine_candidates(problem, [np.array(theta)])
    return None if refined is None else refined.theta


def _linearise(
    whole: Problem, chosen: Sequence[int], values: Mapping[str, float]
) -> FreeRunSelection | None:
    """Linearise the free run in the coefficients of all candidates, and whiten its error."""
    theta = np.array([values[name] for name in whole.free_names])
    terms, rows = whole.model.terms, whole.scored_rows
    simulated = whole.predict(theta[None])[0]
    residuals = (whole.evaluator.measured - simulated)[rows]
    if not np.all(np.abs(residuals) < DIVERGENCE_LIMIT * max(whole.output_scale, _TINY)):
        return None
    lags = sorted(find_lag_parameters(whole.model))
    slopes = _compute_slopes(whole, theta, simulated, [term.coefficient_name for term in terms])
    coefficients = np.array([values.get(term.coefficient_name, 0.0) for term in terms])
    target = residuals + slopes @ coefficients
    others = np.column_stack(
        [
            _compute_slopes(whole, theta, simulated, lags),
            _compute_start_slopes(whole, theta, simulated),
        ]
    )
    columns = np.column_stack([others, slopes, target])
    parts = _list_even_parts(whole)
    noise = fit_autoregression([residuals[part] for part in parts])
    triangle, samples = _fold_whitened(columns, parts, noise, others.shape[1])
    selection = select_forward(triangle, len(chosen), among=chosen)
    if not selection.order:
        return None  # no term has an effect on the free run
    plain = triangle
    if noise.order:
        plain, _ = _fold_whitened(columns, parts, Autoregression(np.zeros(0)), others.shape[1])
    squares = selection.unexplained_share * float(triangle[:, -1] @ triangle[:, -1])
    price = samples ** ((noise.order + others.shape[1]) / samples)
    return FreeRunSelection(
        selection,
        coefficients,
        {name: values[name] for name in lags},
        triangle,
        plain,
        samples,
        price * squares / samples,
        float(np.mean(np.square(residuals))),
        noise.order,
    )


def _fold_whitened(
    columns: FloatArray, parts: Sequence[slice], noise: Autoregression, others: int
) -> tuple[FloatArray, int]:
    """Whiten and fold the columns, project out the first `others`, and count the rows."""
    folded, rows = np.zeros((0, columns.shape[1])), 0
    for part in parts:
        for block in noise.whiten(columns[part], BLOCK_ROWS):
            folded, rows = fold_rows(folded, block), rows + block.shape[0]
    short = max(columns.shape[1] - folded.shape[0], 0)
    folded = np.vstack([folded, np.zeros((short, folded.shape[1]))])
    return folded[others:, others:], rows


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
        slopes[:, batch] = np.where(
            np.all(np.abs(slope) < _MAX_SLOPE, axis=1)[:, None], slope, 0.0
        ).T
    return slopes


def _compute_start_slopes(whole: Problem, theta: FloatArray, simulated: FloatArray) -> FloatArray:
    """Compute the slopes of the scored output (n, N) with respect to its measured start.

    A recursion starts from measured samples, whose errors fade like a part of the response. Terms
    that make up for them belong to no model.
    """
    slopes = []
    for k in range(whole.model.memory):
        moved = whole.replace_outputs([_move_sample(record, k) for record in whole.records])
        slope = (moved.predict(theta[None])[0] - simulated)[whole.scored_rows] / _START_STEP
        for part in iterate_parts(whole):
            own = np.zeros(slope.size)
            own[part.rows] = slope[part.rows]
            if np.all(np.abs(own) < _MAX_SLOPE) and np.any(own):
                slopes.append(own)
    return np.array(slopes).reshape(-1, whole.n_scored).T


def _move_sample(record: Record, k: int) -> Record:
    """Move the k-th sample of each output by a small step of its deviation."""
    outputs = []
    for channel in record.outputs:
        values = np.array(channel.values)
        if k < values.size:
            values[k] += _START_STEP * float(np.nanstd(values))
        outputs.append(replace(channel, values=values))
    return replace(record, outputs=tuple(outputs))
