"""Whether a trend can be made of a job's runs: every one needs its place on the axis."""

from collections.abc import Iterator

from sqlalchemy.orm import Session

from service import warm_starts
from service.errors import FieldError
from service.schemas_jobs import LEAST_PLACE, MOST_PLACE, PREVIOUS, JobIn, is_place
from sysid.core.errors import nearest
from sysid.models.model import Model


def trend_faults(session: Session, job: JobIn, model: Model | None) -> Iterator[FieldError]:
    """Labels that are missing or no numbers, what the model or the reference does not have."""
    if job.warm_start == PREVIOUS and not job.sweep.axes:
        yield FieldError("/warm_start", "'previous' needs a sweep; this job has one run")
    if job.trend is None:
        return
    yield from _label_faults(job, job.trend.x)
    if model is None:
        return
    yield from warm_starts.faults(session, job.trend.reference, model, "/trend/reference")
    known = [one.name for one in model.parameters]
    for index, name in enumerate(job.trend.parameters):
        if name not in known:
            yield FieldError(
                f"/trend/parameters/{index}",
                f"the model has no parameter {name!r}{nearest(name, known)}",
            )


def _label_faults(job: JobIn, x: str) -> Iterator[FieldError]:
    axes = [(n, axis.labels) for n, axis in enumerate(job.sweep.axes) if axis.labels]
    named = [(n, labels) for n, labels in axes if any(x in one for one in labels)]
    if not named:
        known = sorted({name for _, labels in axes for one in labels for name in one})
        there = f"there are {', '.join(known)}" if known else "no axis has labels"
        yield FieldError(
            "/trend/x",
            f"no run has a label {x!r}{nearest(x, known)}; {there}; give an axis "
            f'"labels": [{{"{x}": …}}, …], one for each value',
        )
    for n, labels in named:
        for position, one in enumerate(labels):
            value = one.get(x)
            if not isinstance(value, float | int):
                found = f"found {one[x]!r}" if x in one else "it is missing"
                needed = "a number here"
            elif not is_place(value):
                found = f"found {value!r}"
                needed = f"0, or a size from {LEAST_PLACE:g} to {MOST_PLACE:g}"
            else:
                continue
            yield FieldError(
                f"/sweep/axes/{n}/labels/{position}", f"{x}: {found}; a trend needs {needed}"
            )
