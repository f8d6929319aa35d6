"""Choose the noise model for ``auto``: least squares, or generalised least squares (ar1).

Coloured residuals are noise or missing dynamics, and the residuals alone do not show which. Slow
noise makes estimates of least squares vague; missing dynamics make those of whitened residuals
wrong. Both show in the same way: the free run predicts data badly that were not used.

So the estimates that predict such data better are taken: validation data if there are any, else
blocks of the record (Shao 1993). Each fifth and each tenth but the first is left out in turn. The
first holds the initial states, of which later samples say little. From the estimates of all
samples, least squares of either kind continues on the other blocks, with the correlation time of
all residuals.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sysid.core.settings import NoiseModel
from sysid.core.types import BoolArray, FloatArray, IntArray
from sysid.core.units import format_unit
from sysid.noise_models.generalised_least_squares import (
    GeneralisedEstimate,
    WhitenedLeastSquares,
    estimate_correlation_times,
    select_coloured_outputs,
)
from sysid.residuals.series import iterate_parts, make_whitening
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import to_unit
from sysid.uncertainty.analysis import Analysis

_DIVISIONS = (5, 10)  # numbers of blocks: long ones show slow faults, short ones leave more data
_CLEAR_SHARE = 0.97  # of the error of least squares: a smaller gain may be chance


class PredictionErrors(NamedTuple):
    """RMS errors of the free run on blocks that were left out, and the simulations spent."""

    white: float
    ar1: float
    evaluations: int

    @property
    def speak_for_ar1(self) -> bool:
        """Whether the error under ar1 is clearly smaller."""
        return self.ar1 < _CLEAR_SHARE * self.white


def may_be_ar1(problem: Problem, analysis: Analysis) -> bool:
    """Whether the residuals of a free run by squares are coloured: else there is no choice."""
    uncertainty = analysis.uncertainty
    is_free = problem.prediction == "simulation" and problem.loss.kind == "squares"
    colour = "white" if uncertainty is None else uncertainty.noise_colour
    return is_free and colour in ("coloured", "drifting")


def compare_on_blocks(
    problem: Problem, theta: FloatArray, max_simulations: int | None = None
) -> PredictionErrors | None:
    """Compare both noise models on blocks left out, from estimates of least squares (D,).

    None: too few simulations are left, or no residual is coloured.
    """
    most = 2**62 if max_simulations is None else max_simulations
    whole = WhitenedLeastSquares(problem, most)
    if most < 2 * sum(_DIVISIONS) * whole.round_simulations:
        return None
    point = to_unit(problem.evaluator, theta[None])[0]
    error = whole.compute_residuals(point[None])[0]
    coloured = select_coloured_outputs(problem, error)
    times = estimate_correlation_times(problem, coloured, error, None)
    if not any(times.values()):
        return None
    generalised = whole.find_lowest_minimum([point], make_whitening(problem, times))
    left, squares, count = most - whole.evaluations, np.zeros(2), 0
    for division in _DIVISIONS:
        blocks = _number_blocks(problem, division)
        count += int(np.count_nonzero(blocks))
        for block in range(1, division):
            rows = blocks == block
            part = _leave_out(problem, rows)
            for i, start in enumerate((point, generalised)):
                search = WhitenedLeastSquares(part, left)
                if left < search.round_simulations:
                    return None
                whitening = make_whitening(part, times if i else {})
                end = search.find_lowest_minimum([start], whitening)
                predicted = whole.compute_residuals(end[None])[0][rows]
                squares[i] += float(predicted @ predicted)
                left -= search.evaluations + 1
    white, ar1 = np.sqrt(squares / max(count, 1)).tolist()
    return PredictionErrors(white, ar1, most - left)


def _number_blocks(problem: Problem, division: int) -> IntArray:
    """Number the blocks (n,) of time in which the scored samples of each experiment lie."""
    numbers = np.zeros(problem.n_scored, dtype=np.int64)
    for part in iterate_parts(problem):
        first, span = part.times[0], float(np.ptp(part.times))
        share = (part.times - first) / span if span > 0 else np.zeros(part.times.size)
        numbers[part.rows] = np.minimum((division * share).astype(np.int64), division - 1)
    return numbers


def _leave_out(problem: Problem, rows: BoolArray) -> Problem:
    """Leave scored samples out of the residuals of least squares."""
    weight = problem.evaluator.weight.copy()
    weight[problem.scored_rows[rows]] = 0.0
    return replace(problem, evaluator=problem.evaluator._replace(weight=weight))


def resolve_noise_model(problem: Problem, noise: GeneralisedEstimate) -> Problem:
    """Replace the noise model ``auto`` of a problem by the one that was selected."""
    if problem.loss.noise_model != "auto":
        return problem
    noise_model: NoiseModel = "ar1" if any(noise.correlation_times.values()) else "white"
    loss = replace(problem.loss, noise_model=noise_model)
    return replace(problem, settings=replace(problem.settings, loss=loss))


def explain_noise_model_choice(
    problem: Problem, theta: FloatArray, errors: PredictionErrors
) -> str:
    """Explain why ``auto`` selected ar1, and what least squares gave (D,)."""
    squares = ", ".join(
        f"{parameter.name} = {value:.4g}{format_unit(parameter.unit)}"
        for parameter, value in zip(problem.free_parameters, theta.tolist(), strict=True)
    )
    unit = format_unit(problem.unit)
    return (
        "noise_model auto selected ar1: its free run predicts data that were not used better, with "
        f"an RMS error of {errors.ar1:.4g}{unit} and not {errors.white:.4g}{unit}. "
        f"Plain least squares gave {squares}. To get these, use loss: {{noise_model: white}}"
    )
