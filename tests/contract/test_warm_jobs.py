"""Jobs that start from earlier results: what each run begins with, and that it repeats."""

from copy import deepcopy
from dataclasses import replace
from itertools import takewhile

import pytest
from sqlalchemy import event, select

from service.core.errors import InvalidRequest
from service.core.states import JobState
from service.dispatch import job_parts, job_runs
from service.dispatch.job_runs import JobRuns
from service.dispatch.run_warm_starts import WarmStarts
from service.jobs import submit
from service.jobs.job_schemas import ReferenceIn
from service.jobs.references import accept_reference
from service.queue.leases import LeaseQueue
from service.storage.tables import Run
from sysid.core.errors import InvalidSettings
from sysid.data.noise import Noise
from tests.support.cluster.dispatch_place import carry_out
from tests.support.cluster.inline_executor import InlineExecutor
from workers.protocol import RunNotReady

pytestmark = pytest.mark.slow

QUICK = {"population": 16, "generations": 40, "islands": 2, "stop": {"settled": 2}}


class KeepingExecutor(InlineExecutor):
    """An executor that remembers what each run began with; `slots` decide what is read ahead."""

    def __init__(self, slots):
        super().__init__(slots)
        self.warm = {}

    def submit_pack(self, pack):
        self.warm.update({item.run: item.spec.warm_starts for item in pack.items})
        return super().submit_pack(pack)


def carry_out_job(place, slots=1, **body):
    """The job's runs once it is over, and what each began with."""
    job, executor = place.submit(**{"algorithm": QUICK, **body}), KeepingExecutor(slots)
    carry_out(place, job, executor)
    runs = place.runs(job)
    return runs, [executor.warm.get(run.id) for run in runs]


def read_values(run):
    return {name: one["value"] for name, one in run.estimates.items()}


def build_chain(*axes, **changes):
    return {"sweep": {"axes": list(axes)}, "warm_start": "previous", **changes}


NOISE = {"path": "/noise/sigma", "values": [0.0, 0.01, 0.02]}


def test_a_run_begins_with_the_estimates_of_the_one_before(place):
    runs, warm = carry_out_job(place, **build_chain(NOISE))
    assert warm == [(), (read_values(runs[0]),), (read_values(runs[1]),)]


def test_chains_of_crossed_axes_run_along_the_one_with_labels(place):
    labelled = {**NOISE, "labels": [{"x": 1}, {"x": 2}, {"x": 3}]}
    runs, warm = carry_out_job(place, **build_chain(labelled, {"path": "/seed", "values": [1, 2]}))
    assert warm[:2] == [(), ()]
    assert warm[2:] == [(read_values(one),) for one in runs[:4]]
    runs, warm = carry_out_job(place, **build_chain({"path": "/seed", "values": [1, 2]}, labelled))
    assert [one == () for one in warm] == [True, False, False] * 2


def test_the_result_of_a_chain_does_not_depend_on_how_many_work(place):
    alone, _ = carry_out_job(place, 1, **build_chain(NOISE))
    several, _ = carry_out_job(place, 4, **build_chain(NOISE))
    assert [read_values(one) for one in alone] == [read_values(one) for one in several]
    assert [one.evaluations for one in alone] == [one.evaluations for one in several]


def test_a_chain_computed_before_is_taken_over_whole(place):
    before, _ = carry_out_job(place, **build_chain(NOISE, reuse=True))
    after, warm = carry_out_job(place, **build_chain(NOISE, reuse=True))
    assert [one.result["reused_from"] for one in after] == [one.id for one in before]
    assert warm == [None, None, None]


def test_behind_a_run_that_failed_the_last_that_succeeded_serves(place):
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(job_parts, "replace", broken_second_time())
        runs, warm = carry_out_job(place, **build_chain(NOISE))
    assert [one.state for one in runs] == [JobState.SUCCEEDED, JobState.FAILED, JobState.SUCCEEDED]
    assert warm[2] == (read_values(runs[0]),)


def broken_second_time():
    calls = iter(range(100))

    def replace_fields(item, **changes):
        if isinstance(item, Noise) and next(calls) == 1:
            raise InvalidSettings("/noise", "as told")
        return replace(item, **changes)

    return replace_fields


