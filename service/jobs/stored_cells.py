"""Cells of a stored job: the first are stored at submission, the others later.

Submission stores a sweep of 100,000 runs as one row and its first cells. The dispatcher that holds
the job creates the others from the stored axes when it needs them. Names in axis values are
resolved at submission. A name that changes its meaning later therefore changes nothing.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from operator import itemgetter
from typing import Any

from service.core.bodies.json_pointer import build_run_body, get_value
from service.jobs.axes import AxisGroup, SweepCell, build_axis_groups, group_axes, iterate_cells
from service.jobs.checks import JobChecker
from service.jobs.job_schemas import JobIn, SweepIn
from service.queue.run_writes import NewRun as StoredCell
from service.storage.columns import Document

CELLS_AT_SUBMISSION = 2_000
"""Cells created at submission. Most jobs have no more."""

_NO_LABELS: Document = {}

REFERENCE_FIELDS = ("/model", "/datasets", "/validation", "/warm_start")
"""Fields that name stored objects or contain such names."""


def read_axis_groups(spec: Mapping[str, Any]) -> list[AxisGroup]:
    """Read the crossed groups of a stored job's axes."""
    axes = SweepIn.model_validate(spec["sweep"]).axes
    return build_axis_groups(axes, group_axes(axes))


def build_stored_cells(
    spec: Mapping[str, Any], groups: list[AxisGroup], start: int = 0
) -> Iterator[StoredCell]:
    """Build the rows of a job's runs from number `start`."""
    paths = {axis.path for steps in groups for _, axis, _ in steps.columns}
    read_method = _build_reader(spec, paths, "/algorithm/method")
    read_seed = _build_reader(spec, paths, "/seed")
    read_sigma = _build_reader(spec, paths, "/noise/sigma")
    for number, cell in enumerate(iterate_cells(groups, start), start):
        values = cell.values
        yield StoredCell(
            number,
            values,
            cell.labels or _NO_LABELS,
            method=read_method(values),
            seed=read_seed(values),
            sigma=read_sigma(values),
        )


def resolve_axes(checker: JobChecker, spec: Document, groups: list[AxisGroup]) -> list[Document]:
    """Resolve the axes of a checked job: names to identifiers, objects with their defaults.

    Parameters
    ----------
    spec : dict
        The body from `JobChecker.resolve_body`.
    """
    axes = [dict(axis) for axis in spec["sweep"]["axes"]]
    for steps in groups:
        named = {
            number: axis.path
            for number, axis, _ in steps.columns
            if axis.values is not None
            and (_is_reference_field(axis.path) or any(map(_is_object, axis.values)))
        }
        if not named:
            continue
        resolved = [_resolve_values(checker, spec, step.cell) for step in steps]
        for number, path in named.items():
            axes[number]["values"] = [values[path] for values in resolved]
    return axes


def _resolve_values(checker: JobChecker, spec: Document, cell: SweepCell) -> dict[str, Any]:
    """Return the values of one step as they are stored."""
    whole = checker.resolve_body(
        JobIn.model_validate(build_run_body(spec, cell.values)).to_normal_form()
    )
    return {
        path: get_value(whole, path) if _is_reference_field(path) or _is_object(value) else value
        for path, value in cell.values.items()
    }


def _is_reference_field(path: str) -> bool:
    return path in REFERENCE_FIELDS or path.startswith(("/datasets/", "/validation/datasets"))


def _is_object(value: Any) -> bool:
    return isinstance(value, dict)


def _build_reader(
    spec: Mapping[str, Any], paths: Collection[str], path: str
) -> Callable[[Mapping[str, Any]], Any]:
    """Build the reader of a field of a run's body, from the values of a cell with these paths."""
    if path in paths:
        return itemgetter(path)
    default, (whole, _, name) = get_value(spec, path), path.rpartition("/")
    if whole in paths:
        return lambda values: values[whole].get(name, default)
    return lambda values: default
