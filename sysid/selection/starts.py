"""Starts for the search of a polynomial: least squares one step ahead, tested in free runs.

One step ahead a polynomial is linear in its coefficients. So for fixed lags least squares solves
them directly. A random point of the same box nearly always diverges in a free run. Measured past
values carry noise, which biases the solution and can make it unstable.

So there are several variants: with increasing numbers of terms, regularised, and with simulated
past values as instruments or as regressors. Each is tested in a free run, and the search starts
from the best.
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

DIVERGENCE_LIMIT = 1e6
"""Of a free run that counts, in standard deviations of the output."""

_RIDGES = (1e-8, 1e-6, 1e-4, 1e-2)  # of the sum of squares of a scaled column, which is 1
_TERM_COUNTS = (1, 2, 3, 4, 6, 9, 13, 20, 32, 64)  # terms of the nested solutions
_LAG_COMBINATIONS = 6  # combinations of the lags
_MAX_ITERATIONS = 4  # of the simulated past values
_ITERATED_STARTS = 2  # starts of these iterations
_MAX_OPERATIONS = 1e9  # of one decomposition, about
_BUDGET_SHARE = 4  # all starts take at most one in so many simulations of a budget

_CandidateStart: TypeAlias = tuple[Mapping[str, float], FloatArray]
"""Values of the lags, and coefficients (T,)."""


@dataclass(frozen=True, slots=True)
class SearchStarts:
    """Start values of a search, best first, and the simulations they took."""

    values: tuple[Mapping[str, float], ...] = ()
    evaluations: int = 0


def find_equation_error_starts(problem: Problem, algorithm: GeneticAlgorithm) -> SearchStarts:
    """Find starts for islands with the improved method; none for models that are not polynomials.

    Coefficients outside their bounds are moved onto them. The two methods of the paper start from
    random individuals, as the paper says.
    """
    methods = {get_island_settings(algorithm, i).method for i in range(algorithm.n_islands)}
    if "improved" not in methods or not _is_linear_regression(problem):
        return SearchStarts()
    limit = algorithm.stop.evaluations
    with use_one_thread():  # so that the last bit does not depend on the number of cores
        start_budget = compute_start_budget(algorithm, len(problem.free_parameters))
        return _StartFinder(
            problem, start_budget if limit is None else min(limit // _BUDGET_SHARE, start_budget)
        ).find_starts()


def _is_linear_regression(problem: Problem) -> bool:
    """Return whether the model is a sum of terms whose lags are fixed or free."""
    model = problem.model
    available = {
        parameter.name
        for parameter in problem.all_parameters
        if parameter.is_free or parameter.fixed is not None
    }
    return (
        model.form == "polynomial"
        and len(model.terms) > 0
        and find_lag_parameters(model) <= available
    )


class _StartFinder:
    """Finder of the starts of one problem; tests each in a free run and counts these."""

    def __init__(self, problem: Problem, most: int) -> None:
        self._problem, self._left, self.evaluations = problem, most, 0
        model, names = problem.model, {p.name for p in problem.model.parameters}
        model_parameters = [
            parameter for parameter in problem.all_parameters if parameter.name in names
        ]
        self._regression = Regression.from_experiments(
            model, problem.records, problem.experiments, model_parameters
        )
        self._axes = list_lag_values(
            model, model_parameters, self._regression.experiments[0].period
        )
        fixed = {
            parameter.name: parameter.fixed
            for parameter in model_parameters
            if parameter.fixed is not None
        }
        self._terms = tuple(t for t in model.terms if fixed.get(t.coefficient_name) != 0.0)
        self._fixed = {
            i: fixed[t.coefficient_name]
            for i, t in enumerate(self._terms)
            if t.coefficient_name in fixed
        }
        self._names = [t.coefficient_name for t in self._terms]
        self._free = [i for i in range(len(self._terms)) if i not in self._fixed]
        rows = int(_MAX_OPERATIONS / (2 * (2 * len(self._terms) + 1) ** 2))
        self._rows = self._regression.thin_rows(max(rows, 20 * len(self._terms)))

    def find_starts(self) -> SearchStarts:
        """Find the starts with a finite free run, best first."""
        if self._regression.most_rows == 0:
            return SearchStarts()
        trials = self._evaluate_starts(self._list_selected_starts())
        candidates = [(value, i, start) for i, (value, start) in enumerate(trials)]
        for lags in self._choose_lags():
            trials = self._evaluate_starts([(lags, c) for c in self._fit_one_step(lags)])
            candidates += [
                (value, len(candidates) + i, start) for i, (value, start) in enumerate(trials)
            ]
        for _, _, start in sorted(candidates, key=lambda item: item[:2])[:_ITERATED_STARTS]:
            trials = self._iterate_instruments(start)
            candidates += [
                (value, len(candidates) + i, start) for i, (value, start) in enumerate(trials)
            ]
        ranked = sorted(
            (item for item in candidates if np.isfinite(item[0])), key=lambda item: item[:2]
        )
        values = tuple(self._to_parameter_values(start) for _, _, start in ranked)
        distinct = [item for i, item in enumerate(values) if item not in values[:i]]
        return SearchStarts(tuple(distinct), self.evaluations)

    def _list_selected_starts(self) -> list["_CandidateStart"]:
        """List the lags and coefficients of the term selection."""
        selection = self._problem.model.selection
        if selection is None or not selection.terms:
            return []
        selected = {term.term: term.coefficient for term in selection.terms}
        coefficients = np.array([selected.get(term.label, 0.0) for term in self._terms])
        return [(dict(selection.lags), coefficients)]

    def _choose_lags(self) -> list[dict[str, float]]:
        """Choose combinations of the lags to start from, none of them near a better one."""
        selection = self._problem.model.selection
        first = [dict(selection.lags)] if selection is not None and selection.lags else []
        if not self._axes:
            return [{}]
        effort = plan_effort(self._axes, len(self._terms))
        thinned = self._regression.thin_rows(effort.rows)

        def measure_unexplained(lags: Mapping[str, float]) -> float:
            triangle, _ = thinned.factor_terms(self._terms, lags)
            remainder = triangle[:, -1] - triangle[:, :-1] @ self._solve_coefficients(triangle)
            return float(remainder @ remainder)

        taken = [combination for combination in first if combination.keys() == self._axes.keys()]
        for trial in search_lags(self._axes, measure_unexplained, effort.trials):
            if not any(self._are_neighbours(trial.lags, other) for other in taken):
                taken.append(trial.lags)
            if len(taken) == _LAG_COMBINATIONS:
                break
        return taken

    def _are_neighbours(self, first: Mapping[str, float], second: Mapping[str, float]) -> bool:
        """Return whether no lag differs by more than a sample."""
        return all(
            len(axis) < 2 or abs(first[name] - second[name]) < 1.5 * (axis[1] - axis[0])
            for name, axis in self._axes.items()
        )

    def _solve_coefficients(
        self, triangle: FloatArray, taken: Sequence[int] | None = None, ridge: float = 0.0
    ) -> FloatArray:
        """Solve the least-squares coefficients (T,); fixed ones stay."""
        fixed = np.zeros(len(self._terms))
        for i, value in self._fixed.items():
            fixed[i] = value
        rest = np.column_stack([triangle[:, :-1], triangle[:, -1] - triangle[:, :-1] @ fixed])
        return fixed + solve_coefficients(rest, self._free if taken is None else taken, ridge)

    def _fit_one_step(self, lags: Mapping[str, float]) -> list[FloatArray]:
        """Fit coefficients that explain the measured output one step ahead."""
        triangle, _ = self._rows.factor_terms(self._terms, lags)
        order = select_forward(triangle, _TERM_COUNTS[-1], among=self._free).order
        counts = [k for k in _TERM_COUNTS if k < len(self._free)]
        return [
            self._solve_coefficients(triangle),
            *(self._solve_coefficients(triangle, ridge=ridge) for ridge in _RIDGES),
            *(self._solve_coefficients(triangle, order[:k]) for k in reversed(counts)),
        ]

    def _iterate_instruments(
        self, start: "_CandidateStart"
    ) -> list[tuple[float, "_CandidateStart"]]:
        """Iterate solutions with simulated past values from a start, while they gain."""
        lags, size = start[0], len(self._terms)
        best, starts = np.inf, []
        for _ in range(_MAX_ITERATIONS):
            simulated = self._simulate_start(start)
            if simulated is None:
                break
            triangle, _ = self._rows.factor_terms(self._terms, lags, simulated)
            target = triangle[:size, -1:]
            instruments = np.column_stack([triangle[:size, size:-1], target])
            regressors = np.column_stack([triangle[:size, :size], target])
            solutions = [
                self._solve_coefficients(t, ridge=r)
                for t in (instruments, regressors)
                for r in (0.0, _RIDGES[1])
            ]
            trials = self._evaluate_starts([(lags, item) for item in solutions])
            starts += trials
            value, start = min(trials, key=lambda item: item[0], default=(np.inf, start))
            if not value < best:
                break
            best = value
        return starts

    def _simulate_start(self, start: "_CandidateStart") -> list[FloatArray] | None:
        """Simulate the free run at the grid points of each experiment; None if it diverges."""
        if self._left < 1:
            return None
        self._count_evaluations(1)
        problem = self._problem
        predicted = problem.predict(self._to_individuals([start]))[0]
        if not np.all(np.abs(predicted) < DIVERGENCE_LIMIT * max(problem.output_scale, 1e-300)):
            return None
        outputs, first = [], 0
        for piece, experiment in zip(
            self._regression.experiments, problem.experiments, strict=True
        ):
            positions = np.round(experiment.outputs[0].positions).astype(np.int64)
            output = np.full(piece.output.size, np.nan)
            output[positions] = predicted[first : first + positions.size]
            outputs.append(output)
            first += positions.size
        return outputs

    def _evaluate_starts(
        self, starts: Sequence["_CandidateStart"]
    ) -> list[tuple[float, "_CandidateStart"]]:
        """Evaluate J of the free run of each start, within the budget."""
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
        """Convert a start to values of free parameters, inside their bounds."""
        lags, coefficients = start
        named = dict(zip(self._names, coefficients.tolist(), strict=True))
        named |= lags
        return {
            parameter.name: min(max(named[parameter.name], parameter.lower), parameter.upper)
            for parameter in self._problem.free_parameters
            if parameter.name in named
        }

    def _to_individuals(self, starts: Sequence["_CandidateStart"]) -> FloatArray:
        """Convert starts to individuals (P, D); other parameters are in the middle."""
        free_parameters = self._problem.free_parameters
        return np.array(
            [
                [
                    values.get(parameter.name, 0.5 * (parameter.lower + parameter.upper))
                    for parameter in free_parameters
                ]
                for values in map(self._to_parameter_values, starts)
            ]
        )
