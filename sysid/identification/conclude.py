"""Conclude a search: refinement, uncertainty, validation, warnings."""

from dataclasses import replace
from math import inf

import numpy as np

from sysid.core.errors import DivergedEverywhere, NothingIdentifiable
from sysid.core.jit import read_clock
from sysid.core.settings import GeneticAlgorithm
from sysid.core.threads import use_one_thread
from sysid.core.types import FloatArray
from sysid.data.records import find_common_sample_time
from sysid.diagnosis.fixed_start import warn_fixed_starts
from sysid.diagnosis.hard_switching import warn_hard_switching
from sysid.diagnosis.input_hold import (
    describe_input_holds,
    find_hold_doubts,
    list_input_holds,
    mark_hold_dependent,
    refit_other_holds,
)
from sysid.diagnosis.integration_step import explain_finer_step
from sysid.diagnosis.open_terms import mark_selection_dependent
from sysid.diagnosis.process_order import (
    compare_orders,
    mark_order_dependent,
    warn_other_order,
)
from sysid.diagnosis.unstable_run import (
    compare_one_step,
    mark_prediction_dependent,
    warn_misled_run,
)
from sysid.diagnosis.validation import (
    mark_refuted,
    split_outputs,
    validate_estimates,
    warn_refuted,
    warn_still_validation,
)
from sysid.diagnosis.warnings import (
    collect_warnings,
    find_delay_parameters,
    warn_noise_model,
    warn_time_limit,
)
from sysid.identifiability.exchange import describe_exchanges
from sysid.identification.best_estimate import IslandEnd, find_best_estimate, is_refining
from sysid.identification.budget import Budget
from sysid.identification.deadline import Clock, Deadline
from sysid.islands.run_state import RunState
from sysid.minima.minima import mark_ambiguous
from sysid.minima.search_evidence import assess_search, mark_unsettled, warn_unsettled
from sysid.noise_models.noise_model_choice import resolve_noise_model
from sysid.residuals.feedback import describe_feedback
from sysid.residuals.onset_delay import estimate_onset_delays
from sysid.residuals.residual_tests import list_residual_series, run_residual_tests
from sysid.results.identification import Identification
from sysid.results.result import Agreements, FitPercent, Identifiability, KnownBefore
from sysid.results.verdict import Evidence, judge_result
from sysid.search.state import Improvement, IslandSummary
from sysid.simulation.problem import Problem, compute_metrics
from sysid.uncertainty.analysis import Analysis
from sysid.uncertainty.estimates import CorrelationMatrix, Uncertainty
from sysid.uncertainty.posterior import describe_posterior, sample_posterior
from sysid.uncertainty.unequal_noise import describe_unequal_noise


