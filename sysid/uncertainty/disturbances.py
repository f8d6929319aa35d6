"""Estimated disturbances over time, with their 95 % bands: a smoother behind the filter.

The filter knows a load from the samples before; a plant shows it later. So each time is estimated
from the whole record. The fixed-interval smoother (Rauch, Tung and Striebel, AIAA Journal 3 (1965)
1445) is used in the form that inverts no covariance (Bryson and Frazier 1963; Durbin and Koopman,
Time Series Analysis by State Space Methods, 2nd ed., ch. 4.4 and 6.4)::

    r ← c v/S + (I - K cᵀ)ᵀ r,   N ← c cᵀ/S + (I - K cᵀ)ᵀ N (I - K cᵀ)      over a sample
    r ← Φᵀ r,  N ← Φᵀ N Φ,  Φ = exp(A h), in a recursion its tangent        over a step
    x̂ = x + P r,  V = P - P N P

x, P, A and c are those of the filter, read before the samples of a time, v an innovation and S its
variance. In a model with lags of inputs that is exact; delayed states count as known, as in the
filter. The parameters are estimates, so V is averaged over them, and the variance of x̂ by them is
added (Hamilton, Journal of Econometrics 33 (1986) 387). Both are means over points at √D standard
errors, up and down each axis of the covariance: the cubature rule of third degree (Arasaratnam and
Haykin, IEEE Transactions on Automatic Control 54 (2009) 1254).
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.linalg import expm

from sysid.core.distributions import student_limit
from sysid.core.types import FloatArray
from sysid.kernels.borrowing import compile_borrowing
from sysid.kernels.signals.past_reads import is_difference
from sysid.models.kalman_filter import FilterReadings, list_filter_readings
from sysid.models.model import Model
from sysid.simulation.data_bounds import list_units
from sysid.simulation.grid import Grid
from sysid.simulation.problem import Problem
from sysid.uncertainty.output_bands import ParameterSpread


@dataclass(frozen=True, slots=True, eq=False)
class Disturbance:
    """An estimated disturbance of one record, in `unit`.

    Attributes
    ----------
    place : str
        Where it acts: the input or output with a load, or the state that noise moves.
    kind : {"load", "plant"}
        A load, or a state of the plant itself.
    unit : str
    times : FloatArray, shape (N,)
        Seconds.
    values : FloatArray, shape (N,)
        Estimate from the whole record.
    band : FloatArray, shape (N, 2)
        Lower and upper end of the 95 % band, at each time by itself.
    """

    place: str
    kind: Literal["load", "plant"]
    unit: str
    times: FloatArray
    values: FloatArray
    band: FloatArray


class _Readings(NamedTuple):
    """A filter over the N grid points of one record, of m outputs, for B parameter vectors."""

    states: FloatArray
    """(B, N, n), before the samples of a time."""
    covariances: FloatArray
    """(B, N, n, n)."""
    transitions: FloatArray
    """(B, N - 1 or 1, n, n), from a time to the next."""
    rows: FloatArray
    """(B, N, m, n), slopes of the outputs."""
    innovations: FloatArray
    """(B, N, m), 0 without a sample."""
    precisions: FloatArray
    """(N, m), squared; 0 without a sample."""


def estimate_disturbances(
    problem: Problem, theta: FloatArray, spread: ParameterSpread
) -> tuple[tuple[Disturbance, ...], ...]:
    """Estimate the disturbances of each record at an estimate (D,); none without a filter.

    The free parameters of the problem are among those of the spread.
    """
    if not problem.model.corrections:
        return ()
    readings = list_filter_readings(problem.model)
    chosen = [readings.states.index(state) for state, _ in readings.places]
    columns = [spread.names.index(name) for name in problem.free_names]
    points = _spread_points(problem, theta, spread.covariance[np.ix_(columns, columns)])
    quantile = student_limit(max(spread.degrees, 1.0), 0.025)
    sensor = measure_sensor(problem, theta)
    units = list_units(problem.model, problem.records)
    found = []
    for experiment, filtered in zip(
        problem.experiments, _read_filter(problem, readings, points), strict=True
    ):
        states, variances = _smooth(filtered)
        moves = np.square(states[1:] - states[0])
        width = quantile * np.sqrt(np.mean(sensor**2 * variances[1:] + moves, axis=0))
        found.append(
            tuple(
                Disturbance(
                    *place,
                    units[place.place],
                    experiment.grid.times,
                    states[0, :, i],
                    states[0, :, i, None] + width[:, i, None] * np.array([-1.0, 1.0]),
                )
                for i, (_, place) in zip(chosen, readings.places, strict=True)
            )
        )
    return tuple(found)


def count_values(problem: Problem) -> int:
    """Count the values of the filter that an estimate of the disturbances reads at once."""
    readings = len(list_filter_readings(problem.model).outputs) + len(problem.model.outputs)
    points = sum(experiment.grid.points for experiment in problem.experiments)
    return (2 * len(problem.free_parameters) + 1) * points * readings


def measure_sensor(problem: Problem, theta: FloatArray) -> float:
    """Measure the deviation of the sensor over 1/w, which those of a filter are relative to."""
    rows, evaluator = problem.scored_rows, problem.evaluator
    predicted, deviations = (values[0, rows] for values in problem.predict_ahead(theta[None]))
    errors = evaluator.weight[rows] * (evaluator.measured[rows] - predicted)
    return float(np.sqrt(np.mean(np.square(errors / deviations))))


def _spread_points(problem: Problem, theta: FloatArray, covariance: FloatArray) -> FloatArray:
    """Spread parameters about an estimate: it, then the 2D points of the rule, in bounds.

    Those of a logarithmic scale have their steps on it.
    """
    evaluator = problem.evaluator
    is_log = (evaluator.is_log > 0) & (theta > 0.0)
    start = np.where(is_log, np.log(np.where(is_log, theta, 1.0)), theta)
    unit = np.where(is_log, theta, 1.0)
    scale = np.sqrt(np.diag(covariance)) / unit
    scale = np.where(scale > 0.0, scale, 1.0)
    sizes, axes = np.linalg.eigh(covariance / np.outer(unit * scale, unit * scale))
    steps = np.sqrt(theta.size * np.maximum(sizes, 0.0)) * scale[:, None] * axes
    points = np.vstack([start, start + steps.T, start - steps.T])
    points = np.where(is_log, np.exp(np.where(is_log, points, 0.0)), points)
    return np.vstack([theta, np.clip(points[1:], evaluator.lower, evaluator.upper)])


def _read_filter(problem: Problem, readings: FilterReadings, points: FloatArray) -> list[_Readings]:
    """Read the filter of each record over its grid."""
    observed = problem.observe(readings.outputs)
    values = observed.predict_ahead(points)[0]
    n, m, first, found = len(readings.states), len(problem.model.outputs), 0, []
    for experiment in problem.experiments:
        count = experiment.grid.points
        block = values[:, first : first + len(readings.outputs) * count]
        first += block.shape[1]
        block = block.reshape(len(points), -1, count).transpose(0, 2, 1)
        ends = np.cumsum([n, n * n, n * n, n * m])[:-1]
        parts = np.split(block, ends, axis=2)
        states, covariances, slopes, rows = (np.ascontiguousarray(part) for part in parts)
        innovations = np.zeros((len(points), count, m))
        precisions = np.zeros((count, m))
        for i, samples in enumerate(experiment.outputs):
            at = samples.positions.astype(np.int64)
            predicted = values[:, first : first + at.size]
            first += at.size
            is_known = samples.precision > 0.0
            innovations[:, at, i] = np.where(is_known, samples.values - predicted, 0.0)
            precisions[at, i] = np.square(samples.precision)
        shape = (len(points), count, n, n)
        found.append(
            _Readings(
                states,
                covariances.reshape(shape),
                _make_transitions(slopes.reshape(shape), experiment.grid, problem.model),
                rows.reshape(len(points), count, m, n),
                innovations,
                precisions,
            )
        )
    return found


def _make_transitions(slopes: FloatArray, grid: Grid, model: Model) -> FloatArray:
    """Make Φ over each step from the slopes at its ends; one for all steps of a linear model.

    Those of a recursion are of the last one of its steps between two grid points.
    """
    if is_difference(model):
        return np.asarray(np.linalg.matrix_power(slopes[:, 1:], grid.substeps))
    if np.array_equal(slopes[:, 1:], slopes[:, :-1]):
        return np.asarray(expm(grid.step * slopes[:, :1]))
    return np.asarray(expm(0.5 * grid.step * (slopes[:, :-1] + slopes[:, 1:])))


def _smooth(filtered: _Readings) -> tuple[FloatArray, FloatArray]:
    """Smooth the states: they and their variances, (B, N, n) each."""
    states, variances = np.empty_like(filtered.states), np.empty_like(filtered.states)
    for point in range(len(states)):
        _smooth_states(
            filtered.states[point],
            filtered.covariances[point],
            filtered.transitions[point],
            filtered.rows[point],
            filtered.innovations[point],
            filtered.precisions,
            states[point],
            variances[point],
        )
    return states, variances


@compile_borrowing
def _smooth_states(
    filtered: FloatArray,
    covariances: FloatArray,
    transitions: FloatArray,
    rows: FloatArray,
    innovations: FloatArray,
    precisions: FloatArray,
    states: FloatArray,
    variances: FloatArray,
) -> None:
    """Smooth the states (N, n) of one filter backwards in time, in place."""
    points, n = states.shape
    r, information = np.zeros(n), np.zeros((n, n))
    for k in range(points - 1, -1, -1):
        if k < points - 1:
            move = transitions[min(k, transitions.shape[0] - 1)]
            r[:] = move.T @ r
            information[:] = move.T @ (information @ move)
        start = covariances[k]
        _pass_samples(start, rows[k], innovations[k], precisions[k], r, information)
        states[k] = filtered[k] + start @ r
        left = start - start @ information @ start
        for i in range(n):
            variances[k, i] = max(left[i, i], 0.0)


@compile_borrowing
def _pass_samples(
    start: FloatArray,
    rows: FloatArray,
    innovations: FloatArray,
    precisions: FloatArray,
    r: FloatArray,
    information: FloatArray,
) -> None:
    """Pass the samples of one time backwards, in place; the filter has them one by one."""
    outputs, n = rows.shape
    spread, shared, factors = start.copy(), np.zeros((outputs, n)), np.zeros(outputs)
    for o in range(outputs):
        shared[o] = spread @ rows[o]
        factors[o] = precisions[o] / (1.0 + precisions[o] * np.sum(rows[o] * shared[o]))
        spread -= factors[o] * np.outer(shared[o], shared[o])
    for o in range(outputs - 1, -1, -1):
        row, gain = rows[o], factors[o] * shared[o]
        r += row * (factors[o] * innovations[o] - np.sum(gain * r))
        moved = information @ gain
        seen = factors[o] + np.sum(gain * moved)
        information += seen * np.outer(row, row) - np.outer(row, moved) - np.outer(moved, row)
