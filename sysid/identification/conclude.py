"""From the end of a search to its result: refinement, uncertainty, validation, warnings."""

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

import numpy as np

from sysid.core.errors import DivergedEverywhere, NothingIdentifiable
from sysid.core.settings import GeneticAlgorithm
from sysid.core.threads import one_thread
from sysid.core.types import FloatArray
from sysid.data.records import common_sample_time
from sysid.identifiability.exchange import exchange_notes, exchanges, ordered
from sysid.identification.deadline import Clock, Deadline
from sysid.identification.generalised_least_squares import Generalised, generalised, whitening
from sysid.identification.integration_step import step_notes
from sysid.identification.local_minima import Neighbourhood, affordable, neighbourhood, widened
from sysid.identification.noise_model_choice import choice_notes, decided, settled, speaks_for_ar1
from sysid.identification.result import Identification
from sysid.identification.warnings import noise_notes, time_notes, warnings_of
from sysid.islands.state import RunState
from sysid.residuals.feedback import feedback_notes
from sysid.residuals.onset_delay import onset_delays
from sysid.residuals.residual_tests import ResidualTests, residual_tests, series_of
from sysid.search.island import analysis_budget, of_island
from sysid.search.refine import Refined, refine
from sysid.search.state import Improvement, IslandSummary
from sysid.simulation.metrics import Metrics
from sysid.simulation.problem import Problem, metrics_of
from sysid.uncertainty.analysis import Analysis, analyse
from sysid.uncertainty.estimates import Estimate


def conclude(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    validation: Problem | None = None,
    clock: Clock = perf_counter,
) -> Identification:
    """The identification that a run has led to.

    With ``refine`` the champions of an ``improved`` search are polished by least squares. Those
    of the paper's two methods are reported as found, so that a comparison is one of the methods.
    Of a run whose time is limited all of that ends near the limit, and warnings tell what was left
    out; standard errors, tests and validation are made in any case. `clock` gives seconds.

    Raises
    ------
    DivergedEverywhere
        If no candidate of the search gave a finite simulation.
    NothingIdentifiable
        If no free parameter has an effect on the scored outputs.
    """
    if not np.isfinite(state.rms):
        raise DivergedEverywhere(state.evaluations)
    with one_thread():  # so that the last bit does not depend on the number of cores
        deadline = Deadline(algorithm.stop.seconds, state.seconds, clock)
        return _concluded(problem, algorithm, state, validation, deadline)


def _concluded(
    problem: Problem, algorithm: GeneticAlgorithm, state: RunState, validation: Problem | None,
    deadline: Deadline,
) -> Identification:  # fmt: skip
    refined, ends, noise, analysis = _estimated(problem, algorithm, state, deadline)
    problem, theta = decided(problem, noise), noise.theta
    if analysis.uncertainty is not None and not analysis.uncertainty.singular_values.any():
        raise NothingIdentifiable(problem.free_names)
    simulated = problem.predictions(theta[None])[0]
    metrics = metrics_of(problem, simulated)
    times = noise.correlation_times
    kept = (
        None if validation is None else _validated(validation, problem, analysis.estimates, times)
    )
    tests = kept.tests if kept else residual_tests(problem, simulated, "estimation", times)
    limit = algorithm.safe_limit
    return Identification(
        estimates=analysis.estimates,
        rms=metrics.rms,
        fit_percent=metrics.fit_percent,
        rms_validation=None if kept is None else kept.metrics.rms,
        fit_percent_validation=None if kept is None else kept.metrics.fit_percent,
        valid=limit is None or metrics.rms <= limit,
        evaluations=_evaluations(state, refined, analysis),
        generations=max(island.generation for island in state.islands),
        islands=_summaries(state, refined, ends),
        history=_histories(state, refined),
        migrations=state.migrations,
        uncertainty=analysis.uncertainty,
        simulated=_split(problem, simulated),
        simulated_validation=() if kept is None else kept.simulated,
        agreement=metrics.channels,
        agreement_validation=() if kept is None else kept.metrics.channels,
        warnings=(
            *warnings_of(problem, algorithm, analysis, simulated, metrics.rms, tests),
            *exchange_notes(
                problem,
                analysis.exchanges,
                {one.name for one in analysis.estimates if one.stderr is not None},
            ),
            *time_notes(any(end.is_cut_short for end in refined if end is not None)),
            *_feedback(problem, simulated, analysis),
            *step_notes(problem, theta, analysis.estimates, simulated, deadline.is_past_grace),
            *noise_notes(problem, times, noise.is_complete),
            *choice_notes(problem, noise),
        ),
        selection=() if problem.model.selection is None else problem.model.selection.terms,
        criteria=analysis.criteria,
        residual_tests=tests,
        onset_delays=onset_delays(problem.model, problem.records),
        correlation_times=times,
        holds={one.name: one.hold for one in problem.records[0].inputs},
        sample_time=common_sample_time(problem.records),
        known_before=_known_before(problem),
        known_before_validation=() if validation is None else _known_before(validation),
    )


