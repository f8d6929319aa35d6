"""Use case of trends: a batch of re-identifications over one label, and against its reference."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.errors import Conflict, InvalidRequest
from service.schemas_trends import (
    CoefficientOut,
    DriftOut,
    LawOut,
    PlaceOut,
    PointOut,
    QuantityOut,
    TrendOut,
)
from service.storage.datasets import DatasetRepository
from service.storage.jobs import JobRepository
from service.storage.runs import RunRepository
from service.storage.tables import Job, Run
from service.storage.trends import TrendRow, count_succeeded, trend_rows
from service.sweeps import body_of
from service.trend_points import Channels, Point, Quantity, by_label, place, quantities
from sysid.trend import (
    Drift,
    Estimate,
    Influence,
    Place,
    Trend,
    drift,
    drifts_from_law,
    fit_trend,
)
from sysid.trend_laws import FORMULAS, Law

MOST_RUNS = 5_000
REAL_SCATTER = 1.5  # Birge ratios below that happen by chance in small batches


@dataclass(frozen=True, slots=True)
class _Reference:
    """The run a batch is compared with, and the trend of its job, quantity by quantity.

    `note` is why there is no such trend, where its job has one.
    """

    run: Run
    x: float | None
    trends: Mapping[str, tuple[Trend, Quantity]] = field(default_factory=dict)
    note: str = ""


def has_trend(job: Job) -> bool:
    """Whether a job asks for one."""
    return bool(job.spec.get("trend"))


def trend(session: Session, job_id: str) -> TrendOut:
    """The trend that a job asks for, from the runs that have succeeded so far.

    Raises
    ------
    NotFound
        If there is no such job.
    Conflict
        If the job asks for no trend.
    InvalidRequest
        If it has too many runs for one.
    """
    job = JobRepository(session).get(job_id)
    if not has_trend(job):
        raise Conflict(
            f'{job.id} has no trend; submit it with "trend": {{"x": …}}, the name of a label'
        )
    asked = job.spec["trend"]
    places, found = _gathered(session, job)
    reference = _reference(session, job, asked.get("reference"))
    told = [_told(one, asked["predict"], reference, found) for one in found]
    return TrendOut(
        job=job.id, x=asked["x"],
        reference=None if reference is None else reference.run.id,
        reference_x=None if reference is None else reference.x,
        places=_places(session, job, places), quantities=told,
        missing=job.n_runs - count_succeeded(session, job.id),
        notes=_notes(reference, asked["x"]),
    )  # fmt: skip


def _gathered(session: Session, job: Job) -> tuple[dict[float, list[TrendRow]], list[Quantity]]:
    if job.n_runs > MOST_RUNS:
        raise InvalidRequest.at(
            "", f"{job.id} has {job.n_runs} runs; a trend is made of at most {MOST_RUNS}"
        )
    asked = job.spec["trend"]
    places = by_label(trend_rows(session, job.id, MOST_RUNS), asked["x"])
    return places, quantities(places, asked["parameters"])


def _reference(session: Session, job: Job, run_id: str | None) -> _Reference | None:
    """The reference of a batch, and the laws of its job where that asks for the same trend."""
    if run_id is None:
        return None
    run = RunRepository(session).get(run_id)
    theirs = JobRepository(session).get(run.job_id)
    x = job.spec["trend"]["x"]
    label = run.labels.get(x)
    at = float(label) if isinstance(label, int | float) else None
    if theirs.id == job.id or not has_trend(theirs) or theirs.spec["trend"]["x"] != x:
        return _Reference(run, at)
    if theirs.n_runs > MOST_RUNS:
        return _Reference(
            run, at, note=f"the reference batch {theirs.id} has {theirs.n_runs} runs, and a trend "
            f"is made of at most {MOST_RUNS}: compared with the reference run only",
        )  # fmt: skip
    _, known = _gathered(session, theirs)
    return _Reference(run, at, {one.name: (_fitted(one, ()), one) for one in known})


def _fitted(one: Quantity, predict: Sequence[float]) -> Trend:
    used = [(point.x, point.estimate) for point in one.points if point.estimate is not None]
    return fit_trend(
        [x for x, _ in used], [e.value for _, e in used], [e.stderr for _, e in used], predict
    )


def _told(
    one: Quantity, predict: Sequence[float], reference: _Reference | None, all_: Sequence[Quantity]
) -> QuantityOut:
    fitted = _fitted(one, predict)
    influences = iter(fitted.influences)
    n = sum(point.estimate is not None for other in all_ for point in other.points)
    drifts = _drifts(one, reference, n)
    points = [
        _point(point, next(influences, None) if point.estimate is not None else None,
               drifts.get(point.x, []), bool(fitted.laws))
        for point in one.points
    ]  # fmt: skip
    return QuantityOut(
        name=one.name, unit=one.unit, kind=one.kind, points=points, between_runs=one.between,
        laws=[_law(law, law is fitted.chosen) for law in fitted.laws], reason=fitted.reason,
        band=[_place(at) for at in fitted.band],
        predictions=[_place(at) for at in fitted.predictions],
        notes=_quantity_notes(one, fitted),
    )  # fmt: skip


def _point(
    point: Point, influence: Influence | None, drifts: list[DriftOut], has_laws: bool
) -> PointOut:
    error = None if point.estimate is None else _finite(point.estimate.stderr)
    return PointOut(
        x=point.x, value=point.value, stderr=error, runs=list(point.runs), status=point.status,
        is_used=has_laws and point.estimate is not None,
        studentised=None if influence is None else _finite(influence.studentised),
        p_value=None if influence is None else influence.p_value,
        is_outlier=influence is not None and influence.is_outlier, drifts=drifts,
    )  # fmt: skip


def _drifts(
    one: Quantity, reference: _Reference | None, comparisons: int
) -> dict[float, list[DriftOut]]:
    """What is told of each point, by its x."""
    found: dict[float, list[DriftOut]] = {}
    if reference is None:
        return found
    new = [(point.x, point.estimate) for point in one.points if point.estimate is not None]
    old = _estimate(reference.run, one.name)
    for x, estimate in new:
        if x == reference.x and old is not None:
            found[x] = [_drift("run", old.value, drift(estimate, old, comparisons))]
    fitted, theirs = reference.trends.get(one.name, (None, None))
    if fitted is None or theirs is None or fitted.chosen is None:
        return found
    used = [(p.x, p.estimate.stderr) for p in theirs.points if p.estimate is not None]
    places, errors = np.array([x for x, _ in used]), np.array([error for _, error in used])
    at = np.array([x for x, _ in new])
    moved = drifts_from_law(
        [estimate for _, estimate in new], fitted.chosen, places, errors, at, comparisons
    )
    for (x, estimate), so_far in zip(new, moved, strict=True):
        if isfinite(so_far.difference):
            expected = estimate.value - so_far.difference
            found.setdefault(x, []).append(_drift("trend", expected, so_far))
    return found


def _estimate(run: Run, name: str) -> Estimate | None:
    one: Any = (run.estimates or {}).get(name)
    return None if not one or not one["stderr"] else Estimate(one["value"], one["stderr"])


def _drift(kind: Any, expected: float, moved: Drift) -> DriftOut:
    z = max(min(moved.z, 1e300), -1e300)
    return DriftOut(
        kind=kind, expected=expected, difference=moved.difference, z=z, drifted=moved.has_drifted
    )


def _law(law: Law, is_chosen: bool) -> LawOut:
    return LawOut(
        law=law.kind, formula=FORMULAS[law.kind], is_chosen=is_chosen,
        coefficients=[
            CoefficientOut(name=name, value=value, stderr=error)
            for name, value, error in law.coefficients
        ],
        chi_squared=law.chi_squared, degrees=law.degrees, birge=law.birge, aic=law.aic,
        aicc=_finite(law.aicc),
    )  # fmt: skip


def _place(at: Place) -> PlaceOut:
    return PlaceOut(
        x=at.x, value=_finite(at.value), stderr=_finite(at.stderr), lower=_finite(at.lower),
        upper=_finite(at.upper), is_outside=at.is_outside,
    )  # fmt: skip


def _finite(value: float | None) -> float | None:
    return None if value is None or not isfinite(value) else value


def _quantity_notes(one: Quantity, fitted: Trend) -> list[str]:
    notes = []
    without = [f"{point.x:g}" for point in one.points if point.estimate is None]
    if without:
        notes.append(f"no standard error at {', '.join(without)}: the laws leave this out")
    if one.between is not None and one.between > 1:
        notes.append(
            f"runs of one label differ by {one.between:.2g} times what their standard errors say; "
            "the errors shown hold that"
        )
    if fitted.chosen is not None and fitted.chosen.birge > REAL_SCATTER:
        notes.append(
            f"the points scatter about the law by {fitted.chosen.birge:.2g} times their errors "
            "(Birge ratio); band and intervals are wider by that"
        )
    outside = [f"{at.x:g}" for at in fitted.predictions if at.is_outside]
    if outside:
        notes.append(f"{', '.join(outside)} is outside the measured range: an extrapolation")
    return notes


def _notes(reference: _Reference | None, x: str) -> list[str]:
    if reference is None:
        return []
    if reference.note:
        return [reference.note]
    if reference.x is None and not reference.trends:
        return [f"the reference run has no label {x!r} and no trend: nothing to compare with"]
    return []


def _places(session: Session, job: Job, places: Mapping[float, list[TrendRow]]) -> list[Any]:
    rows = [row for many in places.values() for row in many]
    bodies = {row.id: body_of(job.spec, row.cell) for row in rows}
    datasets = {run: body["datasets"] for run, body in bodies.items()}
    known = _channels(session, {one for many in datasets.values() for one in many})
    return [
        place(x, many, datasets, known, bodies[many[0].id]["channels"])
        for x, many in places.items()
    ]


def _channels(session: Session, datasets: set[str]) -> Channels:
    found = DatasetRepository(session).get_all(sorted(datasets)) if datasets else ()
    return {one.id: {channel["name"]: channel for channel in one.channels} for one in found}
