"""Several dispatcher processes, some of which die or fall silent: each run has one result."""

import multiprocessing
import os
import time
from datetime import timedelta

import pytest

from service.core.states import JobState
from service.queue.leases import LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter
from service.storage.sessions import Database
from service.storage.storage_errors import LeaseLost
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.job_rows import job_of, new_run, runs_of, submit

pytestmark = pytest.mark.slow  # processes of their own

SHORT_LEASE = timedelta(seconds=0.4)  # of those that die or fall silent
LEASE = timedelta(seconds=LIMIT_SECONDS)  # also on a busy machine nobody else loses one
N_JOBS, N_RUNS = 24, 2


def _work_on(database, claim, trouble):
    with database.write_session() as session:
        ledger = RunWriter(session, claim.lease)
        ledger.create_runs(new_run(number=i) for i in range(N_RUNS))
        pending = ledger.list_pending()
        ledger.start_runs([run.id for run in pending])
    for run in pending:
        if trouble == "dies":
            os._exit(9)
        if trouble == "stalls":
            _fall_silent(database, claim.lease)
        outcome = RunOutcome(
            run_id=run.id,
            state=JobState.SUCCEEDED,
            best_rms=float(run.number + 1),
            result={"by": claim.lease.owner, "attempt": claim.lease.attempt, "parameters": []},
        )
        with database.write_session() as session:
            RunWriter(session, claim.lease).record_outcomes([outcome])
    with database.write_session() as session:
        LeaseQueue(session).finish_job(claim.lease, JobState.SUCCEEDED)


def _fall_silent(database, lease):
    """Do nothing until the lease is lost."""
    job = job_of(database, lease.job_id)
    while (job.state, job.attempt) == (JobState.RUNNING, lease.attempt):
        time.sleep(0.05)
        job = job_of(database, lease.job_id)


def _dispatch(url, owner, trouble, before, claimed, refused):
    """Claim and work for ever; the first claim comes after `before` and meets the trouble."""
    database = Database(url)
    before.wait(LIMIT_SECONDS)
    while True:
        with database.write_session() as session:
            queue = LeaseQueue(session)
            queue.reap_expired()
            claim = queue.claim_job(owner, SHORT_LEASE if trouble else LEASE)
        if claim is None:
            time.sleep(0.02)
            continue
        claimed.set()
        try:
            _work_on(database, claim, trouble)
        except LeaseLost:
            refused.put((owner, claim.job.id))
        trouble = ""


def _are_finished(database, jobs):
    return all(job_of(database, job_id).state.is_terminal for job_id in jobs)


@pytest.mark.slow
def test_each_run_has_one_result_though_dispatchers_die_and_stall(database):
    context = multiprocessing.get_context("spawn")
    url = database.engine.url.render_as_string(hide_password=False)
    jobs = [submit(database, n_runs=N_RUNS, max_attempts=10) for _ in range(N_JOBS)]
    refused = context.Queue()
    events = [context.Event() for _ in range(4)]
    events[0].set()
    processes = [
        context.Process(target=_dispatch, args=(url, *who, *events[i : i + 2], refused))
        for i, who in enumerate([("stalling", "stalls"), ("dying", "dies"), ("sound", "")])
    ]
    for process in processes:
        process.start()
    limit = time.monotonic() + LIMIT_SECONDS
    try:
        while not _are_finished(database, jobs) and time.monotonic() < limit:
            time.sleep(0.1)
        owner, late = refused.get(timeout=LIMIT_SECONDS)
        while owner != "stalling":  # on a busy machine the dying one may be late as well
            owner, late = refused.get(timeout=LIMIT_SECONDS)
    finally:
        for process in processes:
            process.kill()
            process.join()
    for job_id in jobs:
        job, runs = job_of(database, job_id), runs_of(database, job_id)
        assert (job.state, job.n_done, job.n_failed) == (JobState.SUCCEEDED, N_RUNS, 0)
        assert [run.number for run in runs] == list(range(N_RUNS))
        assert all(run.result["attempt"] == run.attempt for run in runs)
    assert job_of(database, late).attempt > 1
