"""From an identification to what is stored of it: pure functions."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from service.evidence import onset_document, residual_document
from service.storage.ledger import HistoryPoint, MigrantPoint, RunOutcome
from service.storage.tables import State
from sysid.metrics import ChannelMetrics
from sysid.result import (
    Criteria,
    Estimate,
    Group,
    Identification,
    Improvement,
    Migrant,
    Uncertainty,
)


def outcome_of(run: str, found: Identification, seconds: float, signals: str | None) -> RunOutcome:
    """The row of a run that succeeded."""
    return RunOutcome(
        run_id=run,
        state=State.SUCCEEDED,
        result=result_document(found, seconds),
        valid=found.valid,
        best_rms=_finite(found.rms),
        fit_estimation=_finite(found.fit_percent),
        fit_validation=_finite(found.fit_percent_validation),
        evaluations=found.evaluations,
        generations=found.generations,
        seconds=seconds,
        signals_sha256=signals,
    )


def result_document(found: Identification, seconds: float) -> dict[str, Any]:
    """The result as the interface tells it; numbers that are not finite become null."""
    return {
        "valid": found.valid,
        "parameters": [_estimate(one) for one in found.estimates],
        "rms": _finite(found.rms),
        "rms_validation": _finite(found.rms_validation),
        "fit_percent": {
            "estimation": _finite(found.fit_percent),
            "validation": _finite(found.fit_percent_validation),
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
                "champion_rms": _finite(island.champion_rms),
                "refined_rms": _finite(island.refined_rms),
                "evaluations": island.evaluations,
                "parameters": [_finite(value) for value in island.parameters],
            }
            for island in found.islands
        ],
        "identifiability": _identifiability(found.uncertainty),
        "criteria": _criteria(found.criteria),
        "correlation": _correlation(found.uncertainty),
        "noise_sd": None if found.uncertainty is None else _finite(found.uncertainty.noise_sd),
        "residual_tests": residual_document(found.residual_tests),
        "onset_delays": onset_document(found.onset_delays),
        "warnings": list(found.warnings),
        "selection": [one._asdict() for one in found.selection],
    }


def history_points(
    run: str, history: tuple[tuple[Improvement, ...], ...], written: Mapping[int, int]
) -> Iterator[HistoryPoint]:
    """Improvements beyond the first `written` of each island."""
    for island, improvements in enumerate(history):
        first = written.get(island, 0)
        for number, one in enumerate(improvements[first:], start=first):
            if math.isfinite(one.rms):
                yield HistoryPoint(
                    run, island, number, int(one.generation), int(one.evaluations),
                    float(one.rms), one.phase, [float(value) for value in one.parameters],
                )  # fmt: skip


def migrant_points(run: str, migrants: tuple[Migrant, ...], written: int) -> Iterator[MigrantPoint]:
    """Migrants beyond the first `written`."""
    for number, one in enumerate(migrants[written:], start=written):
        if math.isfinite(one.fitness):
            yield MigrantPoint(
                run, number, int(one.epoch), int(one.source), int(one.destination),
                float(one.fitness),
            )  # fmt: skip


def _estimate(one: Estimate) -> dict[str, Any]:
    return {
        "name": one.name,
        "unit": one.unit,
        "value": float(one.value),
        "lower": float(one.lower),
        "upper": float(one.upper),
        "stderr": _finite(one.stderr),
        "interval95": None if one.interval95 is None else [_finite(v) for v in one.interval95],
        "status": one.status,
        "reason": one.reason,
    }


def _agreement(one: ChannelMetrics) -> dict[str, Any]:
    return {
        "experiment": one.experiment,
        "output": one.output,
        "unit": one.unit,
        "samples": one.samples,
        "rms": _finite(one.rms),
        "fit_percent": _finite(one.fit_percent),
    }


def _identifiability(uncertainty: Uncertainty | None) -> dict[str, Any]:
    if uncertainty is None:
        return {"condition": None, "groups": [], "singular_values": []}
    return {
        "condition": _finite(uncertainty.condition),
        "groups": [_group(one) for one in uncertainty.groups],
        "singular_values": [_finite(value) for value in uncertainty.singular_values],
    }


def _group(one: Group) -> dict[str, Any]:
    return {
        "members": list(one.members),
        "expression": one.expression,
        "value": _finite(one.value),
        "stderr": _finite(one.stderr),
    }


def _criteria(one: Criteria | None) -> dict[str, Any] | None:
    if one is None:
        return None
    return {
        "aic": _finite(one.aic),
        "aicc": _finite(one.aicc),
        "bic": _finite(one.bic),
        "samples": one.samples,
        "parameters": one.parameters,
    }


def _correlation(uncertainty: Uncertainty | None) -> dict[str, Any] | None:
    if uncertainty is None:
        return None
    rows = np.asarray(uncertainty.correlation)
    matrix = [[_finite(value) for value in row] for row in rows]
    return {"names": list(uncertainty.names), "matrix": matrix}


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
