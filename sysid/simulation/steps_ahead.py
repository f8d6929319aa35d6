"""Errors of predictions several samples ahead, of a model whose states measurements correct.

A filter that has seen the samples up to some time runs on freely from there. Between the next
sample and the free run of the whole record this says how long what was measured is worth knowing.
"""

from collections.abc import Iterator

import numpy as np

from sysid.core.types import FloatArray, IntArray
from sysid.kernels.layout import HEAD_FIELDS, ExperimentLayout
from sysid.simulation.evaluator import predict_ahead
from sysid.simulation.experiments import GridExperiment
from sysid.simulation.fit_metrics import PredictionError, rms
from sysid.simulation.problem import Problem

_SHARE = 0.1  # of the shortest record's samples: furthest prediction, so that many remain
_MOST_ORIGINS = 400  # simulations, each of half a record at a mean; the RMS is 4 % uncertain
_LAST = HEAD_FIELDS.index("last")


def measure_prediction_errors(problem: Problem, theta: FloatArray) -> tuple[PredictionError, ...]:
    """Measure the errors of predictions 1, 2, 5, 10, … samples ahead, at an estimate (D,).

    The furthest is a tenth of the shortest record. They begin at so many times that all together
    take at most 400 simulations, spread over the records. Only scored samples count.
    """
    least = min(s.positions.size for e in problem.experiments for s in e.outputs)
    horizons = list(_list_horizons(int(_SHARE * least)))
    errors: dict[int, list[FloatArray]] = {samples: [] for samples in horizons}
    times: dict[int, list[FloatArray]] = {samples: [] for samples in horizons}
    first = 0
    for number, experiment in enumerate(problem.experiments):
        for origin, predicted in _predict_from(problem, theta, number, horizons[-1]):
            row = first
            for samples in experiment.outputs:
                count = samples.positions.size
                ahead = int(np.searchsorted(samples.positions, origin, side="right")) - 1
                for horizon in horizons:
                    at = row + ahead + horizon
                    weight = problem.plain_weight[at] if ahead + horizon < count else 0.0
                    if weight > 0.0:
                        error = problem.evaluator.measured[at] - predicted[at]
                        errors[horizon].append(weight * error)
                        steps = samples.positions[ahead + horizon] - origin
                        times[horizon].append(steps * experiment.grid.step)
                row += count
        first += sum(samples.positions.size for samples in experiment.outputs)
    return tuple(
        PredictionError(horizon, float(np.mean(times[horizon])), _measure_rms(errors[horizon]))
        for horizon in horizons
        if errors[horizon]
    )


def _list_horizons(furthest: int) -> Iterator[int]:
    """List 1, 2, 5, 10, 20, 50, … up to a number of samples, at least 1."""
    yield 1
    decade = 1
    while True:
        for samples in (2 * decade, 5 * decade, 10 * decade):
            if samples > furthest:
                return
            yield samples
        decade *= 10


def _measure_rms(errors: list[FloatArray]) -> float | None:
    values = np.array(errors)
    return rms(values) if np.isfinite(values).all() else None


def _predict_from(
    problem: Problem, theta: FloatArray, number: int, furthest: int
) -> Iterator[tuple[int, FloatArray]]:
    """Predict values (M,) of one record from grid points on which it has samples, the last first.

    Values after `furthest` samples, and those of other records, are arbitrary.
    """
    evaluator, experiment = problem.evaluator, problem.experiments[number]
    origins = _choose_origins(problem, experiment)
    offsets = evaluator.offsets[number : number + 1]
    (first_int, first_float, _) = offsets[0].tolist()
    layout = ExperimentLayout.from_model(problem.averaged_model)
    ints, floats = evaluator.ints.copy(), evaluator.floats.copy()
    last = ints[first_int + _LAST]
    reaches = _find_reaches(experiment, origins, furthest)
    for origin, reach in zip(origins[::-1].tolist(), reaches[::-1].tolist(), strict=True):
        for output in range(len(experiment.outputs)):
            begin = first_float + ints[first_int + layout.locate_output(output, "precision")]
            floats[begin + origin + 1 : begin + experiment.grid.points] = 0.0
        ints[first_int + _LAST] = min(last, reach * experiment.grid.substeps)
        shortened = evaluator._replace(ints=ints, floats=floats, offsets=offsets)
        yield origin, predict_ahead(shortened, theta[None])[0]


def _choose_origins(problem: Problem, experiment: GridExperiment) -> IntArray:
    """Choose grid points with samples, evenly over all that another sample follows."""
    every = [np.concatenate([s.positions for s in e.outputs]) for e in problem.experiments]
    total = sum(np.unique(positions).size - 1 for positions in every)
    own = np.unique(np.concatenate([samples.positions for samples in experiment.outputs]))[:-1]
    count = min(own.size, max(_MOST_ORIGINS * own.size // max(total, 1), 1))
    chosen = own[np.linspace(0, own.size - 1, count).round().astype(np.int64)]
    return np.asarray(chosen.astype(np.int64))


def _find_reaches(experiment: GridExperiment, origins: IntArray, furthest: int) -> IntArray:
    """Find the grid point of the furthest sample ahead of each origin, of any output."""
    reaches = np.zeros(origins.size, dtype=np.int64)
    for samples in experiment.outputs:
        ahead = np.searchsorted(samples.positions, origins, side="right") - 1 + furthest
        positions = samples.positions[np.minimum(ahead, samples.positions.size - 1)]
        reaches = np.maximum(reaches, positions.astype(np.int64))
    return reaches
