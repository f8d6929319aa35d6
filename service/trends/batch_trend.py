"""Use case of trends: a batch of re-identifications over one label, compared with its reference."""

from collections.abc import Hashable, Sequence
from functools import partial

from sqlalchemy.orm import Session

from service.core.bodies.json_pointer import build_run_body
from service.core.computed import ComputedValues
from service.core.errors import Conflict, InvalidRequest
from service.core.states import JobState
from service.repositories.job_rows import JobRepository
from service.repositories.lineage_rows import list_reference_names
from service.repositories.run_rows import RunRepository
from service.repositories.trend_rows import TrendRow, read_trend_rows
from service.storage.sessions import release_connection
from service.storage.tables import Job
from service.trends.drift import BatchReference, compare_with_reference
from service.trends.notes import describe_noise_models, describe_quantity
from service.trends.points import (
    BatchPoint,
    TrendQuantity,
    build_quantities,
    group_by_label,
    to_label_out,
)
from service.trends.reference_differences import describe_differences, read_channels
from service.trends.trend_schemas import (
    DriftOut,
    LawOut,
    LawPointOut,
    PointOut,
    QuantityOut,
    TrendOut,
)
from sysid.trends.laws import FORMULAS, TrendLaw
from sysid.trends.trend import Influence, OutlierRule, Trend, fit_trend

MAX_RUNS = 5_000


def has_trend(job: Job) -> bool:
    """Test whether a job requests a trend."""
    return job.spec["trend"] is not None


def compute_trend(session: Session, job_id: str, outliers: OutlierRule = "exclude") -> TrendOut:
    """Compute the trend that a job requests, from the runs that have succeeded so far.

    Its laws leave outliers out, or count them with ``outliers="include"``.

    Raises
    ------
    NotFound
        If there is no such job.
    Conflict
        If the job requests no trend.
    InvalidRequest
        If it has too many runs for a trend.
    """
    job = JobRepository(session).get(job_id)
    if not has_trend(job):
        raise Conflict(
            f'{job.id} has no trend. Submit it with "trend": {{"x": …}}, where x names a label'
        )
    key = job.id, job.attempt, job.finished_at, _find_reference_version(session, job), outliers
    return _trends.get(
        key,
        lambda: _compute(session, job, outliers),
        is_final=job.state.is_terminal,
        before_wait=partial(release_connection, session),
    )


_trends = ComputedValues(64)


def _find_reference_version(session: Session, job: Job) -> Hashable:
    """Return what may change of a job's reference: its names, and the runs of its own job."""
    run_id = job.spec["trend"].get("reference")
    if run_id is None:
        return None
    of = JobRepository(session).get(RunRepository(session).get(run_id).job_id)
    names = tuple(list_reference_names(session, run_id))
    return names, of.attempt, of.n_done, of.n_failed, of.finished_at


def _compute(session: Session, job: Job, outliers: OutlierRule) -> TrendOut:
    request = job.spec["trend"]
    rows_by_label, quantities = _collect_quantities(session, job)
    bodies = {
        row.id: build_run_body(job.spec, row.cell)
        for rows in rows_by_label.values()
        for row in rows
    }
    datasets = {run: body["datasets"] for run, body in bodies.items()}
    channels = read_channels(session, {dataset for many in datasets.values() for dataset in many})
    reference = _load_reference(session, job, request.get("reference"))
    answers = [
        _to_quantity_out(
            quantity, _fit_quantity(quantity, request["predict"], outliers), reference, quantities
        )
        for quantity in quantities
    ]
    reference_noise_model = (
        "" if reference is None else (reference.run.result or {}).get("noise_model", "white")
    )
    notes = [describe_noise_models(request["x"], rows_by_label, reference_noise_model)]
    if reference is not None:
        notes += [
            reference.explain_gaps(request["x"], rows_by_label),
            describe_differences(session, reference.run, list(bodies.values()), channels),
        ]
    repository = RunRepository(session)
    runs, n_ended = repository.count_states(job.id), repository.count_ended(job.id)
    return TrendOut(
        job=job.id,
        x=request["x"],
        outliers=outliers,
        reference=None if reference is None else reference.run.id,
        reference_x=None if reference is None else reference.x,
        reference_names=[] if reference is None else list(reference.names),
        labels=[
            to_label_out(x, rows, datasets, channels, bodies[rows[0].id]["channels"])
            for x, rows in rows_by_label.items()
        ],
        quantities=answers,
        missing=job.n_runs - runs[JobState.SUCCEEDED],
        failed=runs[JobState.FAILED],
        unended=0 if job.state.is_terminal else job.n_runs - n_ended,
        notes=[note for note in notes if note],
    )