def _known_before(problem: Problem) -> tuple[float, ...]:
    """For how long (s) the inputs are known before what is scored of each experiment."""
    since = problem.settings.scored_from or tuple(one.start for one in problem.records)
    return tuple(
        one.known_before + max(first - one.start, 0.0)
        for one, first in zip(problem.records, since, strict=True)
    )


def _feedback(problem: Problem, simulated: FloatArray, analysis: Analysis) -> list[str]:
    """Whether a controller made an input; past white residuals it does the estimates no harm."""
    known = analysis.uncertainty
    if known is not None and known.noise_colour == "white":
        return []
    advises = problem.prediction == "simulation" and problem.loss.noise_model != "ar1"
    return feedback_notes(series_of(problem, simulated), advises_noise_model=advises)


def _estimated(
    problem: Problem, algorithm: GeneticAlgorithm, state: RunState, deadline: Deadline
) -> tuple[tuple[Refined | None, ...], list[tuple[FloatArray, float]], Generalised, Analysis]:
    """What refinement made of the islands' champions, where each ended, and the best's analysis."""
    champions = [_champion(problem, island.history) for island in state.islands]
    refined = _polished(problem, algorithm, state, champions, deadline)
    ends = [
        (champion, island.champion_rms) if end is None else (end.theta, end.rms)
        for champion, island, end in zip(champions, state.islands, refined, strict=True)
    ]
    best = min(range(len(ends)), key=lambda i: ends[i][1])
    left = _left(algorithm, state, refined)
    spare = None if left is None else max(0, left - analysis_budget(ends[best][0].size))
    groups, spent = exchanges(problem, ends[best][0], spare)
    ends = [(ordered(problem, theta, groups), rms) for theta, rms in ends]
    refined = tuple(
        None if one is None else replace(one, theta=end)
        for one, (end, _) in zip(refined, ends, strict=True)
    )
    theta = ends[best][0]
    analysis = analyse(problem, theta, None if left is None else left - spent)
    analysis = replace(analysis, evaluations=analysis.evaluations + spent, exchanges=groups)
    if _polishes(algorithm, len(ends)):
        end, analysis = _with_neighbours(
            problem, algorithm, state, refined, ends[best], analysis, deadline
        )
        theta = end.theta
        ends[best] = theta, end.rms
        refined = (*refined[:best], end, *refined[best + 1 :])
    noise, analysis = _under_noise(problem, algorithm, state, refined, theta, analysis, deadline)
    return refined, ends, noise, analysis


def _champion(problem: Problem, history: tuple[Improvement, ...]) -> FloatArray:
    if history:
        return np.array(history[-1].parameters)
    return 0.5 * (problem.evaluator.lower + problem.evaluator.upper)


def _polished(
    problem: Problem, algorithm: GeneticAlgorithm, state: RunState, champions: list[FloatArray],
    deadline: Deadline,
) -> tuple[Refined | None, ...]:  # fmt: skip
    if not _polishes(algorithm, len(champions)):
        return (None,) * len(champions)
    left = _left(algorithm, state, ())
    kept = analysis_budget(len(champions[0]))
    most = None if left is None else max(0, left - kept)
    return refine(problem, champions, most, deadline.is_past_grace)


def _polishes(algorithm: GeneticAlgorithm, islands: int) -> bool:
    """Whether least squares goes on from where the search has ended."""
    methods = {of_island(algorithm, i).method for i in range(islands)}
    return algorithm.refine and "improved" in methods


