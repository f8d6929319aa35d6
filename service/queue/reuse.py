"""Reuse earlier runs, which are identified by the hash of their specification."""

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from sqlalchemy import func, select, true, update
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.queue.leases import Lease
from service.queue.packed_results import RESULT_ROWS
from service.queue.run_writes import RunOutcome, RunWriter
from service.storage.sessions import find_project
from service.storage.statements import RETURNING_OPTIONS, insert_missing, split_chunks
from service.storage.tables import Job, MigrationLog, Run, RunHistory

_COPIED_COLUMNS = [name for name in RESULT_ROWS.columns if name not in ("id", "estimates")]
"""The estimates are those of the result."""


def find_computed_runs(
    session: Session,
    hashes: Collection[str],
    project_id: str | None = None,
    *,
    with_signals: bool = False,
) -> dict[str, str]:
    """Return the first successful run of the project for each hash that has one.

    Deleted runs, and those of deleted jobs, are excluded: their signals are garbage and may be
    missing.

    Parameters
    ----------
    with_signals : bool
        Whether only runs count whose signals are stored.
    """
    runs: dict[str, str] = {}
    for chunk in split_chunks(hashes):
        first = select(Run.spec_hash, func.min(Run.id)).join(Job, Job.id == Run.job_id)
        query = first.where(
            Job.deleted_at.is_(None),
            Run.deleted_at.is_(None),
            Run.project_id == (project_id or find_project(session)),
            Run.spec_hash.in_(chunk),
            Run.state == JobState.SUCCEEDED,
            Run.signals_sha256.is_not(None) if with_signals else true(),
        )
        runs.update(
            {str(digest): run for digest, run in session.execute(query.group_by(Run.spec_hash))}
        )
    return runs


def take_over_runs(session: Session, lease: Lease, sources: Mapping[str, str]) -> list[RunOutcome]:
    """End runs with the results of other runs, passed by run; return their outcomes.

    History and migrations are copied, so that each run is complete by itself.
    """
    writer, all_outcomes = RunWriter(session, lease), []
    for chunk in split_chunks(sources.items()):
        pairs = dict(chunk)
        query = select(Run).where(Run.id.in_(set(pairs.values())))
        source_runs = {run.id: run for run in session.scalars(query)}
        outcomes = [_copy_outcome(run, source_runs[source]) for run, source in pairs.items()]
        written = writer.record_outcomes(outcomes)
        for table in (RunHistory, MigrationLog):
            insert_missing(session, table, _copy_rows(session, table, pairs))
        reused_count = (
            update(Job).where(Job.id == lease.job_id).values(n_reused=Job.n_reused + len(written))
        )
        session.execute(reused_count, execution_options=RETURNING_OPTIONS)
        all_outcomes += outcomes
    return all_outcomes


def _copy_outcome(run: str, source: Run) -> RunOutcome:
    values = {name: getattr(source, name) for name in _COPIED_COLUMNS}
    first = (source.result or {}).get("reused_from", source.id)
    # A run that is being deleted has lost this column, not yet its result.
    values["best_rms"] = values["best_rms"] or (source.result or {}).get("rms")
    values["result"] = {**(source.result or {}), "reused_from": first}
    return RunOutcome(run_id=run, state=JobState.SUCCEEDED, **values)


def _copy_rows(
    session: Session, table: Any, sources: Mapping[str, str]
) -> Iterator[dict[str, Any]]:
    columns = table.__table__.c
    rows: dict[str, list[Any]] = {}
    query = select(*columns).where(columns.run_id.in_(set(sources.values())))
    for row in session.execute(query).mappings():
        rows.setdefault(row["run_id"], []).append(row)
    for run, source in sources.items():
        for row in rows.get(source, []):
            yield {**row, "run_id": run}
