"""Progress of a leased job in its earlier attempts, and its deletion."""

from collections.abc import Collection
from dataclasses import dataclass, field

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from service.core.states import OPEN_STATES, JobState
from service.queue.leases import Lease, LeaseQueue
from service.storage.statements import split_chunks
from service.storage.tables import Checkpoint, MigrationLog, Run, RunHistory


@dataclass(frozen=True, slots=True)
class PreviousAttempts:
    """Progress of a claimed job in its earlier attempts.

    Attributes
    ----------
    evaluations, generations : int
        Over the finished runs: the sum, and the largest number.
    failure_reasons : tuple of str
        Some distinct reasons why runs failed.
    checkpoint_evaluations : dict
        Evaluations in the checkpoints of unfinished runs, by run.
    """

    evaluations: int = 0
    generations: int = 0
    failure_reasons: tuple[str, ...] = ()
    checkpoint_evaluations: dict[str, int] = field(default_factory=dict)


def summarize_attempts(session: Session, lease: Lease, n_reasons: int) -> PreviousAttempts:
    """Summarize the results of earlier attempts; `LeaseLost` if the lease is not held."""
    LeaseQueue(session).lock_job(lease)
    of_job = Run.job_id == lease.job_id
    sums = select(
        func.coalesce(func.sum(Run.evaluations), 0), func.coalesce(func.max(Run.generations), 0)
    ).where(of_job, Run.state.not_in(OPEN_STATES))
    evaluations, generations = session.execute(sums).one()
    failed = select(Run.error).where(of_job, Run.state == JobState.FAILED, Run.error.is_not(None))
    first = failed.group_by(Run.error).order_by(func.min(Run.number)).limit(n_reasons)
    checkpoints = select(Checkpoint.run_id, Checkpoint.evaluations).where(
        Checkpoint.job_id == lease.job_id
    )
    return PreviousAttempts(
        int(evaluations),
        int(generations),
        tuple(str(reason) for reason in session.scalars(first)),
        dict(session.execute(checkpoints).all()),
    )


def delete_progress(session: Session, lease: Lease, run_ids: Collection[str]) -> None:
    """Delete checkpoint and history of runs that start again from the beginning.

    Another version of the program may give other numbers, and history is only appended.
    """
    LeaseQueue(session).lock_job(lease)
    for chunk in split_chunks(run_ids):
        for table in (Checkpoint, RunHistory, MigrationLog):
            session.execute(delete(table).where(table.run_id.in_(chunk)))
