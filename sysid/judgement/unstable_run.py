"""Predict from measured outputs where a free run in a closed loop is misled by disturbances.

In an unstable plant each disturbance grows, and a free run attributes all of it to the parameters:
its estimates are far off, or those of a stable plant. Such a plant is recorded in a closed loop
only. A filter corrects the states by each measured output, so it forgets disturbances
(Ljung, System Identification, 2nd ed., ch. 3.2 and 13). Where none can be built, a recursion is
predicted one step ahead. That needs outputs that are states, and measurements whose noise is small
beside the disturbances.

So if residuals are not white, and an input follows them or the free run is unstable, the model is
fitted to such predictions as well. Its estimates are reported if the free run is unstable there
too, or if its residuals are white. A free run counts as unstable if the effect of some start is ten
times as large in the last quarter of an experiment as in its first half. A double integrator
reaches three.

A value depends on that if its 95 % interval does not hold that of the predictions. Such an
interval is often far too narrow: disturbances grow, and so do the sensitivities.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.findings import Finding
from sysid.core.types import FloatArray
from sysid.core.units import format_unit
from sysid.judgement.input_hold import replace_holds, write_hold
from sysid.judgement.residual_context import find_delay_parameters
from sysid.judgement.start_slopes import compute_start_slopes, list_assumed_starts
from sysid.minima.minima import scan_parameters
from sysid.models.kalman_filter import is_noise_parameter
from sysid.noise_models.generalised_least_squares import select_coloured_outputs
from sysid.residuals.past_outputs import reads_outputs
from sysid.residuals.series import iterate_parts
from sysid.results.findings import list_moves
from sysid.results.parts import InputHold
from sysid.search.refine import refine_candidates
from sysid.simulation.noise_levels import add_noise_levels
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.sensitivities import compute_sensitivities

MIN_GROWTH = 10.0
"""Of the effect of a start, from which on a run is unstable: a double integrator reaches three."""
_MOST_SIMULATIONS = 3000  # of the fit to predictions: with fewer left, none is made


class OneStepComparison(NamedTuple):
    """Estimates by predictions where disturbances mislead a free run, and what shows that.

    `options` are those that give these estimates.
    """

    cause: str
    estimates: tuple[Estimate, ...]
    options: tuple[str, ...]


def compare_one_step(
    problem: Problem,
    theta: FloatArray,
    analysis: Analysis,
    max_simulations: int | None,
    is_late: Callable[[], bool],
    *,
    has_feedback: bool,
    doubtful: Sequence[InputHold] = (),
) -> tuple[OneStepComparison | None, int]:
    """Estimate by predictions if disturbances mislead a free run (D,); None if they do not.

    `doubtful` inputs are read the other way, as they are likelier to be. Returns the simulations
    too.
    """
    if not _may_mislead(problem, analysis) or is_late():
        return None, 0
    most = _MOST_SIMULATIONS if max_simulations is None else max_simulations
    if most < _MOST_SIMULATIONS or not (
        has_feedback or compute_growth(problem, theta) >= MIN_GROWTH
    ):
        return None, 0
    ahead = _build_predictions(replace_holds(problem, doubtful) if doubtful else problem)
    if ahead is None:
        return None, 0
    starts = add_noise_levels(ahead, dict(zip(problem.free_names, theta.tolist(), strict=True)))
    start = starts[np.argmin(ahead.evaluate_fitness(starts))]
    (end,) = refine_candidates(ahead, [start], most, is_late)
    if end is None:
        return None, len(starts)
    names = find_delay_parameters(ahead)
    delays = [d for d, name in enumerate(ahead.free_names) if name in names]
    scan = scan_parameters(ahead, end, delays, most - end.evaluations, is_late)
    best = scan.best
    values = dict(zip(ahead.free_names, best.theta.tolist(), strict=True))
    growth = compute_growth(problem, np.array([values[name] for name in problem.free_names]))
    predicted = analyse_estimate(ahead, best.theta)
    spent = len(starts) + end.evaluations + scan.evaluations + predicted.evaluations
    if growth >= MIN_GROWTH:
        cause = f"the free run is unstable: an error of its start grows {growth:.2g} times"
    elif _are_white(ahead, predicted):
        cause = "residuals of predictions are white: the noise acts inside the plant"
    else:
        return None, spent
    is_filter = bool(ahead.model.corrections)
    setting = "loss: {noise_model: load}" if is_filter else "prediction: one-step"
    estimates = tuple(one for one in predicted.estimates if not is_noise_parameter(one.name))
    return OneStepComparison(cause, estimates, (setting, *map(write_hold, doubtful))), spent


def _build_predictions(problem: Problem) -> Problem | None:
    """Build the problem with a filter, else that of one step ahead; None if there is neither."""
    changes: dict[str, Any] = {"weights": problem.output_weights, "deviations": None}
    with suppress(InvalidSettings):
        return problem.rebuild(loss=replace(problem.loss, noise_model="load"), **changes)
    if not reads_outputs(problem.model):
        return None
    loss = replace(problem.loss, noise_model="white")
    return problem.rebuild(prediction="one-step", loss=loss, **changes)


def find_misled_run(
    estimates: Sequence[Estimate], comparison: OneStepComparison | None
) -> Iterator[Finding]:
    """Find a free run that disturbances mislead, with the estimates by predictions."""
    if comparison is None:
        return
    ahead = {one.name: one.value for one in comparison.estimates}
    stderrs = {one.name: one.stderr for one in comparison.estimates}
    moves = list_moves([one for one in estimates if one.is_free], ahead, stderrs)
    moved = {move.parameter for move in moves}
    outside = [one.name for one in estimates if one.name in moved and one.excludes(ahead[one.name])]
    described = _describe(comparison.estimates, {one.name: one for one in estimates})
    yield Finding(
        "noise in the plant",
        "noise",
        "serious" if outside else "note",
        "disturbances mislead the free run",
        f"{comparison.cause}. So a free run attributes disturbances to the parameters. Predicted "
        f"from measured outputs they are {described}.",
        f"Use {' and '.join(comparison.options)}.",
        moves=moves,
        parameters=tuple(outside),
    )


def _may_mislead(problem: Problem, analysis: Analysis) -> bool:
    """Whether residuals of a free run by squares are not white."""
    is_free = problem.is_free_run and problem.loss.kind == "squares"
    uncertainty = analysis.uncertainty
    is_white = uncertainty is None or uncertainty.noise_colour == "white"
    return is_free and not is_white


def compute_growth(problem: Problem, theta: FloatArray) -> float:
    """Compute by what factor the effect of a start grows at most over an experiment, at (D,)."""
    sensitivities = compute_sensitivities(problem, theta)
    noise = float(np.sqrt(np.mean(np.square(sensitivities.residuals))))
    declared = {parameter.name for parameter in problem.model.parameters}
    starts = [name not in declared for name in problem.free_names]
    assumed = list_assumed_starts(problem)
    slopes = [compute_start_slopes(problem, theta, one, noise) for one in assumed]
    effects, growth = np.hstack([sensitivities.columns[:, starts], *slopes]), 1.0
    for part in iterate_parts(problem):
        power = np.square(effects[part.rows])
        middle, late = power.shape[0] // 2, 3 * power.shape[0] // 4
        before, after = np.sum(power[:middle], axis=0), np.sum(power[late:], axis=0)
        moved = before > 0
        ratios = np.sqrt(2.0 * after[moved] / before[moved])
        growth = max([growth, *ratios.tolist()])
    return growth


def _are_white(problem: Problem, analysis: Analysis) -> bool:
    if analysis.residuals_and_sensitivities is None or analysis.is_whitened:
        return False
    return not select_coloured_outputs(problem, analysis.residuals_and_sensitivities[0])


def _describe(ahead: Sequence[Estimate], free: Mapping[str, Estimate]) -> str:
    return ", ".join(
        f"{one.name} = {one.value:.4g} ± {one.stderr:.2g}{format_unit(one.unit)} "
        f"instead of {free[one.name].value:.4g}"
        for one in ahead
        if one.is_free and one.stderr is not None and "(" not in one.name
    )
