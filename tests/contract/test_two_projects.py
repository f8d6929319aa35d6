"""What belongs to one project is neither found nor changed by another, on both databases."""

import pytest

from service.core.states import JobState
from service.jobs.stored_results import write_result_document
from service.queue.leases import Claim, LeaseQueue
from service.queue.reuse import find_computed_runs, take_over_runs
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.job_rows import JobRepository
from service.repositories.lineage_rows import (
    LineageRepository,
    find_datasets_by_name,
    list_dataset_names,
    list_reference_names,
)
from service.repositories.model_rows import ModelRepository
from service.repositories.reference_rows import ReferenceRepository
from service.repositories.summary_rows import find_quietest_run
from service.repositories.trend_rows import read_trend_rows
from service.storage.sessions import SessionOwner, find_database
from service.storage.storage_errors import RowNotFound
from service.storage.tables import DEFAULT_PROJECT, Project
from tests.support.storage.job_rows import job_of, new_dataset, new_job, new_run
from tests.support.storage.run_results import conclude

OTHER = "proj_other"
PROJECTS = (DEFAULT_PROJECT, OTHER)
HASH = "h" * 32


@pytest.fixture
def shared_database(database):
    """A database with two projects."""
    with database.write_session() as session:
        session.add(Project(id=OTHER, name="other"))
    return database


def claim_run(database, project: str) -> tuple[Claim, str]:
    """A claimed job of a project with one run."""
    with database.write_session() as session:
        new = new_job(name="tube", spec={"model": "tube"})
        job = JobRepository(session, project).submit(new).job.id
        got = LeaseQueue(session).claim_job("d1")
        assert got.job.id == job
        writer = RunWriter(session, got.lease)
        writer.create_runs([new_run(number=0, sigma=0.5)])
        (run,) = writer.list_pending()
        return got, run.id


def compute_run(database, project: str, rms: float = 0.5) -> tuple[Claim, str]:
    """The same with a result."""
    got, run = claim_run(database, project)
    result = write_result_document(conclude(rms, L=(rms, None)).identification, 1.0)
    with database.write_session() as session:
        RunWriter(session, got.lease).record_outcomes(
            [
                RunOutcome(
                    run_id=run,
                    state=JobState.SUCCEEDED,
                    result=result,
                    spec_hash=HASH,
                    valid=True,
                    best_rms=rms,
                    signals_sha256="b" * 64,
                )
            ]
        )
    return got, run


def test_results_are_found_again_within_their_project(shared_database):
    mine, theirs = (compute_run(shared_database, project)[1] for project in PROJECTS)
    with shared_database.read_session() as session:
        assert find_computed_runs(session, [HASH]) == {HASH: mine}
        assert find_computed_runs(session, [HASH], OTHER) == {HASH: theirs}
        assert find_computed_runs(session, [HASH], "proj_none") == {}


def test_a_result_that_is_taken_over_twice_is_counted_once(shared_database):
    _, source = compute_run(shared_database, DEFAULT_PROJECT)
    got, run = claim_run(shared_database, DEFAULT_PROJECT)
    other, _ = claim_run(shared_database, DEFAULT_PROJECT)
    for _ in range(2):  # the answer to the first commit was lost
        with shared_database.write_session() as session:
            take_over_runs(session, got.lease, {run: source})
    job = job_of(shared_database, got.job.id)
    assert (job.n_reused, job.n_done, job.best_rms) == (1, 1, 0.5)
    assert job_of(shared_database, other.job.id).n_reused == 0


def test_the_same_source_is_a_dataset_of_each_project(shared_database):
    with shared_database.write_session() as session:
        mine, theirs = (
            DatasetRepository(session, project).add(new_dataset()) for project in PROJECTS
        )
    assert (mine.is_new, theirs.is_new) == (True, True)
    ids = mine.dataset.id, theirs.dataset.id
    with shared_database.read_session() as session:
        for project, dataset, foreign in zip(PROJECTS, ids, ids[::-1], strict=True):
            repository = DatasetRepository(session, project)
            assert [one.id for one in repository.list_page().items] == [dataset]
            assert repository.find_by_source("s1").id == dataset
            with pytest.raises(RowNotFound, match=foreign):
                repository.get_all([dataset, foreign])
            named = find_datasets_by_name(session, "step", project)
            assert [one.id for one in named] == [dataset]
            assert list_dataset_names(session, project) == ["step"]


