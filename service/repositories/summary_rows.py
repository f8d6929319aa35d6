"""Columns of all runs of a job for aggregates, and the stored summaries of ended jobs."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import String, Text, cast, select, type_coerce
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.repositories.run_rows import entry_equals, filter_job
from service.storage.columns import Document
from service.storage.sessions import find_project
from service.storage.statements import upsert
from service.storage.tables import Job, Run, StoredSummary

READ_ROWS = 2_000
"""Rows that are held at a time."""
STATES = tuple(JobState)
_STATE_NUMBERS = {state.value: number for number, state in enumerate(STATES)}

QuantityKind = Literal[
    "rms", "rms_noise_free", "fit_estimation", "fit_validation", "estimate", "stderr"
]


@dataclass(frozen=True, slots=True)
class SummaryQuantity:
    """A number of each run, for quantiles over runs; estimates also name their parameter."""

    kind: QuantityKind
    parameter: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class RunTable:
    """Columns of the created runs of a job, in the order of the sweep (N runs).

    Attributes
    ----------
    numbers : array of int, (N,)
        Positions in the sweep.
    states : array of int, (N,)
        Positions in `STATES`.
    is_valid : array of bool, (N,)
        Whether the run gave a valid model.
    evaluations, seconds, sigma : array of float, (N,)
        Work of each run, and its added noise. NaN where there is none.
    values : mapping
        Array (N,) of each quantity that some run has; NaN where a run has none.
    kinds : array of int, (N,)
        Position of the run's parameters in `names`; -1 without a result.
    names : tuple
        Different tuples of parameters, the first of the sweep first.
    """

    numbers: NDArray[np.int64]
    states: NDArray[np.int8]
    is_valid: NDArray[np.bool_]
    evaluations: NDArray[np.float64]
    seconds: NDArray[np.float64]
    sigma: NDArray[np.float64]
    values: Mapping[SummaryQuantity, NDArray[np.float64]]
    kinds: NDArray[np.int32]
    names: tuple[tuple[str, ...], ...]

    def is_in_state(self, state: JobState) -> NDArray[np.bool_]:
        """Return which runs (N,) are in a state."""
        chosen: NDArray[np.bool_] = self.states == _STATE_NUMBERS[state.value]
        return chosen


_FLOATS = (
    "evaluations",
    "seconds",
    "sigma",
    "best_rms",
    "rms_noise_free",
    "fit_estimation",
    "fit_validation",
)
_QUANTITIES: tuple[tuple[str, QuantityKind], ...] = (
    ("best_rms", "rms"),
    ("rms_noise_free", "rms_noise_free"),
    ("fit_estimation", "fit_estimation"),
    ("fit_validation", "fit_validation"),
)
_ESTIMATES: tuple[tuple[str, QuantityKind], ...] = (("value", "estimate"), ("stderr", "stderr"))
_NO_ESTIMATE = {entry: None for entry, _ in _ESTIMATES}


def read_run_table(session: Session, job_id: str, project_id: str | None = None) -> RunTable:
    """Read the columns of all created runs of a job: about a second of CPU for 100,000 runs."""
    query = (
        select(
            cast(Run.estimates, Text),
            Run.number,
            type_coerce(Run.state, String),
            Run.valid,
            *(getattr(Run, name) for name in _FLOATS),
        )
        .where(*filter_job(job_id, project_id or find_project(session)))
        .order_by(Run.number)
        .execution_options(yield_per=READ_ROWS)
    )
    names: dict[tuple[str, ...], int] = {}
    parts = [
        _read_part(list(zip(*rows, strict=True)), names)
        for rows in session.connection().execute(query).partitions()
    ]
    columns = {
        name: np.concatenate([part[name] for part in parts] or [np.empty(0)])
        for name in ("number", "state", "valid", "kind", *_FLOATS)
    }
    values = {SummaryQuantity(kind): columns[name] for name, kind in _QUANTITIES}
    for quantity in dict.fromkeys(key for part in parts for key in part if key not in columns):
        values[quantity] = np.concatenate(
            [part.get(quantity, np.full(len(part["number"]), np.nan)) for part in parts]
        )
    return RunTable(
        numbers=columns["number"].astype(np.int64),
        states=columns["state"].astype(np.int8),
        is_valid=columns["valid"].astype(np.bool_),
        evaluations=columns["evaluations"],
        seconds=columns["seconds"],
        sigma=columns["sigma"],
        values=values,
        kinds=columns["kind"].astype(np.int32),
        names=tuple(names),
    )


def _read_part(
    columns: Sequence[Sequence[Any]], names: dict[tuple[str, ...], int]
) -> dict[Any, NDArray[Any]]:
    """Convert some rows to arrays by column or quantity; extend the known `names`."""
    texts, numbers, states, valid, *floats = columns
    # One document of many is parsed in half the time of many documents.
    estimates = json.loads(f"[{','.join('null' if text is None else text for text in texts)}]")
    kinds = [
        -1 if document is None else names.setdefault(tuple(document), len(names))
        for document in estimates
    ]
    part: dict[Any, NDArray[Any]] = {
        "number": np.array(numbers),
        "state": np.array([_STATE_NUMBERS[state] for state in states]),
        "valid": np.array([is_valid is True for is_valid in valid]),
        "kind": np.array(kinds),
        **{
            name: np.array(column, dtype=np.float64)  # None becomes NaN
            for name, column in zip(_FLOATS, floats, strict=True)
        },
    }
    for name in dict.fromkeys(one for document in estimates for one in document or ()):
        entries = [(document or {}).get(name, _NO_ESTIMATE) for document in estimates]
        for entry, kind in _ESTIMATES:
            column = np.array([one[entry] for one in entries], dtype=np.float64)
            part[SummaryQuantity(kind, name)] = column
    return part


def find_quietest_run(
    session: Session, job_id: str, cell: Mapping[str, Any], project_id: str | None = None
) -> Run | None:
    """Find the best valid run of a cell among those with the least noise; None without success."""
    query = select(Run).where(
        *filter_job(job_id, project_id or find_project(session)),
        Run.state == JobState.SUCCEEDED,
        Run.valid.is_(True),
        Run.best_rms.is_not(None),
        *(entry_equals(session, Run.cell, path, value) for path, value in cell.items()),
    )
    return session.scalar(query.order_by(Run.sigma, Run.best_rms, Run.number).limit(1))


def read_summary(session: Session, job: Job) -> Document | None:
    """Read the stored summary of a job's present attempt; None if there is none."""
    stored = session.get(StoredSummary, job.id)
    return None if stored is None or stored.attempt != job.attempt else stored.document


def write_summary(session: Session, job: Job, document: Document) -> None:
    """Store the summary of a job's present attempt. The caller locks the row of the job."""
    row = {"job_id": job.id, "attempt": job.attempt, "document": document}
    upsert(session, StoredSummary, [row])
