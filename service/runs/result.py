"""The result of an identification as the interface tells it: a document, from pure functions.

Residual tests and onset delays as documents: what a result stores of them, and the answers.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from service.core.documents import to_finite
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
        "inside95": to_finite(one.inside95),
        "inside99": to_finite(one.inside99),
        "statistic": to_finite(one.statistic),
        "degrees": to_finite(one.degrees),
        "p": to_finite(one.p),
    }


def onset_document(found: Sequence[OnsetDelay]) -> list[dict[str, Any]]:
    """Onset delays in seconds; one that cannot be told is null and says why."""
    return [
        {
            "experiment": one.experiment,
            "input": one.input,
            "output": one.output,
            "delay": to_finite(one.delay),
            "unit": "s",
            "spread": to_finite(one.spread),
            "events": one.events,
            "threshold": to_finite(one.threshold),
            "reason": one.reason,
        }
        for one in found
    ]


def result_document(found: Identification, seconds: float) -> dict[str, Any]:
    """The result as the interface tells it; numbers that are not finite become null."""
    return {
        "valid": found.valid,
        "parameters": [_estimate(one) for one in found.estimates],
        "rms": to_finite(found.rms),
        "rms_validation": to_finite(found.rms_validation),
        "fit_percent": {
            "estimation": to_finite(found.fit_percent),
            "validation": to_finite(found.fit_percent_validation),
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
                "champion_rms": to_finite(island.champion_rms),
                "refined_rms": to_finite(island.refined_rms),
                "evaluations": island.evaluations,
                "parameters": [to_finite(value) for value in island.parameters],
            }
            for island in found.islands
        ],
        "identifiability": _identifiability(found.uncertainty),
        "criteria": _criteria(found.criteria),
        "correlation": _correlation(found.uncertainty),
        "noise_sd": None if found.uncertainty is None else to_finite(found.uncertainty.noise_sd),
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
        "stderr": to_finite(one.stderr),
        "interval95": None if one.interval95 is None else [to_finite(v) for v in one.interval95],
        "status": one.status,
        "reason": one.reason,
    }


def _agreement(one: ChannelMetrics) -> dict[str, Any]:
    return {
        "experiment": one.experiment,
        "output": one.output,
        "unit": one.unit,
        "samples": one.samples,
        "rms": to_finite(one.rms),
        "fit_percent": to_finite(one.fit_percent),
        "span": [to_finite(value) for value in one.span],
    }


def _identifiability(uncertainty: Uncertainty | None) -> dict[str, Any]:
    if uncertainty is None:
        return {"condition": None, "groups": [], "singular_values": []}
    return {
        "condition": to_finite(uncertainty.condition),
        "groups": [_group(one) for one in uncertainty.groups],
        "singular_values": [to_finite(value) for value in uncertainty.singular_values],
    }


def _group(one: Group) -> dict[str, Any]:
    return {
        "members": list(one.members),
        "expression": one.expression,
        "value": to_finite(one.value),
        "stderr": to_finite(one.stderr),
    }


def _criteria(one: Criteria | None) -> dict[str, Any] | None:
    if one is None:
        return None
    return {
        "aic": to_finite(one.aic),
        "aicc": to_finite(one.aicc),
        "bic": to_finite(one.bic),
        "samples": one.samples,
        "parameters": one.parameters,
    }


def _correlation(uncertainty: Uncertainty | None) -> dict[str, Any] | None:
    if uncertainty is None:
        return None
    rows = np.asarray(uncertainty.correlation)
    matrix = [[to_finite(value) for value in row] for row in rows]
    return {"names": list(uncertainty.names), "matrix": matrix}
