"""What a job says of all its runs: aggregates for pages, figures and tables, and its parameters.

They are computed once for a job that has ended, and stored with it. The dispatcher does this for
large jobs before it ends them. For others and for cancelled ones the first request does. While a
job runs, they are remembered for many times the time that they take (`service.core.computed`).
"""

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.core.computed import ComputedValues
from service.core.states import RUN_STATES, JobState
from service.queue.leases import Lease, LeaseQueue
from service.repositories.summary_rows import (
    RunTable,
    SummaryQuantity,
    read_run_table,
    read_summary,
    write_summary,
)
from service.storage.columns import Document
from service.storage.sessions import Database, find_database, release_connection
from service.storage.statements import split_chunks
from service.storage.tables import Job, Run
from service.sweeps.groups import GroupKey, RunGroup, SweepGroups, aggregate_runs

MAX_GROUPS = 2_000
STORED_RUNS = 500
"""Jobs with fewer runs are summarised in some milliseconds, so their summaries are not stored."""
UNIT_FIELDS = ("/model", "/datasets", "/channels", "/parameters")
"""Axes below these fields may change parameters and their units."""
DOCUMENT_FORMAT = 1
"""Another format of a stored document is not read, but computed again."""
STORE_SECONDS = 0.5
"""How long a request waits for the database to store a summary."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class SummaryParameter:
    """A parameter in the results of a job; `is_fixed` if no run estimated it."""

    name: str
    unit: str
    is_fixed: bool


@dataclass(frozen=True, slots=True)
class JobSummary:
    """Aggregates over all axes but seeds, and the parameters in the order of the sweep.

    `is_cut` if there are more than `MAX_GROUPS` groups; then the first ones are here.
    """

    keys: Sequence[GroupKey]
    groups: Sequence[RunGroup]
    is_cut: bool
    parameters: Sequence[SummaryParameter]


def list_default_keys(spec: Mapping[str, Any]) -> list[GroupKey]:
    """List the keys of a job's summary: all axes that are no seeds."""
    paths = [axis["path"] for axis in spec["sweep"]["axes"]]
    return [GroupKey("axis", path) for path in paths if not path.endswith("/seed")]


def load_summary(session: Session, job: Job) -> JobSummary:
    """Load the summary of a job, or compute it."""
    return _remember(_summaries, session, job, "summary", lambda: _load_or_compute(session, job))


def load_groups(session: Session, job: Job, groups: SweepGroups) -> Sequence[RunGroup]:
    """Load the aggregates of a job's runs by any keys."""
    if list(groups.by) == list_default_keys(job.spec):
        return load_summary(session, job).groups
    return _remember(
        _summaries,
        session,
        job,
        groups.by,
        lambda: aggregate_runs(_load_table(session, job), groups, _pending(job)),
    )


def store_summary(database: Database, lease: Lease) -> None:
    """Store the summary of a job whose runs have ended, right before it ends.

    Raises
    ------
    LeaseLost
        If the lease is no longer held.
    """
    with database.read_session() as session:
        job = session.get_one(Job, lease.job_id)
        document = _to_document(_compute_summary(session, job, _read_table(session, job)))
    with database.write_session() as session:
        write_summary(session, LeaseQueue(session).lock_lease(lease).job, document)


def _pending(job: Job) -> JobState:
    """Return the state that runs count in that were never created."""
    if not job.state.is_terminal:
        return JobState.QUEUED
    return JobState.SUCCEEDED if job.state is JobState.INCOMPLETE else job.state


def _load_or_compute(session: Session, job: Job) -> JobSummary:
    if not job.state.is_terminal or job.n_runs < STORED_RUNS:
        return _compute_summary(session, job, _load_table(session, job))
    document = read_summary(session, job)
    if document is not None and document["format"] == DOCUMENT_FORMAT:
        return _from_document(job, document)
    summary = _compute_summary(session, job, _load_table(session, job))
    with suppress(SQLAlchemyError):  # busy, full or read-only: the next request tries again
        release_connection(session)  # so that a request never holds two connections
        _keep_summary(find_database(session), job, summary)
    return summary


def _keep_summary(database: Database, job: Job, summary: JobSummary) -> None:
    """Store the summary of an ended job, unless it was resumed meanwhile."""
    same = Job.id == job.id, Job.attempt == job.attempt, Job.finished_at == job.finished_at
    with database.write_session(STORE_SECONDS) as session:
        if session.scalar(select(Job.id).where(*same).with_for_update(key_share=True)) is not None:
            write_summary(session, job, _to_document(summary))


