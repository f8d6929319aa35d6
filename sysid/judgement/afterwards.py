"""Explain the residuals of a result that was concluded without it, such as that of a sweep's run.

A sweep concludes many runs, of which few are looked at. So their residuals are explained when
somebody does, from the stored estimate. Then starts are compared too: another one is a finding. And
the other reading of an input is tried before it is advised.
"""

from dataclasses import replace

import numpy as np

from sysid.core.threads import use_one_thread
from sysid.judgement.conclusions import (
    conclude_estimates,
    conclude_verdict,
    list_warnings,
    order_findings,
)
from sysid.judgement.input_hold import find_hold_doubts, find_other_readings
from sysid.judgement.judge import Explained, explain_residuals, select_explanations
from sysid.judgement.levels import SOLVER_SHARE
from sysid.judgement.noise_findings import find_unexplained
from sysid.judgement.preparation import find_record_events
from sysid.judgement.residual_context import ResidualContext, Simulations
from sysid.judgement.starts import compare_starts, find_open_starts
from sysid.results.result import Result
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate


def explain_afterwards(problem: Problem, result: Result, simulations: Simulations) -> Result:
    """Explain the residuals of a result, and conclude statuses, verdict and warnings anew.

    `problem` is the one that the result solves; `simulations` counts what was spent. A result that
    is explained already is returned as it is. So is one whose residuals cannot be explained, or are
    those of the integration.
    """
    if result.explained or result.rms <= SOLVER_SHARE * problem.output_scale:
        return result
    values = result.parameter_values
    theta = np.array([values[name] for name in problem.free_names])
    with use_one_thread():
        analysis = analyse_estimate(problem, theta)
        explained = explain_residuals(ResidualContext(problem, theta, analysis, simulations))
        starts = compare_starts(problem, theta, problem.settings.initial)
        simulations.spent += analysis.evaluations + (starts.evaluations if starts else 0) + 1
        holds, simulated = result.input_hold, problem.predict(theta[None])[0]
        doubts = find_hold_doubts(problem, holds, theta, simulated, result.rms, simulations)
        readings = find_other_readings(problem, holds, doubts, result.parameters, simulations)
        advice = {one.brief: one.advice for one in readings}
    if not explained.is_done:
        return result
    tests = result.residual_tests
    has_feedback = any(one.explanation == "feedback" for one in result.findings)
    still = list(find_unexplained(tests, explained, analysis))
    answered = [one for one in find_unexplained(tests, Explained(), analysis) if one not in still]
    kept = [
        replace(one, advice=advice.get(one.brief, one.advice))
        for one in result.findings
        if one not in answered
    ]
    compared = [one for one in kept if one.gain is not None and one.family != "start"]
    compared += find_open_starts(starts, result.parameters)
    answers = select_explanations(() if has_feedback else explained.findings, compared)
    findings = order_findings(
        [
            *(one for one in kept if one.gain is None),
            *answers,
            *find_record_events(problem, answers),
        ],
        problem.n_scored,
    )
    estimates = conclude_estimates(result.parameters, findings)
    declared = [parameter.name for parameter in problem.model.parameters]
    return replace(
        result,
        parameters=estimates,
        findings=findings,
        explained=True,
        verdict=conclude_verdict(estimates, findings, declared),
        warnings=list_warnings(findings),
    )
