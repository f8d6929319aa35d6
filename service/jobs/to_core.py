"""Conversion of stored and wire documents to values of the numerical core.

It is separate from the wire types, so that a client does not load NumPy.
"""

from collections.abc import Mapping
from typing import Any

from sysid.core.settings import (
    FitSettings,
    GeneticAlgorithm,
    IslandChange,
    Loss,
    Migration,
    SequenceSearch,
    Stop,
)


def to_algorithm(document: Mapping[str, Any]) -> GeneticAlgorithm:
    """Build the search settings from the ``algorithm`` of a job body in its normal form.

    Raises
    ------
    InvalidSettings
        With the pointer of the field that cannot be used.
    """
    fields = dict(document)
    fields["mutation"] = _to_schedule(fields["mutation"])
    fields["sequence"] = SequenceSearch(**fields["sequence"])
    fields["migration"] = Migration(**fields["migration"])
    fields["stop"] = Stop(**fields["stop"])
    if isinstance(fields["islands"], list):
        fields["islands"] = tuple(_to_island_change(change) for change in fields["islands"])
    return GeneticAlgorithm(**fields)


def to_loss(document: Mapping[str, Any]) -> Loss:
    """Build the loss from the ``loss`` of a job body.

    Raises
    ------
    InvalidSettings
        If its kind or scale cannot be used.
    """
    return Loss(**document)


def fit_settings_of(body: Mapping[str, Any]) -> FitSettings:
    """Build the fit settings, without model and records, from a job body in its normal form.

    Raises
    ------
    InvalidSettings
        If a setting cannot be used.
    """
    return FitSettings(
        parameters=body["parameters"],
        prediction=body["prediction"],
        loss=to_loss(body["loss"]),
        weights=body["weights"],
        skip=body["skip"],
    )


def _to_island_change(change: Mapping[str, Any]) -> IslandChange:
    mutation = change.get("mutation")
    return IslandChange(
        method=change.get("method"),
        bits=change.get("bits"),
        mutation=None if mutation is None else _to_schedule(mutation),
    )


def _to_schedule(pairs: Any) -> tuple[tuple[int, float], ...]:
    return tuple((int(generation), float(rate)) for generation, rate in pairs)