def _compute_summary(session: Session, job: Job, table: RunTable) -> JobSummary:
    groups = SweepGroups(job.spec, list_default_keys(job.spec), MAX_GROUPS)
    aggregated = aggregate_runs(table, groups, _pending(job))
    parameters = list(_read_parameters(session, job, table))
    return JobSummary(groups.by, aggregated, groups.is_cut, parameters)


def _read_parameters(session: Session, job: Job, table: RunTable) -> Iterator[SummaryParameter]:
    """Read the parameters from the first success of each kind of runs, the earliest first."""
    paths = [axis["path"] for axis in job.spec["sweep"]["axes"]]
    keys = [GroupKey("axis", path) for path in paths if path.startswith(UNIT_FIELDS)]
    succeeded = np.flatnonzero(table.is_in_state(JobState.SUCCEEDED) & (table.kinds >= 0))
    located = SweepGroups(job.spec, keys, MAX_GROUPS).locate_runs(table.numbers[succeeded])
    alike = located * max(len(table.names), 1) + table.kinds[succeeded]
    _, firsts = np.unique(alike, return_index=True)
    numbers = np.sort(table.numbers[succeeded[firsts]]).tolist()
    is_fixed: dict[tuple[str, str], bool] = {}
    for chunk in split_chunks(numbers, 500):
        query = select(Run.result.expression["parameters"]).where(
            Run.job_id == job.id, Run.number.in_(chunk)
        )
        for parameters in session.scalars(query.order_by(Run.number)):
            for one in parameters:
                key = one["name"], one["unit"]
                is_fixed[key] = is_fixed.get(key, True) and one["status"] == "fixed"
    for (name, unit), fixed in is_fixed.items():
        yield SummaryParameter(name, unit, fixed)


def _to_document(summary: JobSummary) -> Document:
    """Convert a summary to its stored form, without the keys: the axes of the job have them."""
    quantities = list(dict.fromkeys(name for group in summary.groups for name in group.quantiles))
    return {
        "format": DOCUMENT_FORMAT,
        "quantities": [[quantity.kind, quantity.parameter] for quantity in quantities],
        "groups": [
            {
                "states": [group.states[state] for state in RUN_STATES],
                "valid": group.n_valid,
                "sigma": group.sigma,
                "evaluations": group.mean_evaluations,
                "seconds": group.mean_seconds,
                "quantiles": [group.quantiles.get(quantity) for quantity in quantities],
            }
            for group in summary.groups
        ],
        "parameters": [[one.name, one.unit, one.is_fixed] for one in summary.parameters],
    }


def _from_document(job: Job, document: Document) -> JobSummary:
    groups = SweepGroups(job.spec, list_default_keys(job.spec), MAX_GROUPS)
    quantities = [SummaryQuantity(kind, parameter) for kind, parameter in document["quantities"]]
    stored = zip(groups.keys, groups.first_numbers, document["groups"], strict=True)
    aggregated = [
        RunGroup(
            key=key,
            first_number=first,
            states=dict(zip(RUN_STATES, group["states"], strict=True)),
            n_valid=group["valid"],
            sigma=None if group["sigma"] is None else (group["sigma"][0], group["sigma"][1]),
            mean_evaluations=group["evaluations"],
            mean_seconds=group["seconds"],
            quantiles={
                quantity: tuple(quantiles)
                for quantity, quantiles in zip(quantities, group["quantiles"], strict=True)
                if quantiles is not None
            },
        )
        for key, first, group in stored
    ]
    parameters = [SummaryParameter(*parameter) for parameter in document["parameters"]]
    return JobSummary(groups.by, aggregated, groups.is_cut, parameters)


def _load_table(session: Session, job: Job) -> RunTable:
    """Load the columns of a job's runs; those of ended jobs are cached for other keys."""
    if not job.state.is_terminal or job.n_runs > MAX_CACHED_RUNS:
        return _read_table(session, job)
    return _remember(_tables, session, job, "table", lambda: _read_table(session, job))


def _read_table(session: Session, job: Job) -> RunTable:
    return read_run_table(session, job.id, job.project_id)


MAX_CACHED_RUNS = 200_000
"""Columns of more runs are not cached: they take 100 bytes a run."""
_summaries, _tables = ComputedValues(32), ComputedValues(2)


def _remember(
    values: ComputedValues, session: Session, job: Job, what: Hashable, compute: Callable[[], T]
) -> T:
    """Return a value of a job; one of a resumed job is computed again when it has ended."""
    key = job.id, job.attempt, job.finished_at, what
    return values.get(
        key,
        compute,
        is_final=job.state.is_terminal,
        before_wait=partial(release_connection, session),
    )
