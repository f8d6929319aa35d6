"""Conclude a search: refinement, uncertainty, validation, warnings."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from math import inf

import numpy as np

from sysid.core.errors import DivergedEverywhere, NothingIdentifiable, SysidError
from sysid.core.findings import Finding, note
from sysid.core.jit import read_clock
from sysid.core.settings import FoundNoiseModel, GeneticAlgorithm, StartKind
from sysid.core.threads import use_one_thread
from sysid.core.types import FloatArray
from sysid.data.records import find_common_sample_time
from sysid.identifiability.exchange import describe_exchanges
from sysid.identification.best_estimate import IslandEnd, find_best_estimate, is_refining
from sysid.identification.budget import Budget
from sysid.identification.deadline import Clock, Deadline
from sysid.identification.plant_noise import describe_plant_noise
from sysid.islands.run_state import RunState
from sysid.judgement.agreement import (
    find_better_yardstick,
    find_constant_outputs,
    find_disagreement,
    find_exchanged_channels,
)
from sysid.judgement.conclusions import (
    conclude_estimates,
    conclude_verdict,
    list_warnings,
    order_findings,
)
from sysid.judgement.determination import find_ambiguous, find_undetermined
from sysid.judgement.hard_switching import find_hard_switches
from sysid.judgement.holding_bounds import find_cause_in_bounds
from sysid.judgement.input_hold import (
    find_hold_doubts,
    find_other_readings,
    list_input_holds,
    refit_other_holds,
)
from sysid.judgement.integration_step import find_finer_step
from sysid.judgement.judge import select_explanations
from sysid.judgement.levels import SOLVER_SHARE
from sysid.judgement.noise_findings import (
    find_feedback,
    find_loop,
    find_noise_model,
    find_plant_noise,
    find_unexplained,
)
from sysid.judgement.noise_sources import (
    compute_response_gain,
    find_no_response,
    find_open_sources,
)
from sysid.judgement.open_terms import find_open_terms
from sysid.judgement.preparation import (
    find_early_responses,
    find_few_repeats,
    find_record_events,
    find_unit_faults,
    find_useless_prediction,
)
from sysid.judgement.process_order import compare_orders, find_other_orders
from sysid.judgement.residual_context import Simulations, find_delay_parameters
from sysid.judgement.settling import find_rough_end, find_unsettled
from sysid.judgement.starts import StartComparison, find_open_starts
from sysid.judgement.unrecorded_input import find_unrecorded_input
from sysid.judgement.unstable_run import (
    MIN_GROWTH,
    compare_one_step,
    compute_growth,
    find_misled_run,
)
from sysid.judgement.validation import find_contradictions, split_outputs, validate_estimates
from sysid.judgement.yardstick import Yardstick, fit_yardstick
from sysid.minima.minima import mark_ambiguous
from sysid.minima.search_evidence import assess_search, is_explained
from sysid.noise_models.generalised_least_squares import resolve_noise_model
from sysid.residuals.feedback import describe_feedback
from sysid.residuals.onset_delay import estimate_onset_delays
from sysid.residuals.residual_tests import list_residual_series, run_residual_tests
from sysid.results.identification import Identification
from sysid.results.result import Agreements, FitPercent, Identifiability, KnownBefore
from sysid.search.refine import refine_candidates
from sysid.search.state import Improvement, IslandSummary
from sysid.simulation.free_run import convert_to_free_run
from sysid.simulation.problem import Problem, compute_metrics
from sysid.simulation.start_values import convert_point
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
    `orders` a process with dead time is compared with one order more and one less, and intervals
    follow the profile likelihood where those of the linear model do not hold.

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
    best = find_best_estimate(problem, algorithm, state, budget, deadline, explains=compares_orders)
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
    analysis = replace(analysis, estimates=mark_ambiguous(problem, analysis.estimates, minima))
    delays, explained = find_delay_parameters(problem), best.explained
    refines = is_refining(algorithm, len(best.ends))
    holds = list_input_holds(problem)
    if refines:
        left, late = budget.count_left(), deadline.is_past_grace
        holds, spent = refit_other_holds(problem, holds, theta, best.lowest_end.theta, left, late)
        budget.spend(spent)
    orders = None
    if compares_orders and refines:
        left, late = budget.count_left(), deadline.is_past_grace
        orders, spent = compare_orders(problem, theta, analysis.estimates, left, late)
        budget.spend(spent)
    simulations = Simulations(budget.count_left(), deadline.is_past_grace)
    doubts = find_hold_doubts(problem, holds, theta, simulated, best.lowest_end.rms, simulations)
    budget.spend(simulations.spent)
    posterior = None
    if has_posterior:
        others = [minimum.values for minimum in minima.minima if minimum.is_compatible]
        left, late = budget.count_left(), deadline.is_past_grace
        posterior = sample_posterior(problem, theta, analysis, others, state.seed, left, late)
        budget.spend(posterior.evaluations)
    feedback = list(find_feedback(problem, simulated, analysis))
    replaced = best.free_run
    # A filter that does not fit explains no loop.
    if replaced is not None and not is_explained(problem, metrics.rms, tests):
        names = tuple(one.name for one in analysis.estimates if one.is_free)
        feedback = feedback or [replace(one, parameters=names) for one in replaced.feedback]
    left, late = budget.count_left(), deadline.is_past_grace
    ahead, spent = compare_one_step(
        problem,
        theta,
        analysis,
        left,
        late,
        has_feedback=bool(feedback),
        doubtful=[hold for hold, doubt in zip(holds, doubts, strict=True) if doubt.text],
    )
    budget.spend(spent)
    estimates = analysis.estimates
    are_noise = is_explained(
        problem,
        metrics.rms,
        run_residual_tests(problem, simulated, "estimation") if any(times.values()) else tests,
    )
    is_of_the_solver = (
        explained.is_of_the_solver or metrics.rms <= SOLVER_SHARE * problem.output_scale
    )
    is_white = analysis.uncertainty is None or analysis.uncertainty.noise_colour == "white"
    # Beside white residuals nothing is better, and in a loop the controller's inverse is.
    measures = compares_orders and not (is_white or is_of_the_solver or feedback)
    yardstick = fit_yardstick(problem, simulated) if measures else None
    if compares_orders and not problem.is_free_run:
        yardstick = _measure_free_run(problem, theta)
    # A sweep's run tries no setting: that is done when somebody opens it.
    left = budget.count_left() if compares_orders else 0
    simulations = Simulations(left, deadline.is_past_grace)
    explanations = (
        ()
        if feedback
        else select_explanations(
            () if is_of_the_solver else explained.findings,
            [
                *find_other_orders(orders, problem.model.name, estimates),
                *find_other_readings(problem, holds, doubts, estimates, simulations),
                *find_open_starts(best.starts, estimates),
            ],
        )
    )
    response = compute_response_gain(problem, theta, simulations)
    findings = order_findings(
        [
            *(find_exchanged_channels(problem, simulated, metrics) if compares_orders else ()),
            *find_disagreement(metrics, limit, are_residuals_noise=are_noise),
            *find_constant_outputs(problem),
            *find_better_yardstick(
                yardstick,
                [one.name for one in estimates if one.is_free],
                explanations,
            ),
            *find_unsettled(
                evidence,
                estimates,
                lambda: find_cause_in_bounds(problem, theta, analysis),
                is_filter=bool(problem.model.corrections),
            ),
            *find_contradictions(problem, metrics, validated, estimates),
            *find_misled_run(estimates, ahead),
            *explanations,
            *find_ambiguous(estimates),
            *find_open_terms(estimates, problem.model),
            *find_undetermined(problem, analysis, delays, are_residuals_noise=are_noise),
            *find_early_responses(problem),
            *find_unrecorded_input(
                problem, analysis, explanations, is_contradicted=minima.is_contradicted
            ),
            *(() if is_of_the_solver else find_unexplained(tests, explained, analysis)),
            *feedback,
            *find_loop(problem, asked),
            *find_unit_faults(problem),
            *find_useless_prediction(problem),
            *find_few_repeats(problem, analysis),
            *(find_record_events(problem, explanations) if compares_orders else ()),
            *_list_notes("unequal noise", describe_unequal_noise(problem, metrics.channels)),
            *_list_notes(
                "exchange",
                describe_exchanges(
                    problem,
                    analysis.exchanges,
                    {one.name for one in estimates if one.stderr is not None},
                ),
            ),
            *find_hard_switches(problem, theta, _list_final_rms(best.ends)),
            *find_rough_end(
                algorithm,
                0.0 if is_of_the_solver else analysis.possible_gain,
                is_cut_short=any(end.is_cut_short for end in best.ends),
                lacks_neighbours=analysis.is_cut_short,
            ),
            *find_finer_step(asked, problem, best.first, estimates),
            *find_noise_model(
                problem,
                times,
                best.lowest_end.theta,
                is_complete=noise.is_complete,
            ),
            *(
                ()
                if replaced is None
                else find_plant_noise(problem, replaced.values, replaced.gain)
            ),
            *find_no_response(problem, response, estimates),
            *find_open_sources(best.sources, problem, estimates),
            *_list_notes(
                "posterior", () if posterior is None else describe_posterior(posterior, estimates)
            ),
        ],
        problem.n_scored,
    )
    budget.spend(simulations.spent)
    analysis = replace(analysis, estimates=conclude_estimates(estimates, findings))
    declared = [parameter.name for parameter in problem.given_model.parameters]
    fit = FitPercent(
        metrics.fit_percent, None if validated is None else validated.metrics.fit_percent
    )
    valid = limit is None or metrics.rms <= limit
    uncertainty = analysis.uncertainty
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
        islands=_summarise_islands(best.state, best.ends),
        identifiability=_describe_identifiability(uncertainty),
        criteria=analysis.criteria,
        correlation=None
        if uncertainty is None
        else CorrelationMatrix(uncertainty.names, uncertainty.correlation),
        covariance=None if uncertainty is None else uncertainty.covariance,
        degrees=inf if uncertainty is None else uncertainty.degrees,
        noise_sd=None if uncertainty is None else uncertainty.noise_sd,
        noise_colour=None if uncertainty is None else uncertainty.noise_colour,
        noise_model=_get_noise_model(problem, times),
        correlation_times=times,
        noise_deviations=None
        if problem.settings.weights is not None
        else problem.settings.deviations,
        residual_tests=tests,
        onset_delays=estimate_onset_delays(problem.model, problem.records),
        time_unit=(*problem.records[0].inputs, *problem.records[0].outputs)[0].time_unit,
        data_bounds=tuple(p.name for p in problem.free_parameters if p.bounds is not None),
        input_hold=holds,
        commands=problem.settings.commands or (),
        known_before=KnownBefore(
            _compute_input_history(problem),
            () if validation is None else _compute_input_history(validation),
        ),
        search=evidence,
        posterior=posterior,
        order_comparison=orders,
        delays=tuple(sorted(delays)),
        findings=findings,
        explained=explained.is_done,
        verdict=conclude_verdict(analysis.estimates, findings, declared),
        warnings=list_warnings(findings),
        substeps=problem.model.solver.substeps,
        initial=_get_start(problem, best.starts),
        plant_noise=describe_plant_noise(problem, theta, metrics.rms),
        selection=() if problem.model.selection is None else problem.model.selection.terms,
        history=_extend_histories(best.state, best.ends),
        migrations=state.migrations,
        simulated=split_outputs(problem, problem.predict_ahead(theta[None])[0][0]),
        simulated_validation=() if validated is None else validated.simulated,
        sample_time=problem.share("sample time", lambda: find_common_sample_time(problem.records)),
    )


def _measure_free_run(problem: Problem, theta: FloatArray) -> Yardstick | None:
    """Compare the free run beside a filter with a linear black box, but in a loop.

    It is fitted by squares first, from estimated starts if it may have them. The comparison is safe
    because the model was fitted to the samples that it is compared on. An unstable plant is
    recorded in a loop, and its free run is of no use.
    """
    if not problem.model.corrections:
        return None
    free, point = convert_to_free_run(problem, theta)
    if compute_growth(free, point) >= MIN_GROWTH:
        return None
    started = free
    with suppress(SysidError):  # some model has no such start
        started = free.rebuild(initial="free")
    free, point = started, convert_point(free, started, point)
    (end,) = refine_candidates(free, [point])
    simulated = free.predict((point if end is None else end.theta)[None])[0]
    if describe_feedback(list_residual_series(free, simulated)):
        return None
    return fit_yardstick(free, simulated)


def _describe_identifiability(uncertainty: Uncertainty | None) -> Identifiability:
    if uncertainty is None:
        return Identifiability(None, (), np.zeros(0))
    return Identifiability(uncertainty.condition, uncertainty.groups, uncertainty.singular_values)


def _get_start(problem: Problem, starts: StartComparison | None) -> StartKind | None:
    """Get the start that the estimates assume; None for that of the model's document."""
    if starts is not None:
        return starts.own.name
    initial = problem.settings.initial
    return None if initial == "auto" else initial


def _get_noise_model(problem: Problem, times: Mapping[str, float]) -> FoundNoiseModel:
    """Get the noise model of the estimates; ``ar1`` was not taken where no noise is coloured."""
    asked = problem.loss.noise_model
    if asked == "plant" or asked == "load" or asked == "drift":
        return asked
    return "ar1" if any(times.values()) else "white"


def _compute_input_history(problem: Problem) -> tuple[float, ...]:
    """Compute the recorded input time (s) before the scored part of each experiment."""
    scored_from = problem.settings.scored_from or tuple(record.start for record in problem.records)
    return tuple(
        record.history_duration + max(start - record.start, 0.0)
        for record, start in zip(problem.records, scored_from, strict=True)
    )


def _list_notes(explanation: str, texts: Iterable[str]) -> list[Finding]:
    return [note(explanation, "numerics", text) for text in texts]


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
