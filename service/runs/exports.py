"""Use case: the identified model of a run as text for other programs."""

import re
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest
from service.jobs.stored_run import StoredRun, load_estimated_run
from service.repositories.datasets import DatasetRepository
from service.storage.errors import StorageError
from service.storage.tables import Dataset
from sysid.control.linear_form import Covariance, Identified, NotLinear, Value
from sysid.core.errors import InvalidSettings
from sysid.data.records import Hold
from sysid.export.export import Format, written

Body = Mapping[str, Any]

_KINDS: Mapping[Format, tuple[str, str]] = {
    "json": ("application/json", ".json"),
    "python": ("text/x-python", "_model.py"),
    "c": ("text/x-c", ".c"),
    "control": ("text/x-python", "_control.py"),
}


class Exported(NamedTuple):
    """A file: its text, media type and name."""

    text: str
    media_type: str
    name: str


def exported(session: Session, run_id: str, format: Format, pade_order: int) -> Exported:
    """The model of a run in one of the formats.

    Raises
    ------
    NotFound
        If there is no such run.
    Conflict
        If the run has no estimates.
    InvalidRequest
        If the model cannot be written in that format; the reason names the term in the way.
    """
    stored = load_estimated_run(session, run_id, "export")
    try:
        text = written(_identified(session, stored), format, pade_order)
    except NotLinear as error:
        raise InvalidRequest.at("?format", f"{format!r} is not possible: {error}") from error
    except InvalidSettings as error:
        name = error.pointer.removeprefix("/")
        raise InvalidRequest.at(f"?{name}" if name == "pade_order" else "", str(error)) from error
    media_type, ending = _KINDS[format]
    stem = re.sub(r"[^A-Za-z0-9]+", "_", stored.model.name)
    return Exported(text, media_type, stem + ending)


def _identified(session: Session, stored: StoredRun) -> Identified:
    rows = _datasets(session, stored.body)
    values = tuple(_values(stored))
    return Identified(
        stored.model, values, _covariance(stored.result, values), _period(stored, rows),
        {one.name: _hold(one.name, stored, rows) for one in stored.model.inputs},
        version("lagid"), _provenance(stored, rows),
    )  # fmt: skip


def _datasets(session: Session, body: Body) -> list[Dataset]:
    """The datasets of the estimation, as far as they have not been deleted since."""
    found = []
    for name in body["datasets"]:
        try:
            found.append(DatasetRepository(session).get(name))
        except StorageError:
            continue
    return found


def _values(stored: StoredRun) -> Iterator[Value]:
    for one in stored.estimates:
        yield Value(one["name"], one["value"], one["unit"], one["stderr"], one["status"])


def _covariance(result: Body, values: tuple[Value, ...]) -> Covariance | None:
    """From correlations and standard errors; ``nan`` where one of them is missing."""
    found = result.get("correlation")
    if found is None:
        return None
    errors = {one.name: np.nan if one.stderr is None else one.stderr for one in values}
    deviations = np.array([errors[name] for name in found["names"]], dtype=np.float64)
    matrix = np.array(found["matrix"], dtype=np.float64)
    return Covariance(tuple(found["names"]), matrix * np.outer(deviations, deviations))


def _channels(name: str, stored: StoredRun, rows: list[Dataset]) -> Iterator[Mapping[str, Any]]:
    """What the datasets say of the recorded channels of a signal of the model."""
    recorded = stored.channels.by_signal[name]
    for row in rows:
        yield from (one for one in row.channels if one["name"] == recorded)


def _period(stored: StoredRun, rows: list[Dataset]) -> float | None:
    """The sampling period that all measured outputs have; None if they have no common one."""
    periods = [
        one["sample_time"] for output in stored.model.outputs
        for one in _channels(output.name, stored, rows)
    ]  # fmt: skip
    if not periods or None in periods or max(periods) - min(periods) > 1e-6 * min(periods):
        return None
    return float(periods[0])


def _hold(name: str, stored: StoredRun, rows: list[Dataset]) -> Hold:
    channel = next(_channels(name, stored, rows), None)
    found: Hold = stored.body["hold"].get(name) or (channel or {}).get("hold", "first")
    return found


def _provenance(stored: StoredRun, rows: list[Dataset]) -> dict[str, Any]:
    run, job = stored.run, stored.job
    known = {row.id: {"id": row.id, "name": row.name, "sha256": row.sha256} for row in rows}
    return {
        "run": run.id,
        "job": job.id,
        "job_name": job.name,
        "finished": None if run.finished_at is None else run.finished_at.isoformat(),
        "method": run.method,
        "seed": run.seed,
        "rms": run.best_rms,
        "fit_percent": stored.result.get("fit_percent"),
        "datasets": [known.get(name, {"id": name}) for name in stored.body["datasets"]],
    }
