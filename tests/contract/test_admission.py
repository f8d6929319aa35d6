"""Which waiting job is next, and how much a project may have unfinished; on both databases."""

from service.core.states import JobState
from service.queue.admission import Admission, UnfinishedWork, count_unfinished
from service.queue.leases import LeaseQueue
from service.queue.notifications import read_queue_status
from service.repositories.job_rows import JobRepository
from service.storage.tables import Project
from tests.support.storage.job_rows import claim, new_job, submit


def submit_for(database, project, **values):
    with database.write_session() as session:
        if session.get(Project, project) is None:
            session.add(Project(id=project, name=project))
            session.flush()
        new = new_job(name="j", spec={"model": "tube"}, **values)
        return JobRepository(session, project).submit(new).job.id


def claim_within(database, admission):
    with database.write_session() as session:
        claimed = LeaseQueue(session).claim_job("d1", admission=admission)
        return None if claimed is None else claimed.job.id


def test_the_project_with_fewest_running_jobs_comes_first(database):
    many = [submit_for(database, "many") for _ in range(3)]
    one = submit_for(database, "one")
    assert [claim(database).job.id for _ in range(4)] == [many[0], one, *many[1:]]


def test_a_priority_comes_before_the_projects_turn(database):
    ordinary, urgent = submit_for(database, "a"), submit_for(database, "b", priority=1)
    more = submit_for(database, "b", priority=1)
    assert [claim(database).job.id for _ in range(3)] == [urgent, more, ordinary]


def test_a_full_dispatcher_sees_and_takes_only_short_or_urgent_jobs(database):
    full = Admission(max_runs=8, above_priority=3)
    sweep = submit(database, n_runs=9, priority=3)
    with database.read_session() as session:
        assert not read_queue_status(session, "d1", full).has_waiting_job
        assert read_queue_status(session, "d1").has_waiting_job
    assert claim_within(database, full) is None
    short, urgent = submit(database, n_runs=8), submit(database, n_runs=100_000, priority=4)
    with database.read_session() as session:
        assert read_queue_status(session, "d1", full).has_waiting_job
    assert [claim_within(database, full) for _ in range(3)] == [urgent, short, None]
    assert claim_within(database, None) == sweep


def test_unfinished_work_is_counted_by_project_and_only_while_it_is_open(database):
    first = submit_for(database, "a", n_runs=10)
    submit_for(database, "a", n_runs=5)
    submit_for(database, "b", n_runs=7)
    with database.read_session() as session:
        assert count_unfinished(session, "a") == UnfinishedWork(2, 15)
        assert count_unfinished(session, "nobody") == UnfinishedWork(0, 0)
    with database.write_session() as session:
        assert JobRepository(session, "a").cancel(first).state is JobState.CANCELLED
    with database.read_session() as session:
        assert count_unfinished(session, "a") == UnfinishedWork(1, 5)
