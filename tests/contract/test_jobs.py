"""Jobs and their events as users see them, on SQLite and on PostgreSQL alike."""

import threading
from datetime import UTC

import pytest

from service.core.states import JobState
from service.items.deletion import delete_item
from service.queue.leases import JobProgress, LeaseQueue
from service.queue.queue_state import read_queue_state
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories import result_rows as results
from service.repositories.event_rows import EventRepository
from service.repositories.job_rows import JobRepository
from service.repositories.result_rows import list_results
from service.repositories.search_conditions import ListFilter
from service.storage.storage_errors import (
    InvalidCursor,
    KeyReused,
    RowConflict,
    RowNotFound,
    UnstorableValue,
)
from service.storage.tables import Job, Project, Run
from tests.support.storage.databases import record_statements
from tests.support.storage.job_rows import (
    claim,
    job_of,
    new_job,
    record_outcomes,
    runs_of,
    submit,
    submit_and_claim,
)

NEW = new_job(name="tube 40 m", spec={"model": "tube", "sweep": {"axes": []}}, n_runs=3)


def list_events(database, job_id, after=0, limit=500):
    with database.read_session() as session:
        return EventRepository(session).list_after(job_id, after, limit)


def kinds(database, job_id):
    return [(event.kind, event.data.get("state")) for event in list_events(database, job_id)]


def test_a_submitted_job_is_queued_and_kept_whole(database):
    with database.write_session() as session:
        submission = JobRepository(session).submit(NEW)
    assert submission.is_new
    job = job_of(database, submission.job.id)
    assert (job.state, job.spec, job.n_runs, job.name) == (
        JobState.QUEUED,
        NEW.spec,
        3,
        "tube 40 m",
    )
    assert job.created_at.tzinfo is UTC


def test_a_specification_keeps_the_order_of_its_keys(database):
    parameters = {name: {"lower": 0, "upper": 1} for name in ("zeta", "T", "L", "gain")}
    with database.write_session() as session:
        job = JobRepository(session).submit(
            new_job(name="order", spec={"model": {"parameters": parameters}}, n_runs=1)
        )
    found = job_of(database, job.job.id).spec["model"]["parameters"]
    assert list(found) == ["zeta", "T", "L", "gain"]


def test_the_same_request_under_the_same_key_is_one_job(database):
    found = []
    for _ in range(2):
        with database.write_session() as session:
            found.append(JobRepository(session).submit(NEW, key="k1", request_hash="h"))
    assert [one.is_new for one in found] == [True, False]
    assert found[0].job.id == found[1].job.id
    assert found[1].job.spec == NEW.spec


def test_another_request_under_the_same_key_is_refused(database):
    with database.write_session() as session:
        JobRepository(session).submit(NEW, key="k1", request_hash="h")
    with pytest.raises(KeyReused, match="k1"), database.write_session() as session:
        JobRepository(session).submit(NEW, key="k1", request_hash="other")


