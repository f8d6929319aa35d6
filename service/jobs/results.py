"""Readers of stored result documents."""

from collections.abc import Mapping
from typing import Any

from sysid.results.verdict import Verdict


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
    """Read the verdict of a result."""
    verdict: dict[str, Any] = result["verdict"]
    return verdict