def _with_neighbours(
    problem: Problem, algorithm: GeneticAlgorithm, state: RunState,
    refined: tuple[Refined | None, ...], end: tuple[FloatArray, float], analysis: Analysis,
    deadline: Deadline,
) -> tuple[Refined, Analysis]:  # fmt: skip
    """The best of the minima beside an estimate, with intervals that allow for the others.

    The evaluations of it are those of all the islands' ends in its place, and of the search here.
    """
    theta, rms = end
    known = next((one for one in refined if one is not None and one.theta is theta), None)
    before, is_cut = (0, False) if known is None else (known.evaluations, known.is_cut_short)
    unchanged = Refined(theta, rms, before, is_cut)
    if analysis.linear is None:
        return unchanged, analysis
    left = _left(algorithm, state, refined)
    kept = analysis.evaluations + analysis_budget(theta.size)
    is_late = deadline.is_over()
    most = affordable(problem, is_late)
    if most == 0 and is_late:
        return unchanged, replace(analysis, is_cut_short=True)
    if left is not None:
        shared = 2 if problem.loss.noise_model == "ar1" else 1  # with the noise model
        most = min(most, max(0, left - kept) // shared)
    found = neighbourhood(problem, theta, rms, analysis.linear, state.seed, most)
    spent = before + found.evaluations
    if found.best is not None:
        spent += analysis.evaluations
        groups = analysis.exchanges
        theta, rms = ordered(problem, found.best.theta, groups), found.best.rms
        left = None if left is None else left - analysis.evaluations - found.evaluations
        analysis = replace(analyse(problem, theta, left), exchanges=groups)
    return Refined(theta, rms, spent, is_cut), _widened(problem, analysis, found)


def _widened(problem: Problem, analysis: Analysis, found: Neighbourhood) -> Analysis:
    """The analysis with intervals that hold those of all minima found."""
    if analysis.linear is None:
        return analysis
    share = analysis.linear.share
    found = replace(found, values=ordered(problem, found.values, analysis.exchanges))
    estimates = widened(analysis.estimates, problem.free_names, problem.n_scored, found, share)
    return replace(analysis, estimates=estimates)


def _under_noise(
    problem: Problem, algorithm: GeneticAlgorithm, state: RunState,
    refined: tuple[Refined | None, ...], theta: FloatArray, analysis: Analysis, deadline: Deadline,
) -> tuple[Generalised, Analysis]:  # fmt: skip
    """The estimates under the noise model that was asked for or chosen, and their analysis.

    Those of the paper's methods stay as found; so do all where residuals may as well be white.
    """
    asked = problem.loss.noise_model
    if asked == "white" or not _polishes(algorithm, len(state.islands)):
        return Generalised(theta, {}, 0, asked != "ar1"), analysis
    in_time = deadline.simulations(state.seconds, state.evaluations, problem.n_steps)
    late = deadline.is_past_grace
    if asked == "auto" and not speaks_for_ar1(problem, theta, analysis, late, in_time):
        return Generalised(theta, {}, 0, True), analysis
    left = _left(algorithm, state, refined)
    kept = analysis.evaluations + analysis_budget(theta.size)
    limits = None if left is None else max(0, left - kept), in_time
    most = min((one for one in limits if one is not None), default=None)
    nothing = np.zeros((theta.size, theta.size))
    covariance = nothing if analysis.uncertainty is None else analysis.uncertainty.covariance
    is_cut_short = analysis.is_cut_short
    found = generalised(problem, theta, covariance, state.seed, most)
    spent = analysis.evaluations + found.evaluations
    if asked == "auto":
        found = settled(problem, theta, found)
    if any(found.correlation_times.values()):
        white = whitening(problem, found.correlation_times)
        groups, theta = analysis.exchanges, ordered(problem, found.theta, analysis.exchanges)
        found = found._replace(theta=theta)
        analysis = analyse(problem, theta, None if left is None else left - spent, white)
        analysis = replace(analysis, exchanges=groups)
        spent += analysis.evaluations
        analysis = _widened(problem, analysis, Neighbourhood(None, found.minima, found.rms, 0))
    return found, replace(analysis, evaluations=spent, is_cut_short=is_cut_short)


def _left(
    algorithm: GeneticAlgorithm, state: RunState, refined: tuple[Refined | None, ...]
) -> int | None:
    """What search and refinement have left of the budget of simulations; None: there is none."""
    limit = algorithm.stop.evaluations
    return None if limit is None else max(0, limit - state.evaluations - _polishing(refined))


def _polishing(refined: tuple[Refined | None, ...]) -> int:
    return sum(end.evaluations for end in refined if end is not None)


def _evaluations(state: RunState, refined: tuple[Refined | None, ...], analysis: Analysis) -> int:
    return state.evaluations + _polishing(refined) + analysis.evaluations


def _summaries(
    state: RunState, refined: tuple[Refined | None, ...], ends: list[tuple[FloatArray, float]]
) -> tuple[IslandSummary, ...]:
    return tuple(
        IslandSummary(
            champion_rms=island.champion_rms,
            refined_rms=None if end is None else end.rms,
            parameters=tuple(theta.tolist()),
            evaluations=island.evaluations + (0 if end is None else end.evaluations),
        )
        for island, end, (theta, _) in zip(state.islands, refined, ends, strict=True)
    )


def _histories(
    state: RunState, refined: tuple[Refined | None, ...]
) -> tuple[tuple[Improvement, ...], ...]:
    """The islands' histories, with what the refinement gained."""
    histories = []
    for island, end in zip(state.islands, refined, strict=True):
        history = island.history
        if end is not None and end.rms < island.champion_rms:
            spent = island.evaluations + end.evaluations
            values = tuple(end.theta.tolist())
            gain = Improvement(island.generation, spent, end.rms, "refinement", values)
            history = (*history, gain)
        histories.append(history)
    return tuple(histories)


def _split(problem: Problem, values: FloatArray) -> tuple[tuple[FloatArray, ...], ...]:
    names = [output.name for output in problem.model.outputs]
    return tuple(tuple(part[name] for name in names) for part in problem.split(values))


class _Validated(NamedTuple):
    metrics: Metrics
    simulated: tuple[tuple[FloatArray, ...], ...]
    tests: ResidualTests


def _validated(
    validation: Problem, estimation: Problem, estimates: tuple[Estimate, ...],
    correlation_times: Mapping[str, float],
) -> _Validated:  # fmt: skip
    """Agreement and simulation on data that were not used.

    The model's parameters are those of the estimate, and so are the weights, so that both RMS
    are in the same measure. An initial state belongs to its record: where the last part of the
    same records is judged it is the estimated one, on other records it is found on them, alone.
    """
    model, changes = validation.untied_model, validation.settings.parameters
    is_part = validation.settings.scored_from is not None
    own = {p.name for p in (validation.all_parameters if is_part else model.parameters)}
    fixed = {e.name: _known(e) for e in estimates if e.name in own}
    kept = {name: fields for name, fields in changes.items() if name not in own}
    known = validation.rebuild(parameters={**kept, **fixed}, weights=estimation.output_weights)
    theta = np.zeros(0)
    if known.space:
        middle = 0.5 * (known.evaluator.lower + known.evaluator.upper)
        start = refine(known, [middle])[0]
        theta = middle if start is None else start.theta
    simulated = known.predictions(theta[None])[0]
    return _Validated(
        metrics_of(known, simulated), _judged(known, _split(known, simulated)),
        residual_tests(known, simulated, "validation", correlation_times),
    )  # fmt: skip


def _known(estimate: Estimate) -> dict[str, float | str]:
    """An estimate as a fixed value; that of a tie may lie outside its parameter's bounds."""
    value = estimate.value
    bounds = {"lower": min(estimate.lower, value), "upper": max(estimate.upper, value)}
    return {"fixed": value, "scale": "linear", **bounds}


def _judged(
    known: Problem, simulated: tuple[tuple[FloatArray, ...], ...]
) -> tuple[tuple[FloatArray, ...], ...]:
    """The part from the time on at which the records are scored, at its measured times."""
    scored_from = known.settings.scored_from
    if scored_from is None:
        return simulated
    names = [output.name for output in known.model.outputs]
    kept = []
    for record, since, outputs in zip(known.records, scored_from, simulated, strict=True):
        times = {channel.name: channel.times for channel in record.outputs}
        late = [times[name] >= since for name in names]
        kept.append(tuple(part[mask] for part, mask in zip(outputs, late, strict=True)))
    return tuple(kept)
