"""Objects and rows: what no row names is garbage, what a row names must be there."""

import os
from datetime import timedelta

import pytest

from service.core.states import JobState
from service.queue.leases import LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.job_rows import JobRepository
from service.storage import garbage as garbage_collection
from service.storage import statements
from service.storage.columns import utc_now
from service.storage.garbage import (
    MINIMUM_AGE,
    delete_orphans,
    find_lost_hashes,
    find_orphans,
)
from service.storage.objects import open_store
from tests.support.storage.job_rows import new_dataset, submit_and_claim
from tests.support.storage.object_stores import make_bucket

AT_ONCE = timedelta(seconds=-5)


@pytest.fixture
def store(database, tmp_path):
    """A folder beside SQLite and a bucket beside PostgreSQL; a contract has both stores."""
    return open_store(f"file://{tmp_path}/objects" if database.is_sqlite else make_bucket())


def garbage(database, store, older_than=AT_ONCE):
    with database.read_session() as session:
        return {one.sha256 for one in find_orphans(session, store, older_than)}


def test_only_objects_that_no_living_row_names_are_garbage(database, store):
    raw, fit, stray = (store.put_stream([name]).sha256 for name in (b"raw", b"fit", b"stray"))
    got, (run_id,) = submit_and_claim(database)
    with database.write_session() as session:
        datasets = DatasetRepository(session)
        dataset_id = datasets.add(new_dataset(sha256=raw)).dataset.id
        datasets.add(new_dataset(sha256=raw, source_key="again"))
        RunWriter(session, got.lease).record_outcomes(
            [RunOutcome(run_id=run_id, state=JobState.SUCCEEDED, signals_sha256=fit)]
        )
        LeaseQueue(session).finish_job(got.lease, JobState.SUCCEEDED)
    assert garbage(database, store) == {stray}
    with database.write_session() as session:
        DatasetRepository(session).delete(dataset_id)
        JobRepository(session).delete(got.job.id)
    assert garbage(database, store) == {stray, fit}  # another dataset has the raw bytes


def test_a_young_object_may_still_be_waiting_for_its_row(database, store):
    store.put_stream([b"just written"])
    assert garbage(database, store, timedelta(hours=1)) == set()


def test_collecting_deletes_the_garbage_only(database, store):
    kept, stray = store.put_stream([b"kept"]).sha256, store.put_stream([b"stray"]).sha256
    with database.write_session() as session:
        DatasetRepository(session).add(new_dataset(sha256=kept))
    assert delete_orphans(database, store, AT_ONCE) == (1, len(b"stray"))
    with database.read_session() as session:
        assert list(find_lost_hashes(session, store)) == []
    assert store.exists(kept)
    assert not store.exists(stray)


def test_an_object_that_a_row_names_but_is_not_there_is_lost(database, store):
    with database.write_session() as session:
        DatasetRepository(session).add(new_dataset(sha256="e" * 64))
    with database.read_session() as session:
        assert list(find_lost_hashes(session, store)) == ["e" * 64]


def test_the_signals_of_runs_are_lost_too_unless_their_job_was_deleted(database, store):
    kept = store.put_stream([b"kept"]).sha256
    got, runs = submit_and_claim(database, n_runs=4)
    hashes = ("f" * 64, kept, "0" * 64, "f" * 64)
    outcomes = [
        RunOutcome(run_id=run, state=JobState.SUCCEEDED, signals_sha256=sha256)
        for run, sha256 in zip(runs, hashes, strict=True)
    ]
    with database.write_session() as session:
        RunWriter(session, got.lease).record_outcomes(outcomes)
        LeaseQueue(session).finish_job(got.lease, JobState.SUCCEEDED)
    with database.read_session() as session:
        assert list(find_lost_hashes(session, store)) == ["0" * 64, "f" * 64]
    with database.write_session() as session:
        JobRepository(session).delete(got.job.id)
    with database.read_session() as session:
        assert list(find_lost_hashes(session, store)) == []


def test_objects_are_looked_up_in_parts(database, store, monkeypatch):
    monkeypatch.setattr(statements.split_chunks, "__defaults__", (3,))
    stray = {store.put_stream([bytes([number])]).sha256 for number in range(10)}
    kept = store.put_stream([b"kept"]).sha256
    with database.write_session() as session:
        DatasetRepository(session).add(new_dataset(sha256=kept))
    assert garbage(database, store) == stray


OLD = 2 * MINIMUM_AGE.total_seconds()


@pytest.fixture
def folder_store(tmp_path):
    return open_store(f"file://{tmp_path}/objects")


@pytest.fixture
def orphan(folder_store, tmp_path):
    """An object that waits in vain for its row, as after a crash between the two."""
    sha256 = folder_store.put_stream([b"live"]).sha256
    (file,) = (tmp_path / "objects").rglob("*.mcap")
    os.utime(file, (file.stat().st_mtime - OLD,) * 2)
    return sha256


@pytest.mark.parametrize("has_row", [True, False])
def test_an_orphan_that_is_stored_again_while_garbage_is_collected_stays(
    database, folder_store, orphan, monkeypatch, has_row
):
    def find_and_let_others_write(*arguments):
        orphans = list(find_orphans(*arguments))
        if has_row:  # for which nothing was written, such as a run that was taken over
            with database.write_session() as session:
                DatasetRepository(session).add(new_dataset(sha256=orphan))
        else:  # its row comes later
            folder_store.put_stream([b"live"])
        assert [one.sha256 for one in orphans] == [orphan]
        return orphans

    monkeypatch.setattr(garbage_collection, "find_orphans", find_and_let_others_write)
    assert delete_orphans(database, folder_store) == (0, 0)
    assert folder_store.get_bytes(orphan) == b"live"


@pytest.mark.parametrize("when", ["before", "after"])
def test_an_object_that_is_stored_again_in_the_moment_it_is_deleted_stays(
    folder_store, orphan, monkeypatch, when
):
    rename = os.rename

    def rename_and_let_others_write(*paths):
        if when == "before":
            folder_store.put_stream([b"live"])
        rename(*paths)
        if when == "after":
            folder_store.put_stream([b"live"])

    monkeypatch.setattr(os, "rename", rename_and_let_others_write)
    assert folder_store.delete_older(orphan, utc_now() - MINIMUM_AGE) is (when == "after")
    assert folder_store.get_bytes(orphan) == b"live"
    assert list((folder_store._folder / "tmp").iterdir()) == []
