"""Aggregates over the runs of a job, computed by the database: no run is loaded to be counted."""

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
"""In thousandths: the database counts places with whole numbers."""


@dataclass(frozen=True, slots=True)
class GroupKey:
    """What runs are grouped by: an axis of the sweep, or a label."""

    kind: Literal["axis", "label"]
    name: str

    @property
    def column(self) -> ColumnElement[Any]:
        """The value in a run's row."""
        column = Run.cell if self.kind == "axis" else Run.labels
        found: ColumnElement[Any] = column.expression[self.name]
        return found


@dataclass(frozen=True, slots=True)
class SummaryQuantity:
    """A number of each run that quantiles are wanted of."""

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
        """The value in a run's row; NULL where it has none."""
        match self.kind:
            case "rms":
                return Run.best_rms.expression
            case "estimate" | "stderr":
                entry = "value" if self.kind == "estimate" else "stderr"
                number: ColumnElement[Any] = Run.estimates[(self.parameter, entry)].as_float()
                return number
            case _:
                found: ColumnElement[Any] = getattr(Run, self.kind)
                return found


@dataclass(slots=True)
class RunGroup:
    """The runs that share the values of the grouping keys; `sigma` is the range of their noise."""

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
    """Groups of a job's runs in the order of the sweep, at most `limit` + 1 of them.

    Quantiles are those of runs that succeeded, linearly interpolated between neighbours.
    """
    columns = [key.column.label(f"key{i}") for i, key in enumerate(keys)]
    # Once asked for the project too, SQLite searches all its runs for those of the job.
    of_project = select(Job.id).where(Job.id == job_id, Job.project_id == project_id)
    mine = (Run.job_id == of_project.scalar_subquery(),)
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
        .where(*mine)
        .group_by(*columns)
        .order_by(func.min(Run.number))
        .limit(limit + 1)
    )
    found: dict[str, RunGroup] = {}
    for first, valid, evaluations, seconds, low, high, *rest in session.execute(query):
        key = tuple(rest[len(counts) :])
        states = {state: int(n) for state, n in zip(JobState, rest, strict=False)}
        mean = None if evaluations is None else float(evaluations)
        sigma = None if low is None else (float(low), float(high))
        found[to_json(key)] = RunGroup(key, int(first), states, int(valid), sigma, mean, seconds)
    by_first = {group.first_number: group for group in found.values()}
    for first, quantity, values in _read_quantiles(session, mine, columns, quantities):
        if first in by_first:  # not beyond the limit
            by_first[first].quantiles[quantity] = values
    return list(found.values())


def find_quietest_run(
    session: Session, job_id: str, cell: Mapping[str, Any], project_id: str = DEFAULT_PROJECT
) -> Run | None:
    """The best valid run of a cell among those with the least noise; None if none succeeded."""
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
    mine: Sequence[ColumnElement[bool]],
    keys: Sequence[Any],
    quantities: Sequence[SummaryQuantity],
) -> Iterator[tuple[int, SummaryQuantity, tuple[float, ...]]]:
    """The first number of each group, a quantity, its quantiles: only values beside them are read.

    One statement takes what it needs out of each row's documents once, and then ranks numbers.
    """
    if not quantities:
        return
    names = [f"q{i}" for i in range(len(quantities))]
    group: ColumnElement[int] = func.dense_rank().over(order_by=list(keys)) if keys else literal(1)
    # Also of runs that did not succeed, so that a group's first run is the same everywhere.
    wide = (
        select(
            group.label("grp"),
            Run.number.label("number"),
            *(
                _restrict_to_succeeded(one.column).label(name)
                for one, name in zip(quantities, names, strict=True)
            ),
        )
        .where(*mine)
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
    for which, grp, number, at, count in session.execute(statement):
        if which < 0:
            first[int(grp)] = int(number)
            continue
        entry = values.setdefault((int(grp), int(which)), (int(count), {}))
        entry[1][int(at)] = float(number)
    for (grp, which), (count, places) in values.items():
        found = tuple(_interpolate_quantile(places, count, q) for q in QUANTILES_PER_MILLE)
        yield first[grp], quantities[which], found


def _select_neighbours(wide: CTE, name: str, which: int) -> Select[Any]:
    """The values on both sides of each quantile of one column, group by group."""
    value = wide.c[name]
    place = func.row_number().over(partition_by=wide.c.grp, order_by=value).label("place")
    # The count is a window's too: SQLite joins a table of counts by trying every pair.
    count = func.count().over(partition_by=wide.c.grp).label("n")
    ranked = (
        select(wide.c.grp, value.label("value"), place, count).where(value.is_not(None)).subquery()
    )
    n = cast(ranked.c.n, Integer)
    lower = [1 + (q * (n - 1)) // 1000 for q in QUANTILES_PER_MILLE]
    return select(literal(which), ranked).where(
        or_(*(ranked.c.place.in_((at, at + 1)) for at in lower))
    )


def _interpolate_quantile(places: dict[int, float], count: int, thousandths: int) -> float:
    whole, rest = divmod(thousandths * (count - 1), 1000)
    low = places[1 + whole]
    return low if rest == 0 else low + (places[2 + whole] - low) * rest / 1000
