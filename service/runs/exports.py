"""Use case: export the identified model of a run for other programs."""

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest
from service.core.label_text import write_csv
from service.jobs.stored_run import StoredRun, load_estimated_run
from service.repositories.dataset_rows import DatasetRepository
from service.storage.storage_errors import StorageError
from service.storage.tables import Dataset
from sysid.control.linear_form import Covariance, IdentifiedModel, IdentifiedValue, NotLinear
from sysid.core.errors import InvalidSettings
from sysid.core.text import find_shown_error
from sysid.core.value_documents import encode, list_fields
from sysid.export.export import ExportFormat, write_export
from sysid.export.observer import build_observer
from sysid.models.kalman_filter import is_noise_parameter
from sysid.results.result import Result
from sysid.uncertainty.estimates import Estimate

JobBody = Mapping[str, Any]

_MEDIA_TYPES: Mapping[ExportFormat, tuple[str, str]] = {
    "json": ("application/json", ".json"),
    "python": ("text/x-python", "_model.py"),
    "c": ("text/x-c", ".c"),
    "control": ("text/x-python", "_control.py"),
}

TEXT_TYPES = sorted({kind for kind, _ in _MEDIA_TYPES.values()} - {"application/json"})
"""Media types of the formats that are source code."""


class ExportFile(NamedTuple):
    """File with its text, media type and name."""

    text: str
    media_type: str
    name: str


def export_run(session: Session, run_id: str, format: ExportFormat, pade_order: int) -> ExportFile:
    """Export the model of a run in one of the formats.

    Raises
    ------
    NotFound
        If there is no such run.
    Conflict
        If the run has no estimates.
    InvalidRequest
        If the format cannot express the model; the message names the term.
    """
    stored = load_estimated_run(session, run_id, "export")
    try:
        identified = _build_identified(session, stored)
        assert stored.result is not None  # only an identified model is exported
        observer = build_observer(identified, stored.result)
        text = write_export(identified, format, pade_order, observer)
    except NotLinear as error:
        raise InvalidRequest.from_fault(
            "?format", f"{format!r} is not possible: {error}"
        ) from error
    except InvalidSettings as error:
        name = error.pointer.removeprefix("/")
        raise InvalidRequest.from_fault(
            f"?{name}" if name == "pade_order" else "", str(error)
        ) from error
    media_type, ending = _MEDIA_TYPES[format]
    stem = re.sub(r"[^A-Za-z0-9]+", "_", stored.model.name)
    return ExportFile(text, media_type, stem + ending)


def write_estimates(session: Session, run_id: str) -> str:
    """Write the estimates of a run as CSV, one per row, in the order of the model.

    The error and the interval are empty where `find_shown_error` finds none.

    Raises
    ------
    NotFound
        If there is no such run.
    Conflict
        If the run has no estimates.
    """
    stored = load_estimated_run(session, run_id, "export")
    return write_csv([_ESTIMATE_COLUMNS, *map(_list_cells, stored.estimates)])


def _list_columns() -> dict[str, str]:
    """List the columns of the estimates with their fields: the named ones first, then the others.

    The interval is two columns.
    """
    first = {
        **{"parameter": "name", "value": "value", "stderr": "stderr"},
        **{"interval95_low": "interval95", "interval95_high": "interval95", "unit": "unit"},
        **{"status": "status", "lower_bound": "lower", "upper_bound": "upper"},
    }
    others = [field.name for field in list_fields(Estimate)]
    return first | {name: name for name in others if name not in first.values()}


def _list_cells(estimate: Estimate) -> Iterator[object]:
    """List the cells of an estimate; without an error that is shown, it has no interval."""
    shown = {
        **encode(estimate),
        "stderr": find_shown_error(estimate.stderr, estimate.status),
        "open_ends": " ".join(estimate.open_ends),
    }
    low, high = (None if shown["stderr"] is None else shown["interval95"]) or (None, None)
    ends = {"interval95_low": low, "interval95_high": high}
    for column, field in _ESTIMATE_COLUMNS.items():
        yield ends[column] if column in ends else shown[field]