def _collect_quantities(
    session: Session, job: Job
) -> tuple[dict[float, list[TrendRow]], list[TrendQuantity]]:
    if job.n_runs > MAX_RUNS:
        raise InvalidRequest.from_fault(
            "", f"{job.id} has {job.n_runs} runs; a trend may have at most {MAX_RUNS}"
        )
    request = job.spec["trend"]
    rows_by_label = group_by_label(read_trend_rows(session, job.id, MAX_RUNS), request["x"])
    return rows_by_label, build_quantities(rows_by_label, request["parameters"])


def _load_reference(session: Session, job: Job, run_id: str | None) -> BatchReference | None:
    """Load the reference of a batch, with the laws of its job if that has the same trend."""
    if run_id is None:
        return None
    run = RunRepository(session).get(run_id)
    reference_job = JobRepository(session).get(run.job_id)
    x = job.spec["trend"]["x"]
    label = run.labels.get(x)
    x_value = float(label) if isinstance(label, int | float) else None
    names = tuple(list_reference_names(session, run.id))
    why = _explain_missing_trend(reference_job, x)
    if why:
        return BatchReference(run, x_value, why_no_trend=why, names=names)
    _, quantities = _collect_quantities(session, reference_job)
    trends = {quantity.name: (_fit_quantity(quantity), quantity) for quantity in quantities}
    return BatchReference(run, x_value, trends, names=names)


def _explain_missing_trend(reference_job: Job, x: str) -> str:
    """Explain why the reference's job has no comparable trend over x; empty if it has one."""
    if not has_trend(reference_job):
        return "its job has no trend"
    if reference_job.spec["trend"]["x"] != x:
        return f"the trend of its job is over {reference_job.spec['trend']['x']!r}"
    if reference_job.n_runs > MAX_RUNS:
        return (
            f"the reference batch {reference_job.id} has {reference_job.n_runs} runs (a trend may "
            f"have at most {MAX_RUNS})"
        )
    return ""


def _fit_quantity(
    quantity: TrendQuantity, predict: Sequence[float] = (), outliers: OutlierRule = "exclude"
) -> Trend:
    used = [(point.x, point.estimate) for point in quantity.points if point.estimate is not None]
    return fit_trend(
        [x for x, _ in used],
        [e.value for _, e in used],
        [e.stderr for _, e in used],
        predict,
        outliers,
    )


def _to_quantity_out(
    quantity: TrendQuantity,
    fitted: Trend,
    reference: BatchReference | None,
    all_: Sequence[TrendQuantity],
) -> QuantityOut:
    with_error = [point.x for point in quantity.points if point.estimate is not None]
    influences = dict(zip(with_error, fitted.influences, strict=False))  # none without a law
    used = set(with_error) - {with_error[i] for i in fitted.excluded} if fitted.laws else set()
    n = sum(point.estimate is not None for other in all_ for point in other.points)
    drifts = compare_with_reference(quantity, reference, n)
    points = [
        _to_point_out(
            point, influences.get(point.x), drifts.get(point.x, []), is_used=point.x in used
        )
        for point in quantity.points
    ]
    return QuantityOut.from_source(
        quantity,
        points=points,
        between_runs=quantity.between_runs,
        laws=[_to_law_out(law, law is fitted.best_law) for law in fitted.laws],
        reason=fitted.reason,
        band=[LawPointOut.from_source(law_point) for law_point in fitted.band],
        predictions=[LawPointOut.from_source(law_point) for law_point in fitted.predictions],
        notes=describe_quantity(quantity, fitted),
    )


def _to_point_out(
    point: BatchPoint, influence: Influence | None, drifts: list[DriftOut], *, is_used: bool
) -> PointOut:
    judged = {} if influence is None else influence._asdict()
    return PointOut.from_source(
        point,
        studentised=judged.get("studentised"),
        p_value=judged.get("p_value"),
        is_outlier=judged.get("is_outlier", False),
        stderr=None if point.estimate is None else point.estimate.stderr,
        is_used=is_used,
        drifts=drifts,
    )


def _to_law_out(law: TrendLaw, is_chosen: bool) -> LawOut:
    names = ("name", "value", "stderr")
    return LawOut.from_source(
        law,
        law=law.kind,
        formula=FORMULAS[law.kind],
        is_chosen=is_chosen,
        birge=law.birge_ratio,
        coefficients=[
            dict(zip(names, coefficient, strict=True)) for coefficient in law.coefficients
        ],
    )
