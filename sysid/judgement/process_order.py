"""Fit a process with one order more and one less, and compare the orders.

A dead time absorbs a missing time constant: L comes out too long, with a small standard error, and
residuals that pass their tests. Only the fit of another order shows it. So a model that is a
process with dead time, however it is written (`sysid.control.process_form`), is compared with its
neighbours in the catalogue (`sysid.models.catalogue.process_family`).

All orders are fitted to the same samples under the same assumptions, also the model's own: the
entry of the catalogue, at rest if the model is, else with free initial states, and one integration
step. If a filter follows a load, it does so beside each order. Least squares starts from the
estimate. A dead time that grows by the time constant that is left out keeps the sum of all.

The criterion is Schwarz's (BIC, 1978), as for all explanations (`sysid.judgement.residual_model`):
each order has noise of its own, an autoregression that is estimated with it. An order is preferred
if its BIC is 6 lower than that of every other: odds of 20 to 1 (Kass and Raftery 1995: strong
evidence). Orders within 6 of the lowest are open, and the dead time lies in the range of theirs.

An open order that moves the dead time makes it doubtful: the data do not tell which of both is
true. With 130 sound records of white noise that happened in one. A part that lies at its bound is
held there (`ResidualContext.residual_model`), else its order would gain by a point beyond it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from sysid.control.linear_form import IdentifiedModel
from sysid.control.process_form import recognise_process
from sysid.core.errors import SysidError
from sysid.core.findings import Finding, Move
from sysid.core.settings import FitSettings, FoundNoiseModel, Loss, StartKind
from sysid.core.text import join_names, plain_estimate, plain_unit
from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.judgement.judge import explain_if_noise
from sysid.judgement.levels import SEPARABLE, UNLIKELY_MOVE
from sysid.judgement.residual_context import ResidualContext, find_delay_parameters
from sysid.models.catalogue.load import load_model
from sysid.models.catalogue.process_family import Process, ProcessEntry, list_neighbouring_orders
from sysid.models.kalman_filter import is_noise_parameter
from sysid.models.model import name_initial_state, replace_substeps
from sysid.noise_models.first_order_fit import fit_first_order_noise
from sysid.residuals.series import is_coloured, iterate_parts
from sysid.results.parts import OrderComparison, OrderFit, compare_fits
from sysid.search.refine import refine_candidates
from sysid.simulation.free_run import convert_to_free_run
from sysid.simulation.problem import Problem
from sysid.simulation.start_values import starts_at_rest
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.estimates import Estimate

_SUBSTEPS = 4  # of every order: a fast part needs them, and one step for all compares them fairly
_NEGLIGIBLE_SHARE = 1e-3  # of the output: smaller residuals are of the integration, not of noise
_NEW_PARTS = (0.1, 0.4, 1.0)  # of the slowest time constant: starts of the part that is added
_MOVE = 1e-3  # of a parameter, relative: what it changes in the process
_MAX_SIMULATIONS = 4000  # of an order: half for the fit, the rest for noise model and errors


class _Assumptions(NamedTuple):
    """What every order takes over from the model.

    Attributes
    ----------
    process : Process
        At the estimate.
    delay : Estimate
        Of the dead time.
    fixed : frozenset of {"gain", "offset"}
        What no free parameter of the model changes.
    initial : {"rest", "free"}
        Where the states start.
    sizes : tuple of float
        Size and correlation time of a load beside the process; none without a filter.
    """

    process: Process
    delay: Estimate
    fixed: frozenset[str]
    initial: StartKind
    sizes: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _FittedOrder:
    entry: ProcessEntry
    problem: Problem
    theta: FloatArray
    evaluations: int


def compare_orders(
    problem: Problem,
    theta: FloatArray,
    estimates: Sequence[Estimate],
    max_simulations: int | None = None,
    is_late: Callable[[], bool] = lambda: False,
) -> tuple[OrderComparison | None, int]:
    """Compare a model with those of one order more and one less; return the simulations too.

    None if the model is no process with one unknown dead time, or is not fitted by least squares
    of a free run or of a filter for a load. Also if a gain, an offset or a start is at its bound,
    if it fits nearly without residuals, or if the budget does not suffice. A dead time at its
    bound, in the model's own fit or in that of the preferred order, says nothing of orders either.

    Parameters
    ----------
    problem : Problem
    theta : FloatArray, shape (D,)
        The estimate.
    estimates : sequence of Estimate
        Of the model's parameters.
    """
    assumptions = _read_assumptions(problem, theta, estimates)
    if assumptions is None or is_late():
        return None, 0
    entries = list_neighbouring_orders(assumptions.process)
    if max_simulations is not None and max_simulations < _MAX_SIMULATIONS * len(entries):
        return None, 0
    tried = [_fit_order(problem, entry, assumptions, is_late) for entry in entries]
    fits = [fitted for fitted in tried if fitted is not None]
    spent = sum(fitted.evaluations for fitted in fits)
    if len(fits) < max(2, len(tried)):
        return None, spent
    noise_model = _get_filter(problem)
    if noise_model == "white" and (
        problem.loss.noise_model == "ar1" or _has_coloured_residuals(fits[-1])
    ):
        noise_model = "ar1"
    compared, contexts, bounded = list[OrderFit](), dict[str, ResidualContext](), set[str]()
    for fitted in fits:
        order, context, is_bounded, simulations = _assess_order(
            fitted, has_colour=noise_model == "ar1"
        )
        compared.append(order)
        contexts[order.model] = context
        bounded |= {order.model} if is_bounded else set()
        spent += simulations
    own = next(
        fitted.entry.model
        for fitted in fits
        if fitted.entry.parts == len(assumptions.process.time_constants)
    )
    comparison = compare_fits(
        own,
        assumptions.delay.name,
        assumptions.delay.unit,
        noise_model,
        compared,
        problem.n_scored,
    )
    if bounded & {own, comparison.preferred_model}:
        return None, spent
    preferred = comparison.preferred_model
    if preferred is not None and preferred != own:
        context = contexts[preferred]
        comparison = _judge_fit(comparison, preferred, context)
        spent += context.simulations.spent
    return comparison, spent


def _judge_fit(
    comparison: OrderComparison, model: str, context: ResidualContext
) -> OrderComparison:
    """Judge whether the fit of a model tells all its parameters, and leaves nothing but noise.

    Time constants that end as equals, in a group, are those of a model with still more of them.
    """
    leaves_noise = (
        all(one.status == "identified" for one in context.analysis.estimates if one.is_free)
        and explain_if_noise(context).is_sound
    )
    fits = tuple(
        replace(fit, leaves_noise=leaves_noise) if fit.model == model else fit
        for fit in comparison.fits
    )
    return replace(comparison, fits=fits)


def find_other_orders(
    comparison: OrderComparison | None, model: str, estimates: Sequence[Estimate]
) -> Iterator[Finding]:
    """Find orders that the data prefer, or do not rule out, and that move the dead time.

    Those that count move it by more than its interval. A larger order is advised if it leaves
    nothing but noise, and if both tell the dead time. `model` is the name of the model that was
    identified.
    """
    if comparison is None or comparison.preferred_model == comparison.model:
        return
    own, name = comparison.own_fit, comparison.delay
    estimate = next(one for one in estimates if one.name == name)
    others = [fit for fit in comparison.open_fits if fit.model != own.model]
    best = min(others, key=lambda fit: fit.bic)
    moved = [fit for fit in others if _is_moved(fit, own)]
    if comparison.preferred_model is None and not moved:
        return
    listed = ", ".join(_write_delay(comparison, fit) for fit in others)
    instead = f"instead of {estimate.value:.4g}{plain_unit(estimate.unit)}"
    if comparison.preferred_model is None:
        names = join_names([fit.model for fit in comparison.open_fits])
        brief = f"the data do not tell {names} apart"
        text, advice = f"{brief}: {name} is {listed} {instead}.", ""
    else:
        brief = f"the data prefer {best.model}"
        text = (
            f"the data prefer {best.model} (order {best.order}) to {own.model} (order "
            f"{own.order}): its BIC is {own.bic - best.bic:.3g} lower. "
            f"{name} is {listed} {instead}."
        )
        cure = "Give your model as many time constants, or use" if model != own.model else "Use"
        is_cure = best.leaves_noise and best.order > own.order and estimate.status == "identified"
        advice = f"{cure} the model {best.model}." if is_cure else ""
    yield Finding(
        "order",
        "structure",
        "caution" if moved else "note",
        brief,
        text,
        advice,
        own.bic - best.bic,
        tuple(
            Move(name, fit.delay, fit.delay_stderr, (fit.delay - estimate.value) / estimate.stderr)
            for fit in sorted(moved, key=lambda fit: fit.bic)
            if estimate.stderr
        ),
        (name, *_list_moved(best, estimates, name)) if moved else (),
    )


def _list_moved(best: OrderFit, estimates: Sequence[Estimate], delay: str) -> list[str]:
    """List the other parameters that both models have and that the better one moves."""
    return [
        one.name
        for one in estimates
        if one.name in best.values
        and one.name != delay
        and one.stderr
        and abs(best.values[one.name] - one.value) > UNLIKELY_MOVE * one.stderr
    ]


def _is_moved(fit: OrderFit, own: OrderFit) -> bool:
    return abs(fit.delay - own.delay) > SEPARABLE * (own.delay_stderr or 0.0)


def _write_delay(comparison: OrderComparison, fit: OrderFit) -> str:
    delay = f"{plain_estimate(fit.delay, fit.delay_stderr)}{plain_unit(comparison.unit)}"
    return f"{delay} with {fit.model}"


def _read_assumptions(
    problem: Problem, theta: FloatArray, estimates: Sequence[Estimate]
) -> _Assumptions | None:
    if not _has_comparable_loss(problem):
        return None
    sizes = tuple(v for name, v in _list_values(problem, theta) if is_noise_parameter(name))
    problem, theta = convert_to_free_run(problem, theta)
    delays = find_delay_parameters(problem)
    process = _recognise(problem, theta)
    if process is None or len(delays) != 1 or not list_neighbouring_orders(process):
        return None
    [delay] = [estimate for estimate in estimates if estimate.name in delays]
    # A delay may be an expression, such as V/q. Without an error nothing is known of it.
    if delay.value != process.delay or delay.stderr is None or delay.status == "at bound":
        return None
    changed, bounded = set[str](), {one.name for one in estimates if one.status == "at bound"}
    for d, name in enumerate(problem.free_names):
        moved = theta.copy()
        moved[d] = moved[d] * (1.0 + _MOVE) if moved[d] else _MOVE
        other = _recognise(problem, moved)
        if other is None:
            continue
        if name in bounded and not _changes_dynamics(process, other):
            return None  # a wrong offset, gain or start looks like missing dynamics
        changed |= {
            part for part in ("gain", "offset") if getattr(other, part) != getattr(process, part)
        }
    initial: StartKind = "rest" if starts_at_rest(problem, theta) else "free"
    fixed = frozenset({"gain", "offset"} - changed)
    return _Assumptions(process, delay, fixed, initial, sizes)


def _has_comparable_loss(problem: Problem) -> bool:
    """Whether it is squares of a free run, or of a filter that other orders have too."""
    is_simulated = problem.prediction == "simulation" and problem.loss.kind == "squares"
    return is_simulated and problem.loss.noise_model != "plant"


def _get_filter(problem: Problem) -> FoundNoiseModel:
    """Get the noise model that all orders share: that of a filter, or white noise."""
    asked = problem.loss.noise_model
    return asked if asked == "load" or asked == "drift" else "white"


def _changes_dynamics(process: Process, other: Process) -> bool:
    return (process.delay, process.time_constants) != (other.delay, other.time_constants)


def _list_values(problem: Problem, theta: FloatArray) -> list[tuple[str, float]]:
    """List all parameters with their values at an estimate (D,)."""
    values = problem.evaluator.template.copy()
    values[problem.evaluator.free_rows] = theta
    names = (parameter.name for parameter in problem.all_parameters)
    return list(zip(names, values.tolist(), strict=True))


def _recognise(problem: Problem, theta: FloatArray) -> Process | None:
    numbers = dict(_list_values(problem, theta))
    return recognise_process(IdentifiedModel.from_numbers(problem.model, numbers))


def _fit_order(
    problem: Problem,
    entry: ProcessEntry,
    assumptions: _Assumptions,
    is_late: Callable[[], bool],
) -> _FittedOrder | None:
    """Fit an entry of the catalogue by least squares; None if that is not possible."""
    try:
        other = _build_problem(problem, entry, assumptions)
    except SysidError:
        return None
    starts = [
        _to_theta(other, entry, process, assumptions.sizes)
        for process in _list_starts(assumptions.process, entry, problem)
    ]
    candidates = refine_candidates(other, starts, _MAX_SIMULATIONS // 2, is_late)
    ends = [end for end in candidates if end is not None]
    if not ends or any(end.is_cut_short for end in ends):
        return None
    best = min(ends, key=lambda end: end.rms)
    if best.rms <= _NEGLIGIBLE_SHARE * problem.output_scale:
        return None
    return _FittedOrder(entry, other, best.theta, sum(end.evaluations for end in ends))


def _build_problem(problem: Problem, entry: ProcessEntry, assumptions: _Assumptions) -> Problem:
    """Build the problem of an entry on the same samples."""
    model = load_model(entry.model)
    model = replace_substeps(model, max(_SUBSTEPS, problem.model.solver.substeps))
    records = [
        Record(
            [replace(channel, name=model.inputs[0].name) for channel in record.inputs],
            [replace(channel, name=model.outputs[0].name) for channel in record.outputs],
        )
        for record in problem.records
    ]
    delay, process = assumptions.delay, assumptions.process
    changes: dict[str, dict[str, Any]] = {"L": {"lower": delay.lower, "upper": delay.upper}}
    for what, name in (("gain", "K"), ("offset", "y0")):
        value = getattr(process, what)
        if what in assumptions.fixed and any(p.name == name for p in model.parameters):
            changes[name] = {"fixed": value, "lower": value - 1.0, "upper": value + 1.0}
    places = {
        problem.model.inputs[0].name: model.inputs[0].name,
        problem.model.outputs[0].name: model.outputs[0].name,
    }
    for name, fields in problem.settings.parameters.items():
        if is_noise_parameter(name):
            kind, _, place = name[:-1].partition("[")
            changes[f"{kind}[{places[place]}]"] = dict(fields)
    settings = FitSettings(
        changes,
        loss=Loss(noise_model=_get_filter(problem)),
        weights={model.outputs[0].name: next(iter(problem.output_weights.values()))},
        skip=problem.settings.skip,
        initial=assumptions.initial,
        scored_from=problem.settings.scored_from,
        deviations=problem.settings.deviations,
    )
    return Problem.from_settings(model, records, settings)


def _list_starts(process: Process, entry: ProcessEntry, problem: Problem) -> list[Process]:
    """List processes with as many parts as an entry, near one with a part more or less."""
    times, delay = process.time_constants, process.delay
    if entry.parts == len(times):
        return [process]
    if entry.parts < len(times):
        slower = (sum(times), *times[1:-1]) if len(times) > 1 else ()
        return [
            process._replace(time_constants=times[:-1], delay=delay + times[-1]),
            process._replace(time_constants=slower),
        ]
    duration = max(record.stop - record.start for record in problem.records)
    slowest = times[0] if times else delay or 0.1 * duration
    return [
        process._replace(
            time_constants=tuple(sorted((*times, share * slowest), reverse=True)),
            delay=max(delay - share * slowest, 0.0),
        )
        for share in _NEW_PARTS
    ]


def _to_theta(
    problem: Problem, entry: ProcessEntry, process: Process, sizes: Sequence[float]
) -> FloatArray:
    """Convert a process to the free parameters of an entry; all states start at the output.

    `sizes` are those of its noise, as the filter has them.
    """
    values = dict(entry.to_parameters(process))
    names = [one.name for one in problem.all_parameters if is_noise_parameter(one.name)]
    values |= zip(names, sizes, strict=True)
    for number, record in enumerate(problem.records):
        measured = record.outputs[0].values
        first = float(measured[np.isfinite(measured)][0]) - process.offset
        for state in problem.model.states:
            values[name_initial_state(state.name, number)] = first
    theta = np.array([values[name] for name in problem.free_names])
    return np.asarray(np.clip(theta, problem.evaluator.lower, problem.evaluator.upper))


def _has_coloured_residuals(fitted: _FittedOrder) -> bool:
    residuals = fitted.problem.compute_residuals(fitted.theta[None])[0]
    return any(is_coloured(part, residuals[part.rows]) for part in iterate_parts(fitted.problem))


def _assess_order(
    fitted: _FittedOrder, *, has_colour: bool
) -> tuple[OrderFit, ResidualContext, bool, int]:
    """Compute the BIC of a fitted order, its dead time, and whether that is at its bound."""
    problem, theta, spent, whitening = fitted.problem, fitted.theta, fitted.evaluations, None
    if has_colour:
        theta, whitening, simulations = fit_first_order_noise(problem, theta)
        spent += simulations
    residuals = problem.compute_residuals(theta[None])[0]
    analysis = analyse_estimate(problem, theta, whitening=whitening)
    context = ResidualContext(problem, theta, analysis)
    used = theta.size * float(np.log(max(problem.n_scored, 2)))
    delay = next(estimate for estimate in analysis.estimates if estimate.name == "L")
    order = OrderFit(
        fitted.entry.model,
        fitted.entry.order,
        delay.value,
        delay.stderr,
        {estimate.name: estimate.value for estimate in analysis.estimates},
        float(np.sqrt(np.mean(np.square(residuals)))),
        context.residual_model.without.criterion + used,
    )
    return order, context, delay.status == "at bound", spent + analysis.evaluations + 1
