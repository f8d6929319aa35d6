"""Aggregates over the runs of a job. The database computes them, so that no run is loaded."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from sqlalchemy import (
    CTE,
    ColumnElement,
    Integer,
    Select,
    case,
    cast,
    func,
    literal,
    or_,
    select,
    union_all,
)
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.repositories.runs import entry_equals
from service.storage.columns import to_json
from service.storage.tables import DEFAULT_PROJECT, Job, Run

QUANTILES_PER_MILLE = (50, 250, 500, 750, 950)
"""Quantiles in thousandths, because the database computes ranks with integers."""


@dataclass(frozen=True, slots=True)
class GroupKey:
    """Key by which runs are grouped: an axis of the sweep, or a label."""

    kind: Literal["axis", "label"]
    name: str

    @property
    def column(self) -> ColumnElement[Any]:
        """Value in the row of a run."""
        column = Run.cell if self.kind == "axis" else Run.labels
        entry: ColumnElement[Any] = column.expression[self.name]
        return entry


@dataclass(frozen=True, slots=True)
class SummaryQuantity:
    """A number of each run, for quantiles over runs."""

    kind: Literal[
        "rms",
        "rms_noise_free",
        "fit_estimation",
        "fit_validation",
        "evaluations",
        "estimate",
        "stderr",
    ]
    parameter: str = ""

    @property
    def column(self) -> ColumnElement[Any]:
        """Value in the row of a run; NULL if it has none."""
        match self.kind:
            case "rms":
                return Run.best_rms.expression
            case "estimate" | "stderr":
                entry = "value" if self.kind == "estimate" else "stderr"
                number: ColumnElement[Any] = Run.estimates[(self.parameter, entry)].as_float()
                return number
            case _:
                column: ColumnElement[Any] = getattr(Run, self.kind)
                return column


@dataclass(slots=True)
class RunGroup:
    """Runs with equal values of the grouping keys; `sigma` is the range of their noise."""

    key: tuple[Any, ...]
    first_number: int
    states: dict[JobState, int]
    n_valid: int
    sigma: tuple[float, float] | None
    mean_evaluations: float | None
    mean_seconds: float | None
    quantiles: dict[SummaryQuantity, tuple[float, ...]] = field(default_factory=dict)


def read_groups(
    session: Session,
    job_id: str,
    keys: Sequence[GroupKey],
    quantities: Sequence[SummaryQuantity],
    limit: int,
    project_id: str = DEFAULT_PROJECT,
) -> list[RunGroup]:
    """Read the groups of a job's runs in the order of the sweep, at most `limit` + 1 of them.

    Quantiles are those of successful runs, interpolated linearly between neighbours.
    """
    columns = [key.column.label(f"key{i}") for i, key in enumerate(keys)]
    # With a condition on the project too, SQLite would search all runs of the project.
    of_project = select(Job.id).where(Job.id == job_id, Job.project_id == project_id)
    of_job = (Run.job_id == of_project.scalar_subquery(),)
    counts = [func.sum(case((Run.state == state, 1), else_=0)) for state in JobState]
    query = (
        select(
            func.min(Run.number),
            func.sum(case((Run.valid.is_(True), 1), else_=0)),
            func.avg(_restrict_to_succeeded(Run.evaluations)),
            func.avg(_restrict_to_succeeded(Run.seconds)),
            func.min(Run.sigma),
            func.max(Run.sigma),
            *counts,
            *columns,
        )
        .where(*of_job)
        .group_by(*columns)
        .order_by(func.min(Run.number))
        .limit(limit + 1)
    )
    groups: dict[str, RunGroup] = {}
    for first, valid, evaluations, seconds, low, high, *rest in session.execute(query):
        key = tuple(rest[len(counts) :])
        states = {state: int(n) for state, n in zip(JobState, rest, strict=False)}
        mean = None if evaluations is None else float(evaluations)
        sigma = None if low is None else (float(low), float(high))
        groups[to_json(key)] = RunGroup(key, int(first), states, int(valid), sigma, mean, seconds)
    by_first = {group.first_number: group for group in groups.values()}
    for first, quantity, values in _read_quantiles(session, of_job, columns, quantities):
        if first in by_first:  # not beyond the limit
            by_first[first].quantiles[quantity] = values
    return list(groups.values())


def find_quietest_run(
    session: Session, job_id: str, cell: Mapping[str, Any], project_id: str = DEFAULT_PROJECT
) -> Run | None:
    """Find the best valid run of a cell among those with the least noise; None without success."""
    query = select(Run).where(
        Run.job_id == job_id,
        Run.project_id == project_id,
        Run.state == JobState.SUCCEEDED,
        Run.valid.is_(True),
        Run.best_rms.is_not(None),
        *(entry_equals(session, Run.cell, path, value) for path, value in cell.items()),
    )
    return session.scalar(query.order_by(Run.sigma, Run.best_rms, Run.number).limit(1))


def _restrict_to_succeeded(column: Any) -> ColumnElement[Any]:
    return case((Run.state == JobState.SUCCEEDED, column))


def _read_quantiles(
    session: Session,
    of_job: Sequence[ColumnElement[bool]],
    keys: Sequence[Any],
    quantities: Sequence[SummaryQuantity],
) -> Iterator[tuple[int, SummaryQuantity, tuple[float, ...]]]:
    """Yield the first number of each group, a quantity, and its quantiles.

    Only the values next to the quantiles are read. One statement extracts the numbers from the
    documents of each row once, and then ranks them.
    """
    if not quantities:
        return
    names = [f"q{i}" for i in range(len(quantities))]
    group: ColumnElement[int] = func.dense_rank().over(order_by=list(keys)) if keys else literal(1)
    # Includes runs that did not succeed, so that the first run of a group is always the same.
    wide = (
        select(
            group.label("grp"),
            Run.number.label("number"),
            *(
                _restrict_to_succeeded(quantity.column).label(name)
                for quantity, name in zip(quantities, names, strict=True)
            ),
        )
        .where(*of_job)
        .cte("wide")
    )
    nothing = literal(0)
    firsts = select(literal(-1), wide.c.grp, func.min(wide.c.number), nothing, nothing)
    statement = union_all(
        firsts.group_by(wide.c.grp),
        *(_select_neighbours(wide, name, i) for i, name in enumerate(names)),
    )
    first: dict[int, int] = {}
    values: dict[tuple[int, int], tuple[int, dict[int, float]]] = {}
    for which, grp, number, rank, count in session.execute(statement):
        if which < 0:
            first[int(grp)] = int(number)
            continue
        entry = values.setdefault((int(grp), int(which)), (int(count), {}))
        entry[1][int(rank)] = float(number)
    for (grp, which), (count, ranked) in values.items():
        quantiles = tuple(_interpolate_quantile(ranked, count, q) for q in QUANTILES_PER_MILLE)
        yield first[grp], quantities[which], quantiles


def _select_neighbours(wide: CTE, name: str, which: int) -> Select[Any]:
    """Select the values on both sides of each quantile of one column, by group."""
    value = wide.c[name]
    rank = func.row_number().over(partition_by=wide.c.grp, order_by=value).label("place")
    # The count is a window function too: SQLite would join a table of counts pair by pair.
    count = func.count().over(partition_by=wide.c.grp).label("n")
    ranked = (
        select(wide.c.grp, value.label("value"), rank, count).where(value.is_not(None)).subquery()
    )
    n = cast(ranked.c.n, Integer)
    lower = [1 + (q * (n - 1)) // 1000 for q in QUANTILES_PER_MILLE]
    return select(literal(which), ranked).where(
        or_(*(ranked.c.place.in_((low, low + 1)) for low in lower))
    )


def _interpolate_quantile(ranked: dict[int, float], count: int, thousandths: int) -> float:
    whole, rest = divmod(thousandths * (count - 1), 1000)
    low = ranked[1 + whole]
    return low if rest == 0 else low + (ranked[2 + whole] - low) * rest / 1000
