"""Conversion of an identification to the result document, with residual tests and onset delays."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from service.core.documents import to_finite
from sysid.identification.result import Identification
from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import TEST_LEVEL, ResidualTest, ResidualTests
from sysid.simulation.metrics import ChannelMetrics
from sysid.uncertainty.estimates import Criteria, Estimate, Uncertainty


def to_residual_document(found: ResidualTests | None) -> dict[str, Any]:
    """Convert verdicts and statistics, without correlation functions; empty without tests."""
    if found is None:
        return {}
    return {
        "data": found.data,
        "level": TEST_LEVEL,
        "passed": found.passed,
        "tests": [to_test_document(one) for one in found.tests],
    }


def to_test_document(one: ResidualTest) -> dict[str, Any]:
    """Convert one test. Numbers that were not computed are null, with a reason."""
    return {
        **_read(one, "experiment", "output"),
        "test": one.kind,
        **_read(one, "input", "outcome", "reason", "samples"),
        "lags_tested": one.lags,
        **_read(one, "inside95", "inside99", "statistic", "degrees", "p"),
    }


def to_onset_document(found: Sequence[OnsetDelay]) -> list[dict[str, Any]]:
    """Convert onset delays in seconds. One that cannot be estimated is null, with a reason."""
    return [
        {
            **_read(one, "experiment", "input", "output", "delay"),
            "unit": "s",
            **_read(one, "spread", "events", "threshold", "reason"),
        }
        for one in found
    ]


def to_result_document(found: Identification, seconds: float) -> dict[str, Any]:
    """Convert an identification to its result document; non-finite numbers become null."""
    return {
        "valid": found.valid,
        "parameters": [_to_estimate_document(one) for one in found.estimates],
        "rms": to_finite(found.rms),
        "rms_validation": to_finite(found.rms_validation),
        "fit_percent": {
            "estimation": to_finite(found.fit_percent),
            "validation": to_finite(found.fit_percent_validation),
        },
        "agreement": {
            "estimation": [_to_agreement_document(one) for one in found.agreement],
            "validation": [_to_agreement_document(one) for one in found.agreement_validation],
        },
        "evaluations": found.evaluations,
        "generations": found.generations,
        "seconds": seconds,
        "islands": [
            _read(island, "champion_rms", "refined_rms", "evaluations", "parameters")
            for island in found.islands
        ],
        "identifiability": _to_identifiability_document(found.uncertainty),
        "criteria": _to_criteria_document(found.criteria),
        "correlation": _to_correlation_document(found.uncertainty),
        "noise_sd": None if found.uncertainty is None else to_finite(found.uncertainty.noise_sd),
        "noise_colour": None if found.uncertainty is None else found.uncertainty.noise_colour,
        "noise_model": found.noise_model,
        "correlation_times": dict(found.correlation_times),
        "residual_tests": to_residual_document(found.residual_tests),
        "onset_delays": to_onset_document(found.onset_delays),
        "known_before": {
            "estimation": list(found.known_before),
            "validation": list(found.known_before_validation),
        },
        "warnings": list(found.warnings),
        "selection": [one._asdict() for one in found.selection],
    }


def _to_estimate_document(one: Estimate) -> dict[str, Any]:
    return _read(
        one, "name", "unit", "value", "lower", "upper", "stderr", "interval95", "status", "reason"
    )


def _to_agreement_document(one: ChannelMetrics) -> dict[str, Any]:
    return _read(one, "experiment", "output", "unit", "samples", "rms", "fit_percent", "span")


def _to_identifiability_document(uncertainty: Uncertainty | None) -> dict[str, Any]:
    if uncertainty is None:
        return {"condition": None, "groups": [], "singular_values": []}
    groups = [_read(one, "members", "expression", "value", "stderr") for one in uncertainty.groups]
    return {
        **_read(uncertainty, "condition"),
        "groups": groups,
        **_read(uncertainty, "singular_values"),
    }


def _to_criteria_document(one: Criteria) -> dict[str, Any]:
    return _read(one, "aic", "aicc", "bic", "samples", "parameters")


def _to_correlation_document(uncertainty: Uncertainty | None) -> dict[str, Any] | None:
    if uncertainty is None:
        return None
    return {"names": list(uncertainty.names), "matrix": _to_json(uncertainty.correlation)}


def _read(source: object, *names: str) -> dict[str, Any]:
    """Read attributes of a value as a document."""
    return {name: _to_json(getattr(source, name)) for name in names}


def _to_json(value: Any) -> Any:
    """Convert a value to JSON: arrays to lists, non-finite numbers to null."""
    if isinstance(value, float):
        return to_finite(value)
    if isinstance(value, tuple | list | np.ndarray):
        return [_to_json(item) for item in value]
    return value
