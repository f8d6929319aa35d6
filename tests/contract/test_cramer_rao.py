"""Cramér–Rao bounds of a job: computed beside the dispatcher's turns, which no error ends."""

import threading
import time

import numpy as np
import pytest

from service.core.states import OPEN_STATES, JobState
from service.datasets import stored_recordings
from service.dispatch import job_parts, run_cramer_rao
from service.dispatch.dispatcher import Dispatcher
from service.dispatch.held_leases import HeldLeases
from service.repositories.event_rows import EventRepository
from service.repositories.job_rows import JobRepository
from service.storage.storage_errors import ObjectStoreFailed
from service.sweeps.group_cramer_rao import StoredBounds
from sysid.uncertainty.cramer_rao import cramer_rao_bound
from tests.support.cluster.inline_executor import InlineExecutor
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.job_rows import new_job

pytestmark = pytest.mark.slow

SMALL = {"population": 8, "generations": 3, "islands": 1, "refine": False}
NOISY = {"algorithm": SMALL, "noise": {"sigma": 0.1}}


def carry_out_jobs(place, *jobs, meanwhile=lambda: None):
    """Carry out jobs; `meanwhile` is called in another thread."""
    dispatcher = Dispatcher(
        place.database, place.store, InlineExecutor(), HeldLeases(place.database, 30)
    )

    def stop_at_the_end():
        try:
            meanwhile()
            while any(place.job(job).state in OPEN_STATES for job in jobs):
                time.sleep(0.01)
        finally:
            dispatcher.stopping.set()

    watcher = threading.Thread(target=stop_at_the_end)
    watcher.start()
    dispatcher.run_until_stopped()
    watcher.join()
    return [place.job(job) for job in jobs]


def list_notes(job):
    return list(StoredBounds(job.cramer_rao).list_notes())


def test_other_jobs_are_carried_out_while_bounds_are_computed(place, monkeypatch):
    may_go_on, begun = threading.Event(), threading.Event()
    made = cramer_rao_bound

    def wait_and_compute(problem, theta):
        begun.set()
        assert may_go_on.wait(LIMIT_SECONDS)
        return made(problem, theta)

    monkeypatch.setattr(run_cramer_rao, "cramer_rao_bound", wait_and_compute)
    noisy = place.submit(**NOISY)
    states = []

    def meanwhile():
        assert begun.wait(LIMIT_SECONDS)
        quiet = place.submit(algorithm=SMALL)
        states.append(place.until(quiet, JobState.SUCCEEDED).state)
        states.append(place.job(noisy).state)
        may_go_on.set()

    (job,) = carry_out_jobs(place, noisy, meanwhile=meanwhile)
    assert states == [JobState.SUCCEEDED, JobState.RUNNING]
    assert job.state is JobState.SUCCEEDED
    assert job.cramer_rao["problems"][0]["stderr"]["T"] > 0


def test_a_job_is_cancelled_while_its_bounds_are_computed(place, monkeypatch):
    may_go_on, begun = threading.Event(), threading.Event()

    def wait_and_compute(problem, theta):
        begun.set()
        assert may_go_on.wait(LIMIT_SECONDS)
        raise ZeroDivisionError

    monkeypatch.setattr(run_cramer_rao, "cramer_rao_bound", wait_and_compute)
    noisy = place.submit(**NOISY)

    def meanwhile():
        assert begun.wait(LIMIT_SECONDS)
        place.cancel(noisy)
        place.until(noisy, JobState.CANCELLED)
        may_go_on.set()

    (job,) = carry_out_jobs(place, noisy, meanwhile=meanwhile)
    assert job.state is JobState.CANCELLED
    assert job.cramer_rao is None
    assert {run.state for run in place.runs(noisy)} == {JobState.SUCCEEDED}


@pytest.mark.parametrize("error", [np.linalg.LinAlgError("as told"), MemoryError()])
def test_an_error_of_the_numerics_is_a_note_and_the_job_succeeds(place, monkeypatch, error):
    def broken(problem, theta):
        raise error

    monkeypatch.setattr(run_cramer_rao, "cramer_rao_bound", broken)
    (job,) = carry_out_jobs(place, place.submit(**NOISY))
    assert job.state is JobState.SUCCEEDED
    assert any("no Cramér–Rao bound: internal error" in one for one in list_notes(job))


def test_of_more_problems_than_bounds_are_computed_of_a_note_tells(place, monkeypatch):
    monkeypatch.setattr(run_cramer_rao, "MAX_PROBLEMS", 2)
    (few,) = carry_out_jobs(place, place.submit(**NOISY, sweep={"axes": [SKIPS[0]]}))
    (many,) = carry_out_jobs(place, place.submit(**NOISY, sweep={"axes": [SKIPS[1]]}))
    assert [len(job.cramer_rao["problems"]) for job in (few, many)] == [2, 2]
    assert [run_cramer_rao.LEFT_OUT_NOTE in list_notes(job) for job in (few, many)] == [False, True]


SKIPS = [{"path": "/skip", "values": [1, 2]}, {"path": "/skip", "values": [1, 2, 3]}]


def test_bounds_and_runs_wait_for_a_store_that_is_away(place, monkeypatch):
    monkeypatch.setattr(job_parts, "RETRY_SECONDS", 0.0)
    monkeypatch.setattr(run_cramer_rao, "RETRY_SECONDS", 0.0)
    read, n_refused = place.store.get_bytes, [0]

    def refuse(sha256):
        n_refused[0] += 1
        if n_refused[0] % 4:
            raise ObjectStoreFailed("the object store cannot read an object: 500")
        return read(sha256)

    monkeypatch.setattr(place.store, "get_bytes", refuse)
    monkeypatch.setattr(stored_recordings, "CACHE_SIZE", 0)
    empty = stored_recordings._RecordingCache()
    monkeypatch.setattr(stored_recordings, "_recording_cache", empty)
    monkeypatch.setattr(job_parts, "CACHED_SAMPLES", 0)
    (job,) = carry_out_jobs(place, place.submit(**NOISY))
    assert job.state is JobState.SUCCEEDED
    assert job.cramer_rao["problems"][0]["stderr"]["T"] > 0
    with place.database.read_session() as session:
        told = [one.data for one in EventRepository(session).list_after(job.id)]
    assert "wait for their recordings" in str(told)


def test_a_dispatcher_goes_on_while_recordings_are_read(place, monkeypatch):
    monkeypatch.setattr(job_parts, "LOAD_SECONDS", 0.05)
    monkeypatch.setattr(job_parts, "ASK_SECONDS", 0.0)
    empty = stored_recordings._RecordingCache()
    monkeypatch.setattr(stored_recordings, "_recording_cache", empty)
    may_go_on, read = threading.Event(), place.store.get_bytes

    def hang(sha256):
        assert may_go_on.wait(LIMIT_SECONDS)
        return read(sha256)

    slow = place.submit(algorithm=SMALL)
    monkeypatch.setattr(place.store, "get_bytes", hang)

    def meanwhile():
        place.until(slow, JobState.RUNNING)
        with place.database.write_session() as session:
            other = JobRepository(session).submit(new_job("other", place.job(slow).spec)).job.id
            JobRepository(session).cancel(slow)
        place.until(slow, JobState.CANCELLED)  # the main loop has seen it
        may_go_on.set()
        place.until(other, JobState.SUCCEEDED)

    (job,) = carry_out_jobs(place, slow, meanwhile=meanwhile)
    assert job.state is JobState.CANCELLED
