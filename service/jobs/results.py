"""Readers of stored result documents."""

from collections.abc import Mapping
from typing import Any

from sysid.residuals.residual_tests import ResidualTest
from sysid.results.result import SearchEvidence
from sysid.results.verdict import Evidence, Verdict, judge_result
from sysid.uncertainty.estimates import Estimate

VERDICT_PARTS = ("verdict", "valid", "parameters", "fit_percent", "search", "residual_tests")
"""Parts of a result that `read_verdict` reads."""


def is_free(estimate: Mapping[str, Any]) -> bool:
    """Test whether an entry of ``parameters`` was estimated, that is, neither fixed nor tied."""
    return estimate["status"] not in ("fixed", "tied")


def read_noise_model(result: Mapping[str, Any]) -> str:
    """Read the noise model that the estimates used, whatever the request asked for."""
    return "ar1" if any((result.get("correlation_times") or {}).values()) else "white"


def to_verdict_document(verdict: Verdict) -> dict[str, Any]:
    """Convert a verdict to a part of a result document."""
    return {
        "trust": verdict.trust,
        "text": verdict.text,
        "reasons": [
            {"severity": reason.severity, "brief": reason.brief, "text": reason.text}
            for reason in verdict.reasons
        ],
    }


def read_verdict(result: Mapping[str, Any]) -> dict[str, Any]:
    """Read the verdict of a result; one of an earlier version is judged now."""
    verdict: dict[str, Any] | None = result.get("verdict")
    return verdict or to_verdict_document(judge_result(_read_evidence(result)))


def _read_evidence(result: Mapping[str, Any]) -> Evidence:
    fit, search = result.get("fit_percent") or {}, result.get("search") or {}
    tests = (result.get("residual_tests") or {}).get("tests", ())
    return Evidence(
        estimates=[_read_estimate(entry) for entry in result.get("parameters") or ()],
        valid=result.get("valid") is not False,
        fit_percent=fit.get("estimation"),
        fit_percent_validation=fit.get("validation"),
        search=SearchEvidence(
            search["settled"],
            search["because"],
            search["independent_starts"],
            search["agreeing_starts"],
        )
        if search
        else None,
        tests=[_read_test(entry) for entry in tests],
        delays=tuple(result.get("delays") or ()),
    )


def _read_estimate(entry: Mapping[str, Any]) -> Estimate:
    names = "name", "unit", "value", "lower", "upper", "stderr", "interval95", "status"
    return Estimate(*(entry[name] for name in names))


def _read_test(entry: Mapping[str, Any]) -> ResidualTest:
    experiment, output, kind, signal, outcome, samples = (
        entry[name] for name in ("experiment", "output", "test", "input", "outcome", "samples")
    )
    return ResidualTest(experiment, output, kind, signal, outcome, samples, p=entry.get("p"))
