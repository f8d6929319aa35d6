"""Stop the jobs of projects that have used up their evaluations of a day.

A submission is refused at once. But what a job will cost is not known before, so each dispatcher
looks with its heartbeat. A stopped job keeps its results and checkpoints, and can be resumed.
"""

import logging

from service.repositories.job_rows import JobRepository
from service.repositories.project_rows import list_overruns
from service.storage.sessions import Database, SessionOwner
from service.storage.storage_errors import RowConflict, RowNotFound

_log = logging.getLogger(__name__)

ACTOR = "daily limit"
"""Who cancels, in the audit log."""


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
