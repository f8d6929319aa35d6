"""Trends of stored results: each label is compared with its own reference, at a common limit."""

from collections.abc import Sequence
from typing import Any

import pytest

from service.core.states import JobState
from service.items.deletion import delete_item
from service.pages.job_pages import job_page
from service.queue.leases import Lease, LeaseQueue
from service.queue.run_writes import RunOutcome
from service.repositories.job_rows import JobRepository
from service.repositories.reference_rows import ReferenceRepository
from service.storage.tables import Job, Run
from service.trends.batch_trend import compute_trend
from service.trends.trend_schemas import TrendOut
from sysid.trends.trend import OutlierRule, compute_drift_limit
from tests.support.cluster.dispatch_place import Place
from tests.support.storage.databases import record_statements
from tests.support.storage.job_rows import parcel_of, record_outcomes
from tests.support.storage.run_results import claim_job, conclude, write_results

LENGTHS = (1.0, 2.0, 4.0)


def batch(
    place: Place,
    change: dict[float, float] | None = None,
    reference: str | None = None,
    lengths: Sequence[float] = LENGTHS,
) -> tuple[str, dict[float, str]]:
    """A batch over lengths, and its run at each; `change` is added to L and T at a length."""
    labels = [{"x": x} for x in lengths]
    seeds = list(range(1, len(lengths) + 1))
    job = place.submit(
        sweep={"axes": [{"path": "/seed", "values": seeds, "labels": labels}]},
        trend={"x": "x", "parameters": ["L", "T"], "reference": reference},
    )
    lease = claim_job(place.database, job)
    runs = {float(run.labels["x"]): run.id for run in place.runs(job)}
    results = {}
    for x, run in runs.items():
        more = (change or {}).get(x, 0.0)
        results[run] = conclude(
            L=(0.1 * x + more, 0.01), T=(1.0 + more, 0.02), K=(1.0, None), y0=(0.0, None)
        )
    write_results(place.database, lease, results)
    return job, runs


def read_trend(place: Place, job: str, outliers: OutlierRule = "exclude") -> TrendOut:
    with place.database.read_session() as session:
        return compute_trend(session, job, outliers)


def list_drifts(found: TrendOut, kind: str) -> dict[tuple[str, float], Any]:
    return {
        (quantity.name, point.x): drift
        for quantity in found.quantities
        for point in quantity.points
        for drift in point.drifts
        if drift.kind == kind
    }


def test_the_reference_run_is_compared_at_its_own_label_only(place: Place) -> None:
    _, runs = batch(place)
    job, _ = batch(place, {2.0: 0.03}, runs[2.0])
    told = list_drifts(read_trend(place, job), "run")
    assert set(told) == {("L", 2.0), ("T", 2.0)}
    assert told["L", 2.0].expected == pytest.approx(0.2)
    assert told["L", 2.0].z == pytest.approx(0.03 / (0.01 * 2**0.5))


def test_the_limit_of_drift_counts_all_labels_and_quantities(place: Place) -> None:
    _, runs = batch(place)
    job, _ = batch(place, {4.0: 1.0}, runs[2.0])
    found = read_trend(place, job)
    limit = compute_drift_limit(None, 2 * len(LENGTHS))
    assert {drift.limit for drift in list_drifts(found, "run").values()} == {limit}
    along = list_drifts(found, "trend")
    assert len(along) == 2 * len(LENGTHS)
    assert {key for key, drift in along.items() if drift.drifted} == {("L", 4.0), ("T", 4.0)}
    assert along["L", 4.0].expected == pytest.approx(0.4)


def test_an_outlier_moves_neither_its_own_law_nor_what_a_reference_expects(place: Place) -> None:
    lengths = (1.0, 2.0, 4.0, 5.0, 7.0, 8.0)
    first, runs = batch(place, {5.0: 3.0}, lengths=lengths)
    found, counted = read_trend(place, first), read_trend(place, first, "include")
    assert (found.outliers, counted.outliers) == ("exclude", "include")
    for quantity, other in zip(found.quantities, counted.quantities, strict=True):
        assert [p.x for p in quantity.points if p.is_outlier] == [5.0]
        assert [p.x for p in quantity.points if not p.is_used] == [5.0]
        assert "the laws leave out the outlier at 5" in quantity.notes
        assert all(point.is_used for point in other.points)
    with place.database.read_session() as session:
        pages = [
            job_page(session, place.store, first, "", outliers=one)
            for one in ("exclude", "include")
        ]
    for text, query in zip(pages, ("", "?outliers=include"), strict=True):
        assert f'/figures/trend{query}" style' in text
        assert f'/jobs/{first}{query}#trend" aria-current="true"' in text
        assert f'<option value="{runs[5.0]}">' in text
        assert f'<option value="{runs[4.0]}" selected>' in text
    job, _ = batch(place, None, runs[2.0], lengths)
    assert list_drifts(read_trend(place, job), "trend")["L", 5.0].expected == pytest.approx(0.5)


