"""Sweeps: from axes to cells, and from a cell to the body of its run."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import exp, log, prod
from typing import Any

from service.core.errors import FieldError
from service.jobs.job_schemas import JobIn, SweepAxisIn
from sysid.core.errors import split_pointer, suggest_name

# Fields of the job as a whole. A cell cannot change them.
UNSWEPT_FIELDS = ("name", "priority", "reuse", "keep_signals", "sweep", "trend")

MAX_LABEL_CHARACTERS = 64
"""Longest name of a label in characters."""


@dataclass(frozen=True, slots=True)
class SweepCell:
    """One run of a sweep: the value of each axis' field, and labels for tables and plots."""

    values: dict[str, Any] = field(default_factory=dict)
    labels: dict[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class AxisPosition:
    """Values set by one position of one group of axes, with their pointer in the body."""

    pointer: str
    cell: SweepCell


@dataclass(frozen=True, slots=True)
class AxisGroup(Sequence[AxisPosition]):
    """Positions of one group of axes, built on access.

    Attributes
    ----------
    columns : tuple
        Number of each axis of the group in the sweep, the axis, and its values.
    """

    columns: tuple[tuple[int, SweepAxisIn, Sequence[Any]], ...]

    @classmethod
    def from_axes(cls, axes: Sequence[SweepAxisIn], numbers: Sequence[int]) -> "AxisGroup":
        """Build the group of the axes with these numbers."""
        return cls(tuple((number, axes[number], expand_values(axes[number])) for number in numbers))

    def __len__(self) -> int:
        return len(self.columns[0][2])

    def __getitem__(self, position: Any) -> Any:
        if not -len(self) <= position < len(self):
            raise IndexError(position)
        pointer = _build_pointer(self.columns[0][0], self.columns[0][1], position)
        return AxisPosition(pointer, self.build_cell(position))

    def build_cell(self, position: int) -> SweepCell:
        """Build the values and labels of one position."""
        labels: dict[str, float | str] = {}
        for _, axis, _ in self.columns:
            labels.update(axis.labels[position] if axis.labels else {})
        return SweepCell({axis.path: values[position] for _, axis, values in self.columns}, labels)


def group_axes(axes: Sequence[SweepAxisIn]) -> list[list[int]]:
    """List the numbers of the axes that step together, group by group."""
    groups: dict[str, list[int]] = {}
    for number, axis in enumerate(axes):
        groups.setdefault(f"zip {axis.zip}" if axis.zip else f"axis {number}", []).append(number)
    return list(groups.values())


def count_runs(job: JobIn, groups: list[list[int]]) -> int:
    """Count the runs that the crossed groups give."""
    return prod(count_values(job.sweep.axes[numbers[0]]) for numbers in groups)


def build_axis_groups(axes: Sequence[SweepAxisIn], groups: list[list[int]]) -> list[AxisGroup]:
    """Build the groups of axes."""
    return [AxisGroup.from_axes(axes, numbers) for numbers in groups]


def iterate_cells(groups: Sequence[AxisGroup], start: int = 0) -> Iterator[SweepCell]:
    """Iterate over the crossed groups' cells from number `start`; without axes one empty cell."""
    if not groups:
        yield from (SweepCell(),)[start:]
        return
    *slower, fastest = groups
    row, first = divmod(start, len(fastest))
    for cell in iterate_cells(slower, row):  # so that little is built for each cell
        for position in range(first, len(fastest)):
            own = fastest.build_cell(position)
            yield SweepCell({**cell.values, **own.values}, {**cell.labels, **own.labels})
        first = 0


def locate_cell(number: int, lengths: Sequence[int]) -> list[int]:
    """Find the position of a cell in each of the crossed groups. The last group varies fastest."""
    positions = []
    for length in reversed(lengths):
        number, position = divmod(number, length)
        positions.append(position)
    return positions[::-1]


def count_values(axis: SweepAxisIn) -> int:
    """Count the values of an axis."""
    if axis.log is not None:
        return axis.log[2]
    return len(axis.values if axis.values is not None else range(*(axis.range or [0])))


def expand_values(axis: SweepAxisIn) -> Sequence[Any]:
    """List the values of an axis."""
    if axis.values is not None:
        return axis.values
    if axis.range is not None:
        return range(*axis.range)
    assert axis.log is not None
    start, stop, points = axis.log
    ratio = log(stop / start) / max(points - 1, 1)
    return [_to_whole_number(start * exp(ratio * i)) for i in range(points - 1)] + [
        _to_whole_number(stop)
    ]


def _to_whole_number(value: float) -> float | int:
    """Convert whole numbers to int, so that integer fields accept them."""
    return int(value) if value.is_integer() and value < 2**53 else value


def _build_pointer(number: int, axis: SweepAxisIn, position: int) -> str:
    kind = next(n for n in ("values", "range", "log") if getattr(axis, n) is not None)
    return f"/sweep/axes/{number}/{kind}" + (f"/{position}" if kind == "values" else "")


def find_axis_faults(job: JobIn) -> Iterator[FieldError]:
    """Report faults of the axes themselves: paths, lengths, labels."""
    document = job.to_normal_form()
    lengths: dict[str, int] = {}
    seen: set[str] = set()
    for number, axis in enumerate(job.sweep.axes):
        pointer = f"/sweep/axes/{number}"
        detail = _describe_unknown_path(document, axis.path)
        if axis.path in seen:
            detail = f"{axis.path!r} is already an axis of this sweep"
        if detail:
            yield FieldError(f"{pointer}/path", detail)
        seen.add(axis.path)
        detail = _describe_bad_spacing(axis)
        if detail:
            yield FieldError(f"{pointer}/{'log' if axis.log else 'range'}", detail)
            continue
        n = count_values(axis)
        if axis.labels is not None and len(axis.labels) != n:
            message = f"found {len(axis.labels)} labels for {n} values; need one label per value"
            yield FieldError(f"{pointer}/labels", message)
        yield from _find_axis_label_faults(axis, pointer)
        if axis.zip is not None and lengths.setdefault(axis.zip, n) != n:
            yield FieldError(
                f"{pointer}/zip",
                f"axes of zip {axis.zip!r} step together, but have {lengths[axis.zip]} and {n} "
                "values; need equal numbers",
            )


def _find_axis_label_faults(axis: SweepAxisIn, pointer: str) -> Iterator[FieldError]:
    """Report label names that a database cannot look up in a document, which would merge groups."""
    for position, labels in enumerate(axis.labels or ()):
        for name in labels:
            if (
                not 1 <= len(name) <= MAX_LABEL_CHARACTERS
                or not name.isprintable()
                or set(name) & {*'"\\'}
            ):
                yield FieldError(
                    f"{pointer}/labels/{position}",
                    f"found the name {name!r:.80}; need 1 to {MAX_LABEL_CHARACTERS} printable "
                    "characters without quotation marks and backslashes",
                )
                return  # the other positions usually have the same names


def _describe_bad_spacing(axis: SweepAxisIn) -> str | None:
    if axis.log is not None:
        start, stop, points = axis.log
        if not (start > 0 and stop > 0 and points >= 1):
            return f"found {list(axis.log)}; need [start, stop, count] with start > 0, stop > 0"
        return None
    if axis.range is not None and (axis.range[2:] == [0] or not range(*axis.range)):
        return f"the range {axis.range} is empty; need [start, stop] or [start, stop, step]"
    return None


def _describe_unknown_path(document: Mapping[str, Any], path: str) -> str | None:
    """Explain why a path is not a field of the body, or return None."""
    parts = split_pointer(path)
    if parts[0] in UNSWEPT_FIELDS:
        return f"{path!r} cannot be swept"
    if parts[0] in ("channels", "weights") and len(parts) == 2:
        return None  # the check of each value reports unknown signals
    if parts[0] == "parameters" and len(parts) in (2, 3):
        return None
    value: Any = document
    for part in parts:
        children = _list_children(value)
        if part not in children:
            return f"the job has no field {path!r}{suggest_name(part, children)}"
        value = value[int(part)] if isinstance(value, list) else value[part]
    return None


def _list_children(value: Any) -> list[str]:
    if isinstance(value, list):
        return [str(index) for index in range(len(value))]
    return list(value) if isinstance(value, dict) else []
