"""Summaries of many runs, on SQLite and on PostgreSQL alike."""

import numpy as np
import pytest

from service.core.states import JobState
from service.queue.leases import Lease, LeaseQueue
from service.queue.run_writes import NewRun, RunOutcome, RunWriter
from service.repositories.summaries import (
    QUANTILES_PER_MILLE,
    GroupKey,
    SummaryQuantity,
    find_quietest_run,
    read_groups,
)
from service.storage.errors import LeaseLost
from service.storage.tables import Job
from tests.stored import runs_of, submit

SIGMA = GroupKey("axis", "/noise/sigma")
METHOD = GroupKey("axis", "/algorithm/method")


def filled(database, cells, values):
    """A job with these cells, whose runs gave these values; None: the run failed."""
    submit(database, n_runs=len(cells))
    with database.write_session() as session:
        got = LeaseQueue(session).claim_job("d1")
        ledger = RunWriter(session, got.lease)
        ledger.create_runs(
            NewRun(
                number=i,
                cell=cell,
                labels={"length_m": 5.0 * (i % 2)},
                sigma=cell.get("/noise/sigma"),
            )
            for i, cell in enumerate(cells)
        )
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


def summary(database, job, keys, *quantities, limit=100):
    with database.read_session() as session:
        return read_groups(session, job, keys, quantities, limit)


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_quantiles_are_those_of_the_values(database, count):
    values = np.random.default_rng(count).random(count).tolist()
    job = filled(database, [{"/seed": i} for i in range(count)], values)
    (whole,) = summary(database, job, [], SummaryQuantity("rms"), SummaryQuantity("estimate", "L"))
    expected = np.quantile(values, np.array(QUANTILES_PER_MILLE) / 1000)
    np.testing.assert_allclose(whole.quantiles[SummaryQuantity("rms")], expected, rtol=1e-12)
    np.testing.assert_allclose(
        whole.quantiles[SummaryQuantity("estimate", "L")], 2 * expected, rtol=1e-12
    )
    assert whole.mean_evaluations == pytest.approx(100 + (count - 1) / 2)


def test_groups_come_in_the_order_of_the_sweep_each_with_its_own_runs(database):
    cells = [
        {"/noise/sigma": sigma, "/algorithm/method": method, "/seed": seed}
        for sigma in (0.2, 0, 0.1)
        for method in ("simple", "improved")
        for seed in range(3)
    ]
    values = [float(i) for i in range(len(cells))]
    job = filled(database, cells, values)
    found = summary(database, job, [SIGMA, METHOD], SummaryQuantity("rms"))
    assert [one.key for one in found] == [
        (0.2, "simple"),
        (0.2, "improved"),
        (0, "simple"),
        (0, "improved"),
        (0.1, "simple"),
        (0.1, "improved"),
    ]
    medians = [one.quantiles[SummaryQuantity("rms")][2] for one in found]
    assert medians == [1.0, 4.0, 7.0, 10.0, 13.0, 16.0]


def test_failed_runs_are_counted_and_enter_no_quantile(database):
    job = filled(database, [{"/seed": i} for i in range(4)], [1.0, None, 3.0, None])
    (whole,) = summary(database, job, [], SummaryQuantity("rms"))
    assert whole.states[JobState.SUCCEEDED] == 2
    assert whole.states[JobState.FAILED] == 2
    assert whole.n_valid == 2
    assert whole.quantiles[SummaryQuantity("rms")][2] == 2.0


def test_runs_may_be_grouped_by_a_label_and_by_values_that_are_no_numbers(database):
    model = {"name": "own", "form": "difference"}
    job = filled(database, [{"/model": model}, {"/model": "tube"}], [1.0, 2.0])
    by_model = summary(database, job, [GroupKey("axis", "/model")])
    assert [one.key for one in by_model] == [(model,), ("tube",)]
    by_label = summary(database, job, [GroupKey("label", "length_m")])
    assert [one.key for one in by_label] == [(0.0,), (5.0,)]


