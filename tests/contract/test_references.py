"""References and what a trend reads, on SQLite and on PostgreSQL alike."""

import threading

import pytest

from service.core.states import JobState
from service.queue.leases import LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.reference_rows import ReferenceRepository
from service.repositories.trend_rows import read_trend_rows
from service.storage.storage_errors import RowNotFound
from service.storage.tables import Run
from sysid.core.value_documents import encode
from sysid.residuals.onset_delay import OnsetDelay
from sysid.results.result import Agreements
from tests.support.storage.job_rows import new_run, runs_of, submit, submit_and_claim
from tests.support.storage.run_results import build_estimate, write_result

WARNINGS = ["T and L not separable"]
ONSETS = (OnsetDelay(0, "u", "y", 0.5),)
RESULT = write_result(
    parameters=[encode(build_estimate("L", 0.1, 0.25))],
    onset_delays=encode(ONSETS),
    warnings=WARNINGS,
)


def accept_reference(database, name, run, **more):
    with database.write_session() as session:
        return ReferenceRepository(session).accept_run(name, run, **more).number


def test_the_latest_acceptance_is_in_use_and_the_others_stay(database):
    _, runs = submit_and_claim(database, n_runs=3)
    assert [accept_reference(database, "tube", run, accepted_by="me") for run in runs[:2]] == [1, 2]
    assert accept_reference(database, "tube", runs[1]) == 2  # the one in use
    assert accept_reference(database, "tube", runs[0]) == 3  # an earlier one again
    accept_reference(database, "other", runs[2], note="narrow")
    with database.read_session() as session:
        repository = ReferenceRepository(session)
        history = repository.list_history("tube")
        assert [one.run_id for one in history] == [runs[0], runs[1], runs[0]]
        assert [one.accepted_by for one in history] == [None, "me", "me"]
        page = repository.list_page()
        assert [(one.accepted.name, one.accepted.run_id) for one in page.items] == [
            ("other", runs[2]),
            ("tube", runs[0]),
        ]
        with pytest.raises(RowNotFound, match="reference nobody"):
            repository.list_history("nobody")


def test_the_same_run_again_is_kept_where_it_is_said_by_another_or_why(database):
    _, (run,) = submit_and_claim(database)
    assert accept_reference(database, "tube", run, note="first") == 1
    assert accept_reference(database, "tube", run, note="first") == 1
    assert accept_reference(database, "tube", run) == 1  # nothing new is said
    assert accept_reference(database, "tube", run, note="second") == 2
    assert accept_reference(database, "tube", run, accepted_by="me", note="second") == 3
    with database.read_session() as session:
        repository = ReferenceRepository(session)
        assert repository.get_latest("tube").number == 3
        assert [one.note for one in repository.list_history("tube")] == [
            "second",
            "second",
            "first",
        ]


def test_references_are_listed_page_by_page_without_the_results_of_their_runs(database):
    claim, runs = submit_and_claim(database, n_runs=5)
    for number, run in enumerate(runs):
        accept_reference(database, f"n{number}", runs[0])
        accept_reference(database, f"n{number}", run)
    found, cursor = [], None
    with database.read_session() as session:
        repository = ReferenceRepository(session)
        for _ in range(3):
            page = repository.list_page(cursor=cursor, limit=2)
            found += page.items
            cursor = page.next
        assert not any(isinstance(one, Run) for one in session.identity_map.values())
    assert cursor is None
    assert [(one.accepted.name, one.accepted.run_id) for one in found] == [
        (f"n{number}", run) for number, run in enumerate(runs)
    ]
    assert {one.job_id for one in found} == {claim.lease.job_id}


def test_acceptances_at_once_have_numbers_of_their_own(database):
    _, runs = submit_and_claim(database, n_runs=6)
    threads = [
        threading.Thread(target=accept_reference, args=(database, "tube", run)) for run in runs
    ]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    with database.read_session() as session:
        history = ReferenceRepository(session).list_history("tube")
    assert [one.number for one in history] == [6, 5, 4, 3, 2, 1]
    assert {one.run_id for one in history} == set(runs)


def test_a_trend_reads_the_runs_that_succeeded_in_order_with_parts_of_their_results(database):
    submit(database, n_runs=3)
    with database.write_session() as session:
        lease = LeaseQueue(session).claim_job("d1").lease
        RunWriter(session, lease).create_runs(
            new_run(number=i, cell={"/seed": i}, labels={"length_m": 5.0 * i}) for i in range(3)
        )
    runs = [run.id for run in runs_of(database, lease.job_id)]
    ends = [
        {"state": JobState.SUCCEEDED, "result": RESULT, "best_rms": 0.5, "evaluations": 7},
        {"state": JobState.FAILED, "error": "diverged"},
        {"state": JobState.SUCCEEDED, "result": {**RESULT, "warnings": []}},
    ]
    with database.write_session() as session:
        RunWriter(session, lease).record_outcomes(
            [RunOutcome(run_id=run, **end) for run, end in zip(runs, ends, strict=True)]
        )
    with database.read_session() as session:
        first, last = read_trend_rows(session, lease.job_id, 10)
        assert [one.id for one in read_trend_rows(session, lease.job_id, 1)] == runs[:1]
    assert (first.id, first.labels, first.evaluations) == (runs[0], {"length_m": 0.0}, 7)
    assert first.parameters == (build_estimate("L", 0.1, 0.25),)
    assert (first.onset_delays, first.warnings) == (ONSETS, tuple(WARNINGS))
    assert (first.agreement, first.noise_model) == (Agreements((), ()), "white")
    assert (last.id, last.warnings) == (runs[2], ())
