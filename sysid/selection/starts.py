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
from sysid.core.threads import one_thread
from sysid.core.types import FloatArray
from sysid.search.island import budget_before, of_island
from sysid.selection.frols import forward, solved
from sysid.selection.lag_search import affordable, lag_values, search
from sysid.selection.regression import Regression, lag_parameters
from sysid.simulation.problem import Problem

_RIDGES = (1e-8, 1e-6, 1e-4, 1e-2)  # of the sum of the scaled columns' squares, which is one
_COUNTS = (1, 2, 3, 4, 6, 9, 13, 20, 32, 64)  # terms of the nested solutions
_LAGS = 6  # combinations of the lags
_ITERATIONS = 4  # of the simulated past values
_SIMULATED = 2  # starts from which these iterations begin
_OPERATIONS = 1e9  # of one decomposition, about
_DIVERGED = 1e6  # of the output's standard deviation
_SHARE = 4  # of a budget of simulations, at most one in so many for all starts

_Start: TypeAlias = tuple[Mapping[str, float], FloatArray]
"""Values of the lags, and coefficients (T,)."""


@dataclass(frozen=True, slots=True)
class Starts:
    """Values for a search to begin with, best first, and the simulations they have cost."""

    values: tuple[Mapping[str, float], ...] = ()
    evaluations: int = 0


