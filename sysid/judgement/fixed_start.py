"""Test whether the record starts where the model says that it does.

A state that starts at a fixed number (0 by default) is an assumption about the record. If it is
wrong, the estimates compensate for it, and their standard errors do not show it. A start at the
first measured value contains the noise of that sample, and an integrator never forgets it.

The sensitivities of the outputs to each fixed start are added to those of the parameters. If one
Gauss-Newton step reduces the loss by far more than chance (likelihood ratio; Wilks 1938), the
model is fitted again with these starts free. A start is reported if it then lies many of its own
standard errors away. These allow for coloured residuals. If the residuals still drift over the
whole record, they are too small, and nothing is reported. Noise alone does that to a measured
start, so such a start is reported only if it moves an estimate.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sysid.core.distributions import chi_square_limit
from sysid.core.errors import InvalidModel
from sysid.core.linear_algebra import compute_truncated_svd
from sysid.core.types import RANK_TOLERANCE, FloatArray, IntArray
from sysid.core.units import format_unit
from sysid.kernels.signals.past_reads import is_difference
from sysid.models.model import (
    EstimatedInitial,
    FixedInitial,
    InitialState,
    MeasuredInitial,
    Model,
    name_initial_state,
)
from sysid.models.parse import parse_model
from sysid.models.sections import STEADY
from sysid.search.refine import refine_candidates
from sysid.simulation.fit_metrics import compute_mean
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from sysid.uncertainty.estimates import Estimate

_SIGNIFICANCE = 1e-4  # of the likelihood ratio
_UNLIKELY_DISTANCE = 2.0  # half 95 % intervals of a free start from the fixed one
_ROUNDING_SHARE = 1e-6  # of the output: a smaller effect is of rounding or of the solver
_NOTABLE_MOVE = 1.0  # of a standard error of an estimate
_MOST_MOVES = 3  # of estimates that are described
_FIRST_STEP = 1e-9  # of the start, or in its unit: first trial of the step of its slope
_NOTABLE_STEP = 0.1  # of the noise: a step that moves the outputs less is too small
_MAX_GROWTH, _MAX_TRIALS = 1e6, 5  # of the step
_BOUND_DISTANCE = 10.0  # of the predicted moves of a start: its bounds in the new fit
_MAX_STARTS = 32  # of all states and experiments: more are not fitted
_MAX_STEPS = 30  # of least squares, with as many simulations as there are parameters and one


def warn_fixed_starts(
    problem: Problem,
    theta: FloatArray,
    analysis: Analysis,
    is_late: Callable[[], bool] | None = None,
) -> list[str]:
    """Warn about fixed or measured initial states that do not fit the record, at (D,).

    Squares of a free run are tested: one step ahead, a start is soon forgotten.
    """
    if (
        analysis.uncertainty is None
        or problem.loss.kind != "squares"
        or problem.prediction != "simulation"
        or (is_late is not None and is_late())
    ):
        return []
    predicted = _predict_starts(problem, theta, analysis)
    if not predicted or sum(moves.size for moves in predicted.values()) > _MAX_STARTS:
        return []
    before, after, freed = _fit_free_starts(problem, theta, predicted)
    if np.sqrt(max(before**2 - after**2, 0.0)) <= _ROUNDING_SHARE * problem.output_scale:
        return []
    if not _is_significant(
        problem.n_scored, before**2, after**2, sum(moves.size for moves in predicted.values())
    ):
        return []
    if freed.uncertainty is None or freed.uncertainty.noise_colour == "drifting":
        return []
    by_name = {estimate.name: estimate for estimate in freed.estimates}
    wrong = {
        state: starts
        for state in predicted
        if (starts := _list_wrong_starts(problem, state, by_name))
    }
    moves = _describe_moves(analysis.estimates, by_name)
    if not (moves or any(state in wrong for state in _list_states(problem, FixedInitial))):
        return []
    return [_describe_starts(problem, wrong, moves)] if wrong else []


def list_fixed_starts(problem: Problem) -> list[str]:
    """List the states that start at a number or at a measured value."""
    return list(_list_states(problem, FixedInitial, MeasuredInitial))


def _list_states(problem: Problem, *kinds: type[InitialState]) -> dict[str, int]:
    """List the states with such initial values, and their numbers."""
    pairs = zip(problem.model.states, problem.model.initial, strict=True)
    return {state.name: i for i, (state, initial) in enumerate(pairs) if isinstance(initial, kinds)}


def _get_assumed_starts(problem: Problem) -> dict[str, FloatArray]:
    """Get the starts (E,) of states that start at a number or, not in a recursion, measured."""
    kinds = (FixedInitial,) if is_difference(problem.model) else (FixedInitial, MeasuredInitial)
    return {state: _get_starts(problem, i) for state, i in _list_states(problem, *kinds).items()}


def _get_starts(problem: Problem, number: int) -> FloatArray:
    """Get the starts (E,) of a state that is not estimated."""
    return np.array([one.starts[number].first_values[0] for one in problem.experiments])


def _predict_starts(
    problem: Problem, theta: FloatArray, analysis: Analysis
) -> dict[str, FloatArray]:
    """Predict the moves (E,) of each state's starts that would reduce the loss significantly."""
    if not _get_assumed_starts(problem):
        return {}
    if analysis.residuals_and_sensitivities is None:  # no simulations were left for them
        return {}
    error, columns = analysis.residuals_and_sensitivities
    known = None if analysis.is_whitened else analysis.decomposition
    left, _, _, retained = known or compute_truncated_svd(columns)
    basis = left[:, retained]
    rest = error - basis @ (basis.T @ error)
    loss = float(rest @ rest)
    predicted: dict[str, FloatArray] = {}
    for state in _get_assumed_starts(problem):
        slopes = compute_start_slopes(problem, theta, state, np.sqrt(loss / error.size))
        others = slopes - basis @ (basis.T @ slopes)
        moves = np.asarray(
            -np.linalg.lstsq(others, rest, rcond=RANK_TOLERANCE)[0], dtype=np.float64
        )
        after = rest + others @ moves
        if _is_significant(error.size, loss, float(after @ after), moves.size):
            predicted[state] = moves
    return predicted


