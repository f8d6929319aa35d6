"""What a user should be told about a result, in whole sentences."""

import numpy as np

from sysid.islands.archipelago import of_island
from sysid.kernels.demand import is_difference
from sysid.problem import Problem
from sysid.result import Estimate, Uncertainty
from sysid.settings import GeneticAlgorithm
from sysid.types import FloatArray
from sysid.uncertainty import Analysis

_STRONG = 0.9
_HELD = 0.5  # of an input's neighbouring samples are equal, where it is taken for one of steps
_NOTABLE_GAIN = 0.01
_ROUNDING = 1e-9  # of the output: below, the residual is rounding and has no optimum


def warnings_of(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    analysis: Analysis,
    simulated: FloatArray,
    rms: float,
) -> tuple[str, ...]:
    """All warnings, the weightiest first."""
    found = []
    limit = algorithm.safe_limit
    if limit is not None and rms > limit:
        found.append(f"the RMS error {rms:.4g} is above the safe limit {limit:g}: not valid")
    found += _worse_than_a_line(problem, simulated)
    found += _steps_read_as_ramps(problem)
    found += [text for e in analysis.estimates if (text := _of_estimate(e))]
    if analysis.uncertainty is not None:
        found += _correlated(analysis.uncertainty)
    if analysis.possible_gain > _NOTABLE_GAIN and rms > _ROUNDING * problem.output_scale:
        found.append(_not_an_optimum(algorithm, analysis.possible_gain))
    return tuple(found)


def _steps_read_as_ramps(problem: Problem) -> list[str]:
    """Inputs that look held between samples, but are read as straight lines.

    A jump read as a ramp over one sample moves the estimate of a lag by half a sample.
    """
    if is_difference(problem.model):
        return []  # a recursion reads inputs at the samples only
    channels = [one for record in problem.arguments[1] for one in record.inputs]
    names = {
        one.name
        for one in channels
        if one.hold == "first" and _HELD <= np.mean(np.diff(one.values) == 0) < 1
    }
    return [
        f"input {name!r} stays constant between jumps, but is read as straight between its "
        f"samples, which moves a lag by about half a sample; if it was held, set hold: "
        f"{{{name}: zero}}"
        for name in sorted(names)
    ]


def _worse_than_a_line(problem: Problem, simulated: FloatArray) -> list[str]:
    """Whether straight lines through the outputs would fit better than the model does."""
    measured = problem.split(problem.evaluator.measured)
    weights = problem.split(problem.evaluator.weight)
    models = problem.split(simulated)
    found = []
    for e, experiment in enumerate(problem.experiments):
        for output, samples in zip(problem.model.outputs, experiment.outputs, strict=True):
            scored = weights[e][output.name] > 0
            if np.count_nonzero(scored) < 3:
                continue
            y, model = measured[e][output.name][scored], models[e][output.name][scored]
            line = _rms(y - _line(samples.places[scored], y))
            rms = _rms(y - model)
            if rms > line:
                where = f" of experiment {e + 1}" if len(problem.experiments) > 1 else ""
                found.append(
                    f"the model fits {output.name}{where} worse than a straight line "
                    f"(RMS {rms:.4g} against {line:.4g} {output.unit})"
                )
    return found


def _line(x: FloatArray, y: FloatArray) -> FloatArray:
    centred = x - np.mean(x)
    spread = float(centred @ centred)
    slope = float(centred @ (y - np.mean(y))) / spread if spread > 0 else 0.0
    return np.asarray(np.mean(y) + slope * centred)


def _rms(values: FloatArray) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean(np.square(values))))


def _of_estimate(estimate: Estimate) -> str:
    match estimate.status:
        case "at bound":
            low = estimate.value < 0.5 * (estimate.lower + estimate.upper)
            side, bound = ("lower", estimate.lower) if low else ("upper", estimate.upper)
            unit = "" if estimate.unit == "1" else f" {estimate.unit}"
            return f"{estimate.name} lies at its {side} bound {bound:g}{unit}"
        case "group" | "unidentifiable":
            return f"{estimate.name} is not identified: {estimate.reason}"
    return ""


def _correlated(uncertainty: Uncertainty) -> list[str]:
    found = []
    for i, first in enumerate(uncertainty.names):
        for j in range(i + 1, len(uncertainty.names)):
            r = float(uncertainty.correlation[i, j])
            if abs(r) > _STRONG:
                found.append(
                    f"{first} and {uncertainty.names[j]} are strongly correlated (r = {r:.3f}): "
                    "the data fix a combination of them better than each alone"
                )
    return found


def _not_an_optimum(algorithm: GeneticAlgorithm, gain: float) -> str:
    methods = {of_island(algorithm, i).method for i in range(algorithm.n_islands)}
    text = (
        "the estimate is not a local optimum: one least-squares step promises to remove "
        f"{100 * gain:.0f} % of the squared error, so the standard errors are a rough guide"
    )
    return text if "improved" in methods else f"{text} ({', '.join(sorted(methods))}: as found)"
