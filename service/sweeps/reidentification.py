"""Batch re-identification: one run for each value of a label, warm-started, with a trend."""

import re
from typing import Any

from service.core.errors import FieldError, InvalidRequest
from service.core.settings import Settings
from service.items.reference_names import REFERENCE_PREFIX, RUN_PREFIX
from service.jobs import submit
from service.jobs.job_schemas import PREVIOUS, JobIn, JobOut
from service.storage.sessions import Database
from service.sweeps.sweep_schemas import ReidentifyIn

AXIS_POINTER = "/sweep/axes/0"
DATASET_FAULT = re.compile(r"/datasets(?P<place>/\d+): ")
"""Start of the fault of one recording in an axis value."""


def submit_reidentification(
    database: Database, body: ReidentifyIn, settings: Settings, key: str | None = None
) -> JobOut:
    """Queue the batch as an ordinary job.

    Raises
    ------
    InvalidRequest
        With every fault that can be detected before the job runs, at its pointer in this body.
    KeyReused
        If the idempotency key was used with another body.
    """
    order = sort_batch(body)
    job = build_job(body, order)
    faults = []
    if body.warm_start == "reference" and body.reference is None:
        faults.append(
            FieldError(
                "/warm_start",
                "'reference' needs the field 'reference'. Name a run or an accepted reference",
            )
        )
    try:
        if not faults:
            return submit.submit_job(database, job, settings, key)
        with database.read_session() as session:
            submit.check_job(session, job, settings)
    except InvalidRequest as error:
        faults += [_move_fault(fault, order) for fault in error.errors]
    raise InvalidRequest(dict.fromkeys(faults))


def sort_batch(body: ReidentifyIn) -> list[int]:
    """Sort the entries of the batch by x and return their positions."""
    return sorted(range(len(body.batch)), key=lambda number: body.batch[number].x)


def build_job(body: ReidentifyIn, order: list[int]) -> JobIn:
    """Build the job with its cells in the order of x, so that warm starts come from neighbours."""
    chosen = [body.batch[number] for number in order]
    axis = {
        "path": "/datasets",
        "values": [entry.datasets for entry in chosen],
        "labels": [{body.label: entry.x} for entry in chosen],
    }
    reference = _to_job_reference(body.reference)
    trend = {
        "x": body.label,
        "parameters": body.trend_parameters,
        "predict": body.predict,
        "reference": reference,
    }
    return JobIn.model_validate(
        {
            **body.job_fields,
            "datasets": chosen[0].datasets,
            "sweep": {"axes": [axis]},
            "warm_start": _choose_warm_start(body, reference),
            "trend": trend,
        }
    )


def _to_job_reference(reference: str | None) -> str | None:
    """Convert a reference to the form of a job: a run's id, or ``reference:`` and a name."""
    if reference is None or reference.startswith((RUN_PREFIX, REFERENCE_PREFIX)):
        return reference
    return REFERENCE_PREFIX + reference


def _choose_warm_start(body: ReidentifyIn, reference: str | None) -> str | None:
    start = body.warm_start or ("previous" if reference is None else "reference")
    if start == "reference":
        return reference
    return PREVIOUS if start == "previous" else None


def _move_fault(error: FieldError, order: list[int]) -> FieldError:
    """Move a fault of the job to its pointer in this body."""
    pointer = _move_pointer(error.pointer, order)
    inner = DATASET_FAULT.match(error.detail)
    if inner and pointer.startswith("/batch/"):
        return FieldError(pointer + inner["place"], error.detail[inner.end() :], error.column)
    return FieldError(pointer, error.detail, error.column)


def _move_pointer(pointer: str, order: list[int]) -> str:
    parts: list[Any] = pointer.split("/")
    if pointer.startswith(f"{AXIS_POINTER}/values/"):
        return f"/batch/{order[int(parts[5])]}/datasets"
    if pointer.startswith(f"{AXIS_POINTER}/labels/"):
        return "/label"
    if pointer.startswith("/datasets"):
        return "/".join([f"/batch/{order[0]}", *parts[1:]])
    for job_pointer, body_pointer in (
        ("/trend/parameters", "/trend_parameters"),
        ("/trend/reference", "/reference"),
        ("/trend/predict", "/predict"),
        ("/trend/x", "/label"),
        ("/warm_start", "/reference"),
    ):
        if pointer.startswith(job_pointer):
            return body_pointer + pointer.removeprefix(job_pointer)
    return pointer
