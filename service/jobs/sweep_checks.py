"""Checks of a job with axes: the job itself, every axis value, and its trend.

A trend needs a numeric label on every run.
"""

from collections.abc import Iterator, Mapping, Sequence, Set
from typing import Any

from pydantic import TypeAdapter, ValidationError
from sqlalchemy.orm import Session

from service.core.bodies.json_pointer import build_run_body, get_value
from service.core.bodies.wire import Seed, Sigma
from service.core.errors import FieldError
from service.jobs import warm_starts
from service.jobs.axes import (
    AxisPosition,
    SweepCell,
    build_axis_groups,
    count_runs,
    find_axis_faults,
    group_axes,
)
from service.jobs.checks import JobChecker, find_type_faults
from service.jobs.job_schemas import MAX_X, MIN_X, PREVIOUS, JobIn, is_valid_x
from sysid.core.errors import suggest_name
from sysid.models.model import Model


def find_trend_faults(session: Session, job: JobIn, model: Model | None) -> Iterator[FieldError]:
    """Report labels that are missing or not numbers, and names that model or reference lack."""
    if job.warm_start == PREVIOUS and not job.sweep.axes:
        yield FieldError("/warm_start", "'previous' needs a sweep, but this job has one run")
    if job.trend is None:
        return
    yield from _find_label_faults(job, job.trend.x)
    if model is None:
        return
    yield from warm_starts.find_warm_start_faults(
        session, job.trend.reference, model, "/trend/reference"
    )
    names = [parameter.name for parameter in model.parameters]
    for index, name in enumerate(job.trend.parameters):
        if name not in names:
            yield FieldError(
                f"/trend/parameters/{index}",
                f"the model has no parameter {name!r}{suggest_name(name, names)}",
            )


def _find_label_faults(job: JobIn, x: str) -> Iterator[FieldError]:
    axes = [(n, axis.labels) for n, axis in enumerate(job.sweep.axes) if axis.labels]
    named = [(n, labels) for n, labels in axes if any(x in value_labels for value_labels in labels)]
    if not named:
        names = sorted(
            {name for _, labels in axes for value_labels in labels for name in value_labels}
        )
        available = f"The labels are {', '.join(names)}" if names else "No axis has labels"
        yield FieldError(
            "/trend/x",
            f"no run has a label {x!r}{suggest_name(x, names)}. {available}. Give an axis "
            f'"labels": [{{"{x}": …}}, …], one for each value',
        )
    for n, labels in named:
        for position, value_labels in enumerate(labels):
            value = value_labels.get(x)
            if not isinstance(value, float | int):
                problem = f"found {value_labels[x]!r}" if x in value_labels else "it is missing"
                needed = "a number"
            elif not is_valid_x(value):
                problem = f"found {value!r}"
                needed = f"0, or a magnitude from {MIN_X:g} to {MAX_X:g}"
            else:
                continue
            yield FieldError(
                f"/sweep/axes/{n}/labels/{position}", f"{x}: {problem}; a trend needs {needed}"
            )


# No other field depends on these fields, so their values are checked alone. A whole body for each
# of a hundred thousand seeds would take too long.
INDEPENDENT_FIELDS: Mapping[str, TypeAdapter[Any]] = {
    "/seed": TypeAdapter(Seed),
    "/noise/seed": TypeAdapter(Seed),
    "/noise/sigma": TypeAdapter(Sigma),
}
MAX_FAULTY_VALUES = 200
"""Faulty values after which the check ends. Some checks take 2 ms per value."""


def find_job_faults(
    session: Session, checker: JobChecker, body: JobIn, most_runs: int
) -> list[FieldError]:
    """List every fault that can be detected before the job runs.

    Axis values are checked only if the axes are valid and give at most `most_runs` runs.
    """
    document = body.to_normal_form()
    faults = list(find_axis_faults(body))
    base_faults = checker.find_faults(build_run_body(document, {}))
    if not faults:
        groups = group_axes(body.sweep.axes)
        n_runs = count_runs(body, groups)
        if n_runs > most_runs:
            faults.append(
                FieldError(
                    "/sweep/axes",
                    f"the sweep has {n_runs} runs; a job may have at most {most_runs}",
                )
            )
        else:
            steps = build_axis_groups(body.sweep.axes, groups)
            wrong = list(_find_value_faults(checker, document, steps, frozenset(base_faults)))
            faults += wrong
            if len(wrong) < MAX_FAULTY_VALUES:
                faults += _find_repeated_recordings(checker, body)
    model = checker.resolve_model(body.model)
    faults += find_trend_faults(session, body, None if isinstance(model, list) else model[0])
    return list(dict.fromkeys([*base_faults, *faults]))


