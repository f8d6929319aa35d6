"""Summaries of many runs, on SQLite and on PostgreSQL alike."""

import numpy as np
import pytest

from service.core.states import JobState
from service.jobs.stored_cells import build_stored_cells, read_axis_groups
from service.queue.leases import Lease, LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.summary_rows import SummaryQuantity, find_quietest_run, read_run_table
from service.storage.storage_errors import LeaseLost
from service.storage.tables import DEFAULT_PROJECT, Job
from service.sweeps.groups import QUANTILES_PER_MILLE, GroupKey, SweepGroups, aggregate_runs
from tests.support.storage.job_rows import job_of, runs_of, submit

SIGMA = GroupKey("axis", "/noise/sigma")
METHOD = GroupKey("axis", "/algorithm/method")
LABEL = GroupKey("label", "length_m")
RMS, LAG = SummaryQuantity("rms"), SummaryQuantity("estimate", "L")
BODY = {
    "model": "tube",
    "seed": 1,
    "algorithm": {"method": "improved"},
    "noise": {"sigma": 0.0, "seed": 0},
}


def seeds(count):
    return {"path": "/seed", "range": [0, count]}


def add_ended_job(database, axes, values):
    """A job with these axes, whose runs gave these values; None: the run failed."""
    spec = {**BODY, "sweep": {"axes": axes}}
    submit(database, n_runs=len(values), spec=spec)
    with database.write_session() as session:
        got = LeaseQueue(session).claim_job("d1")
        cells = build_stored_cells(spec, read_axis_groups(spec))
        RunWriter(session, got.lease).create_runs(cells)
    outcomes = [
        RunOutcome(run_id=run.id, state=JobState.FAILED, error="diverged")
        if value is None
        else RunOutcome(
            run_id=run.id,
            state=JobState.SUCCEEDED,
            valid=True,
            best_rms=value,
            rms_noise_free=value / 2,
            evaluations=100 + i,
            result={"parameters": [{"name": "L", "value": 2 * value, "stderr": None}]},
        )
        for i, (run, value) in enumerate(zip(runs_of(database, got.job.id), values, strict=True))
    ]
    with database.write_session() as session:
        RunWriter(session, got.lease).record_outcomes(outcomes)
    return got.job.id


def read_summary(database, job, keys, *, limit=100, project=DEFAULT_PROJECT):
    groups = SweepGroups(job_of(database, job).spec, keys, limit)
    with database.read_session() as session:
        return aggregate_runs(read_run_table(session, job, project), groups)


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_quantiles_are_those_of_the_values(database, count):
    values = np.random.default_rng(count).random(count).tolist()
    job = add_ended_job(database, [seeds(count)], values)
    (whole,) = read_summary(database, job, [])
    expected = np.quantile(values, np.array(QUANTILES_PER_MILLE) / 1000)
    np.testing.assert_allclose(whole.quantiles[RMS], expected, rtol=1e-12)
    np.testing.assert_allclose(whole.quantiles[LAG], 2 * expected, rtol=1e-12)
    assert whole.mean_evaluations == pytest.approx(100 + (count - 1) / 2)


def test_groups_come_in_the_order_of_the_sweep_each_with_its_own_runs(database):
    axes = [
        {"path": "/noise/sigma", "values": [0.2, 0, 0.1]},
        {"path": "/algorithm/method", "values": ["simple", "improved"]},
        seeds(3),
    ]
    job = add_ended_job(database, axes, [float(i) for i in range(18)])
    found = read_summary(database, job, [SIGMA, METHOD])
    assert [one.key for one in found] == [
        (0.2, "simple"),
        (0.2, "improved"),
        (0, "simple"),
        (0, "improved"),
        (0.1, "simple"),
        (0.1, "improved"),
    ]
    assert [one.quantiles[RMS][2] for one in found] == [1.0, 4.0, 7.0, 10.0, 13.0, 16.0]


def test_failed_runs_are_counted_and_enter_no_quantile(database):
    job = add_ended_job(database, [seeds(4)], [1.0, None, 3.0, None])
    (whole,) = read_summary(database, job, [])
    assert whole.states[JobState.SUCCEEDED] == 2
    assert whole.states[JobState.FAILED] == 2
    assert whole.n_valid == 2
    assert (whole.mean_evaluations, whole.quantiles[RMS][2]) == (101.0, 2.0)


def test_runs_may_be_grouped_by_a_label_and_by_values_that_are_no_numbers(database):
    model = {"name": "own", "form": "difference"}
    labels = [{"length_m": 0.0}, {"length_m": 5.0}, {"length_m": 0.0}]
    axis = {"path": "/model", "values": [model, "tube", "mine"], "labels": labels}
    job = add_ended_job(database, [axis], [1.0, 2.0, 3.0])
    by_model = read_summary(database, job, [GroupKey("axis", "/model")])
    assert [one.key for one in by_model] == [(model,), ("tube",), ("mine",)]
    by_label = read_summary(database, job, [LABEL])
    assert [(one.key, one.quantiles[RMS][2]) for one in by_label] == [((0.0,), 2.0), ((5.0,), 2.0)]


def test_a_quantity_that_no_run_has_gives_no_quantiles(database):
    job = add_ended_job(database, [seeds(1)], [1.0])
    (whole,) = read_summary(database, job, [])
    assert set(whole.quantiles) == {RMS, SummaryQuantity("rms_noise_free"), LAG}


