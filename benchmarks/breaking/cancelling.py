"""Cancel and resume jobs in every state, and submit runs that harm their workers.

The jobs continue during the next faults. They must end like undisturbed jobs.
"""

import time
from collections.abc import Callable
from typing import TypeVar

from benchmarks.breaking.faults import LIMIT_SECONDS, Bench, goes_on, kill, recovery, renewal
from benchmarks.breaking.stand import until
from service.client.calls import ClientError, ProblemError
from service.core.states import JobState
from service.storage.retry import TRANSIENT_ERRORS
from service.storage.tables import Job

T = TypeVar("T")
CONFLICT = 409


def cancel_without_dispatcher(bench: Bench) -> float:
    """Kill the dispatcher; cancel one of its jobs and one that has just been queued."""
    running = _insist(lambda: bench.stream.submit("cancelled"))
    until(lambda: _has_begun(bench, running), "it was begun", LIMIT_SECONDS)

    def both() -> None:
        kill(bench.stand.family.dispatchers())
        queued = _insist(lambda: bench.stream.submit("cancelled"))
        for job in (queued, running):
            _cancel_and_resume(bench, job)

    return renewal(bench, both)


def cancel_running(bench: Bench) -> float:
    """Cancel a job of which some runs have ended."""
    return _cancelled(bench, _has_begun)


def cancel_finishing(bench: Bench) -> float:
    """Cancel a job whose runs are over, while its bounds are computed; or soon after."""
    return _cancelled(bench, _is_finishing)


def bad_runs(bench: Bench) -> float:
    """Submit runs that kill their workers, and one that takes all the memory it gets."""

    def submit() -> None:
        bench.stream.watch(_insist(lambda: bench.stream.submit("bad")), "bad")

    return recovery(bench, submit)


def _cancelled(bench: Bench, is_time: Callable[[Bench, str], bool]) -> float:
    job = _insist(lambda: bench.stream.submit("cancelled"))
    until(lambda: is_time(bench, job), "it was time to cancel", LIMIT_SECONDS)
    begun = time.monotonic()
    _cancel_and_resume(bench, job)
    return goes_on(bench, begun)


def _cancel_and_resume(bench: Bench, job: str) -> None:
    """Do both, and watch the job from then on; nothing is cancelled that has already ended."""
    met = _read_job(bench, job)
    try:
        _insist(lambda: bench.stand.client.cancel(job))
    except ProblemError:
        bench.stream.counts["cancelled too late"] += 1
        bench.stream.watch(job, "cancelled")
        return
    until(lambda: _read_job(bench, job).state.is_terminal, "it was cancelled", LIMIT_SECONDS)
    if _read_job(bench, job).state is not JobState.CANCELLED:  # it ended before anybody looked
        bench.stream.counts["cancelled too late"] += 1
        bench.stream.watch(job, "cancelled")
        return
    state = "finishing" if met.n_done >= met.n_runs else met.state.value
    bench.stream.counts[f"cancelled while {state}"] += 1
    try:
        _insist(lambda: bench.stand.client.resume(job))
    except ProblemError:  # the answer to an earlier try was lost
        if _read_job(bench, job).state is JobState.CANCELLED:
            raise
    bench.stream.watch(job, "cancelled", ends=2)


def _has_begun(bench: Bench, job: str) -> bool:
    row = _read_job(bench, job)
    return row.state.is_terminal or (row.state is JobState.RUNNING and row.n_done > 0)


def _is_finishing(bench: Bench, job: str) -> bool:
    row = _read_job(bench, job)
    return row.state.is_terminal or row.n_done >= row.n_runs


def _read_job(bench: Bench, job: str) -> Job:
    def read() -> Job:
        with bench.stand.database.read_session() as session:
            return session.get_one(Job, job)

    return _insist(read)


def _insist(work: Callable[[], T]) -> T:
    """Do something until it is answered; a conflict is an answer."""
    limit = time.monotonic() + LIMIT_SECONDS
    while True:
        try:
            return work()
        except (ClientError, *TRANSIENT_ERRORS) as error:
            is_answer = isinstance(error, ProblemError) and error.status == CONFLICT
            if is_answer or time.monotonic() > limit:
                raise
            time.sleep(0.1)
