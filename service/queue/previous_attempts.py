"""Progress of a leased parcel in its earlier attempts, and its deletion."""

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
    """Progress of a claimed parcel in its earlier attempts.

    Attributes
    ----------
    evaluations, generations : int
        Over the finished runs: the sum, and the largest number.
    checkpoint_evaluations : dict
        Evaluations in the checkpoints of unfinished runs, by run.
    """

    evaluations: int = 0
    generations: int = 0
    checkpoint_evaluations: dict[str, int] = field(default_factory=dict)


def summarize_attempts(session: Session, lease: Lease) -> PreviousAttempts:
    """Summarize the results of earlier attempts; `LeaseLost` if the lease is not held."""
    parcel, _ = LeaseQueue(session).lock_lease(lease)
    in_parcel = (
        Run.job_id == lease.job_id,
        Run.number >= parcel.first,
        Run.number < parcel.stop,
    )
    sums = select(
        func.coalesce(func.sum(Run.evaluations), 0), func.coalesce(func.max(Run.generations), 0)
    ).where(*in_parcel, Run.state.not_in(OPEN_STATES))
    evaluations, generations = session.execute(sums).one()
    checkpoints = select(Checkpoint.run_id, Checkpoint.evaluations).join(
        Run, Run.id == Checkpoint.run_id
    )
    of_job = checkpoints.where(Checkpoint.job_id == lease.job_id, *in_parcel)
    return PreviousAttempts(int(evaluations), int(generations), dict(session.execute(of_job).all()))


def list_failure_reasons(session: Session, job_id: str, n_reasons: int) -> list[str]:
    """List some distinct reasons why runs of a job failed, those of the first runs first."""
    failed = select(Run.error).where(
        Run.job_id == job_id,
        Run.state == JobState.FAILED,
        Run.error.is_not(None),
        Run.deleted_at.is_(None),
    )
    first = failed.group_by(Run.error).order_by(func.min(Run.number)).limit(n_reasons)
    return [str(reason) for reason in session.scalars(first)]


def delete_progress(session: Session, lease: Lease, run_ids: Collection[str]) -> None:
    """Delete checkpoint and history of runs that start again from the beginning.

    Another version of the program may give other numbers, and history is only appended.
    """
    LeaseQueue(session).lock_lease(lease)
    for chunk in split_chunks(run_ids):
        for table in (Checkpoint, RunHistory, MigrationLog):
            session.execute(delete(table).where(table.run_id.in_(chunk)))