def test_an_earlier_run_seeds_all_cells_and_its_values_are_part_of_the_hash(place):
    (first,), _ = carry_out_job(place)
    runs, warm = carry_out_job(place, warm_start=first.id, sweep={"axes": [NOISE]})
    assert warm == [(read_values(first),)] * 3
    assert runs[0].spec_hash != first.spec_hash


def test_a_reference_means_the_run_accepted_when_the_job_was_submitted(place):
    (first,), _ = carry_out_job(place)
    (second,), _ = carry_out_job(place, seed=2)
    with place.database.write_session() as session:
        accept_reference(session, "tube", ReferenceIn(run=first.id, by="me"))
    job = place.submit(warm_start="reference:tube")
    with place.database.write_session() as session:
        told = accept_reference(session, "tube", ReferenceIn(run=second.id))
    assert place.job(job).spec["warm_start"] == first.id
    assert (told.run, [one.run for one in told.history]) == (second.id, [first.id])
    assert told.history[0].by == "me"


def test_a_warm_start_that_is_not_there_is_told(place):
    (first,), _ = carry_out_job(place)
    with place.database.write_session() as session:
        accept_reference(session, "tube", ReferenceIn(run=first.id))
    for warm, said in [
        ("previous", "needs a sweep"),
        ("run_unknown", "there is no run run_unknown"),
        ("reference:tupe", "there is no reference 'tupe'; did you mean 'tube'"),
    ]:
        with pytest.raises(InvalidRequest) as caught:
            place.submit(warm_start=warm)
        (fault,) = caught.value.errors
        assert fault.pointer == "/warm_start"
        assert said in fault.detail


def test_a_run_of_another_model_or_one_that_did_not_succeed_is_refused(place):
    (first,), _ = carry_out_job(place)
    open_job = place.submit()
    (waiting,) = place.runs(open_job)
    for warm, model, said in [
        (waiting.id, "fopdt", "is queued; need a run that succeeded"),
        (first.id, "sopdt", "has another model: its parameters are K, T, L"),
    ]:
        with pytest.raises(InvalidRequest) as caught:
            place.submit(warm_start=warm, model=model, parameters={})
        assert [one.pointer for one in caught.value.errors] == ["/warm_start"]
        assert said in caught.value.errors[0].detail


def test_a_run_in_another_unit_is_refused_unless_the_unit_is_that_of_its_data(place):
    (first,), _ = carry_out_job(place)

    def set_unit(name, unit):
        with place.database.write_session() as session:
            run = session.get(Run, first.id)
            result = deepcopy(run.result)
            (entry,) = [one for one in result["parameters"] if one["name"] == name]
            entry["unit"], run.result = unit, result

    set_unit("K", "°C/%")
    assert place.submit(warm_start=first.id)
    set_unit("T", "min")
    with pytest.raises(InvalidRequest) as caught:
        place.submit(warm_start=first.id)
    assert "T is in min there, but in s in 'fopdt'" in caught.value.errors[0].detail


LABELLED = {**NOISE, "labels": [{"x": 1}, {"x": 2}, {"x": 3}]}
SEEDS = {"path": "/seed", "values": [1, 2]}


def before_the_first_wait(place, body):
    """Numbers of the runs that come before one waits for another."""
    place.submit(**{"algorithm": QUICK, **body})
    with place.database.write_session() as session:
        claim = LeaseQueue(session).claim_job("d1")
    numbers = {run.id: run.number for run in place.runs(claim.job.id)}
    coming = takewhile(
        lambda one: not isinstance(one, RunNotReady),
        JobRuns(place.database, claim, place.store).iterate_runs(),
    )
    return [numbers[one.run] for one in coming]


@pytest.mark.parametrize(
    ("axes", "first"), [([SEEDS, LABELLED], [0, 3]), ([LABELLED, SEEDS], [0, 1])]
)
def test_every_chain_begins_at_once_whichever_axis_goes_fastest(place, axes, first):
    assert before_the_first_wait(place, build_chain(*axes)) == first


