"""Conversion of an identification to the result document, with residual tests and onset delays."""

from collections.abc import Sequence
from types import NoneType
from typing import Any

import numpy as np

from service.core.documents import to_finite
from service.jobs.results import to_verdict_document
from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import TEST_LEVEL, ResidualTest, ResidualTests
from sysid.results.result import Identification, InputHold, OrderComparison
from sysid.simulation.metrics import ChannelMetrics
from sysid.uncertainty.estimates import Criteria, Estimate, Uncertainty


def to_residual_document(tests: ResidualTests | None) -> dict[str, Any]:
    """Convert verdicts and statistics, without correlation functions; empty without tests."""
    if tests is None:
        return {}
    return {
        "data": tests.data,
        "level": TEST_LEVEL,
        "passed": tests.passed,
        "tests": [to_test_document(test) for test in tests.tests],
    }


def to_test_document(test: ResidualTest) -> dict[str, Any]:
    """Convert one test. Numbers that were not computed are null, with a reason."""
    return {
        **_read(test, "experiment", "output"),
        "test": test.kind,
        **_read(test, "input", "outcome", "reason", "samples"),
        "lags_tested": test.lags,
        **_read(test, "inside95", "inside99", "statistic", "degrees", "p"),
    }


def to_onset_document(onsets: Sequence[OnsetDelay]) -> list[dict[str, Any]]:
    """Convert onset delays in seconds. One that cannot be estimated is null, with a reason."""
    return [
        {
            **_read(onset, "experiment", "input", "output", "delay"),
            "unit": "s",
            **_read(onset, "spread", "events", "threshold", "reason"),
        }
        for onset in onsets
    ]


def to_result_document(identification: Identification, seconds: float) -> dict[str, Any]:
    """Convert an identification to its result document; non-finite numbers become null."""
    return {
        "valid": identification.valid,
        "parameters": [_to_estimate_document(estimate) for estimate in identification.estimates],
        "rms": to_finite(identification.rms),
        "rms_validation": to_finite(identification.rms_validation),
        "fit_percent": {
            "estimation": to_finite(identification.fit_percent),
            "validation": to_finite(identification.fit_percent_validation),
        },
        "agreement": {
            "estimation": [_to_agreement_document(metrics) for metrics in identification.agreement],
            "validation": [
                _to_agreement_document(metrics) for metrics in identification.agreement_validation
            ],
        },
        "evaluations": identification.evaluations,
        "generations": identification.generations,
        "seconds": seconds,
        "islands": [
            _read(island, "champion_rms", "refined_rms", "evaluations", "parameters")
            for island in identification.islands
        ],
        "identifiability": _to_identifiability_document(identification.uncertainty),
        "criteria": _to_criteria_document(identification.criteria),
        "correlation": _to_correlation_document(identification.uncertainty),
        "noise_sd": None
        if identification.uncertainty is None
        else to_finite(identification.uncertainty.noise_sd),
        "noise_colour": None
        if identification.uncertainty is None
        else identification.uncertainty.noise_colour,
        "noise_model": identification.noise_model,
        "correlation_times": dict(identification.correlation_times),
        "noise_deviations": identification.noise_deviations,
        "residual_tests": to_residual_document(identification.residual_tests),
        "onset_delays": to_onset_document(identification.onset_delays),
        "data_bounds": list(identification.data_bounds),
        "input_hold": [_to_hold_document(hold) for hold in identification.input_holds],
        "known_before": {
            "estimation": list(identification.known_before),
            "validation": list(identification.known_before_validation),
        },
        "search": _to_search_document(identification),
        "posterior": _to_posterior_document(identification),
        "order_comparison": _to_order_document(identification.order_comparison),
        "delays": list(identification.delays),
        "verdict": to_verdict_document(identification.verdict),
        "warnings": list(identification.warnings),
        "substeps": identification.substeps,
        "selection": [step._asdict() for step in identification.selection],
    }


def _to_estimate_document(estimate: Estimate) -> dict[str, Any]:
    return _read(
        estimate,
        "name",
        "unit",
        "value",
        "lower",
        "upper",
        "stderr",
        "interval95",
        "status",
        "reason",
    )


