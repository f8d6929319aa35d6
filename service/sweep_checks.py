"""Faults of a job with axes: of the job itself, of every value that an axis gives, of its trend."""

from collections.abc import Iterator, Mapping, Sequence, Set
from typing import Any

from pydantic import TypeAdapter, ValidationError
from sqlalchemy.orm import Session

from service.checks import JobChecker, value_faults
from service.errors import FieldError, InvalidRequest
from service.schemas_jobs import JobIn, Seed, Sigma
from service.sweeps import Cell, Step, body_of, value_at
from service.trend_checks import trend_faults

# Fields that no other field depends on: their values are checked alone, a whole body for each of
# a hundred thousand seeds would only take time.
ALONE: Mapping[str, TypeAdapter[Any]] = {
    "/seed": TypeAdapter(Seed),
    "/noise/seed": TypeAdapter(Seed),
    "/noise/sigma": TypeAdapter(Sigma),
}


def check_sweep(
    checker: JobChecker, document: dict[str, Any], groups: Sequence[Sequence[Step]]
) -> None:
    """Refuse a job with faults, or with values of axes that have some.

    Raises
    ------
    InvalidRequest
        With every fault that can be known before the job runs.
    """
    errors = checker.errors(body_of(document, {}))
    errors += _sweep_faults(checker, document, groups, frozenset(errors))
    if errors:
        unique = dict.fromkeys(errors)
        raise InvalidRequest(unique)


def check_trend(session: Session, checker: JobChecker, body: JobIn) -> None:
    """Refuse a job whose trend, or chain of warm starts, cannot be made.

    Raises
    ------
    InvalidRequest
        With the reasons.
    """
    model = checker.model(body.model)
    errors = list(trend_faults(session, body, None if isinstance(model, list) else model[0]))
    errors += _repeated_recordings(checker, body)
    if errors:
        raise InvalidRequest(errors)


def _repeated_recordings(checker: JobChecker, body: JobIn) -> Iterator[FieldError]:
    """Recordings that a trend would take for measured at two places, or twice at one."""
    if body.trend is None:
        return
    for number, axis in enumerate(body.sweep.axes):
        if axis.path != "/datasets" or not axis.values or not axis.labels:
            continue
        first: dict[str, tuple[int, tuple[Any, str]]] = {}
        for position, (given, labels) in enumerate(zip(axis.values, axis.labels, strict=True)):
            x = labels.get(body.trend.x)
            for name in [given] if isinstance(given, str) else given:
                dataset = checker.dataset(name)
                key = dataset if isinstance(dataset, str) else dataset.sha256
                at, before = first.setdefault(key, (position, (x, name)))
                if at != position:
                    yield FieldError(
                        f"/sweep/axes/{number}/values/{position}",
                        f"{name!r} at {body.trend.x} = {x} is the same recording as {before[1]!r} "
                        f"at {body.trend.x} = {before[0]}: one of them is another file",
                    )


def _sweep_faults(
    checker: JobChecker,
    document: dict[str, Any],
    groups: Sequence[Sequence[Step]],
    known: Set[FieldError],
) -> Iterator[FieldError]:
    """Faults of the values; of a range or a logarithmic axis, those of its first bad value.

    What the job has without its axes is `known`, and not told of every value again.
    """
    told: set[str] = set()
    for step in (step for group in groups for step in group):
        if step.pointer in told or _is_good_alone(step.cell):
            continue
        found = list(_step_faults(checker, document, step, known))
        if found:
            told.add(step.pointer)
        yield from found


def _of_another_type(step: Step, whole: dict[str, Any]) -> Iterator[FieldError]:
    """Values that a body would take for others, as '3' for 3: workers take a cell's as they are."""
    for path, value in step.cell.values.items():
        if not isinstance(value, str | bool | float):
            continue
        taken = value_at(whole, path)
        if not isinstance(taken, type(value) | list):
            yield FieldError(step.pointer, f"{path}: found {value!r}; write {taken!r}")


def _is_good_alone(cell: Cell) -> bool:
    return all(path in ALONE and _fits(ALONE[path], value) for path, value in cell.values.items())


def _fits(kind: TypeAdapter[Any], value: Any) -> bool:
    try:
        kind.validate_python(value, strict=True)
    except ValidationError:
        return False
    return True


def _step_faults(
    checker: JobChecker, document: dict[str, Any], step: Step, known: Set[FieldError]
) -> Iterator[FieldError]:
    body = body_of(document, step.cell.values)
    wrong = value_faults(step.pointer, body)
    yield from wrong
    if wrong:
        return
    whole = JobIn.model_validate(body).normal_form()
    yield from _of_another_type(step, whole)
    for fault in checker.errors(whole):
        if fault not in known:
            yield FieldError(step.pointer, str(fault), fault.column)
