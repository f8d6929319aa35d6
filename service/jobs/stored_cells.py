"""Cells of a stored job: the first are stored at submission, the others later.

Submission stores a sweep of 100,000 runs as one row and its first cells. The dispatcher that holds
the job creates the others from the stored axes when it needs them. Names in axis values are
resolved at submission. A name that changes its meaning later therefore changes nothing.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from service.core.json_pointer import build_run_body, get_value
from service.jobs.axes import AxisGroup, SweepCell, build_axis_groups, group_axes, iterate_cells
from service.jobs.checks import JobChecker
from service.jobs.schemas import JobIn, SweepIn
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
    for number, cell in enumerate(iterate_cells(groups, start), start):
        yield StoredCell(
            number=number,
            cell=dict(cell.values),
            labels=dict(cell.labels) if cell.labels else _NO_LABELS,
            method=_find_field_value(spec, cell, "algorithm", "method"),
            seed=_find_field_value(spec, cell, "seed"),
            sigma=_find_field_value(spec, cell, "noise", "sigma"),
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


def _find_field_value(spec: Mapping[str, Any], cell: SweepCell, *parts: str) -> Any:
    """Find the value of a field in the run's body without building the body."""
    path = "/" + "/".join(parts)
    if path in cell.values:
        return cell.values[path]
    whole = cell.values.get(f"/{parts[0]}", spec[parts[0]])
    return whole.get(parts[1], spec[parts[0]][parts[1]]) if len(parts) > 1 else whole