def test_a_model_of_one_name_has_its_own_versions_in_each_project(shared_database):
    with shared_database.write_session() as session:
        mine, theirs = (ModelRepository(session, project) for project in PROJECTS)
        mine.add("pump", {"order": 1})
        first = mine.add("pump", {"order": 2}).model
        assert theirs.add("pump", {"order": 3}).model.version == 1
    with shared_database.read_session() as session:
        mine, theirs = (ModelRepository(session, project) for project in PROJECTS)
        assert mine.get("pump").document == {"order": 2}
        assert mine.get("pump@1").document == {"order": 1}
        assert theirs.get("pump").document == theirs.get("pump@1").document == {"order": 3}
        assert [one.document for one in theirs.list_page().items] == [{"order": 3}]
        for reference in ("pump@2", first.id):
            with pytest.raises(RowNotFound):
                theirs.get(reference)


def test_a_reference_of_one_name_stands_for_its_own_run_in_each_project(shared_database):
    _, mine = compute_run(shared_database, DEFAULT_PROJECT)
    _, theirs = compute_run(shared_database, OTHER)
    runs = dict(zip(PROJECTS, (mine, theirs), strict=True))
    with shared_database.write_session() as session:
        for project, run in runs.items():
            accepted = ReferenceRepository(session, project).accept_run("tube", run)
            assert accepted.number == 1
        ReferenceRepository(session, OTHER).accept_run("bend", theirs)
    with shared_database.read_session() as session:
        names = {DEFAULT_PROJECT: ["tube"], OTHER: ["bend", "tube"]}
        for project, run in runs.items():
            repository = ReferenceRepository(session, project)
            assert repository.get_latest("tube").run_id == run
            assert [one.run_id for one in repository.list_history("tube")] == [run]
            page = repository.list_page().items
            assert [(one.accepted.name, one.accepted.run_id) for one in page] == [
                (name, run) for name in names[project]
            ]
            assert sorted(repository.list_names()) == names[project]
            assert list_reference_names(session, run, project) == names[project]
            assert list_reference_names(session, run, "proj_none") == []


def test_lineage_is_that_of_its_project(shared_database):
    with shared_database.write_session() as session:
        for project, parent in zip(PROJECTS, ("ds_mine", "ds_theirs"), strict=True):
            LineageRepository(session, project).add_links("job_1", [parent], "estimation")
        LineageRepository(session, OTHER).add_links("ds_mine", ["ds_raw"], "derived")
        LineageRepository(session).add_links("ds_raw", ["ds_far"], "derived")  # behind theirs
    with shared_database.read_session() as session:
        lineage = LineageRepository(session)
        assert [link.parent for link in lineage.list_ancestors("job_1")] == ["ds_mine"]
        assert lineage.list_descendants("ds_theirs") == []
        assert lineage.list_descendants("ds_raw") == []


def test_a_trend_and_the_best_run_are_read_within_a_project(shared_database):
    got, run = compute_run(shared_database, DEFAULT_PROJECT)
    job = got.job.id
    with shared_database.read_session() as session:
        assert [row.id for row in read_trend_rows(session, job, 10)] == [run]
        assert read_trend_rows(session, job, 10, OTHER) == []
        assert find_quietest_run(session, job, {}).id == run
        assert find_quietest_run(session, job, {}, OTHER) is None


def test_sessions_of_an_owner_see_and_write_its_project_alone(shared_database):
    mine, theirs = (shared_database.open_for(SessionOwner(project)) for project in PROJECTS)
    with theirs.write_session() as session:
        dataset = DatasetRepository(session).add(new_dataset()).dataset.id
        job = JobRepository(session).submit(new_job(name="tube", spec={"model": "tube"})).job.id
    for reader in (mine, shared_database):
        with reader.read_session() as session:
            assert DatasetRepository(session).list_page().items == ()
            assert find_datasets_by_name(session, "step") == []
            with pytest.raises(RowNotFound):
                JobRepository(session).get(job)
            assert find_database(session) is reader
    with theirs.read_session() as session:
        assert [row.id for row in DatasetRepository(session).list_page().items] == [dataset]
        assert JobRepository(session).get(job).project_id == OTHER
    with theirs.write_session(busy_seconds=1.0) as session:  # from another factory
        assert JobRepository(session).cancel(job).state is JobState.CANCELLED
