"""Where the search of a polynomial begins: least squares one step ahead, made fit for a free run.

One step ahead a polynomial is linear in its coefficients, so that at given lags least squares
finds them at once; a random point of the same box, run freely, nearly always diverges. Measured
past values carry noise, which biases that solution and may make it unstable. So it comes in
several forms: with ever more terms, regularised, and with simulated past values as instruments
or as regressors. Each is run freely, and the search is given those that do best.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from sysid.core.settings import GeneticAlgorithm
from sysid.core.threads import use_one_thread
from sysid.core.types import FloatArray
from sysid.search.island import compute_start_budget, get_island_settings
from sysid.selection.frols import select_forward, solve_coefficients
from sysid.selection.lag_search import list_lag_values, plan_effort, search_lags
from sysid.selection.regression import Regression, find_lag_parameters
from sysid.simulation.problem import Problem

_RIDGES = (1e-8, 1e-6, 1e-4, 1e-2)  # of the sum of the scaled columns' squares, which is one
_TERM_COUNTS = (1, 2, 3, 4, 6, 9, 13, 20, 32, 64)  # terms of the nested solutions
_LAG_COMBINATIONS = 6  # combinations of the lags
_MOST_ITERATIONS = 4  # of the simulated past values
_ITERATED_STARTS = 2  # starts from which these iterations begin
_MOST_OPERATIONS = 1e9  # of one decomposition, about
_DIVERGENCE_LIMIT = 1e6  # of the output's standard deviation
_BUDGET_SHARE = 4  # of a budget of simulations, at most one in so many for all starts

_CandidateStart: TypeAlias = tuple[Mapping[str, float], FloatArray]
"""Values of the lags, and coefficients (T,)."""


@dataclass(frozen=True, slots=True)
class SearchStarts:
    """Values for a search to begin with, best first, and the simulations they have cost."""

    values: tuple[Mapping[str, float], ...] = ()
    evaluations: int = 0


def find_equation_error_starts(problem: Problem, algorithm: GeneticAlgorithm) -> SearchStarts:
    """Starts for the islands that search by the improved method; none for another model.

    Coefficients outside their bounds are put on them. The two methods of the paper begin as the
    paper says, with random individuals.
    """
    methods = {get_island_settings(algorithm, i).method for i in range(algorithm.n_islands)}
    if "improved" not in methods or not _is_linear_regression(problem):
        return SearchStarts()
    limit = algorithm.stop.evaluations
    with use_one_thread():  # so that the last bit does not depend on the number of cores
        before = compute_start_budget(algorithm, len(problem.free_parameters))
        return _StartFinder(
            problem, before if limit is None else min(limit // _BUDGET_SHARE, before)
        ).find_starts()


def _is_linear_regression(problem: Problem) -> bool:
    """Whether the model is the sum of its terms at lags that are known or sought."""
    model = problem.model
    known = {one.name for one in problem.all_parameters if one.is_free or one.fixed is not None}
    return (
        model.form == "polynomial" and len(model.terms) > 0 and find_lag_parameters(model) <= known
    )


class _StartFinder:
    """Starts of one problem, each tried in a free run; counts these."""

    def __init__(self, problem: Problem, most: int) -> None:
        self._problem, self._left, self.evaluations = problem, most, 0
        model, names = problem.model, {p.name for p in problem.model.parameters}
        own = [one for one in problem.all_parameters if one.name in names]
        self._regression = Regression.from_experiments(
            model, problem.records, problem.experiments, own
        )
        self._axes = list_lag_values(model, own, self._regression.experiments[0].period)
        fixed = {one.name: one.fixed for one in own if one.fixed is not None}
        self._terms = tuple(t for t in model.terms if fixed.get(t.coefficient_name) != 0.0)
        self._given = {
            i: fixed[t.coefficient_name]
            for i, t in enumerate(self._terms)
            if t.coefficient_name in fixed
        }
        self._sought = [i for i in range(len(self._terms)) if i not in self._given]
        rows = int(_MOST_OPERATIONS / (2 * (2 * len(self._terms) + 1) ** 2))
        self._rows = self._regression.thin_rows(max(rows, 20 * len(self._terms)))

    def find_starts(self) -> SearchStarts:
        """All that a free run can follow, best first."""
        if self._regression.most_rows == 0:
            return SearchStarts()
        tried = self._evaluate_starts(self._list_selected_starts())
        found = [(value, i, start) for i, (value, start) in enumerate(tried)]
        for lags in self._choose_lags():
            tried = self._evaluate_starts([(lags, c) for c in self._fit_one_step(lags)])
            found += [(value, len(found) + i, start) for i, (value, start) in enumerate(tried)]
        for _, _, start in sorted(found, key=lambda one: one[:2])[:_ITERATED_STARTS]:
            tried = self._iterate_instruments(start)
            found += [(value, len(found) + i, start) for i, (value, start) in enumerate(tried)]
        ranked = sorted((one for one in found if np.isfinite(one[0])), key=lambda one: one[:2])
        values = tuple(self._to_parameter_values(start) for _, _, start in ranked)
        distinct = [one for i, one in enumerate(values) if one not in values[:i]]
        return SearchStarts(tuple(distinct), self.evaluations)

    def _list_selected_starts(self) -> list["_CandidateStart"]:
        """Lags and coefficients that the selection of the terms has found."""
        selection = self._problem.model.selection
        if selection is None or not selection.terms:
            return []
        known = {one.term: one.coefficient for one in selection.terms}
        coefficients = np.array([known.get(term.label, 0.0) for term in self._terms])
        return [(dict(selection.lags), coefficients)]

    def _choose_lags(self) -> list[dict[str, float]]:
        """Combinations of the lags to begin with, none of them beside a better one."""
        selection = self._problem.model.selection
        first = [dict(selection.lags)] if selection is not None and selection.lags else []
        if not self._axes:
            return [{}]
        effort = plan_effort(self._axes, len(self._terms))
        few = self._regression.thin_rows(effort.rows)

        def unexplained(lags: Mapping[str, float]) -> float:
            triangle, _ = few.factor_terms(self._terms, lags)
            left = triangle[:, -1] - triangle[:, :-1] @ self._solve_coefficients(triangle)
            return float(left @ left)

        taken = [one for one in first if one.keys() == self._axes.keys()]
        for tried in search_lags(self._axes, unexplained, effort.trials):
            if not any(self._are_neighbours(tried.lags, other) for other in taken):
                taken.append(tried.lags)
            if len(taken) == _LAG_COMBINATIONS:
                break
        return taken

    def _are_neighbours(self, one: Mapping[str, float], other: Mapping[str, float]) -> bool:
        """Whether no lag differs by more than a sample."""
        return all(
            len(axis) < 2 or abs(one[name] - other[name]) < 1.5 * (axis[1] - axis[0])
            for name, axis in self._axes.items()
        )

    def _solve_coefficients(
        self, triangle: FloatArray, taken: Sequence[int] | None = None, ridge: float = 0.0
    ) -> FloatArray:
        """Least-squares coefficients (T,), the fixed ones as they are."""
        held = np.zeros(len(self._terms))
        for i, value in self._given.items():
            held[i] = value
        rest = np.column_stack([triangle[:, :-1], triangle[:, -1] - triangle[:, :-1] @ held])
        return held + solve_coefficients(rest, self._sought if taken is None else taken, ridge)

    def _fit_one_step(self, lags: Mapping[str, float]) -> list[FloatArray]:
        """Coefficients that explain the measured output one step ahead."""
        triangle, _ = self._rows.factor_terms(self._terms, lags)
        order = select_forward(triangle, _TERM_COUNTS[-1], among=self._sought).order
        counts = [k for k in _TERM_COUNTS if k < len(self._sought)]
        return [
            self._solve_coefficients(triangle),
            *(self._solve_coefficients(triangle, ridge=ridge) for ridge in _RIDGES),
            *(self._solve_coefficients(triangle, order[:k]) for k in reversed(counts)),
        ]

    def _iterate_instruments(
        self, start: "_CandidateStart"
    ) -> list[tuple[float, "_CandidateStart"]]:
        """Solutions with simulated past values, from a start on, as long as they gain."""
        lags, size = start[0], len(self._terms)
        best, found = np.inf, []
        for _ in range(_MOST_ITERATIONS):
            simulated = self._simulate_start(start)
            if simulated is None:
                break
            both, _ = self._rows.factor_terms(self._terms, lags, simulated)
            target = both[:size, -1:]
            instruments = np.column_stack([both[:size, size:-1], target])
            regressors = np.column_stack([both[:size, :size], target])
            solutions = [
                self._solve_coefficients(t, ridge=r)
                for t in (instruments, regressors)
                for r in (0.0, _RIDGES[1])
            ]
            tried = self._evaluate_starts([(lags, one) for one in solutions])
            found += tried
            value, start = min(tried, key=lambda one: one[0], default=(np.inf, start))
            if not value < best:
                break
            best = value
        return found

    def _simulate_start(self, start: "_CandidateStart") -> list[FloatArray] | None:
        """The free run at the grid points of each experiment; None where it diverges."""
        if self._left < 1:
            return None
        self._count_evaluations(1)
        problem = self._problem
        predicted = problem.predict(self._to_individuals([start]))[0]
        if not np.all(np.abs(predicted) < _DIVERGENCE_LIMIT * max(problem.output_scale, 1e-300)):
            return None
        outputs, first = [], 0
        for piece, experiment in zip(
            self._regression.experiments, problem.experiments, strict=True
        ):
            places = np.round(experiment.outputs[0].places).astype(np.int64)
            output = np.full(piece.output.size, np.nan)
            output[places] = predicted[first : first + places.size]
            outputs.append(output)
            first += places.size
        return outputs

    def _evaluate_starts(
        self, starts: Sequence["_CandidateStart"]
    ) -> list[tuple[float, "_CandidateStart"]]:
        """J of the free run of each, as far as the budget goes."""
        starts = starts[: self._left]
        if not starts:
            return []
        self._count_evaluations(len(starts))
        values = self._problem.evaluate_fitness(self._to_individuals(starts))
        return list(zip(values.tolist(), starts, strict=True))

    def _count_evaluations(self, count: int) -> None:
        self._left -= count
        self.evaluations += count

    def _to_parameter_values(self, start: "_CandidateStart") -> dict[str, float]:
        """Values of the free parameters that a start is about, inside their bounds."""
        lags, coefficients = start
        named = {
            t.coefficient_name: float(c) for t, c in zip(self._terms, coefficients, strict=True)
        }
        named |= lags
        return {
            one.name: min(max(named[one.name], one.lower), one.upper)
            for one in self._problem.free_parameters
            if one.name in named
        }

    def _to_individuals(self, starts: Sequence["_CandidateStart"]) -> FloatArray:
        """The starts as individuals (P, D); what they are not about is in the middle."""
        space = self._problem.free_parameters
        return np.array(
            [
                [values.get(one.name, 0.5 * (one.lower + one.upper)) for one in space]
                for values in map(self._to_parameter_values, starts)
            ]
        )