def _to_hold_document(hold: InputHold) -> dict[str, Any]:
    others = hold.estimates_other
    return {
        **_read(hold, "input", "chosen", "reason", "other"),
        "estimates_other": None
        if others is None
        else {name: to_finite(value) for name, value in others.items()},
        **_read(hold, "rms_other"),
    }


def _to_agreement_document(metrics: ChannelMetrics) -> dict[str, Any]:
    return _read(metrics, "experiment", "output", "unit", "samples", "rms", "fit_percent", "span")


def _to_search_document(identification: Identification) -> dict[str, Any]:
    """Convert the evidence of the whole search, with the minima that were found."""
    evidence = identification.search
    return {
        **_read(evidence, "settled", "because", "independent_starts", "agreeing_starts"),
        "minima": [
            {
                "parameters": dict(zip(evidence.names, minimum.values.tolist(), strict=True)),
                "rms": to_finite(minimum.rms),
                "likelihood_ratio": to_finite(minimum.likelihood_ratio),
                **_read(minimum, "count", "independent", "is_compatible", "recorded_from"),
            }
            for minimum in evidence.minima
        ],
    }


def _to_posterior_document(identification: Identification) -> dict[str, Any] | None:
    """Convert the samples of the posterior; None if they were not requested."""
    posterior = identification.posterior
    if posterior is None:
        return None
    names = [parameter.name for parameter in posterior.parameters]
    return {
        "converged": posterior.is_converged,
        **_read(posterior, "reason", "walkers", "steps", "acceptance", "evaluations"),
        "parameters": [
            _read(parameter, "name", "unit", "median", "interval95", "effective_samples")
            for parameter in posterior.parameters
        ],
        "correlation": {"names": names, "matrix": _to_json(posterior.correlation[: len(names)])},
        "samples": [[float(f"{value:.8g}") for value in row] for row in posterior.samples],
    }


def _to_order_document(comparison: OrderComparison | None) -> dict[str, Any] | None:
    """Convert the comparison of orders; None if there is none."""
    if comparison is None:
        return None
    return {
        **_read(
            comparison, "model", "preferred_model", "delay", "unit", "delay_range", "noise_model"
        ),
        "fits": [
            {
                **_read(fit, "model", "order", "delay", "delay_stderr", "rms", "bic"),
                "values": {name: to_finite(value) for name, value in fit.values.items()},
                "is_open": fit in comparison.open_fits,
            }
            for fit in comparison.fits
        ],
    }


def _to_identifiability_document(uncertainty: Uncertainty | None) -> dict[str, Any]:
    if uncertainty is None:
        return {"condition": None, "groups": [], "singular_values": []}
    groups = [
        _read(group, "members", "expression", "value", "stderr", "is_local")
        for group in uncertainty.groups
    ]
    return {
        **_read(uncertainty, "condition"),
        "groups": groups,
        **_read(uncertainty, "singular_values"),
    }


def _to_criteria_document(criteria: Criteria) -> dict[str, Any]:
    return _read(criteria, "aic", "aicc", "bic", "samples", "parameters")


def _to_correlation_document(uncertainty: Uncertainty | None) -> dict[str, Any] | None:
    if uncertainty is None:
        return None
    return {"names": list(uncertainty.names), "matrix": _to_json(uncertainty.correlation)}


def _read(source: object, *names: str) -> dict[str, Any]:
    """Read attributes of a value as a document."""
    return {name: _to_json(getattr(source, name)) for name in names}


def _to_json(value: Any) -> Any:
    """Convert a value to JSON: arrays to lists, non-finite numbers to null."""
    if type(value) in _PLAIN:  # most values: the quickest way
        return value
    if isinstance(value, float):
        return to_finite(value)
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and np.isfinite(value).all():
        return value.tolist()
    if isinstance(value, tuple | list | np.ndarray):
        return [_to_json(item) for item in value]
    return value


_PLAIN = frozenset({NoneType, str, int, bool})
