"""Objects and rows: what no row names is garbage, what a row names must be there."""

from datetime import timedelta

import pytest

from service.core.states import JobState
from service.queue.leases import LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.datasets import DatasetRepository
from service.repositories.jobs import JobRepository
from service.storage.garbage import delete_orphans, find_lost_hashes, find_orphans
from service.storage.objects import open_store
from tests.stored import claimed, new_dataset

AT_ONCE = timedelta(seconds=-5)


@pytest.fixture
def store(tmp_path):
    return open_store(f"file://{tmp_path}/objects")


def garbage(database, store, older_than=AT_ONCE):
    with database.read_session() as session:
        return {one.sha256 for one in find_orphans(session, store, older_than)}


def test_only_objects_that_no_living_row_names_are_garbage(database, store):
    raw, fit, stray = (store.put_stream([name]).sha256 for name in (b"raw", b"fit", b"stray"))
    got, (run_id,) = claimed(database)
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
    with database.read_session() as session:
        assert delete_orphans(session, store, AT_ONCE) == len(b"stray")
        assert find_lost_hashes(session, store) == set()
    assert store.exists(kept)
    assert not store.exists(stray)


def test_an_object_that_a_row_names_but_is_not_there_is_lost(database, store):
    with database.write_session() as session:
        DatasetRepository(session).add(new_dataset(sha256="e" * 64))
    with database.read_session() as session:
        assert find_lost_hashes(session, store) == {"e" * 64}