def test_groups_beyond_the_limit_are_left_out(database):
    axes = [{"path": "/noise/sigma", "values": list(range(9))}, seeds(2)]
    job = add_ended_job(database, axes, [float(i) for i in range(18)])
    found = read_summary(database, job, [SIGMA], limit=4)
    assert [(one.key, one.quantiles[RMS][2]) for one in found] == [
        ((sigma,), 2 * sigma + 0.5) for sigma in range(4)
    ]


def test_a_group_knows_between_which_deviations_its_noise_lies(database):
    axes = [{"path": "/noise/sigma", "values": [0.0, 0.5]}, seeds(2)]
    job = add_ended_job(database, axes, [1.0] * 4)
    assert [one.sigma for one in read_summary(database, job, [SIGMA])] == [(0.0, 0.0), (0.5, 0.5)]
    assert [one.sigma for one in read_summary(database, job, [])] == [(0.0, 0.5)]


def test_runs_with_other_parameters_have_their_own_columns(database):
    axes = [{"path": "/model", "values": ["one", "other"]}, seeds(2)]
    spec = {**BODY, "sweep": {"axes": axes}}
    submit(database, n_runs=4, spec=spec)
    with database.write_session() as session:
        got = LeaseQueue(session).claim_job("d1")
        ledger = RunWriter(session, got.lease)
        ledger.create_runs(build_stored_cells(spec, read_axis_groups(spec)))
        outcomes = [
            RunOutcome(
                run_id=run.id,
                state=JobState.SUCCEEDED,
                result={"parameters": [{"name": name, "value": number, "stderr": 0.5}]},
            )
            for number, (run, name) in enumerate(
                zip(ledger.list_pending(), ("L", "L", "T", "T"), strict=True)
            )
        ]
        ledger.record_outcomes(outcomes)
    with database.read_session() as session:
        table = read_run_table(session, got.job.id)
    assert table.names == (("L",), ("T",))
    assert table.kinds.tolist() == [0, 0, 1, 1]
    for name, expected in (("L", [0, 1, np.nan, np.nan]), ("T", [np.nan, np.nan, 2, 3])):
        np.testing.assert_equal(table.values[SummaryQuantity("estimate", name)], expected)


@pytest.mark.parametrize("keys", [[], [SIGMA], [METHOD], [SIGMA, METHOD]])
def test_the_quantiles_of_a_group_are_those_of_its_own_successes(database, keys):
    draws = np.random.default_rng(3)
    axes = [
        seeds(5),
        {"path": "/noise/sigma", "values": [0.1, 0.2, 0.1]},
        {"path": "/algorithm/method", "values": ["simple", "improved"]},
    ]
    values = [None if draws.random() < 0.2 else float(draws.random()) for _ in range(30)]
    job = add_ended_job(database, axes, values)
    cells = [run.cell for run in runs_of(database, job)]
    found = read_summary(database, job, keys)
    assert sum(sum(one.states.values()) for one in found) == 30
    for one in found:
        mine = [
            value
            for value, cell in zip(values, cells, strict=True)
            if value is not None and [cell[key.name] for key in keys] == list(one.key)
        ]
        expected = np.quantile(mine, np.array(QUANTILES_PER_MILLE) / 1000)
        np.testing.assert_allclose(one.quantiles[RMS], expected, rtol=1e-12)
        assert one.states[JobState.SUCCEEDED] == len(mine)


def test_the_quietest_run_is_the_best_of_those_with_the_least_noise_in_its_cell(database):
    axes = [
        {"path": "/model", "values": ["tube", {"name": "own"}]},
        {"path": "/noise/sigma", "values": [0.3, 0.1]},
        seeds(3),
    ]
    values = [0.1, 0.1, 0.1, 4.0, 2.0, None, 0.1, 0.1, 0.1, 5.0, 6.0, 5.0]
    job = add_ended_job(database, axes, values)
    with database.read_session() as session:
        found = [
            find_quietest_run(session, job, cell).number
            for cell in ({}, {"/model": "tube"}, {"/model": {"name": "own"}})
        ]
        assert find_quietest_run(session, job, {"/model": "absent"}) is None
    assert found == [4, 4, 9]


def test_runs_of_a_job_are_not_told_to_another_project(database):
    job = add_ended_job(database, [{"path": "/noise/sigma", "values": [0.0]}], [1.0])
    (group,) = read_summary(database, job, [SIGMA], project="proj_other")
    assert (group.states[JobState.SUCCEEDED], group.quantiles) == (0, {})


def test_cramer_rao_bounds_are_written_under_the_lease_only(database):
    submit(database, n_runs=1)
    with database.write_session() as session:
        lease = LeaseQueue(session).claim_job("d1").lease
        LeaseQueue(session).write_cramer_rao(lease, {"axes": [], "problems": []})
    with database.read_session() as session:
        assert session.get(Job, lease.job_id).cramer_rao == {"axes": [], "problems": []}
    late = Lease(lease.job_id, lease.attempt + 1, "d2")
    with database.write_session() as session, pytest.raises(LeaseLost):
        LeaseQueue(session).write_cramer_rao(late, {"axes": ["late"], "problems": []})
    with database.read_session() as session:
        assert session.get(Job, lease.job_id).cramer_rao == {"axes": [], "problems": []}