def test_a_quantity_that_no_run_has_gives_no_quantiles(database):
    job = filled(database, [{"/seed": 0}], [1.0])
    (whole,) = summary(
        database, job, [], SummaryQuantity("stderr", "L"), SummaryQuantity("estimate", "x")
    )
    assert whole.quantiles == {}


def test_at_most_one_group_more_than_the_limit_is_read(database):
    job = filled(database, [{"/noise/sigma": i} for i in range(9)], [1.0] * 9)
    assert len(summary(database, job, [SIGMA], SummaryQuantity("rms"), limit=4)) == 5


def test_a_group_knows_between_which_deviations_its_noise_lies(database):
    cells = [{"/noise/sigma": sigma, "/seed": seed} for sigma in (0.0, 0.5) for seed in (1, 2)]
    job = filled(database, cells, [1.0] * 4)
    assert [one.sigma for one in summary(database, job, [SIGMA])] == [(0.0, 0.0), (0.5, 0.5)]
    assert [one.sigma for one in summary(database, job, [])] == [(0.0, 0.5)]


def test_several_quantities_have_the_quantiles_that_each_has_alone(database):
    draws = np.random.default_rng(3)
    cells = [{"/noise/sigma": draws.integers(3) / 10} for _ in range(60)]
    values = [None if draws.random() < 0.2 else float(draws.random()) for _ in cells]
    job = filled(database, cells, values)
    wanted = (
        SummaryQuantity("rms"),
        SummaryQuantity("estimate", "L"),
        SummaryQuantity("rms_noise_free"),
    )
    together = summary(database, job, [SIGMA], *wanted)
    for quantity in wanted:
        alone = summary(database, job, [SIGMA], quantity)
        for one, other in zip(together, alone, strict=True):
            assert one.key == other.key
            assert one.quantiles.get(quantity) == other.quantiles.get(quantity)
    for one in together:
        mine = [v for v, c in zip(values, cells, strict=True) if c["/noise/sigma"] == one.key[0]]
        left = [v for v in mine if v is not None]
        expected = np.quantile(left, np.array(QUANTILES_PER_MILLE) / 1000)
        np.testing.assert_allclose(one.quantiles[wanted[0]], expected, rtol=1e-12)
        np.testing.assert_allclose(one.quantiles[wanted[2]], expected / 2, rtol=1e-12)


def test_the_quietest_run_is_the_best_of_those_with_the_least_noise_in_its_cell(database):
    cells = [
        {"/noise/sigma": sigma, "/model": model, "/seed": seed}
        for model in ("tube", {"name": "own"})
        for sigma in (0.3, 0.1)
        for seed in range(3)
    ]
    values = [0.1, 0.1, 0.1, 4.0, 2.0, None, 0.1, 0.1, 0.1, 5.0, 6.0, 5.0]
    job = filled(database, cells, values)
    with database.read_session() as session:
        found = [
            find_quietest_run(session, job, cell).number
            for cell in ({}, {"/model": "tube"}, {"/model": {"name": "own"}})
        ]
        assert find_quietest_run(session, job, {"/model": "absent"}) is None
    assert found == [4, 4, 9]


def test_groups_of_a_job_are_not_told_to_another_project(database):
    job = filled(database, [{"/noise/sigma": 0.0}], [1.0])
    with database.read_session() as session:
        assert read_groups(session, job, [SIGMA], [SummaryQuantity("rms")], 10, "proj_other") == []


def test_floors_are_written_under_the_lease_only(database):
    submit(database, n_runs=1)
    with database.write_session() as session:
        lease = LeaseQueue(session).claim_job("d1").lease
        LeaseQueue(session).write_floors(lease, {"axes": [], "problems": []})
    with database.read_session() as session:
        assert session.get(Job, lease.job_id).floors == {"axes": [], "problems": []}
    late = Lease(lease.job_id, lease.attempt + 1, "d2")
    with database.write_session() as session, pytest.raises(LeaseLost):
        LeaseQueue(session).write_floors(late, {"axes": ["late"], "problems": []})
    with database.read_session() as session:
        assert session.get(Job, lease.job_id).floors == {"axes": [], "problems": []}