def test_runs_that_have_not_succeeded_are_missing(place: Place) -> None:
    labels = [{"x": x} for x in LENGTHS]
    job = place.submit(
        sweep={"axes": [{"path": "/seed", "values": [1, 2, 3], "labels": labels}]},
        trend={"x": "x", "parameters": ["L"]},
    )
    lease = claim_job(place.database, job)
    first, failed, _ = (run.id for run in place.runs(job))
    write_results(place.database, lease, {first: conclude(L=(0.1, 0.01))})
    outcome = RunOutcome(run_id=failed, state=JobState.FAILED, error="diverged")
    record_outcomes(place.database, lease, outcome)
    found = read_trend(place, job)
    assert (found.missing, [label.x for label in found.labels]) == (2, [1.0])
    assert (found.failed, found.unended) == (1, 1)
    with place.database.write_session() as session:
        LeaseQueue(session).finish_job(lease, JobState.CANCELLED)
    found = read_trend(place, job)
    assert (found.missing, found.failed, found.unended) == (2, 1, 0)


def test_a_deleted_run_of_a_resumed_batch_has_ended(place: Place) -> None:
    labels = [{"x": x} for x in (*LENGTHS, 8.0)]
    job = place.submit(
        sweep={"axes": [{"path": "/seed", "values": [1, 2, 3, 4], "labels": labels}]},
        trend={"x": "x", "parameters": ["L"]},
    )
    lease = claim_job(place.database, job)
    first, deleted, _, last = (run.id for run in place.runs(job))
    with place.database.write_session() as session:  # as in a sweep that is created by parcels
        session.delete(session.get_one(Run, last))
    write_results(place.database, lease, {first: conclude(L=(0.1, 0.01))})
    with place.database.write_session() as session:
        LeaseQueue(session).finish_job(lease, JobState.CANCELLED)
    with place.database.write_session() as session:
        delete_item(session, "run", deleted)
        JobRepository(session).resume(job)
    found = read_trend(place, job)
    # The third run waits, and the fourth has no row.
    assert (found.missing, found.failed, found.unended) == (3, 0, 2)


def end(place: Place, job: str) -> None:
    with place.database.write_session() as session:
        lease = Lease(job, place.job(job).attempt, str(parcel_of(place.database, job).lease_owner))
        LeaseQueue(session).finish_job(lease, JobState.SUCCEEDED)


def test_the_trend_of_an_ended_batch_is_computed_once(place: Place) -> None:
    job, _ = batch(place)
    end(place, job)
    first = read_trend(place, job)
    with record_statements(place.database) as statements:
        assert read_trend(place, job) == first
    assert not [one for one, _ in statements if "FROM runs" in one]


def test_a_trend_has_the_names_under_which_its_reference_was_accepted_later(place: Place) -> None:
    _, runs = batch(place)
    job, _ = batch(place, None, runs[2.0])
    end(place, job)
    assert read_trend(place, job).reference_names == []
    with place.database.write_session() as session:
        ReferenceRepository(session).accept_run("tubes", runs[2.0])
    assert read_trend(place, job).reference_names == ["tubes"]


def test_a_trend_follows_the_batch_of_its_reference(place: Place) -> None:
    first, runs = batch(place)
    job, _ = batch(place, None, runs[2.0])
    end(place, job)
    limit = list_drifts(read_trend(place, job), "trend")["L", 4.0].expected
    assert limit == pytest.approx(0.4)
    with place.database.write_session() as session:  # as if a run of it had come later
        session.get_one(Run, runs[4.0]).state = JobState.FAILED
        session.get_one(Job, first).n_failed = 1
    assert list_drifts(read_trend(place, job), "trend") == {}