def _is_significant(n: int, before: float, after: float, starts: int) -> bool:
    """Whether the loss falls by far more than chance when so many starts are free."""
    if not 0.0 < after < before:
        return before > after == 0.0
    return bool(n * np.log(before / after) > chi_square_limit(starts, _SIGNIFICANCE))


def compute_start_slopes(
    problem: Problem, theta: FloatArray, state: str, noise: float
) -> FloatArray:
    """Compute the slopes (n, E) of the weighted outputs in a state's start; 0 if undefined.

    The step is the one that moves the outputs by about the noise, in whatever unit the state has.
    """
    weight, rows = problem.evaluator.weight[problem.scored_rows], problem.scored_rows
    starts = _get_starts(problem, [one.name for one in problem.model.states].index(state))

    def free_start() -> Problem:
        return _free_starts(problem, {state: starts}, {state: 1.0})

    # A start at a measured value differs from run to run of a sweep, and any other does not.
    depends = _list_states(problem, MeasuredInitial)
    freed = free_start() if depends else problem.share(f"free start of {state}", free_start)
    known = dict(zip(problem.free_names, theta.tolist(), strict=True))
    point = _join_starts(freed, known, {state: starts})
    is_start = np.array([name not in known for name in freed.free_names])

    def simulate(*steps: float) -> FloatArray:
        points = np.repeat(point[None], len(steps), axis=0)
        points[:, is_start] += np.array(steps)[:, None]
        return np.asarray(weight * freed.predict(points)[:, rows])

    experiments = _number_experiments(problem)
    slopes = np.zeros((rows.size, len(problem.experiments)))
    step = _FIRST_STEP * max(float(np.max(np.abs(starts))), 1.0)
    with np.errstate(all="ignore"):
        output, above, below = simulate(0.0, step, -step)
        for _ in range(_MAX_TRIALS):
            move = float(np.sqrt(compute_mean((above - output) ** 2)))
            if not move < _NOTABLE_STEP * noise:
                break
            step *= noise / max(move, noise / _MAX_GROWTH)
            above, below = simulate(step, -step)
        slope = (above - below) / (2.0 * step)
    if np.all(np.isfinite(slope)):
        slopes[np.arange(rows.size), experiments] = slope
    return slopes


def _number_experiments(problem: Problem) -> IntArray:
    """Number the experiment of each scored sample, (n,)."""
    counts = [
        sum(samples.positions.size for samples in experiment.outputs)
        for experiment in problem.experiments
    ]
    return np.repeat(np.arange(len(counts), dtype=np.int64), counts)[problem.scored_rows]


def _free_starts(
    problem: Problem, starts: Mapping[str, FloatArray], reaches: Mapping[str, float]
) -> Problem:
    """Free the starts of states, with bounds so far beyond their values (E,)."""
    model = problem.untied_model
    free = {
        state: EstimatedInitial(
            float(np.min(starts[state])) - reach, float(np.max(starts[state])) + reach
        )
        for state, reach in reaches.items()
    }
    initial = tuple(
        free.get(state.name, start)
        for state, start in zip(model.states, model.initial, strict=True)
    )
    return problem.rebuild(
        model=replace(model, initial=initial), initial=None, weights=problem.output_weights
    )


def _join_starts(
    freed: Problem, known: Mapping[str, float], starts: Mapping[str, FloatArray]
) -> FloatArray:
    """Join values of parameters and starts (E,) of states in the order of a problem (D,)."""
    values = dict(known)
    for state, numbers in starts.items():
        for e, number in enumerate(numbers.tolist()):
            values[name_initial_state(state, e)] = number
    return np.array([values[name] for name in freed.free_names])


