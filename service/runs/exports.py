"""Use case: the identified model of a run as text for other programs."""

import re
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import Conflict, InvalidRequest
from service.core.json_pointer import body_of
from service.models.models import model_of_run
from service.repositories.datasets import DatasetRepository
from service.repositories.jobs import JobRepository
from service.repositories.runs import RunRepository
from service.storage.errors import StorageError
from service.storage.tables import Dataset, Job, Run
from sysid.control.linear_form import Covariance, Identified, NotLinear, Value
from sysid.core.errors import InvalidSettings
from sysid.data.records import Hold
from sysid.export.export import Format, written
from sysid.models.model import Model

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
    run = RunRepository(session).get(run_id)
    if run.result is None or not run.result.get("parameters"):
        raise Conflict(f"run {run_id} is {run.state.value} and has no estimates to export")
    job = JobRepository(session).get(run.job_id)
    try:
        text = written(_identified(session, run, job), format, pade_order)
    except NotLinear as error:
        raise InvalidRequest.at("?format", f"{format!r} is not possible: {error}") from error
    except InvalidSettings as error:
        name = error.pointer.removeprefix("/")
        raise InvalidRequest.at(f"?{name}" if name == "pade_order" else "", str(error)) from error
    media_type, ending = _KINDS[format]
    stem = re.sub(r"[^A-Za-z0-9]+", "_", model_of_run(session, run, job).name)
    return Exported(text, media_type, stem + ending)


def _identified(session: Session, run: Run, job: Job) -> Identified:
    model = model_of_run(session, run, job)
    body = body_of(job.spec, run.cell)
    rows = _datasets(session, body)
    values = tuple(_values(run.result or {}))
    return Identified(
        model, values, _covariance(run.result or {}, values), _period(model, body, rows),
        {one.name: _hold(one.name, body, rows) for one in model.inputs}, version("lagid"),
        _provenance(run, job, body, rows),
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


def _values(result: Body) -> Iterator[Value]:
    for one in result["parameters"]:
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


def _channels(name: str, body: Body, rows: list[Dataset]) -> Iterator[Mapping[str, Any]]:
    """What the datasets say of the recorded channels of a signal of the model."""
    recorded = body["channels"].get(name, name)
    for row in rows:
        yield from (one for one in row.channels if one["name"] == recorded)


def _period(model: Model, body: Body, rows: list[Dataset]) -> float | None:
    """The sampling period that all measured outputs have; None if they have no common one."""
    periods = [
        one["sample_time"] for output in model.outputs
        for one in _channels(output.name, body, rows)
    ]  # fmt: skip
    if not periods or None in periods or max(periods) - min(periods) > 1e-6 * min(periods):
        return None
    return float(periods[0])


def _hold(name: str, body: Body, rows: list[Dataset]) -> Hold:
    stored = next(_channels(name, body, rows), None)
    found: Hold = body["hold"].get(name) or (stored or {}).get("hold", "first")
    return found


def _provenance(run: Run, job: Job, body: Body, rows: list[Dataset]) -> dict[str, Any]:
    known = {row.id: {"id": row.id, "name": row.name, "sha256": row.sha256} for row in rows}
    return {
        "run": run.id,
        "job": job.id,
        "job_name": job.name,
        "finished": None if run.finished_at is None else run.finished_at.isoformat(),
        "method": run.method,
        "seed": run.seed,
        "rms": run.best_rms,
        "fit_percent": (run.result or {}).get("fit_percent"),
        "datasets": [known.get(name, {"id": name}) for name in body["datasets"]],
    }
