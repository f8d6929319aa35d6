"""A whole service, web, dispatcher, Ray and all, broken in every way while it works.

How soon it recovers is measured by `benchmarks/torture.py`; here it must, and nothing may differ.
"""

from collections.abc import Callable, Iterator

import pytest
from sqlalchemy import func, select

from benchmarks.breaking import cancelling, faults
from benchmarks.breaking.faults import Bench
from benchmarks.breaking.stand import Stand, until
from benchmarks.breaking.work import Stream
from service.core.states import JobState
from service.storage.tables import Checkpoint, Job, Run
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.whole_service import Service

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(600)]

FAULTS = [
    faults.kill_worker,
    faults.kill_raylet,
    faults.kill_gcs,
    faults.kill_web,
    faults.step_clock_back,
    faults.pause_dispatcher,
    cancelling.cancel_running,
    cancelling.cancel_finishing,
]


@pytest.fixture(scope="module")
def bench(whole_service: Service) -> Iterator[Bench]:
    """The service at work on jobs whose undisturbed results are known."""
    stream = Stream(whole_service.stand, whole_service.folder, kinds=("sweep", "long"), size=0.3)
    stream.measure("cancelled")
    stream.start()
    yield Bench(whole_service.stand, stream, clock=whole_service.clock)
    stream.finish()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_the_work_goes_on_after(fault: Callable[[Bench], float], bench: Bench) -> None:
    before = count_successes(bench.stand)
    fault(bench)
    assert count_successes(bench.stand) > before
    assert bench.stand.answers() == 200


def count_successes(stand: Stand) -> int:
    """Number of runs of all jobs whose results are stored."""
    with stand.database.read_session() as session:
        ended = select(func.count()).where(Run.state == JobState.SUCCEEDED)
        return session.scalar(ended) or 0


def test_jobs_of_a_killed_dispatcher_go_on_or_are_cancelled_though_the_clock_was_set_back(
    bench: Bench, service: Service
) -> None:
    going, cancelled = service.submit_endless(), service.submit_endless()
    service.wait_for_checkpoint(going)
    until(
        lambda: any(map(service.has_checkpoint, bench.stream.jobs())),
        "a job whose bits are compared has a checkpoint",
        LIMIT_SECONDS,
    )

    def break_service() -> None:
        faults.kill(service.stand.family.dispatchers())
        faults.set_clock_back(bench)
        assert service.read_job(going).state is JobState.RUNNING
        service.stand.client.cancel(cancelled)

    faults.renewal(bench, break_service)
    ended = service.wait_for_end(cancelled)
    assert (ended.state, ended.attempt) == (JobState.CANCELLED, 1)
    before = service.read_job(going).evaluations
    until(lambda: service.read_job(going).evaluations > before, "more", LIMIT_SECONDS)
    job = service.read_job(going)
    assert (job.state, job.attempt, job.lost_leases) == (JobState.RUNNING, 2, 1)
    service.stand.client.cancel(going)
    assert service.wait_for_end(going).state is JobState.CANCELLED


def test_nothing_is_lost_doubled_stuck_or_different(bench: Bench) -> None:
    stand, stream = bench.stand, bench.stream
    assert stream.finish() == 0
    assert stream.counts["runs"] > 0
    assert (stream.counts["lost"], stream.counts["doubled"], stream.different) == (0, 0, [])
    assert (stream.counts["given up"], stream.counts["unplotted"]) == (0, 0)
    assert stream.jobs() == []
    with stand.database.read_session() as session:
        kept = select(Job.state).join(Checkpoint, Checkpoint.job_id == Job.id)
        assert JobState.SUCCEEDED not in session.scalars(kept).all()