def test_many_requests_under_one_key_at_once_make_one_job(database):
    found, start = [], threading.Barrier(4)

    def send():
        start.wait()
        with database.write_session() as session:
            found.append(JobRepository(session).submit(NEW, key="k1", request_hash="h"))

    threads = [threading.Thread(target=send) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({one.job.id for one in found}) == 1
    assert sum(one.is_new for one in found) == 1
    with database.read_session() as session:
        assert read_queue_state(session).jobs[JobState.QUEUED] == 1


def test_pages_of_jobs_stay_put_while_new_ones_arrive(database):
    old = [submit(database) for _ in range(5)]
    with database.read_session() as session:
        first = JobRepository(session).list_page(limit=2)
    submit(database)
    with database.read_session() as session:
        second = JobRepository(session).list_page(limit=2, cursor=first.next)
        third = JobRepository(session).list_page(limit=2, cursor=second.next)
    pages = [*first.items, *second.items, *third.items]
    assert [job.id for job in pages] == old[::-1]
    assert third.next is None


def test_a_page_that_ends_exactly_at_the_end_has_no_next(database):
    submit(database), submit(database)
    with database.read_session() as session:
        page = JobRepository(session).list_page(limit=2)
    assert len(page.items) == 2
    assert page.next is None


def end_with_fit(database, name, *fits, cell=None, trust=None):
    """A job whose runs ended with these fits (%); a better fit has a smaller RMS.

    `trust` is that of all runs, or has one for each.
    """
    each = trust if isinstance(trust, tuple) else (trust,) * len(fits)
    results = [
        None if one is None else {"parameters": [], "verdict": {"trust": one}} for one in each
    ]
    ended, runs = submit_and_claim(database, n_runs=len(fits), name=name)
    record_outcomes(
        database,
        ended.lease,
        *(
            RunOutcome(
                run_id=run,
                state=JobState.SUCCEEDED,
                best_rms=None if fit is None else 100.0 - fit,
                fit_estimation=fit,
                result=result,
            )
            for run, fit, result in zip(runs, fits, results, strict=True)
        ),
    )
    with database.write_session() as session:
        if cell is not None:
            session.get_one(Run, runs[0]).cell = cell
        LeaseQueue(session).finish_job(ended.lease, JobState.SUCCEEDED)
    return ended.job.id


def list_in_order(database, order, **options):
    """The names of all pages of two jobs in an order."""
    names, cursor = [], None
    while True:
        with database.read_session() as session:
            page = JobRepository(session).list_page(cursor=cursor, limit=2, order=order, **options)
        names += [job.name for job in page.items]
        cursor = page.next
        if cursor is None:
            return names


def test_jobs_are_sorted_over_all_pages_and_those_without_a_value_come_last(database):
    end_with_fit(database, "c", 90.0)
    end_with_fit(database, "B", 70.0, 95.0)  # its best run counts
    end_with_fit(database, "a", None)
    end_with_fit(database, "d", 90.0)
    end_with_fit(database, "batch", 99.0, cell={"/datasets": ["ds_1"]})
    submit(database, "e")
    assert list_in_order(database, "fit") == ["B", "d", "c", "e", "batch", "a"]
    assert list_in_order(database, "worst-fit") == ["d", "c", "B", "e", "batch", "a"]
    assert list_in_order(database, "rms") == ["B", "d", "c", "e", "batch", "a"]
    assert list_in_order(database, "name") == ["a", "B", "batch", "c", "d", "e"]
    assert list_in_order(database, "oldest") == ["c", "B", "a", "d", "batch", "e"]
    assert list_in_order(database, "fit", chosen=ListFilter(name="B")) == ["B", "batch"]
    queued = list_in_order(database, "name", states=[JobState.QUEUED])
    assert queued == ["e"]


def test_jobs_are_sorted_by_the_trust_in_their_results(database):
    end_with_fit(database, "a", 90.0, trust="limited")
    end_with_fit(database, "b", 70.0, trust="not trustworthy")
    resumed = end_with_fit(database, "c", 80.0, trust="trustworthy")
    end_with_fit(database, "d", 99.0, trust="trustworthy")
    end_with_fit(database, "batch", 99.0, trust="trustworthy", cell={"/datasets": ["ds_1"]})
    submit(database, "e")
    assert list_in_order(database, "verdict") == ["d", "c", "a", "b", "e", "batch"]
    assert list_in_order(database, "worst-verdict") == ["b", "a", "d", "c", "e", "batch"]
    with database.write_session() as session:
        session.get_one(Job, resumed).state = JobState.FAILED
    with database.write_session() as session:
        JobRepository(session).resume(resumed)
    assert list_in_order(database, "verdict")[0:2] == ["d", "a"]


def test_fit_and_trust_of_a_job_are_those_of_the_best_run_that_is_left(database):
    job = end_with_fit(database, "two", 90.0, 95.0, trust=("limited", "trustworthy"))
    runs = [run.id for run in runs_of(database, job)]
    found = []
    for best in (None, runs[1], runs[0]):
        if best is not None:
            with database.write_session() as session:
                delete_item(session, "run", best)
        left = job_of(database, job)
        found.append((left.fit_estimation, left.best_rms, left.trust))
    assert found == [(95.0, 5.0, "trustworthy"), (90.0, 10.0, "limited"), (None, None, None)]


@pytest.mark.parametrize("cursor", ["job_0", "nothing", "job_0:7"])
def test_a_cursor_of_a_sorted_list_is_a_job(database, cursor):
    submit(database)
    with pytest.raises(InvalidCursor), database.read_session() as session:
        JobRepository(session).list_page(cursor=cursor, order="fit")


def test_results_of_all_jobs_follow_each_other_page_by_page(database):
    for name, fits in (("a", (90.0,)), ("b", (80.0, 85.0, 83.0)), ("c", (None,)), ("d", (70.0,))):
        end_with_fit(database, name, *fits)
    submit(database, "waits")

    def walk(**options):
        found, cursor = [], None
        for _ in range(9):
            with database.read_session() as session:
                page = list_results(session, cursor=cursor, limit=2, **options)
            found += [(row.job.name, row.number) for row in page.items]
            cursor = page.next
            if cursor is None:
                return found
        raise AssertionError(found)

    assert walk() == [("d", 0), ("c", 0), ("b", 0), ("b", 1), ("b", 2), ("a", 0)]
    assert walk(only_best=True) == [("d", 0), ("c", 0), ("b", 1), ("a", 0)]
    assert walk(chosen=ListFilter(name="b")) == [("b", 0), ("b", 1), ("b", 2)]
    for cursor in ("job_0:1", "x", "job_0:", "job_0:-1"):
        with pytest.raises(InvalidCursor), database.read_session() as session:
            list_results(session, cursor=cursor)


def test_jobs_without_results_cost_pages_of_results_no_query_each(database):
    end_with_fit(database, "first", 70.0)
    for name in "abcdef":
        job = end_with_fit(database, name, 80.0, 85.0)
        with database.write_session() as session:
            for run in runs_of(database, job):
                delete_item(session, "run", run.id)
    for options in ({}, {"only_best": True}):
        with database.read_session() as session, record_statements(database) as statements:
            page = list_results(session, **options)
        assert [row.job.name for row in page.items] == ["first"]
        assert len(statements) <= 5


def test_a_page_of_results_looks_at_so_many_jobs_and_the_next_goes_on(database, monkeypatch):
    monkeypatch.setattr(results, "MAX_JOBS", 2)
    monkeypatch.setattr(results, "JOBS_AT_ONCE", 1)
    end_with_fit(database, "first", 70.0)
    for _ in range(4):
        submit(database, "waits")
    pages, cursor = [], None
    while not pages or cursor is not None:
        with database.read_session() as session:
            page = list_results(session, cursor=cursor)
        pages.append([row.job.name for row in page.items])
        cursor = page.next
    assert pages == [[], [], ["first"]]


def test_jobs_are_listed_and_counted_by_state(database):
    first, second = submit(database), submit(database)
    claim(database)
    with database.read_session() as session:
        jobs = JobRepository(session)
        assert [job.id for job in jobs.list_page(states=[JobState.RUNNING]).items] == [first]
        assert [
            job.id for job in jobs.list_page(states=[JobState.QUEUED, JobState.RUNNING]).items
        ] == [second, first]
        assert read_queue_state(session).jobs == {
            JobState.QUEUED: 1,
            JobState.RUNNING: 1,
            JobState.SUCCEEDED: 0,
            JobState.FAILED: 0,
            JobState.CANCELLED: 0,
            JobState.INCOMPLETE: 0,
        }


def test_a_deleted_job_is_no_longer_there(database):
    job_id = submit(database)
    with pytest.raises(RowConflict, match="cancel it"), database.write_session() as session:
        JobRepository(session).delete(job_id)
    with database.write_session() as session:
        JobRepository(session).cancel(job_id)
        JobRepository(session).delete(job_id)
    with database.read_session() as session:
        assert JobRepository(session).list_page().items == ()
        assert sum(read_queue_state(session).jobs.values()) == 0
        with pytest.raises(RowNotFound, match=job_id):
            JobRepository(session).get(job_id)


def test_another_projects_jobs_are_neither_seen_nor_touched(database):
    with database.write_session() as session:
        session.add(Project(id="proj_other", name="other"))
    job_id = submit(database)
    with database.write_session() as session:
        foreign = JobRepository(session, "proj_other")
        assert foreign.list_page().items == ()
        for act in (foreign.get, foreign.cancel, foreign.resume, foreign.delete):
            with pytest.raises(RowNotFound):
                act(job_id)
        assert foreign.submit(NEW, key="k", request_hash="h").is_new
    with database.write_session() as session:
        assert JobRepository(session).submit(NEW, key="k", request_hash="h").is_new


@pytest.mark.parametrize("name", ["a\x00b", "\udcff"])
def test_a_name_that_not_every_database_can_keep_is_refused(database, name):
    with pytest.raises(UnstorableValue), database.write_session() as session:
        JobRepository(session).submit(new_job(name=name, spec={}))


def test_a_job_tells_its_whole_story(database):
    got, (run_id,) = submit_and_claim(database)
    with database.write_session() as session:
        queue = LeaseQueue(session)
        queue.append_event(got.lease, "log", {"line": "packing 1 run"})
        queue.write_progress(got.lease, JobProgress(50, best_rms=0.5))
        RunWriter(session, got.lease).record_outcomes(
            [RunOutcome(run_id=run_id, state=JobState.SUCCEEDED)]
        )
        queue.finish_job(got.lease, JobState.SUCCEEDED)
    assert kinds(database, got.job.id) == [
        ("state", "queued"),
        ("state", "running"),
        ("log", None),
        ("progress", None),
        ("state", "succeeded"),
        ("end", "succeeded"),
    ]


def test_a_resumed_job_tells_on_after_its_end(database):
    job_id = submit(database)
    with database.write_session() as session:
        JobRepository(session).cancel(job_id)
        JobRepository(session).resume(job_id)
    assert kinds(database, job_id)[-2:] == [("end", "cancelled"), ("state", "queued")]


def test_a_reader_goes_on_after_the_last_event_it_saw(database):
    got, _ = submit_and_claim(database)
    other, _ = submit_and_claim(database)
    for i in range(5):
        with database.write_session() as session:
            LeaseQueue(session).append_event(got.lease, "log", {"line": i})
            LeaseQueue(session).append_event(other.lease, "log", {"line": -i})
    everything = list_events(database, got.job.id)
    ids = [event.id for event in everything]
    assert ids == sorted(set(ids))
    first = list_events(database, got.job.id, limit=3)
    rest = list_events(database, got.job.id, after=first[-1].id)
    assert [event.id for event in first + rest] == ids
    assert [event.data["line"] for event in rest] == [1, 2, 3, 4]


def test_an_event_is_never_seen_before_one_with_a_smaller_number(database):
    got, _ = submit_and_claim(database)
    before = len(list_events(database, got.job.id))

    def write(line):
        with database.write_session() as session:
            EventRepository(session).append_event(got.job.id, "log", {"line": line})

    with database.write_session() as slow:
        EventRepository(slow).append_event(got.job.id, "log", {"line": "first"})
        quick = threading.Thread(target=write, args=("second",))
        quick.start()
        quick.join(0.3)
        assert len(list_events(database, got.job.id)) == before
    quick.join()
    lines = [event.data["line"] for event in list_events(database, got.job.id)[before:]]
    assert lines == ["first", "second"]


def test_a_reader_who_polls_while_two_writers_write_misses_no_event(database):
    got, _ = submit_and_claim(database)
    stop, seen = threading.Event(), []

    def write(who):
        for i in range(15):
            with database.write_session() as session:
                EventRepository(session).append_event(got.job.id, "log", {"line": f"{who}{i}"})

    def read():
        last, final = 0, False
        while not final:
            final = stop.is_set()
            for event in list_events(database, got.job.id, last):
                last = event.id
                seen.append(event.id)

    reader = threading.Thread(target=read)
    writers = [threading.Thread(target=write, args=(who,)) for who in "ab"]
    for thread in [reader, *writers]:
        thread.start()
    for thread in writers:
        thread.join()
    stop.set()
    reader.join()
    assert seen == [event.id for event in list_events(database, got.job.id)]
    assert len(seen) == 32
