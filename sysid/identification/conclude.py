"""Conclude a search: refinement, uncertainty, validation, warnings."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from time import perf_counter
from typing import NamedTuple

import numpy as np

from sysid.core.errors import DivergedEverywhere, InvalidRecord, NothingIdentifiable
from sysid.core.settings import GeneticAlgorithm
from sysid.core.threads import use_one_thread
from sysid.core.types import FloatArray
from sysid.core.units import format_unit
from sysid.data.records import find_common_sample_time
from sysid.identifiability.exchange import describe_exchanges, find_exchanges, order_exchangeable
from sysid.identification.deadline import Clock, Deadline
from sysid.identification.fixed_start import warn_fixed_starts
from sysid.identification.generalised_least_squares import (
    GeneralisedEstimate,
    fit_generalised_least_squares,
    make_whitening,
)
from sysid.identification.hard_switching import warn_hard_switching
from sysid.identification.input_hold import (
    describe_input_holds,
    list_input_holds,
    refit_other_holds,
)
from sysid.identification.integration_step import (
    HalfStep,
    choose_starts,
    compare_half_step,
    compute_work_limit,
    explain_finer_step,
    find_limit,
    mark_changing,
)
from sysid.identification.local_minima import (
    LocalMinima,
    count_affordable_simulations,
    find_local_minima,
    widen_intervals,
)
from sysid.identification.minima import (
    FoundMinima,
    ScanResult,
    collect_minima,
    mark_ambiguous,
    scan_parameters,
)
from sysid.identification.noise_model_choice import (
    confirm_noise_model,
    explain_noise_model_choice,
    is_ar1_indicated,
    resolve_noise_model,
)
from sysid.identification.result import Identification
from sysid.identification.search_evidence import assess_search, mark_unsettled, warn_unsettled
from sysid.identification.unrecorded_input import compare_where_recorded
from sysid.identification.warnings import (
    collect_warnings,
    find_delay_parameters,
    warn_noise_model,
    warn_time_limit,
)
from sysid.islands.state import RunState
from sysid.residuals.feedback import describe_feedback
from sysid.residuals.onset_delay import estimate_onset_delays
from sysid.residuals.residual_tests import ResidualTests, list_residual_series, run_residual_tests
from sysid.search.island import compute_analysis_budget, get_island_settings
from sysid.search.refine import RefinedCandidate, refine_candidates
from sysid.search.state import SAME_OPTIMUM, Improvement, IslandSummary
from sysid.simulation.metrics import Metrics
from sysid.simulation.problem import Problem, compute_metrics
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from sysid.uncertainty.estimates import Estimate

_SCAN_DIVISOR = 4  # of the simulations that are left, a scan takes this part at most
_STILL_SHARE = 0.3  # of the estimation data's variation: validation data with less hardly move
_STILL_NOISE = 2.0  # of the estimation RMS: and with less they show mostly noise
_START_SHARE = 0.3  # of a validation record: its first part gives its initial states


def conclude_run(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    validation: Problem | None = None,
    clock: Clock = perf_counter,
) -> Identification:
    """Conclude a run: refine, analyse and validate its estimate.

    With ``refine`` the champions of an ``improved`` search are refined by least squares. Those of
    the paper's two methods are reported unchanged, so that a comparison is one of the methods. If
    the time of the run is limited, refinement ends near the limit and warnings list what was left
    out. Standard errors, tests and validation are always computed. `clock` returns seconds.

    Raises
    ------
    DivergedEverywhere
        If no candidate of the search gave a finite simulation.
    NothingIdentifiable
        If no free parameter has an effect on the scored outputs.
    """
    if not np.isfinite(state.rms):
        raise DivergedEverywhere(state.evaluations)
    with use_one_thread():  # so that the last bit does not depend on the number of cores
        deadline = Deadline(algorithm.stop.seconds, state.seconds, clock)
        return _build_identification(problem, algorithm, state, validation, deadline)


def _build_identification(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    validation: Problem | None,
    deadline: Deadline,
) -> Identification:
    asked = problem
    problem, refined, ends, found, first, noise, analysis = _refine_and_analyse(
        problem, algorithm, state, deadline
    )
    problem, theta = resolve_noise_model(problem, noise), noise.theta
    if analysis.uncertainty is not None and not analysis.uncertainty.singular_values.any():
        raise NothingIdentifiable(problem.free_names)
    simulated = problem.predict(theta[None])[0]
    metrics = compute_metrics(problem, simulated)
    times = noise.correlation_times
    validated = (
        None
        if validation is None
        else _validate_estimates(validation, problem, analysis.estimates, times, metrics)
    )
    tests = (
        validated.tests
        if validated
        else run_residual_tests(problem, simulated, "estimation", times)
    )
    limit = algorithm.safe_limit
    evidence = assess_search(problem, state, metrics.rms, tests, found)
    analysis = replace(
        analysis,
        estimates=mark_unsettled(mark_ambiguous(problem, analysis.estimates, found), evidence),
    )
    holds, spent = list_input_holds(problem), 0
    if _should_refine(algorithm, len(ends)):
        left = _count_budget_left(algorithm, state, refined)
        left = None if left is None else max(0, left - analysis.evaluations)
        holds, spent = refit_other_holds(
            problem, holds, theta, min(ends, key=itemgetter(1))[0], left, deadline.is_past_grace
        )
    return Identification(
        estimates=analysis.estimates,
        rms=metrics.rms,
        fit_percent=metrics.fit_percent,
        rms_validation=None if validated is None else validated.metrics.rms,
        fit_percent_validation=None if validated is None else validated.metrics.fit_percent,
        valid=limit is None or metrics.rms <= limit,
        evaluations=_count_evaluations(state, refined, analysis) + spent,
        generations=max(island.generation for island in state.islands),
        islands=_summarise_islands(state, refined, ends),
        history=_extend_histories(state, refined),
        migrations=state.migrations,
        uncertainty=analysis.uncertainty,
        simulated=_split_outputs(problem, simulated),
        simulated_validation=() if validated is None else validated.simulated,
        agreement=metrics.channels,
        agreement_validation=() if validated is None else validated.metrics.channels,
        warnings=(
            *warn_fixed_starts(problem, theta, analysis, deadline.is_past_grace),
            *collect_warnings(problem, algorithm, analysis, simulated, metrics.rms, tests),
            *found.warnings,
            *warn_unsettled(evidence),
            *describe_input_holds(problem, holds, analysis.estimates, min(rms for _, rms in ends)),
            *describe_exchanges(
                problem,
                analysis.exchanges,
                {estimate.name for estimate in analysis.estimates if estimate.stderr is not None},
            ),
            *warn_hard_switching(problem, theta, _list_final_rms(refined, ends)),
            *_warn_still_validation(problem, metrics, validated),
            *warn_time_limit(any(end.is_cut_short for end in refined if end is not None)),
            *_check_feedback(problem, simulated, analysis),
            *explain_finer_step(asked, problem, first, analysis.estimates),
            *warn_noise_model(problem, times, noise.is_complete),
            *explain_noise_model_choice(problem, noise),
        ),
        selection=() if problem.model.selection is None else problem.model.selection.terms,
        criteria=analysis.criteria,
        residual_tests=tests,
        onset_delays=estimate_onset_delays(problem.model, problem.records),
        correlation_times=times,
        input_holds=holds,
        data_bounds=tuple(p.name for p in problem.free_parameters if p.bounds is not None),
        sample_time=find_common_sample_time(problem.records),
        search=evidence,
        substeps=problem.model.solver.substeps,
        known_before=_compute_input_history(problem),
        known_before_validation=() if validation is None else _compute_input_history(validation),
    )


def _compute_input_history(problem: Problem) -> tuple[float, ...]:
    """Compute the recorded input time (s) before the scored part of each experiment."""
    scored_from = problem.settings.scored_from or tuple(record.start for record in problem.records)
    return tuple(
        record.history_duration + max(start - record.start, 0.0)
        for record, start in zip(problem.records, scored_from, strict=True)
    )


def _check_feedback(problem: Problem, simulated: FloatArray, analysis: Analysis) -> list[str]:
    """Describe feedback from outputs to inputs; with white residuals it does no harm."""
    uncertainty = analysis.uncertainty
    if uncertainty is not None and uncertainty.noise_colour == "white":
        return []
    advises = problem.prediction == "simulation" and problem.loss.noise_model != "ar1"
    return describe_feedback(list_residual_series(problem, simulated), advises_noise_model=advises)


class _Analysed(NamedTuple):
    """The analysed estimate, and the problem with the integration step that it needs.

    `first`: the estimates with the model's own step, if that is not the one.
    """

    problem: Problem
    refined: tuple[RefinedCandidate | None, ...]
    ends: list[tuple[FloatArray, float]]
    found: FoundMinima
    first: tuple[Estimate, ...]
    noise: GeneralisedEstimate
    analysis: Analysis


def _refine_and_analyse(
    problem: Problem, algorithm: GeneticAlgorithm, state: RunState, deadline: Deadline
) -> _Analysed:
    """Refine the islands' champions, scan for better minima and analyse the best.

    The integration step is halved until the estimates and their errors stand still, or until a
    limit is reached. Then those that still change are not identified.
    """
    champions = [_get_champion(problem, island.history) for island in state.islands]
    refined = _refine_champions(problem, algorithm, state, champions, deadline)
    ends = [
        (champion, island.champion_rms) if end is None else (end.theta, end.rms)
        for champion, island, end in zip(champions, state.islands, refined, strict=True)
    ]
    work = compute_work_limit(problem, state.evaluations)
    first: tuple[Estimate, ...] = ()
    has_gained = False
    while True:
        best = _analyse_best(problem, algorithm, state, refined, ends, deadline)
        refined, ends, theta, analysis = best.refined, best.ends, best.theta, best.analysis
        has_gained |= best.has_gained
        half, limit = _compare_half_step(
            problem, algorithm, state, refined, theta, analysis, work, deadline
        )
        if half is None:
            break
        analysis = replace(analysis, evaluations=analysis.evaluations + half.evaluations)
        fitted = None
        if half.changes and not limit:
            left = _count_simulations_left(algorithm, state, refined, analysis)
            most = work // half.problem.n_steps
            most = most if left is None else min(most, left)
            fitted = _fit_half_step(half, state, ends, theta, most, deadline)
            if fitted is None:
                limit = "no simulation with half the step is finite"
        if fitted is None:
            marked = mark_changing(analysis.estimates, half.changes, limit)
            analysis = replace(analysis, estimates=marked)
            break
        first = first or analysis.estimates
        problem = half.problem
        work -= problem.n_steps * sum(end.evaluations for end in fitted)
        refined = _add_evaluations(fitted, refined, ends, theta, analysis)
        ends = [(end.theta, end.rms) for end in fitted]
    is_settled = half is None or not half.changes
    noise, analysis = _apply_noise_model(
        problem, algorithm, state, refined, theta, analysis, deadline, is_settled=is_settled
    )
    groups = analysis.exchanges
    ordered = [(order_exchangeable(problem, end, groups), rms) for end, rms in best.all_ends]
    minima = collect_minima(problem, ordered, _get_variance_ratio(analysis))
    found = FoundMinima(minima, has_gained)
    if _should_refine(algorithm, len(ends)):
        simulations = _count_scan_simulations(problem, algorithm, state, refined, deadline)
        recorded = compare_where_recorded(
            problem,
            noise.theta,
            analysis,
            _list_delays(problem),
            simulations,
            deadline.is_past_grace,
        )
        analysis = replace(analysis, evaluations=analysis.evaluations + recorded.evaluations)
        found = FoundMinima((*minima, *recorded.minima), has_gained, recorded.warnings)
    return _Analysed(problem, refined, ends, found, first, noise, analysis)


class _AnalysedBest(NamedTuple):
    """The best end and its analysis, with all ends; `has_gained`: a scan found it."""

    refined: tuple[RefinedCandidate | None, ...]
    ends: list[tuple[FloatArray, float]]
    all_ends: list[tuple[FloatArray, float]]
    has_gained: bool
    theta: FloatArray
    analysis: Analysis


def _analyse_best(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    refined: tuple[RefinedCandidate | None, ...],
    ends: list[tuple[FloatArray, float]],
    deadline: Deadline,
) -> _AnalysedBest:
    """Scan from the best of the ends, analyse the result, and search for minima near it."""
    ends = list(ends)
    best = min(range(len(ends)), key=lambda i: ends[i][1])
    all_ends, has_gained = list(ends), False
    if _should_refine(algorithm, len(ends)):
        scanned = _scan_from_best(problem, algorithm, state, refined, ends[best], deadline)
        all_ends += [(end.theta, end.rms) for end in scanned.ends[1:]]
        has_gained = scanned.best.rms < ends[best][1] * (1.0 - SAME_OPTIMUM)
        ends[best] = scanned.best.theta, scanned.best.rms
        refined = (*refined[:best], scanned.best, *refined[best + 1 :])
    left = _count_budget_left(algorithm, state, refined)
    spare = None if left is None else max(0, left - compute_analysis_budget(ends[best][0].size))
    groups, spent = find_exchanges(problem, ends[best][0], spare)
    ends = [(order_exchangeable(problem, theta, groups), rms) for theta, rms in ends]
    refined = tuple(
        None if candidate is None else replace(candidate, theta=end)
        for candidate, (end, _) in zip(refined, ends, strict=True)
    )
    theta = ends[best][0]
    analysis = analyse_estimate(problem, theta, None if left is None else left - spent)
    analysis = replace(analysis, evaluations=analysis.evaluations + spent, exchanges=groups)
    if _should_refine(algorithm, len(ends)):
        end, analysis = _search_local_minima(
            problem, algorithm, state, refined, ends[best], analysis, deadline
        )
        theta = end.theta
        ends[best] = theta, end.rms
        refined = (*refined[:best], end, *refined[best + 1 :])
    return _AnalysedBest(refined, ends, all_ends, has_gained, theta, analysis)


def _compare_half_step(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    refined: tuple[RefinedCandidate | None, ...],
    theta: FloatArray,
    analysis: Analysis,
    work: int,
    deadline: Deadline,
) -> tuple[HalfStep | None, str]:
    """Compare an estimate with that of half the step; name the limit that forbids to use it."""
    is_refined = _should_refine(algorithm, len(state.islands))
    is_late = deadline.is_past_grace if is_refined else lambda: True
    left = _count_simulations_left(algorithm, state, refined, analysis)
    half = compare_half_step(problem, theta, analysis, left, is_late)
    if half is None or not half.changes:
        return half, ""
    if not is_refined:
        return half, "estimates of this search are not refined"
    left = None if left is None else max(0, left - half.evaluations)
    return half, find_limit(half, work, left, deadline.is_past_grace)


def _count_simulations_left(
    algorithm: GeneticAlgorithm,
    state: RunState,
    refined: tuple[RefinedCandidate | None, ...],
    analysis: Analysis,
) -> int | None:
    """Count the simulations left for a finer step, less those of its analysis."""
    left = _count_budget_left(algorithm, state, refined)
    if left is None:
        return None
    size = len(state.islands[0].point)
    return max(0, left - analysis.evaluations - compute_analysis_budget(size))


def _fit_half_step(
    half: HalfStep,
    state: RunState,
    ends: list[tuple[FloatArray, float]],
    theta: FloatArray,
    max_simulations: int,
    deadline: Deadline,
) -> tuple[RefinedCandidate, ...] | None:
    """Fit the champions of all islands with half the step; None if none is finite.

    An island starts from the best of its champions with that step.
    """
    champions = [
        [*(np.array(one.parameters) for one in island.history), end]
        + ([half.theta] if end is theta else [])
        for island, (end, _) in zip(state.islands, ends, strict=True)
    ]
    starts, values, spent = choose_starts(half, champions)
    if not np.isfinite(values).any():
        return None
    found = refine_candidates(
        half.problem, starts, max(0, max_simulations - spent), deadline.is_past_grace
    )
    each = spent // len(starts)
    return tuple(
        RefinedCandidate(start, rms, each)
        if end is None
        else replace(end, evaluations=end.evaluations + each)
        for start, rms, end in zip(starts, values.tolist(), found, strict=True)
    )


def _add_evaluations(
    fitted: tuple[RefinedCandidate, ...],
    refined: tuple[RefinedCandidate | None, ...],
    ends: list[tuple[FloatArray, float]],
    theta: FloatArray,
    analysis: Analysis,
) -> tuple[RefinedCandidate | None, ...]:
    """Add the evaluations of the longer step to those of the finer one."""
    counts = [0 if end is None else end.evaluations for end in refined]
    counts = [
        count + (analysis.evaluations if end is theta else 0)
        for count, (end, _) in zip(counts, ends, strict=True)
    ]
    return tuple(
        replace(end, evaluations=end.evaluations + count)
        for end, count in zip(fitted, counts, strict=True)
    )


def _get_variance_ratio(analysis: Analysis) -> float:
    """Get the least variance ratio of all parameters; 1 for white residuals."""
    if analysis.linear_model is None:
        return 1.0
    ratios = analysis.linear_model.variance_ratio
    return float(np.min(ratios[np.isfinite(ratios)], initial=1.0))


def _scan_from_best(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    refined: tuple[RefinedCandidate | None, ...],
    end: tuple[FloatArray, float],
    deadline: Deadline,
) -> ScanResult:
    """Scan from the best end; the result's evaluations include those of its refinement."""
    theta, rms = end
    start = _find_refined(refined, theta) or RefinedCandidate(theta, rms, 0)
    most = _count_scan_simulations(problem, algorithm, state, refined, deadline)
    scanned = scan_parameters(problem, start, _list_delays(problem), most, deadline.is_past_grace)
    spent = start.evaluations + scanned.evaluations
    best = replace(scanned.best, evaluations=spent, is_cut_short=start.is_cut_short)
    return scanned._replace(best=best)


