"""Runs that were computed before are taken over, whole, and say so."""

from datetime import timedelta

import pytest

from service.core.states import JobState
from service.dispatch import fitted_signals
from service.repositories.event_rows import EventRepository
from service.repositories.job_rows import JobRepository
from service.storage.garbage import delete_orphans
from service.storage.storage_errors import ObjectStoreFailed
from tests.support.cluster.dispatch_place import carry_out
from tests.support.cluster.inline_executor import InlineExecutor
from workers import tasks

pytestmark = pytest.mark.slow

SMALL = {"population": 8, "generations": 5, "islands": 1}


class CountingExecutor(InlineExecutor):
    """An executor that remembers which runs it was given."""

    def __init__(self):
        super().__init__()
        self.computed = []

    def submit_pack(self, pack):
        self.computed += [item.run for item in pack.items]
        return super().submit_pack(pack)


def sweep(seeds, **changes):
    axes = [{"path": "/seed", "range": [0, seeds]}]
    return {"sweep": {"axes": axes}, "algorithm": SMALL, "reuse": True, **changes}


def carry_out_job(place, **body):
    """The job's runs once it is over, and those that a worker computed."""
    job, executor = place.submit(**body), CountingExecutor()
    carry_out(place, job, executor)
    return job, place.runs(job), list(dict.fromkeys(executor.computed))


def test_more_replicates_of_a_sweep_compute_only_the_new_ones(place):
    _, before, computed = carry_out_job(place, **sweep(3))
    assert len(computed) == 3
    job, after, computed = carry_out_job(place, **sweep(5))
    assert computed == [run.id for run in after[3:]]
    for old, new in zip(before, after[:3], strict=True):
        assert new.result.pop("reused_from") == old.id
        assert new.result == old.result
        assert place.history(new.id) == place.history(old.id) != []
        assert (new.best_rms, new.evaluations, new.signals_sha256) == (
            old.best_rms,
            old.evaluations,
            old.signals_sha256,
        )
    with place.database.read_session() as session:
        told = [one.data.get("message") for one in EventRepository(session).list_latest(job, 20)]
    assert "3 of 5 runs were taken over from earlier runs" in told
    assert place.job(job).evaluations == sum(run.evaluations for run in after)
    assert place.job(job).n_done == 5


def test_the_same_sweep_twice_reports_the_same_figures(place):
    jobs = [place.job(carry_out_job(place, **sweep(3))[0]) for _ in range(2)]
    names = ("state", "n_runs", "n_done", "n_failed", "evaluations", "generation", "best_rms")
    first, again = ([getattr(job, name) for name in names] for job in jobs)
    assert first == again
    assert jobs[0].generation > 0
    assert [job.n_reused for job in jobs] == [0, 3]


def test_a_run_taken_over_twice_names_the_one_that_was_computed(place):
    _, (first,), _ = carry_out_job(place, **sweep(1))
    carry_out_job(place, **sweep(1))
    _, (third,), computed = carry_out_job(place, **sweep(1))
    assert third.result["reused_from"] == first.id
    assert computed == []


def test_a_job_that_keeps_signals_takes_over_no_run_without_them(place):
    carry_out_job(place, **sweep(2))
    _, runs, computed = carry_out_job(place, **sweep(2, keep_signals=True))
    assert computed == [run.id for run in runs]
    assert carry_out_job(place, **sweep(2, keep_signals=True))[2] == []


def test_runs_of_a_deleted_job_are_not_taken_over_as_their_signals_are_garbage(place):
    kept = {"keep_signals": True}
    first, before, _ = carry_out_job(place, **sweep(2, **kept))
    with place.database.write_session() as session:
        JobRepository(session).delete(first)
    delete_orphans(place.database, place.store, older_than=timedelta(0))
    _, after, computed = carry_out_job(place, **sweep(2, **kept))
    assert computed == [run.id for run in after]
    assert [run.best_rms for run in after] == [run.best_rms for run in before]
    assert all(place.store.exists(run.signals_sha256) for run in after)


def test_reuse_can_be_declined(place):
    carry_out_job(place, **sweep(2))
    _, runs, computed = carry_out_job(place, **sweep(2, reuse=False))
    assert computed == [run.id for run in runs]
    assert all("reused_from" not in run.result for run in runs)


def test_another_specification_is_computed(place):
    carry_out_job(place, **sweep(1))
    for changes in (
        {"noise": {"sigma": 0.1}},
        {"skip": 1},
        {"parameters": {"T": {"upper": 9.0}}},
        {"algorithm": {**SMALL, "bits": 20}},
        {"loss": {"kind": "soft-l1", "scale": 0.5}},
    ):
        _, _, computed = carry_out_job(place, **{**sweep(1), **changes})
        assert len(computed) == 1, changes


def test_a_run_that_the_clock_may_end_is_computed_again(place):
    body = sweep(1, algorithm={**SMALL, "stop": {"seconds": 60}})
    carry_out_job(place, **body)
    assert len(carry_out_job(place, **body)[2]) == 1


def test_a_run_that_failed_is_tried_again(place, monkeypatch):
    def broken(*_, **__):
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(tasks, "conclude_run", broken)
        _, (run,), _ = carry_out_job(place, **sweep(1))
    assert run.state is JobState.FAILED
    _, (again,), computed = carry_out_job(place, **sweep(1))
    assert computed == [again.id]
    assert again.state is JobState.SUCCEEDED


def test_a_run_without_its_signals_is_computed_again(place, monkeypatch):
    def full(_):
        raise ObjectStoreFailed("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(fitted_signals, "RETRY_SECONDS", -1.0)
        patched.setattr(place.store, "put_stream", full)
        _, (first,), _ = carry_out_job(place, **sweep(1))
    assert first.signals_sha256 is None
    _, (again,), computed = carry_out_job(place, **sweep(1))
    assert computed == [again.id]
    assert again.signals_sha256 is not None
