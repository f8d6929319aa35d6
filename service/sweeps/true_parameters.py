"""True parameters of simulated recordings."""

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy.orm import Session

from service.models import models
from service.storage.tables import Dataset
from sysid.models.model import EstimatedInitial, Model, name_initial_state


def find_true_parameters(
    session: Session, reference: Any, datasets: Sequence[Dataset]
) -> dict[str, float] | None:
    """Find the true values of a model's parameters and initial states, by their names in a result.

    None unless every dataset was simulated from this very model with the same parameters. Another
    model's parameters may have the same names but another meaning.
    """
    model, stored = models.resolve_model(session, reference)
    truths = [
        _read_true_parameters(model, stored, row, number) for number, row in enumerate(datasets)
    ]
    if not truths or any(truth is None for truth in truths):
        return None
    values: dict[str, float] = {}
    for truth in truths:
        for name, value in (truth or {}).items():
            if values.setdefault(name, value) != value:
                return None
    return values


def _read_true_parameters(
    model: Model, stored: Any, row: Dataset, number: int
) -> dict[str, float] | None:
    source = row.details.get("simulation") if row.kind == "simulate" else None
    if not isinstance(source, Mapping) or source.get("model") != stored:
        return None
    stored_values: Mapping[str, float] = row.details.get("true_parameters") or {}
    values = {p.name: p.fixed for p in model.parameters if p.fixed is not None}
    names = {p.name for p in model.parameters}
    values |= {name: float(value) for name, value in stored_values.items() if name in names}
    for state, start in zip(model.states, model.initial, strict=True):
        if isinstance(start, EstimatedInitial):
            values[name_initial_state(state.name, number)] = float(
                stored_values.get(f"{state.name}(0)", 0.0)
            )
    return values