def _count_scan_simulations(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    refined: tuple[RefinedCandidate | None, ...],
    deadline: Deadline,
) -> int:
    """Count the simulations that a scan may take."""
    left = _count_budget_left(algorithm, state, refined)
    most = count_affordable_simulations(problem, deadline.is_over())
    return most if left is None else min(most, left // _SCAN_DIVISOR)


def _list_delays(problem: Problem) -> list[int]:
    """List the numbers of the free parameters that time lags depend on."""
    names = find_delay_parameters(problem)
    return [d for d, name in enumerate(problem.free_names) if name in names]


def _find_refined(
    refined: tuple[RefinedCandidate | None, ...], theta: FloatArray
) -> RefinedCandidate | None:
    return next((one for one in refined if one is not None and one.theta is theta), None)


def _get_champion(problem: Problem, history: tuple[Improvement, ...]) -> FloatArray:
    if history:
        return np.array(history[-1].parameters)
    return 0.5 * (problem.evaluator.lower + problem.evaluator.upper)


def _refine_champions(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    champions: list[FloatArray],
    deadline: Deadline,
) -> tuple[RefinedCandidate | None, ...]:
    if not _should_refine(algorithm, len(champions)):
        return (None,) * len(champions)
    left = _count_budget_left(algorithm, state, ())
    reserved = compute_analysis_budget(len(champions[0]))
    max_simulations = None if left is None else max(0, left - reserved)
    return refine_candidates(problem, champions, max_simulations, deadline.is_past_grace)


def _should_refine(algorithm: GeneticAlgorithm, islands: int) -> bool:
    """Whether least squares continues from the end of the search."""
    methods = {get_island_settings(algorithm, i).method for i in range(islands)}
    return algorithm.refine and "improved" in methods


def _search_local_minima(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    refined: tuple[RefinedCandidate | None, ...],
    end: tuple[FloatArray, float],
    analysis: Analysis,
    deadline: Deadline,
) -> tuple[RefinedCandidate, Analysis]:
    """Search the minima near an estimate; return the best, with intervals that cover the others.

    Its evaluations are those of the candidate that it replaces, and of this search.
    """
    theta, rms = end
    previous = _find_refined(refined, theta)
    before, is_cut = (
        (0, False) if previous is None else (previous.evaluations, previous.is_cut_short)
    )
    unchanged = RefinedCandidate(theta, rms, before, is_cut)
    if analysis.linear_model is None:
        return unchanged, analysis
    left = _count_budget_left(algorithm, state, refined)
    reserved = analysis.evaluations + compute_analysis_budget(theta.size)
    is_late = deadline.is_over()
    max_simulations = count_affordable_simulations(problem, is_late)
    if max_simulations == 0 and is_late:
        return unchanged, replace(analysis, is_cut_short=True)
    if left is not None:
        shared = 2 if problem.loss.noise_model == "ar1" else 1  # with the noise model
        max_simulations = min(max_simulations, max(0, left - reserved) // shared)
    minima = find_local_minima(
        problem, theta, rms, analysis.linear_model, state.seed, max_simulations
    )
    spent = before + minima.evaluations
    if minima.best is not None:
        spent += analysis.evaluations
        groups = analysis.exchanges
        theta, rms = order_exchangeable(problem, minima.best.theta, groups), minima.best.rms
        left = None if left is None else left - analysis.evaluations - minima.evaluations
        analysis = replace(analyse_estimate(problem, theta, left), exchanges=groups)
    return RefinedCandidate(theta, rms, spent, is_cut), _widen_intervals(problem, analysis, minima)


def _widen_intervals(problem: Problem, analysis: Analysis, minima: LocalMinima) -> Analysis:
    """Widen the intervals of an analysis so that they contain those of all minima."""
    if analysis.linear_model is None:
        return analysis
    share = analysis.linear_model.variance_ratio
    minima = replace(minima, values=order_exchangeable(problem, minima.values, analysis.exchanges))
    estimates = widen_intervals(
        analysis.estimates, problem.free_names, problem.n_scored, minima, share
    )
    return replace(analysis, estimates=estimates)


def _apply_noise_model(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    refined: tuple[RefinedCandidate | None, ...],
    theta: FloatArray,
    analysis: Analysis,
    deadline: Deadline,
    *,
    is_settled: bool,
) -> tuple[GeneralisedEstimate, Analysis]:
    """Estimate and analyse under the noise model that was requested or selected.

    Estimates of the paper's methods stay unchanged. So do all if the residuals are consistent with
    white noise, or if the integration step is too long for them.
    """
    requested = problem.loss.noise_model
    if requested == "white" or not _should_refine(algorithm, len(state.islands)):
        return GeneralisedEstimate(theta, {}, 0, requested != "ar1"), analysis
    in_time = deadline.count_simulations_left(state.seconds, state.evaluations, problem.n_steps)
    is_indicated = is_settled and is_ar1_indicated(problem, theta, analysis, in_time)
    if requested == "auto" and not is_indicated:
        return GeneralisedEstimate(theta, {}, 0, True), analysis
    left = _count_budget_left(algorithm, state, refined)
    reserved = analysis.evaluations + compute_analysis_budget(theta.size)
    limits = None if left is None else max(0, left - reserved), in_time
    max_simulations = min((limit for limit in limits if limit is not None), default=None)
    nothing = np.zeros((theta.size, theta.size))
    covariance = nothing if analysis.uncertainty is None else analysis.uncertainty.covariance
    is_cut_short = analysis.is_cut_short
    estimate = fit_generalised_least_squares(
        problem, theta, covariance, state.seed, max_simulations
    )
    spent = analysis.evaluations + estimate.evaluations
    if requested == "auto":
        estimate = confirm_noise_model(problem, theta, estimate)
    if any(estimate.correlation_times.values()):
        white = make_whitening(problem, estimate.correlation_times)
        groups, theta = (
            analysis.exchanges,
            order_exchangeable(problem, estimate.theta, analysis.exchanges),
        )
        estimate = estimate._replace(theta=theta)
        analysis = analyse_estimate(problem, theta, None if left is None else left - spent, white)
        analysis = replace(analysis, exchanges=groups)
        spent += analysis.evaluations
        analysis = _widen_intervals(
            problem, analysis, LocalMinima(None, estimate.minima, estimate.rms, 0)
        )
    return estimate, replace(analysis, evaluations=spent, is_cut_short=is_cut_short)


def _count_budget_left(
    algorithm: GeneticAlgorithm, state: RunState, refined: tuple[RefinedCandidate | None, ...]
) -> int | None:
    """Count the simulations that search and refinement left of the budget; None: no budget."""
    limit = algorithm.stop.evaluations
    return (
        None
        if limit is None
        else max(0, limit - state.evaluations - _count_refinement_evaluations(refined))
    )


def _count_refinement_evaluations(refined: tuple[RefinedCandidate | None, ...]) -> int:
    return sum(end.evaluations for end in refined if end is not None)


def _count_evaluations(
    state: RunState, refined: tuple[RefinedCandidate | None, ...], analysis: Analysis
) -> int:
    return state.evaluations + _count_refinement_evaluations(refined) + analysis.evaluations


def _summarise_islands(
    state: RunState,
    refined: tuple[RefinedCandidate | None, ...],
    ends: list[tuple[FloatArray, float]],
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


def _extend_histories(
    state: RunState, refined: tuple[RefinedCandidate | None, ...]
) -> tuple[tuple[Improvement, ...], ...]:
    """Extend the islands' histories by the gain of the refinement."""
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


def _split_outputs(problem: Problem, values: FloatArray) -> tuple[tuple[FloatArray, ...], ...]:
    names = [output.name for output in problem.model.outputs]
    return tuple(tuple(part[name] for name in names) for part in problem.split_by_output(values))


def _list_final_rms(
    refined: tuple[RefinedCandidate | None, ...], ends: list[tuple[FloatArray, float]]
) -> list[float]:
    """List the RMS of the refined champions, or of all; one near a better one is not refined."""
    return [end.rms for end in refined if end is not None] or [rms for _, rms in ends]


class _ValidationResult(NamedTuple):
    """Agreement with validation data; `spread` is the RMS of their mean.

    `is_still`: they hardly move, so that their fit % says nothing and is undefined.
    """

    metrics: Metrics
    simulated: tuple[tuple[FloatArray, ...], ...]
    tests: ResidualTests
    spread: float
    is_still: bool


def _validate_estimates(
    validation: Problem,
    estimation: Problem,
    estimates: tuple[Estimate, ...],
    correlation_times: Mapping[str, float],
    metrics: Metrics,
) -> _ValidationResult:
    """Simulate data that were not used for the estimate, and measure the agreement.

    Parameters and output weights are those of the estimate, so both RMS use the same measure. An
    initial state belongs to its record. If the last part of the same records is validated, it is
    the estimated one. On other records only the initial state is estimated, on their first part.
    `metrics` are those of the estimation data.
    """
    model, changes = validation.untied_model, validation.settings.parameters
    is_part = validation.settings.scored_from is not None
    shared = {p.name for p in (validation.all_parameters if is_part else model.parameters)}
    fixed = {e.name: _to_fixed_parameter(e) for e in estimates if e.name in shared}
    other_changes = {name: fields for name, fields in changes.items() if name not in shared}
    fixed_problem = validation.rebuild(
        model=estimation.untied_model,
        parameters={**other_changes, **fixed},
        weights=estimation.output_weights,
    )
    theta = _estimate_starts(fixed_problem) if fixed_problem.free_parameters else np.zeros(0)
    simulated = fixed_problem.predict(theta[None])[0]
    agreement, spread = compute_metrics(fixed_problem, simulated), fixed_problem.output_scale
    is_still = spread < _STILL_SHARE * estimation.output_scale and (
        agreement.fit_percent < 0.0 or spread < _STILL_NOISE * metrics.rms
    )
    return _ValidationResult(
        _leave_out_fit(agreement) if is_still else agreement,
        _select_scored_part(fixed_problem, _split_outputs(fixed_problem, simulated)),
        run_residual_tests(fixed_problem, simulated, "validation", correlation_times),
        spread,
        is_still,
    )


def _estimate_starts(problem: Problem) -> FloatArray:
    """Estimate the initial states of validation data on the first part of each record.

    So the rest is predicted. A record of which nothing is scored there is used as a whole.
    """
    first = [
        replace(
            record,
            outputs=tuple(
                replace(
                    channel,
                    values=np.where(
                        np.arange(channel.values.size) < _START_SHARE * channel.values.size,
                        channel.values,
                        np.nan,
                    ),
                )
                for channel in record.outputs
            ),
        )
        for record in problem.records
    ]
    with suppress(InvalidRecord):  # nothing in it is scored
        problem = problem.rebuild(records=first, weights=problem.output_weights)
    middle = 0.5 * (problem.evaluator.lower + problem.evaluator.upper)
    start = refine_candidates(problem, [middle])[0]
    return middle if start is None else start.theta


def _leave_out_fit(metrics: Metrics) -> Metrics:
    channels = tuple(replace(channel, fit_percent=float("nan")) for channel in metrics.channels)
    return replace(metrics, fit_percent=float("nan"), channels=channels)


def _warn_still_validation(
    problem: Problem, metrics: Metrics, validated: _ValidationResult | None
) -> list[str]:
    """Warn about validation data that hardly move: their fit % would say nothing."""
    if validated is None or not validated.is_still:
        return []
    unit = format_unit(metrics.unit)
    return [
        f"the validation data hardly move: their standard deviation is {validated.spread:.3g}{unit}"
        f", that of the estimation data {problem.output_scale:.3g}{unit}. So their fit % says "
        f"nothing. Compare the RMS: {validated.metrics.rms:.3g}{unit} in validation, "
        f"{metrics.rms:.3g}{unit} in estimation."
    ]


def _to_fixed_parameter(estimate: Estimate) -> dict[str, float | str]:
    """Fix a parameter at its estimate; that of a tie may lie outside the bounds."""
    value = estimate.value
    bounds = {"lower": min(estimate.lower, value), "upper": max(estimate.upper, value)}
    return {"fixed": value, "scale": "linear", **bounds}


def _select_scored_part(
    problem: Problem, simulated: tuple[tuple[FloatArray, ...], ...]
) -> tuple[tuple[FloatArray, ...], ...]:
    """Select the simulated samples from the time on at which the records are scored."""
    scored_from = problem.settings.scored_from
    if scored_from is None:
        return simulated
    names = [output.name for output in problem.model.outputs]
    scored = []
    for record, since, outputs in zip(problem.records, scored_from, simulated, strict=True):
        times = {channel.name: channel.times for channel in record.outputs}
        late = [times[name] >= since for name in names]
        scored.append(tuple(part[mask] for part, mask in zip(outputs, late, strict=True)))
    return tuple(scored)
