"""What a filter says of noise: the size of each source, and the free run beside the predictions."""

from collections.abc import Iterator, Mapping
from math import exp, isfinite, log

import numpy as np

from sysid.core.types import FloatArray
from sysid.core.units import is_blank_unit
from sysid.kernels.signals.past_reads import is_difference
from sysid.models.kalman_filter import is_noise_parameter
from sysid.results.parts import NoiseSource, PlantNoise
from sysid.simulation.data_bounds import list_units
from sysid.simulation.free_run import simulate_free_run
from sysid.simulation.problem import Problem, compute_metrics
from sysid.simulation.steps_ahead import measure_prediction_errors


def describe_plant_noise(problem: Problem, theta: FloatArray, rms: float) -> PlantNoise | None:
    """Describe the noise of an estimate (D,) whose J is `rms`; None without noise in the plant.

    The sensor's deviation is J over the geometric mean of the innovations' deviations, which are
    relative to it.
    """
    if not problem.model.corrections:
        return None
    values = {p.name: p.fixed for p in problem.all_parameters if p.fixed is not None}
    values |= dict(zip(problem.free_names, theta.tolist(), strict=True))
    _, deviations = problem.predict_ahead(theta[None])
    mean = np.mean(np.log(deviations[0, problem.scored_rows]))
    sensor = exp(log(rms) - float(mean)) if rms > 0 else 0.0
    metrics = compute_metrics(*simulate_free_run(problem, theta))
    is_finite = isfinite(metrics.rms)
    return PlantNoise(
        tuple(_list_sources(problem, values, sensor)),
        metrics.rms if is_finite else None,
        metrics.fit_percent if is_finite else None,
        measure_prediction_errors(problem, theta),
    )


def _list_sources(
    problem: Problem, values: Mapping[str, float], sensor: float
) -> Iterator[NoiseSource]:
    """List the sensors, and the places of noise by the parameters of the filter."""
    units = list_units(problem.model, problem.records)
    for output in problem.model.outputs:
        size = sensor / problem.output_weights[output.name]
        yield NoiseSource(output.name, "sensor", size, units[output.name], None)
    for parameter in filter(is_noise_parameter, values):
        kind, _, place = parameter[:-1].partition("[")
        size = values[parameter] * sensor
        if kind == "load":
            yield NoiseSource(place, "load", size, units[place], values[f"tau[{place}]"])
        elif kind == "noise":
            unit = "1" if is_blank_unit(units[place]) else units[place]
            per = "" if is_difference(problem.model) else "/√s"
            yield NoiseSource(place, "plant", size, f"{unit}{per}", None)
