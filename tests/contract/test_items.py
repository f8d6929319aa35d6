"""Items are edited, found and deleted, on SQLite and on PostgreSQL alike."""

import threading
from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import func, select

from service.core.errors import Conflict, InvalidRequest, StaleVersion
from service.core.states import JobState
from service.items.deletion import HasDependents, delete_item
from service.items.editing import edit_item
from service.items.item_schemas import EditIn
from service.items.items import compute_etag
from service.jobs.job_links import store_job_links
from service.queue.leases import LeaseQueue
from service.queue.reuse import find_computed_runs
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.audit_rows import list_actions
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.job_rows import JobRepository
from service.repositories.lineage_rows import LineageRepository
from service.repositories.model_rows import ModelRepository
from service.repositories.reference_rows import ReferenceRepository
from service.repositories.run_rows import RunRepository
from service.repositories.search_conditions import ItemKind, ListFilter, Term
from service.repositories.summary_rows import read_run_table
from service.storage.sessions import Database, SessionOwner
from service.storage.storage_errors import RowNotFound
from service.storage.tables import DEFAULT_PROJECT, Run, SearchTerm, StoredSummary
from tests.support.storage.job_rows import (
    job_of,
    new_dataset,
    new_job,
    runs_of,
    submit,
    submit_and_claim,
)


def spec_of(dataset: str = "ds_1", **changes: Any) -> dict[str, Any]:
    return {
        "model": "tube",
        "datasets": [dataset],
        "validation": None,
        "warm_start": None,
        "trend": None,
        "sweep": {"axes": []},
        **changes,
    }


def add_dataset(database: Database, **values: Any) -> str:
    with database.write_session() as session:
        return DatasetRepository(session).add(new_dataset(**values)).dataset.id


def add_job(database: Database, name: str = "tube", **changes: Any) -> str:
    with database.write_session() as session:
        job = JobRepository(session).submit(new_job(name, spec_of(**changes))).job
        store_job_links(session, job)
        return job.id


def end_job(
    database: Database, states: tuple[JobState, ...], **changes: Any
) -> tuple[str, list[str]]:
    """An ended job whose runs have these states."""
    claim, runs = submit_and_claim(database, n_runs=len(states), spec=spec_of(**changes))
    end = JobState.SUCCEEDED
    with database.write_session() as session:
        store_job_links(session, claim.job)
        for number, (run, state) in enumerate(zip(runs, states, strict=True)):
            if state is JobState.CANCELLED:
                end = JobState.CANCELLED
                continue
            if state is JobState.FAILED and end is JobState.SUCCEEDED:
                end = JobState.INCOMPLETE
            done = {"estimates": {}, "parameters": []} if state is JobState.SUCCEEDED else None
            RunWriter(session, claim.lease).record_outcomes(
                [
                    RunOutcome(
                        run_id=run,
                        state=state,  # type: ignore[arg-type]
                        best_rms=1.0 + number if done else None,
                        spec_hash=f"h{number}" if done else None,
                        result=done,
                    )
                ]
            )
        LeaseQueue(session).finish_job(claim.lease, end)
    return claim.job.id, runs


def edit(
    database: Database, kind: ItemKind, item: str, if_match: str | None = None, **values: Any
) -> str:
    """Edit an item; return its new version."""
    with database.write_session() as session:
        return compute_etag(edit_item(session, kind, item, EditIn(**values), if_match))


def delete(database: Database, kind: ItemKind, item: str, *, cascade: bool = False) -> list[str]:
    with database.write_session() as session:
        return [one.id for one in delete_item(session, kind, item, cascade=cascade)]


def find_jobs(database: Database, *terms: Term, **values: Any) -> list[str]:
    with database.read_session() as session:
        found = JobRepository(session).list_page(chosen=ListFilter(terms=terms, **values))
        return [job.name for job in found.items]


