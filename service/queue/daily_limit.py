"""Evaluations of a day: jobs of projects that have used them up are stopped, requests refused.

A submission is refused at once. But what a job will cost is not known before, so each dispatcher
looks with its heartbeat. A stopped job keeps its results and checkpoints, and can be resumed.
What a web process computes on request, or to show a run, counts too, whatever the scope of the key.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from sqlalchemy.exc import OperationalError

from service.core.process.concurrency import simulation_places
from service.repositories.job_rows import JobRepository
from service.repositories.project_rows import (
    add_requested_work,
    check_daily_evaluations,
    list_overruns,
)
from service.storage.sessions import Database, SessionOwner
from service.storage.storage_errors import RowConflict, RowNotFound
from service.storage.tables import Project

_log = logging.getLogger(__name__)

ACTOR = "daily limit"
"""Who cancels, in the audit log."""


NOTE_BUSY_SECONDS = 0.5
"""How long the note of a request's work waits for the lock of others; then it is not counted."""


def check_budget(database: Database) -> None:
    """Refuse a request that computes, if its project has used up its evaluations of a day.

    Raises
    ------
    BudgetExceeded
        With the numbers, and when to try again.
    """
    with database.read_session() as session:
        project = session.get(Project, database.owner.project_id)
        if project is not None:
            check_daily_evaluations(session, project.id, project.max_daily_evaluations)


def count_evaluations(database: Database, evaluations: int) -> None:
    """Count what a request has computed."""
    if not evaluations:
        return
    with suppress(OperationalError), database.write_session(NOTE_BUSY_SECONDS) as session:
        add_requested_work(session, evaluations)


@dataclass(slots=True)
class Computation:
    """What a request computes: its `evaluations`, one simulation by default."""

    evaluations: int = 1


@contextmanager
def compute_on_request(database: Database) -> Iterator[Computation]:
    """Hold a place for simulations during the block, and count what it has computed.

    Raises
    ------
    BudgetExceeded
        If the project has used up its evaluations of a day.
    ServiceBusy
        If no place became free in time.
    """
    check_budget(database)
    computation = Computation()
    with simulation_places.hold(database.owner.project_id):
        yield computation
    count_evaluations(database, computation.evaluations)


def stop_overruns(database: Database, busy_seconds: float | None = None) -> list[str]:
    """Cancel the open jobs of projects beyond their limit; return their identifiers.

    Parameters
    ----------
    busy_seconds : float, optional
        How long to wait for a lock of the database.
    """
    with database.read_session() as session:
        overruns = list_overruns(session)
    stopped = []
    for overrun in overruns:
        owned = database.open_for(SessionOwner(overrun.project_id, ACTOR))
        for job_id in overrun.job_ids:
            try:
                with owned.write_session(busy_seconds) as session:
                    JobRepository(session).cancel(job_id, overrun.reason)
            except (RowConflict, RowNotFound):  # it has just ended
                continue
            stopped.append(job_id)
        _log.warning("project %s %s", overrun.project_id, overrun.reason)
    return stopped
