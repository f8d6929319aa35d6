"""Residual tests and onset delays as documents: what a result stores of them, and the answers."""

import math
from collections.abc import Sequence
from typing import Any

from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import LEVEL, ResidualTest, ResidualTests


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