_ESTIMATE_COLUMNS = _list_columns()


def _build_identified(session: Session, stored: StoredRun) -> IdentifiedModel:
    rows, result = _read_datasets(session, stored.body), stored.result
    assert result is not None  # only an identified model is exported
    values = tuple(_read_values(stored))
    return IdentifiedModel(
        stored.model,
        values,
        _compute_covariance(result, values),
        _find_sample_time(stored, rows),
        {signal.name: result.holds[signal.name] for signal in stored.model.inputs},
        stored.document["version"],
        _describe_provenance(stored, rows),
        dict(_find_units(stored, rows)),
    )


def _read_datasets(session: Session, body: JobBody) -> list[Dataset]:
    """Read the estimation datasets that have not been deleted since."""
    datasets = []
    for name in body["datasets"]:
        try:
            datasets.append(DatasetRepository(session).get(name))
        except StorageError:
            continue
    return datasets


def _read_values(stored: StoredRun) -> Iterator[IdentifiedValue]:
    for one in stored.estimates:
        if not is_noise_parameter(one.name):
            yield IdentifiedValue(one.name, one.value, one.unit, one.stderr, one.status)


def _compute_covariance(result: Result, values: tuple[IdentifiedValue, ...]) -> Covariance | None:
    """Compute the covariance from correlations and standard errors; ``nan`` if one is missing."""
    if result.correlation is None:
        return None
    correlation = result.correlation
    errors = {value.name: np.nan if value.stderr is None else value.stderr for value in values}
    rows = [i for i, name in enumerate(correlation.names) if name in errors]  # not those of noise
    names = tuple(correlation.names[i] for i in rows)
    deviations = np.array([errors[name] for name in names], dtype=np.float64)
    matrix = correlation.matrix[np.ix_(rows, rows)] * np.outer(deviations, deviations)
    return Covariance(names, matrix)


def _find_channels(
    name: str, stored: StoredRun, rows: list[Dataset]
) -> Iterator[Mapping[str, Any]]:
    """Iterate over the datasets' descriptions of the channel of a signal."""
    recorded = stored.channels.by_signal[name]
    for row in rows:
        yield from (channel for channel in row.channels if channel["name"] == recorded)


def _find_sample_time(stored: StoredRun, rows: list[Dataset]) -> float | None:
    """Find the common sampling period of all measured outputs; None if there is none."""
    periods = [
        channel["sample_time"]
        for output in stored.model.outputs
        for channel in _find_channels(output.name, stored, rows)
    ]
    if not periods or None in periods or max(periods) - min(periods) > 1e-6 * min(periods):
        return None
    return float(periods[0])


def _find_units(stored: StoredRun, rows: list[Dataset]) -> Iterator[tuple[str, str]]:
    """Find the units of the recorded signals; those of several units are left out."""
    for signal in stored.channels.by_signal:
        units = {str(channel["unit"]) for channel in _find_channels(signal, stored, rows)}
        if len(units) == 1:
            yield signal, units.pop()


def _describe_provenance(stored: StoredRun, rows: list[Dataset]) -> dict[str, Any]:
    run, job = stored.run, stored.job
    descriptions = {row.id: {"id": row.id, "name": row.name, "sha256": row.sha256} for row in rows}
    return {
        "run": run.id,
        "job": job.id,
        "job_name": job.name,
        "finished": None if run.finished_at is None else run.finished_at.isoformat(),
        "method": run.method,
        "seed": run.seed,
        "spec_hash": run.spec_hash,
        "fingerprint": stored.document["fingerprint"],
        "rms": run.best_rms,
        "fit_percent": stored.document["fit_percent"],
        "datasets": [descriptions.get(name, {"id": name}) for name in stored.body["datasets"]],
    }