def equation_error_starts(problem: Problem, algorithm: GeneticAlgorithm) -> Starts:
    """Starts for the islands that search by the improved method; none for another model.

    Coefficients outside their bounds are put on them. The two methods of the paper begin as the
    paper says, with random individuals.
    """
    methods = {of_island(algorithm, i).method for i in range(algorithm.n_islands)}
    if "improved" not in methods or not _is_regression(problem):
        return Starts()
    limit = algorithm.stop.evaluations
    with one_thread():  # so that the last bit does not depend on the number of cores
        before = budget_before(algorithm, len(problem.space))
        return _Finder(problem, before if limit is None else min(limit // _SHARE, before)).starts()


def _is_regression(problem: Problem) -> bool:
    """Whether the model is the sum of its terms at lags that are known or sought."""
    model = problem.model
    known = {one.name for one in problem.all_parameters if one.is_free or one.fixed is not None}
    return model.form == "polynomial" and len(model.terms) > 0 and lag_parameters(model) <= known


class _Finder:
    """Starts of one problem, each tried in a free run; counts these."""

    def __init__(self, problem: Problem, most: int) -> None:
        self._problem, self._left, self.evaluations = problem, most, 0
        model, names = problem.model, {p.name for p in problem.model.parameters}
        own = [one for one in problem.all_parameters if one.name in names]
        self._regression = Regression.laid(model, problem.records, problem.experiments, own)
        self._axes = lag_values(model, own, self._regression.pieces[0].period)
        fixed = {one.name: one.fixed for one in own if one.fixed is not None}
        self._terms = tuple(t for t in model.terms if fixed.get(t.coefficient) != 0.0)
        self._given = {i: fixed[t.coefficient] for i, t in enumerate(self._terms)
                       if t.coefficient in fixed}  # fmt: skip
        self._sought = [i for i in range(len(self._terms)) if i not in self._given]
        rows = int(_OPERATIONS / (2 * (2 * len(self._terms) + 1) ** 2))
        self._rows = self._regression.thinned(max(rows, 20 * len(self._terms)))

    def starts(self) -> Starts:
        """All that a free run can follow, best first."""
        if self._regression.samples == 0:
            return Starts()
        tried = self._tried(self._from_selection())
        found = [(value, i, start) for i, (value, start) in enumerate(tried)]
        for lags in self._lags():
            tried = self._tried([(lags, c) for c in self._one_step(lags)])
            found += [(value, len(found) + i, start) for i, (value, start) in enumerate(tried)]
        for _, _, start in sorted(found, key=lambda one: one[:2])[:_SIMULATED]:
            tried = self._iterated(start)
            found += [(value, len(found) + i, start) for i, (value, start) in enumerate(tried)]
        ranked = sorted((one for one in found if np.isfinite(one[0])), key=lambda one: one[:2])
        values = tuple(self._values(start) for _, _, start in ranked)
        distinct = [one for i, one in enumerate(values) if one not in values[:i]]
        return Starts(tuple(distinct), self.evaluations)

    def _from_selection(self) -> list["_Start"]:
        """Lags and coefficients that the selection of the terms has found."""
        selection = self._problem.model.selection
        if selection is None or not selection.terms:
            return []
        known = {one.term: one.coefficient for one in selection.terms}
        coefficients = np.array([known.get(term.label, 0.0) for term in self._terms])
        return [(dict(selection.lags), coefficients)]

    def _lags(self) -> list[dict[str, float]]:
        """Combinations of the lags to begin with, none of them beside a better one."""
        selection = self._problem.model.selection
        first = [dict(selection.lags)] if selection is not None and selection.lags else []
        if not self._axes:
            return [{}]
        effort = affordable(self._axes, len(self._terms))
        few = self._regression.thinned(effort.rows)

        def unexplained(lags: Mapping[str, float]) -> float:
            triangle, _ = few.triangle(self._terms, lags)
            left = triangle[:, -1] - triangle[:, :-1] @ self._solved(triangle)
            return float(left @ left)

        taken = [one for one in first if one.keys() == self._axes.keys()]
        for tried in search(self._axes, unexplained, effort.trials):
            if not any(self._are_beside(tried.lags, other) for other in taken):
                taken.append(tried.lags)
            if len(taken) == _LAGS:
                break
        return taken

    def _are_beside(self, one: Mapping[str, float], other: Mapping[str, float]) -> bool:
        """Whether no lag differs by more than a sample."""
        return all(
            len(axis) < 2 or abs(one[name] - other[name]) < 1.5 * (axis[1] - axis[0])
            for name, axis in self._axes.items()
        )

    def _solved(
        self, triangle: FloatArray, taken: Sequence[int] | None = None, ridge: float = 0.0
    ) -> FloatArray:
        """Least-squares coefficients (T,), the fixed ones as they are."""
        held = np.zeros(len(self._terms))
        for i, value in self._given.items():
            held[i] = value
        rest = np.column_stack([triangle[:, :-1], triangle[:, -1] - triangle[:, :-1] @ held])
        return held + solved(rest, self._sought if taken is None else taken, ridge)

    def _one_step(self, lags: Mapping[str, float]) -> list[FloatArray]:
        """Coefficients that explain the measured output one step ahead."""
        triangle, _ = self._rows.triangle(self._terms, lags)
        order = forward(triangle, _COUNTS[-1], among=self._sought).order
        counts = [k for k in _COUNTS if k < len(self._sought)]
        return [
            self._solved(triangle),
            *(self._solved(triangle, ridge=ridge) for ridge in _RIDGES),
            *(self._solved(triangle, order[:k]) for k in reversed(counts)),
        ]

    def _iterated(self, start: "_Start") -> list[tuple[float, "_Start"]]:
        """Solutions with simulated past values, from a start on, as long as they gain."""
        lags, size = start[0], len(self._terms)
        best, found = np.inf, []
        for _ in range(_ITERATIONS):
            simulated = self._simulated(start)
            if simulated is None:
                break
            both, _ = self._rows.triangle(self._terms, lags, simulated)
            target = both[:size, -1:]
            instruments = np.column_stack([both[:size, size:-1], target])
            regressors = np.column_stack([both[:size, :size], target])
            solutions = [self._solved(t, ridge=r) for t in (instruments, regressors)
                         for r in (0.0, _RIDGES[1])]  # fmt: skip
            tried = self._tried([(lags, one) for one in solutions])
            found += tried
            value, start = min(tried, key=lambda one: one[0], default=(np.inf, start))
            if not value < best:
                break
            best = value
        return found

    def _simulated(self, start: "_Start") -> list[FloatArray] | None:
        """The free run at the grid points of each experiment; None where it diverges."""
        if self._left < 1:
            return None
        self._spend(1)
        problem = self._problem
        predicted = problem.predictions(self._theta([start]))[0]
        if not np.all(np.abs(predicted) < _DIVERGED * max(problem.output_scale, 1e-300)):
            return None
        outputs, first = [], 0
        for piece, experiment in zip(self._regression.pieces, problem.experiments, strict=True):
            places = np.round(experiment.outputs[0].places).astype(np.int64)
            output = np.full(piece.output.size, np.nan)
            output[places] = predicted[first : first + places.size]
            outputs.append(output)
            first += places.size
        return outputs

    def _tried(self, starts: Sequence["_Start"]) -> list[tuple[float, "_Start"]]:
        """J of the free run of each, as far as the budget goes."""
        starts = starts[: self._left]
        if not starts:
            return []
        self._spend(len(starts))
        values = self._problem.fitness(self._theta(starts))
        return list(zip(values.tolist(), starts, strict=True))

    def _spend(self, count: int) -> None:
        self._left -= count
        self.evaluations += count

    def _values(self, start: "_Start") -> dict[str, float]:
        """Values of the free parameters that a start is about, inside their bounds."""
        lags, coefficients = start
        named = {t.coefficient: float(c) for t, c in zip(self._terms, coefficients, strict=True)}
        named |= lags
        return {
            one.name: min(max(named[one.name], one.lower), one.upper)
            for one in self._problem.space
            if one.name in named
        }

    def _theta(self, starts: Sequence["_Start"]) -> FloatArray:
        """The starts as individuals (P, D); what they are not about is in the middle."""
        space = self._problem.space
        return np.array(
            [
                [values.get(one.name, 0.5 * (one.lower + one.upper)) for one in space]
                for values in map(self._values, starts)
            ]
        )