def conclude_run(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    validation: Problem | None = None,
    clock: Clock = read_clock,
    *,
    posterior: bool = False,
    orders: bool = False,
) -> Identification:
    """Conclude a run: refine, analyse and validate its estimate.

    With ``refine`` the champions of an ``improved`` search are refined by least squares. Those of
    the paper's two methods are reported unchanged, so that a comparison is one of the methods. If
    the time of the run is limited, refinement ends near the limit and warnings list what was left
    out. Standard errors, tests and validation are always computed. `clock` returns seconds. With
    `posterior` samples of the posterior are taken, as far as budget and time are left. With
    `orders` a process with dead time is compared with one order more and one less.

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
        return _build_identification(
            problem,
            algorithm,
            state,
            validation,
            deadline,
            has_posterior=posterior,
            compares_orders=orders,
        )


def _build_identification(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    validation: Problem | None,
    deadline: Deadline,
    *,
    has_posterior: bool,
    compares_orders: bool,
) -> Identification:
    budget = Budget(algorithm.stop.evaluations, state.evaluations)
    best = find_best_estimate(problem, algorithm, state, budget, deadline, validation)
    asked, noise, minima, analysis = problem, best.noise, best.minima, best.analysis
    problem, theta = resolve_noise_model(best.problem, noise), noise.theta
    if analysis.uncertainty is not None and not analysis.uncertainty.singular_values.any():
        raise NothingIdentifiable(problem.free_names)
    simulated = problem.predict(theta[None])[0]
    metrics = compute_metrics(problem, simulated)
    times = noise.correlation_times
    validated = (
        None
        if validation is None
        else validate_estimates(validation, problem, analysis.estimates, times, metrics)
    )
    tests = (
        validated.tests
        if validated
        else run_residual_tests(problem, simulated, "estimation", times)
    )
    limit = algorithm.safe_limit
    evidence = assess_search(problem, state, metrics.rms, tests, minima)
    settled = mark_unsettled(mark_ambiguous(problem, analysis.estimates, minima), evidence)
    settled = mark_selection_dependent(settled, problem.model)
    analysis = replace(analysis, estimates=mark_refuted(settled, validated))
    holds = list_input_holds(problem)
    if is_refining(algorithm, len(best.ends)):
        left, late = budget.count_left(), deadline.is_past_grace
        holds, spent = refit_other_holds(problem, holds, theta, best.lowest_end.theta, left, late)
        budget.spend(spent)
    orders = None
    if compares_orders and is_refining(algorithm, len(best.ends)):
        left, late = budget.count_left(), deadline.is_past_grace
        orders, spent = compare_orders(problem, theta, analysis.estimates, left, late)
        budget.spend(spent)
        analysis = replace(analysis, estimates=mark_order_dependent(analysis, orders))
    doubts = find_hold_doubts(problem, holds, simulated, best.lowest_end.rms)
    hold_marked = mark_hold_dependent(analysis.estimates, holds, doubts)
    analysis = replace(analysis, estimates=hold_marked)
    posterior = None
    if has_posterior:
        others = [minimum.values for minimum in minima.minima if minimum.is_compatible]
        left, late = budget.count_left(), deadline.is_past_grace
        posterior = sample_posterior(problem, theta, analysis, others, state.seed, left, late)
        budget.spend(posterior.evaluations)
    feedback = _check_feedback(problem, simulated, analysis)
    left, late = budget.count_left(), deadline.is_past_grace
    ahead, spent = compare_one_step(
        problem,
        theta,
        analysis,
        left,
        late,
        has_feedback=bool(feedback),
        doubtful=[hold for hold, doubt in zip(holds, doubts, strict=True) if doubt],
    )
    budget.spend(spent)
    analysis = replace(analysis, estimates=mark_prediction_dependent(analysis.estimates, ahead))
    fit = FitPercent(
        metrics.fit_percent, None if validated is None else validated.metrics.fit_percent
    )
    valid = limit is None or metrics.rms <= limit
    delays, uncertainty = tuple(sorted(find_delay_parameters(problem))), analysis.uncertainty
    return Identification(
        valid=valid,
        parameters=analysis.estimates,
        rms=metrics.rms,
        rms_validation=None if validated is None else validated.metrics.rms,
        fit_percent=fit,
        agreement=Agreements(
            metrics.channels, () if validated is None else validated.metrics.channels
        ),
        evaluations=state.evaluations + budget.spent,
        generations=max(island.generation for island in state.islands),
        islands=_summarise_islands(state, best.ends),
        identifiability=_describe_identifiability(uncertainty),
        criteria=analysis.criteria,
        correlation=None
        if uncertainty is None
        else CorrelationMatrix(uncertainty.names, uncertainty.correlation),
        covariance=None if uncertainty is None else uncertainty.covariance,
        degrees=inf if uncertainty is None else uncertainty.degrees,
        noise_sd=None if uncertainty is None else uncertainty.noise_sd,
        noise_colour=None if uncertainty is None else uncertainty.noise_colour,
        noise_model="ar1" if any(times.values()) else "white",
        correlation_times=times,
        noise_deviations=None
        if problem.settings.weights is not None
        else problem.settings.deviations,
        residual_tests=tests,
        onset_delays=estimate_onset_delays(problem.model, problem.records),
        data_bounds=tuple(p.name for p in problem.free_parameters if p.bounds is not None),
        input_hold=holds,
        known_before=KnownBefore(
            _compute_input_history(problem),
            () if validation is None else _compute_input_history(validation),
        ),
        search=evidence,
        posterior=posterior,
        order_comparison=orders,
        delays=delays,
        verdict=judge_result(
            Evidence(
                estimates=analysis.estimates,
                valid=valid,
                fit_percent=fit.estimation,
                fit_percent_validation=fit.validation,
                search=evidence,
                tests=tests.tests,
                delays=delays,
                orders=orders,
                channels=metrics.channels,
            )
        ),
        warnings=(
            *warn_refuted(metrics, validated),
            *warn_other_order(orders, problem.model.name),
            *warn_fixed_starts(problem, theta, analysis, deadline.is_past_grace),
            *collect_warnings(
                problem,
                algorithm,
                analysis,
                metrics,
                tests,
                is_contradicted=minima.is_contradicted,
            ),
            *describe_unequal_noise(problem, metrics.channels),
            *warn_unsettled(evidence),
            *describe_input_holds(problem, holds, doubts, analysis.estimates, best.lowest_end.rms),
            *describe_exchanges(
                problem,
                analysis.exchanges,
                {estimate.name for estimate in analysis.estimates if estimate.stderr is not None},
            ),
            *warn_hard_switching(problem, theta, _list_final_rms(best.ends)),
            *warn_still_validation(problem, metrics, validated),
            *warn_time_limit(any(end.is_cut_short for end in best.ends)),
            *feedback,
            *warn_misled_run(analysis.estimates, ahead),
            *explain_finer_step(asked, problem, best.first, analysis.estimates),
            *warn_noise_model(problem, times, noise.is_complete),
            *filter(None, [noise.note]),
            *(() if posterior is None else describe_posterior(posterior, analysis.estimates)),
        ),
        substeps=problem.model.solver.substeps,
        selection=() if problem.model.selection is None else problem.model.selection.terms,
        history=_extend_histories(state, best.ends),
        migrations=state.migrations,
        simulated=split_outputs(problem, simulated),
        simulated_validation=() if validated is None else validated.simulated,
        sample_time=problem.share("sample time", lambda: find_common_sample_time(problem.records)),
    )


def _describe_identifiability(uncertainty: Uncertainty | None) -> Identifiability:
    if uncertainty is None:
        return Identifiability(None, (), np.zeros(0))
    return Identifiability(uncertainty.condition, uncertainty.groups, uncertainty.singular_values)


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


def _summarise_islands(state: RunState, ends: tuple[IslandEnd, ...]) -> tuple[IslandSummary, ...]:
    return tuple(
        IslandSummary(
            champion_rms=island.champion_rms,
            refined_rms=end.rms if end.is_refined else None,
            parameters=tuple(end.theta.tolist()),
            evaluations=island.evaluations + end.evaluations,
        )
        for island, end in zip(state.islands, ends, strict=True)
    )


def _extend_histories(
    state: RunState, ends: tuple[IslandEnd, ...]
) -> tuple[tuple[Improvement, ...], ...]:
    """Extend the islands' histories by the gain of the refinement."""
    histories = []
    for island, end in zip(state.islands, ends, strict=True):
        history = island.history
        if end.is_refined and end.rms < island.champion_rms:
            spent = island.evaluations + end.evaluations
            values = tuple(end.theta.tolist())
            gain = Improvement(island.generation, spent, end.rms, "refinement", values)
            history = (*history, gain)
        histories.append(history)
    return tuple(histories)


def _list_final_rms(ends: tuple[IslandEnd, ...]) -> list[float]:
    """List the RMS of the refined ends, or of all; one near a better one is not refined."""
    return [end.rms for end in ends if end.is_refined] or [end.rms for end in ends]
