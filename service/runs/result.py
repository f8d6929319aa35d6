"""The result of an identification as the interface tells it: a document, from pure functions.

Residual tests and onset delays as documents: what a result stores of them, and the answers.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sysid.identifiability.combinations import Group
from sysid.identification.result import Identification
from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import LEVEL, ResidualTest, ResidualTests
from sysid.simulation.metrics import ChannelMetrics
from sysid.uncertainty.estimates import Criteria, Estimate, Uncertainty


def residual_document(found: ResidualTests | None) -> dict[str, Any]:
    """Verdicts and statistics, without the correlation functions; empty if there was no test."""
    if found is None:
        return {}
    return {
        "data": found.data,
        "level": LEVEL,
        "passed": found.passed,
        "tests": [test_document(one) for one in found.tests],
    }


def test_document(one: ResidualTest) -> dict[str, Any]:
    """One test; what was not tested has null for its numbers, and says why."""
    return {
        "experiment": one.experiment,
        "output": one.output,
        "test": one.kind,
        "input": one.input,
        "outcome": one.outcome,
        "reason": one.reason,
        "samples": one.samples,
        "lags_tested": one.lags,
        "inside95": _finite(one.inside95),
        "inside99": _finite(one.inside99),
        "statistic": _finite(one.statistic),
        "degrees": _finite(one.degrees),
        "p": _finite(one.p),
    }


def onset_document(found: Sequence[OnsetDelay]) -> list[dict[str, Any]]:
    """Onset delays in seconds; one that cannot be told is null and says why."""
    return [
        {
            "experiment": one.experiment,
            "input": one.input,
            "output": one.output,
            "delay": _finite(one.delay),
            "unit": "s",
            "spread": _finite(one.spread),
            "events": one.events,
            "threshold": _finite(one.threshold),
            "reason": one.reason,
        }
        for one in found
    ]


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def result_document(found: Identification, seconds: float) -> dict[str, Any]:
    """The result as the interface tells it; numbers that are not finite become null."""
    return {
        "valid": found.valid,
        "parameters": [_estimate(one) for one in found.estimates],
        "rms": finite(found.rms),
        "rms_validation": finite(found.rms_validation),
        "fit_percent": {
            "estimation": finite(found.fit_percent),
            "validation": finite(found.fit_percent_validation),
        },
        "agreement": {
            "estimation": [_agreement(one) for one in found.agreement],
            "validation": [_agreement(one) for one in found.agreement_validation],
        },
        "evaluations": found.evaluations,
        "generations": found.generations,
        "seconds": seconds,
        "islands": [
            {
                "champion_rms": finite(island.champion_rms),
                "refined_rms": finite(island.refined_rms),
                "evaluations": island.evaluations,
                "parameters": [finite(value) for value in island.parameters],
            }
            for island in found.islands
        ],
        "identifiability": _identifiability(found.uncertainty),
        "criteria": _criteria(found.criteria),
        "correlation": _correlation(found.uncertainty),
        "noise_sd": None if found.uncertainty is None else finite(found.uncertainty.noise_sd),
        "noise_colour": None if found.uncertainty is None else found.uncertainty.noise_colour,
        "noise_model": found.noise_model,
        "correlation_times": dict(found.correlation_times),
        "residual_tests": residual_document(found.residual_tests),
        "onset_delays": onset_document(found.onset_delays),
        "known_before": {
            "estimation": list(found.known_before),
            "validation": list(found.known_before_validation),
        },
        "warnings": list(found.warnings),
        "selection": [one._asdict() for one in found.selection],
    }


def _estimate(one: Estimate) -> dict[str, Any]:
    return {
        "name": one.name,
        "unit": one.unit,
        "value": float(one.value),
        "lower": float(one.lower),
        "upper": float(one.upper),
        "stderr": finite(one.stderr),
        "interval95": None if one.interval95 is None else [finite(v) for v in one.interval95],
        "status": one.status,
        "reason": one.reason,
    }


def _agreement(one: ChannelMetrics) -> dict[str, Any]:
    return {
        "experiment": one.experiment,
        "output": one.output,
        "unit": one.unit,
        "samples": one.samples,
        "rms": finite(one.rms),
        "fit_percent": finite(one.fit_percent),
        "span": [finite(value) for value in one.span],
    }


def _identifiability(uncertainty: Uncertainty | None) -> dict[str, Any]:
    if uncertainty is None:
        return {"condition": None, "groups": [], "singular_values": []}
    return {
        "condition": finite(uncertainty.condition),
        "groups": [_group(one) for one in uncertainty.groups],
        "singular_values": [finite(value) for value in uncertainty.singular_values],
    }


def _group(one: Group) -> dict[str, Any]:
    return {
        "members": list(one.members),
        "expression": one.expression,
        "value": finite(one.value),
        "stderr": finite(one.stderr),
    }


def _criteria(one: Criteria) -> dict[str, Any]:
    return {
        "aic": finite(one.aic),
        "aicc": finite(one.aicc),
        "bic": finite(one.bic),
        "samples": one.samples,
        "parameters": one.parameters,
    }


def _correlation(uncertainty: Uncertainty | None) -> dict[str, Any] | None:
    if uncertainty is None:
        return None
    rows = np.asarray(uncertainty.correlation)
    matrix = [[finite(value) for value in row] for row in rows]
    return {"names": list(uncertainty.names), "matrix": matrix}


def finite(value: float | None) -> float | None:
    """The number, or None where it is not finite: JSON has no such numbers."""
    return None if value is None or not math.isfinite(value) else float(value)