def test_name_note_and_tags_are_changed_and_the_rest_stays(database: Database) -> None:
    job = add_job(database)
    first = edit(database, "job", job, name="forty", tags=["good", "blue", "good"])
    second = edit(database, "job", job, first, note="checked")
    row = job_of(database, job)
    assert (row.name, row.note, row.tags) == ("forty", "checked", ["good", "blue"])
    assert first != second
    assert edit(database, "job", job) == second  # no change, the same version
    with pytest.raises(StaleVersion, match="have ETag"):
        edit(database, "job", job, first, note="too late")
    assert edit(database, "job", job, "*", note=None) == first
    assert job_of(database, job).note is None


def test_of_two_edits_at_once_from_one_version_the_second_is_stale(database: Database) -> None:
    data, start, results = add_dataset(database), threading.Barrier(2), []
    version = edit(database, "dataset", data)

    def change(note: str) -> None:
        start.wait()
        try:
            edit(database, "dataset", data, version, note=note)
            results.append(note)
        except StaleVersion:
            results.append("stale")

    threads = [threading.Thread(target=change, args=(note,)) for note in ("a", "b")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(results) in (["a", "stale"], ["b", "stale"])


def test_a_reference_is_renamed_with_its_history_and_its_tags(database: Database) -> None:
    _, runs = end_job(database, (JobState.SUCCEEDED,) * 2)
    with database.write_session() as session:
        for run in runs:
            ReferenceRepository(session).accept_run("tube", run)
        ReferenceRepository(session).accept_run("other", runs[0])
    edit(database, "reference", "tube", tags=["good"])
    edit(database, "reference", "tube", name="hose", note="after cleaning")
    with pytest.raises(Conflict, match="'other' already"):
        edit(database, "reference", "hose", name="other")
    with pytest.raises(InvalidRequest, match="without '/'"):
        edit(database, "reference", "hose", name="a/b")
    with database.read_session() as session:
        references = ReferenceRepository(session)
        assert [one.run_id for one in references.list_history("hose")] == runs[::-1]
        assert references.get_latest("hose").note == "after cleaning"
        tagged = references.list_page(chosen=ListFilter(terms=(("tag", "good"),))).items
        assert [one.accepted.name for one in tagged] == ["hose"]
        named = references.list_page(chosen=ListFilter(name="THE")).items
        assert [one.accepted.name for one in named] == ["other"]
        later = named[0].accepted.accepted_at + timedelta(seconds=1)
        assert references.list_page(chosen=ListFilter(since=later)).items == ()
        assert len(references.list_page(chosen=ListFilter(until=later)).items) == 2


@pytest.mark.parametrize("kind", ["model", "run"])
def test_what_has_no_name_of_its_own_is_not_renamed(database: Database, kind: ItemKind) -> None:
    _, (run,) = end_job(database, (JobState.SUCCEEDED,))
    with database.write_session() as session:
        ModelRepository(session).add("pump", {"name": "pump"})
    item = run if kind == "run" else "pump"
    with pytest.raises(InvalidRequest, match="cannot be changed"):
        edit(database, kind, item, name="new")
    assert edit(database, kind, item, note="seen") != edit(database, kind, item, tags=["a"])


def test_jobs_are_found_by_each_condition_and_by_all_together(database: Database) -> None:
    model = {"name": "pump", "equations": {}}
    labels = {"path": "/datasets", "values": ["ds_1", "ds_2"], "labels": [{"x": 5.0}, {"x": 10}]}
    add_job(database, "Tube 40 m")
    add_job(database, "100 % open", dataset="ds_2", validation={"datasets": ["ds_3"]})
    batch = add_job(database, "batch of tubes", model=model, sweep={"axes": [labels]})
    edit(database, "job", batch, tags=["night"])
    assert find_jobs(database, name="tube") == ["batch of tubes", "Tube 40 m"]
    assert find_jobs(database, name="%") == ["100 % open"]
    assert find_jobs(database, name="_") == []
    assert find_jobs(database, ("model", "tube")) == ["100 % open", "Tube 40 m"]
    assert find_jobs(database, ("dataset", "ds_2")) == ["batch of tubes", "100 % open"]
    assert find_jobs(database, ("dataset", "ds_3")) == ["100 % open"]
    assert find_jobs(database, ("label", "x=5")) == ["batch of tubes"]
    assert find_jobs(database, ("tag", "night"), ("label", "x=10"), name="of") == ["batch of tubes"]
    assert find_jobs(database, ("tag", "night"), ("model", "tube")) == []
    edit(database, "job", batch, tags=[])
    assert find_jobs(database, ("tag", "night")) == []


def test_times_are_those_at_which_an_item_was_stored(database: Database) -> None:
    for name in ("first", "second"):
        add_job(database, name)
    with database.read_session() as session:
        second = JobRepository(session).list_page().items[0].created_at
    assert find_jobs(database, since=second) == ["second"]
    assert find_jobs(database, until=second) == ["first"]
    assert find_jobs(database, since=second + timedelta(days=1)) == []
    assert find_jobs(database, until=second - timedelta(days=1)) == []


def test_pages_of_a_search_have_no_gap_and_no_repeat(database: Database) -> None:
    ended, _ = end_job(database, (JobState.SUCCEEDED,))
    ids = [add_job(database, f"tube {number}") for number in range(7)]
    for chosen in (ListFilter(name="tube"), ListFilter(terms=(("model", "tube"),))):
        found, cursor, states = [], None, [JobState.QUEUED]
        with database.read_session() as session:
            while True:
                page = JobRepository(session).list_page(
                    cursor=cursor, limit=2, states=states, chosen=chosen
                )
                found += [job.id for job in page.items]
                cursor = page.next
                if cursor is None:
                    break
        assert found == ids[::-1]
        assert ended not in found


def test_datasets_are_found_by_the_labels_of_their_segments(database: Database) -> None:
    segments = [{"labels": {"length_m": length}} for length in (5, 10.0)]
    add_dataset(database, name="Tubes", details={"segments": segments})
    add_dataset(database, name="plain", source_key="other")
    with database.read_session() as session:
        datasets = DatasetRepository(session)
        for chosen in (
            ListFilter(terms=(("label", "length_m=10"),)),
            ListFilter(name="tUb", terms=(("label", "length_m=5"),)),
        ):
            assert [one.name for one in datasets.list_page(chosen=chosen).items] == ["Tubes"]


def test_another_project_sees_and_deletes_nothing(database: Database) -> None:
    job, (run,) = end_job(database, (JobState.SUCCEEDED,))
    edit(database, "job", job, tags=["mine"])
    chosen = ListFilter(terms=(("tag", "mine"),))
    other = database.open_for(SessionOwner("proj_other"))
    with other.write_session() as session:
        assert JobRepository(session).list_page(chosen=chosen).items == ()
        for kind, item in (("job", job), ("run", run), ("dataset", "ds_1")):
            with pytest.raises(RowNotFound):
                delete_item(session, kind, item)  # type: ignore[arg-type]


def test_what_others_were_made_from_is_refused_with_their_list(database: Database) -> None:
    raw = add_dataset(database, name="raw")
    with database.write_session() as session:
        cut = DatasetRepository(session).add(new_dataset(name="cut", source_key="c"), parents=[raw])
    job, (run,) = end_job(database, (JobState.SUCCEEDED,), dataset=cut.dataset.id)
    with database.write_session() as session:
        ReferenceRepository(session).accept_run("tube", run)
    later, _ = end_job(database, (JobState.SUCCEEDED,), dataset="ds_9", warm_start=run)
    with pytest.raises(HasDependents, match="cut") as refusal:
        delete(database, "dataset", raw)
    expected = [cut.dataset.id, job, later, "tube"]
    assert [one["id"] for one in refusal.value.members["dependents"]] == expected
    with pytest.raises(HasDependents):
        delete(database, "run", run)
    assert delete(database, "dataset", raw, cascade=True) == [raw, *expected]
    with database.read_session() as session:
        assert DatasetRepository(session).list_page().items == ()
        assert JobRepository(session).list_page().items == ()
        assert ReferenceRepository(session).list_names() == []
        assert session.scalars(select(SearchTerm)).all() == []
        edges = LineageRepository(session).list_ancestors(later)
        assert {(edge.child, edge.parent) for edge in edges} >= {(cut.dataset.id, raw)}
        with pytest.raises(RowNotFound, match=run):
            RunRepository(session).get(run)
        assert find_computed_runs(session, ["h0"]) == {}


@pytest.mark.parametrize("cascade", [True, False])
def test_an_open_job_is_refused_and_nothing_is_deleted(database: Database, cascade: bool) -> None:
    data = add_dataset(database)
    job = add_job(database, dataset=data)
    with pytest.raises(Conflict, match=job):
        delete(database, "dataset", data, cascade=cascade)
    with pytest.raises(Conflict, match="is queued"):
        delete(database, "job", job, cascade=cascade)
    with database.read_session() as session:
        DatasetRepository(session).get(data)
    assert job_of(database, job).state is JobState.QUEUED


def test_a_deleted_run_is_left_out_of_lists_counts_and_summaries(database: Database) -> None:
    job, runs = end_job(database, (JobState.SUCCEEDED,) * 3)
    with database.write_session() as session:
        session.add(StoredSummary(job_id=job, attempt=1, document={}))
    assert delete(database, "run", runs[0]) == [runs[0]]
    assert [run.id for run in runs_of(database, job)] == runs[1:]
    with database.read_session() as session:
        repository = RunRepository(session)
        assert repository.count_states(job)[JobState.SUCCEEDED] == 2
        assert session.scalar(select(func.count()).where(Run.job_id == job)) == 3
        assert read_run_table(session, job).numbers.tolist() == [1, 2]
        assert session.get(StoredSummary, job) is None
        assert find_computed_runs(session, ["h0", "h1"]) == {"h1": runs[1]}
        assert [job.best_rms for job in JobRepository(session).list_page().items] == [2.0]


def test_a_resumed_job_does_not_compute_a_deleted_run_again(database: Database) -> None:
    states = (JobState.SUCCEEDED, JobState.FAILED, JobState.FAILED, *2 * (JobState.CANCELLED,))
    job, runs = end_job(database, states)
    for run in runs[:4:3] + runs[1:2]:
        delete(database, "run", run)
    with database.write_session() as session:
        JobRepository(session).resume(job)
        claim = LeaseQueue(session).claim_job("d2")
        assert claim is not None
        waiting = RunWriter(session, claim.lease).list_pending()
        assert [run.id for run in waiting] == [runs[2], runs[4]]
        RunWriter(session, claim.lease).record_outcomes(
            [RunOutcome(run_id=run.id, state=JobState.SUCCEEDED) for run in waiting]
        )
        ended = LeaseQueue(session).finish_job(claim.lease, JobState.SUCCEEDED)
        assert (ended.n_runs, ended.n_done, ended.n_failed) == (5, 5, 0)


def test_a_job_is_complete_once_its_last_failed_run_is_deleted(database: Database) -> None:
    states = (JobState.SUCCEEDED, JobState.FAILED, JobState.FAILED)
    job, runs = end_job(database, states)
    for run, state in ((runs[1], JobState.INCOMPLETE), (runs[2], JobState.SUCCEEDED)):
        delete(database, "run", run)
        with database.read_session() as session:
            assert JobRepository(session).get(job).state is state


def test_dispatchers_share_a_resumed_job_without_its_deleted_runs(database: Database) -> None:
    job, runs = end_job(database, (JobState.CANCELLED,) * 4)
    for run in runs[:2]:
        delete(database, "run", run)
    with database.write_session() as session:
        JobRepository(session).resume(job)
    for owner, left in (("d1", []), ("d2", runs[2:])):
        with database.write_session() as session:
            queue = LeaseQueue(session)
            claim = queue.claim_job(owner, choose_size=lambda _: 2)
            assert claim is not None
            writer = RunWriter(session, claim.lease)
            assert [run.id for run in writer.list_pending()] == left
            writer.record_outcomes(
                [RunOutcome(run_id=run, state=JobState.SUCCEEDED) for run in left]
            )
            assert queue.end_parcel(claim.lease) is not bool(left)
            if left:
                ended = queue.finish_job(claim.lease, JobState.SUCCEEDED)
                assert (ended.n_done, ended.n_failed) == (4, 0)


def test_each_edit_and_deletion_is_in_the_audit_log(database: Database) -> None:
    data, (job, (run, other)) = add_dataset(database), end_job(database, (JobState.SUCCEEDED,) * 2)
    with database.write_session() as session:
        model = ModelRepository(session).add("pump", {"name": "pump"}).model
        ReferenceRepository(session).accept_run("tube", other)
    items: dict[ItemKind, tuple[str, str]] = {
        "reference": ("tube", "tube"),
        "run": (run, run),
        "job": (job, job),
        "dataset": (data, data),
        "model": ("pump", model.id),
    }
    for kind, (name, _) in items.items():
        edit(database, kind, name, note="n")
        delete(database, kind, name)
    with database.read_session() as session:
        page = list_actions(session, DEFAULT_PROJECT, limit=2 * len(items))
    told = [(entry.action, entry.object_id) for entry in reversed(page.items)]
    assert told == [
        (f"{kind}.{what}", identity)
        for kind, (_, identity) in items.items()
        for what in ("edit", "delete")
    ]


def test_a_model_is_deleted_by_version_or_whole_and_its_jobs_depend_on_it(
    database: Database,
) -> None:
    documents = [{"name": "pump", "order": order} for order in (1, 2)]
    with database.write_session() as session:
        for document in documents:
            ModelRepository(session).add("pump", document)
    job, _ = end_job(database, (JobState.SUCCEEDED,), model=documents[0])
    assert delete(database, "model", "pump@2") == ["pump@2"]
    with pytest.raises(HasDependents, match=job):
        delete(database, "model", "pump")
    assert delete(database, "model", "pump", cascade=True) == ["pump", job]
    with database.read_session() as session:
        assert ModelRepository(session).list_page().items == ()
    with pytest.raises(Exception, match="tube"):
        delete(database, "model", "tube")  # built in


def test_a_key_of_a_deleted_job_may_be_used_again(database: Database) -> None:
    def send() -> str:
        with database.write_session() as session:
            return JobRepository(session).submit(new_job("a", spec_of()), key="k").job.id

    first = send()
    with database.write_session() as session:
        JobRepository(session).cancel(first)
    delete(database, "job", first)
    assert send() != first


def test_a_dataset_that_is_being_used_cannot_be_deleted_meanwhile(database: Database) -> None:
    """A job is stored while somebody deletes its dataset: one of both sees the other."""
    data, locked, deleted = add_dataset(database), threading.Event(), []

    def remove() -> None:
        locked.wait()
        try:
            deleted.extend(delete(database, "dataset", data))
        except Conflict as error:
            deleted.append(type(error).__name__)

    thread = threading.Thread(target=remove)
    thread.start()
    with database.write_session() as session:
        DatasetRepository(session).lock_used([data])
        locked.set()
        job = JobRepository(session).submit(new_job("a", spec_of(data))).job
        store_job_links(session, job)
    thread.join()
    assert deleted == ["HasDependents"]
    with database.write_session() as session, pytest.raises(RowNotFound, match="ds_none"):
        DatasetRepository(session).lock_used([data, "ds_none"])


@pytest.mark.parametrize("kind", ["job", "run"])
def test_a_run_that_is_being_used_cannot_be_deleted_meanwhile(
    database: Database, kind: ItemKind
) -> None:
    job, (run,) = end_job(database, (JobState.SUCCEEDED,))
    locked, deleted = threading.Event(), []

    def remove() -> None:
        locked.wait()
        try:
            deleted.extend(delete(database, kind, run if kind == "run" else job))
        except Conflict as error:
            deleted.append(type(error).__name__)

    thread = threading.Thread(target=remove)
    thread.start()
    with database.write_session() as session:
        JobRepository(session).share_lock(job)
        locked.set()
        later = JobRepository(session).submit(new_job("a", spec_of(warm_start=run))).job
        store_job_links(session, later)
    thread.join()
    assert deleted == ["HasDependents"]


def test_submit_still_works_without_links(database: Database) -> None:
    """Rows of earlier versions have no terms; lists without a filter show them."""
    old = submit(database, "old")
    with database.read_session() as session:
        assert [job.id for job in JobRepository(session).list_page().items] == [old]
        assert session.scalars(select(Run)).all() == []