def test_a_chain_begins_also_where_its_first_run_was_not_made_yet(place, monkeypatch):
    monkeypatch.setattr(submit, "CELLS_AT_SUBMISSION", 2)
    monkeypatch.setattr(job_runs, "CHUNK_ROWS", 2)
    runs, warm = carry_out_job(place, **build_chain(SEEDS, LABELLED))
    assert [one == () for one in warm] == [True, False, False] * 2
    assert {run.state for run in runs} == {JobState.SUCCEEDED}


def test_the_results_of_chains_do_not_depend_on_the_order_of_the_axes(place):
    fastest, _ = carry_out_job(place, 2, **build_chain(SEEDS, LABELLED))
    slowest, _ = carry_out_job(place, 1, **build_chain(LABELLED, SEEDS))
    assert by_cell(fastest) == by_cell(slowest)


def by_cell(runs):
    cells = [tuple(run.cell[axis["path"]] for axis in (SEEDS, LABELLED)) for run in runs]
    return {
        cell: (read_values(run), run.evaluations) for cell, run in zip(cells, runs, strict=True)
    }


def test_runs_that_begin_cold_do_not_wait_beside_those_that_follow_one_another(place):
    cold_or_warm = {"path": "/warm_start", "values": [None, "previous"]}
    axes = {"sweep": {"axes": [cold_or_warm, LABELLED]}}
    assert before_the_first_wait(place, axes) == [0, 3, 1, 2]
    runs, warm = carry_out_job(place, **axes)
    assert warm == [(), (), (), (), (read_values(runs[3]),), (read_values(runs[4]),)]


def statements_behind(place, n_failed):
    """SQL statements that it takes to learn what the last of a chain begins with."""
    job = place.submit(
        **build_chain({"path": "/seed", "range": [0, n_failed + 2]}, algorithm=QUICK)
    )
    with place.database.write_session() as session:
        claim = LeaseQueue(session).claim_job("d1")
        rows = session.scalars(
            select(Run).where(Run.job_id == claim.job.id).order_by(Run.number)
        ).all()
        rows[0].state, rows[0].estimates = JobState.SUCCEEDED, {"T": {"value": 2.0, "stderr": None}}
        for row in rows[1:-1]:
            row.state = JobState.FAILED
    seen = []
    with place.database.read_session() as session:
        engine = session.get_bind()
    event.listen(engine, "before_cursor_execute", lambda *told: seen.append(told[2]))
    (last,) = JobRuns(place.database, claim, place.store).iterate_runs()
    assert last.spec.warm_starts == ({"T": 2.0},)
    place.cancel(job)
    return len(seen)


def test_chains_of_an_earlier_attempt_go_on_each_from_its_own_runs(place):
    place.submit(**build_chain(LABELLED, {"path": "/seed", "values": [1, 2, 3, 4]}))
    with place.database.write_session() as session:
        claim = LeaseQueue(session).claim_job("d1")
        rows = session.scalars(
            select(Run).where(Run.job_id == claim.job.id).order_by(Run.number)
        ).all()
        assert [row.cell["/seed"] for row in rows[:5]] == [1, 2, 3, 4, 1]
        for row in rows[:6]:  # of four chains the first two have two runs behind them
            row.state = JobState.SUCCEEDED
            row.estimates = {"T": {"value": 10.0 + row.number, "stderr": None}}
        rows[4].state = JobState.FAILED
    source = JobRuns(place.database, claim, place.store)
    starts = [one.spec.warm_starts for one in takewhile(is_run, source.iterate_runs())]
    assert starts == [({"T": 10.0 + number},) for number in (2, 3, 0, 5)]


def is_run(entry):
    return not isinstance(entry, RunNotReady)


def test_what_a_chain_goes_on_from_is_found_as_quickly_behind_many_failures(place):
    assert statements_behind(place, 60) == statements_behind(place, 3)


def test_a_chain_of_runs_that_fail_asks_the_database_for_none_of_them(place, monkeypatch):
    def refuse_look(*_):
        raise AssertionError("an earlier attempt is looked for")

    def broken(body, **_):
        raise InvalidSettings("/algorithm", "as told")

    monkeypatch.setattr(WarmStarts, "_read_last_success", refuse_look)
    monkeypatch.setattr(job_parts, "read_run_settings", broken)
    runs, _ = carry_out_job(place, **build_chain({"path": "/seed", "range": [0, 50]}))
    assert {one.state for one in runs} == {JobState.FAILED}