def _fit_free_starts(
    problem: Problem, theta: FloatArray, predicted: dict[str, FloatArray]
) -> tuple[float, float, Analysis]:
    """Fit the model with these starts free; return the RMS before and after, and the analysis."""
    assumed = _get_assumed_starts(problem)
    known = dict(zip(problem.free_names, theta.tolist(), strict=True))
    reaches = {
        state: _BOUND_DISTANCE * float(np.max(np.abs(moves))) for state, moves in predicted.items()
    }
    freed = _free_starts(problem, assumed, reaches)
    moved_starts = {state: assumed[state] + moves for state, moves in predicted.items()}
    start = _join_starts(freed, known, moved_starts)
    n = _MAX_STEPS * (start.size + 1)
    (end,) = refine_candidates(freed, [start], n)
    point = start if end is None else end.theta
    after = float(freed.evaluate_fitness(point[None])[0])
    # The loss may also fall because the new fit left a poor minimum.
    by_name = dict(zip(freed.free_names, point.tolist(), strict=True))
    moved = np.array([by_name[name] for name in problem.free_names])
    ends = refine_candidates(problem, [theta, moved], n)
    before = min(candidate.rms for candidate in ends if candidate is not None)
    with np.errstate(all="ignore"):  # a start may have no effect on the output
        return before, after, analyse_estimate(freed, point)


def _list_wrong_starts(
    problem: Problem, state: str, by_name: dict[str, Estimate]
) -> list[Estimate]:
    """List a state's free starts (one for each experiment) that lie far from the assumed one."""
    starts = _get_assumed_starts(problem)[state].tolist()
    free = [by_name[name_initial_state(state, e)] for e in range(len(starts))]
    return [one for one, value in zip(free, starts, strict=True) if _is_far(one, value)]


def _is_far(start: Estimate, value: float) -> bool:
    if start.interval95 is None:
        return False
    lower, upper = start.interval95
    return abs(start.value - value) > _UNLIKELY_DISTANCE * 0.5 * (upper - lower)


def _describe_moves(estimates: Sequence[Estimate], by_name: dict[str, Estimate]) -> list[str]:
    """Describe the estimates that move furthest, by more than a standard error.

    It is the smaller of both: a wrong start also counts as noise and so widens the old one.
    """
    moves = []
    for old in estimates:
        new = by_name[old.name]
        if not (old.stderr and new.stderr):
            continue
        shift = abs(new.value - old.value) / min(old.stderr, new.stderr)
        if shift > _NOTABLE_MOVE:
            unit = format_unit(old.unit)
            text = (
                f"{old.name} is {new.value:.4g} ± {new.stderr:.2g} instead of "
                f"{old.value:.4g} ± {old.stderr:.2g}{unit}, {_round(shift)} standard errors away"
            )
            moves.append((-shift, text))
    return [text for _, text in sorted(moves)][:_MOST_MOVES]


def _describe_starts(
    problem: Problem,
    wrong: dict[str, list[Estimate]],
    moves: list[str],
) -> str:
    values, measured = _get_assumed_starts(problem), _list_states(problem, MeasuredInitial)
    assumed = ", ".join(
        f"the first measured {state}"
        if state in measured
        else f"{state} = {values[state][0]:g}{format_unit(starts[0].unit)}"
        for state, starts in wrong.items()
    )
    found = ", ".join(
        f"{start.name} = {start.value:.4g} ± {start.stderr:.2g}{format_unit(start.unit)}"
        for starts in wrong.values()
        for start in starts
    )
    effect = (
        f" With {'it' if len(wrong) == 1 else 'them'} free {', '.join(moves)}." if moves else ""
    )
    cures = ", ".join(
        f"{state}: {_suggest_bounds(values[state], starts)}" for state, starts in wrong.items()
    )
    steady = ", or initial: steady for a plant at rest" if _can_rest(problem.untied_model) else ""
    return (
        f"the record does not start at {assumed}. The data give {found}.{effect} "
        f"Let the start be estimated: initial: {{{cures}}}{steady}"
    )


def _can_rest(model: Model) -> bool:
    """Whether the equations determine a rest of all states."""
    try:
        parse_model({**model.document, "initial": STEADY})
    except InvalidModel:
        return False
    return True


def _suggest_bounds(assumed: FloatArray, starts: Sequence[Estimate]) -> str:
    """Suggest bounds as far beyond the assumed and the free starts as these are apart."""
    values = [*assumed.tolist(), *(start.value for start in starts)]
    span = max(values) - min(values)
    lower, upper = _round(min(values) - span), _round(max(values) + span)
    return f"{{lower: {lower}, upper: {upper}}}"


def _round(value: float) -> str:
    """Round to two digits, without an exponent: YAML reads 1e+06 as text."""
    return str(np.format_float_positional(float(f"{value:.2g}"), trim="-"))
