"""A job that is claimed again goes on where it was: its progress, reasons and history."""

import pytest

from service.core.states import JobState
from service.dispatch.checkpoints import pack_state, unpack_state
from service.dispatch.job_runs import JobRuns
from service.dispatch.recorder import RunRecorder
from service.queue.leases import LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.event_rows import EventRepository
from service.repositories.history_rows import HistoryPoint, MigrantPoint
from service.repositories.run_rows import RunRepository
from service.storage.tables import Checkpoint
from sysid.identification.run import begin_run
from tests.support.cluster.small_runs import RECORDS, encode_runs, spec
from tests.support.library.search_problems import bits
from workers.protocol import QueuedRun, RunFailure
from workers.tasks import build_pack_problems

SWEEP = {"axes": [{"path": "/seed", "values": [1, 2, 3, 4]}]}


@pytest.fixture(scope="module")
def state():
    return begin_run(build_pack_problems(spec().problem, RECORDS)[0], spec().algorithm, 1)


def claim(place):
    with place.database.write_session() as session:
        return LeaseQueue(session).claim_job("d1")


def claim_again(place, lease):
    with place.database.write_session() as session:
        LeaseQueue(session).release_job(lease)
    return claim(place)


def recorder(place, claim):
    return RunRecorder(place.database, claim, place.store, encode_runs, lambda *_: None)


def make_point(run, number):
    return HistoryPoint(run, 0, number, 10 * number, 50, 1.0 / (number + 1), "genetic", [1.5])


def save_by_another(place, state) -> None:
    """A job of another dispatcher with a failure and a checkpoint."""
    rival = place.submit(sweep={"axes": [{"path": "/seed", "values": [1, 2]}]})
    with place.database.write_session() as session:
        got = LeaseQueue(session).claim_job("d2")
    assert got.job.id == rival
    fails, goes_on = (run.id for run in place.runs(rival))
    with place.database.write_session() as session:
        ledger = RunWriter(session, got.lease)
        ledger.record_outcomes(
            [
                RunOutcome(
                    run_id=fails,
                    state=JobState.FAILED,
                    error="elsewhere",
                    evaluations=5000,
                    generations=500,
                )
            ]
        )
        ledger.save_checkpoints([(goes_on, 9000, pack_state(state))])


def test_progress_and_reasons_go_on_from_the_attempt_before(place, state) -> None:
    save_by_another(place, state)
    job = place.submit(sweep=SWEEP)
    first, runs = claim(place), [run.id for run in place.runs(job)]
    with place.database.write_session() as session:
        ledger = RunWriter(session, first.lease)
        ledger.record_outcomes(
            [
                RunOutcome(
                    run_id=runs[0], state=JobState.SUCCEEDED, evaluations=700, generations=40
                ),
                RunOutcome(run_id=runs[1], state=JobState.FAILED, error="as told", evaluations=30),
            ]
        )
        ledger.save_checkpoints([(runs[2], 200, pack_state(state))])
    again = recorder(place, claim_again(place, first.lease))
    again.record_failure(runs[3], RunFailure("otherwise"))
    again.write_all()
    assert (place.job(job).evaluations, place.job(job).generation) == (930, 40)
    again.record_progress(runs[2], state, 1.0)
    again.write_all()
    assert place.job(job).evaluations == 730 + state.evaluations
    again.record_failure(runs[2], RunFailure("as told"))
    again.finish_job()
    assert place.job(job).error == "3 of 4 runs failed: as told; otherwise"
    assert place.job(job).evaluations == 730 + state.evaluations
    with place.database.read_session() as session:
        told = [one.data for one in EventRepository(session).list_after(job) if one.kind == "log"]
    assert told == [{"message": f"{runs[3]} failed: otherwise"}]


def test_a_run_whose_checkpoint_is_refused_loses_its_history_and_only_that_run(
    place, state
) -> None:
    job = place.submit(sweep=SWEEP)
    first, runs = claim(place), [run.id for run in place.runs(job)]
    with place.database.write_session() as session:
        ledger = RunWriter(session, first.lease)
        ledger.append_history(
            [make_point(run, number) for run in runs for number in range(2)],
            [MigrantPoint(run, 0, 1, 0, 1, 0.5) for run in runs],
        )
        ledger.record_outcomes([RunOutcome(run_id=runs[0], state=JobState.SUCCEEDED)])
        ledger.save_checkpoints(
            [(runs[1], 9, pack_state(state)), (runs[2], 9, b"lagid 0.0 run state 1\n...")]
        )
    source = JobRuns(place.database, claim_again(place, first.lease), place.store)
    queued = [one for one in source.iterate_runs() if isinstance(one, QueuedRun)]
    assert [(one.run, one.state is None) for one in queued] == [
        (runs[1], False),
        (runs[2], True),
        (runs[3], True),
    ]
    with place.database.read_session() as session:
        lengths = [len(RunRepository(session).read_history(run)) for run in runs]
        logs = [len(RunRepository(session).read_migrations(run)) for run in runs]
        kept = [(one.run_id, bits(unpack_state(one.state))) for one in session.query(Checkpoint)]
        told = [one.data for one in EventRepository(session).list_after(job) if one.kind == "log"]
    assert (lengths, logs) == ([2, 2, 0, 0], [1, 1, 0, 0])
    assert kept == [(runs[1], bits(state))]
    why = "its checkpoint cannot be read, another version of lagid wrote it"
    assert told == [{"message": f"{runs[2]} starts anew: {why}"}]