def _find_repeated_recordings(checker: JobChecker, body: JobIn) -> Iterator[FieldError]:
    """Report recordings that a trend would count at two labels, or twice at one."""
    if body.trend is None:
        return
    for number, axis in enumerate(body.sweep.axes):
        if axis.path != "/datasets" or not axis.values or not axis.labels:
            continue
        first: dict[str, tuple[int, tuple[Any, str]]] = {}
        for position, (value, labels) in enumerate(zip(axis.values, axis.labels, strict=True)):
            x = labels.get(body.trend.x)
            names = value if isinstance(value, list) else [value]
            for name in (
                name for name in names if isinstance(name, str)
            ):  # others are reported earlier
                dataset = checker.get_dataset(name)
                key = dataset if isinstance(dataset, str) else dataset.sha256
                earlier_position, earlier = first.setdefault(key, (position, (x, name)))
                if earlier_position != position:
                    yield FieldError(
                        f"/sweep/axes/{number}/values/{position}",
                        f"{name!r} at {body.trend.x} = {x} is the same recording as {earlier[1]!r} "
                        f"at {body.trend.x} = {earlier[0]}. Give a different file for one of them",
                    )


def _find_value_faults(
    checker: JobChecker,
    document: dict[str, Any],
    groups: Sequence[Sequence[AxisPosition]],
    base_faults: Set[FieldError],
) -> Iterator[FieldError]:
    """Report faults of axis values; for a range or a logarithmic axis only the first one.

    `base_faults` are the faults of the job without its axes. They are not repeated for every value.
    """
    reported: set[str] = set()
    n_wrong = 0
    for step in (step for group in groups for step in group):
        if step.pointer in reported or _is_valid_alone(step.cell):
            continue
        if n_wrong == MAX_FAULTY_VALUES:
            yield FieldError(
                "", f"{MAX_FAULTY_VALUES} faulty axis values are reported. The rest is not checked"
            )
            return
        faults = list(_find_position_faults(checker, document, step, base_faults))
        if faults:
            reported.add(step.pointer)
            n_wrong += 1
        yield from faults


def _find_type_mismatches(step: AxisPosition, whole: dict[str, Any]) -> Iterator[FieldError]:
    """Report values that the body would convert, such as '3' to 3; workers use them unconverted."""
    for path, value in step.cell.values.items():
        if not isinstance(value, str | bool | float):
            continue
        taken = get_value(whole, path)
        if not isinstance(taken, type(value) | list):
            yield FieldError(step.pointer, f"{path}: found {value!r}; write {taken!r}")


def _is_valid_alone(cell: SweepCell) -> bool:
    return all(
        path in INDEPENDENT_FIELDS and _has_type(INDEPENDENT_FIELDS[path], value)
        for path, value in cell.values.items()
    )


def _has_type(kind: TypeAdapter[Any], value: Any) -> bool:
    try:
        kind.validate_python(value, strict=True)
    except ValidationError:
        return False
    return True


def _find_position_faults(
    checker: JobChecker,
    document: dict[str, Any],
    step: AxisPosition,
    base_faults: Set[FieldError],
) -> Iterator[FieldError]:
    body = build_run_body(document, step.cell.values)
    wrong = find_type_faults(step.pointer, body)
    yield from wrong
    if wrong:
        return
    whole = JobIn.model_validate(body).to_normal_form()
    yield from _find_type_mismatches(step, whole)
    for fault in checker.find_faults(whole):
        if fault not in base_faults:
            yield FieldError(step.pointer, str(fault), fault.column)
