"""Groups of a job's runs, including runs that have not been created yet.

The runs of a job are created in order, so the missing ones are the cells from some number on. The
lengths of the axes give how many of them belong to a group. Groups of ended jobs are cached.
Grouping 100,000 runs takes seconds, and a page requests the same groups repeatedly.
"""

from collections import OrderedDict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from itertools import product
from math import prod
from threading import Lock
from typing import Any, NamedTuple

from sqlalchemy.orm import Session

from service.core.job_fields import SIGMA_PATH
from service.core.states import JobState
from service.jobs.axes import AxisGroup, SweepCell, locate_cell
from service.jobs.stored_cells import read_axis_groups
from service.repositories.runs import RunRepository
from service.repositories.summaries import GroupKey, RunGroup, SummaryQuantity, read_groups
from service.storage.columns import to_json
from service.storage.tables import Job


def group_all_runs(
    session: Session,
    job: Job,
    keys: Sequence[GroupKey],
    quantities: Sequence[SummaryQuantity],
    limit: int,
) -> list[RunGroup]:
    """Group all runs of a job in the order of the sweep, into at most `limit` + 1 groups.

    A run not yet created counts as queued. In a job that ended without it, it has the job's state.
    """
    groups = read_groups(session, job.id, keys, quantities, limit, job.project_id)
    n_created = RunRepository(session, job.project_id).count_created(job.id)
    if n_created >= job.n_runs or len(groups) > limit:
        return groups
    sweep = _GroupedSweep(job.spec, keys)
    # Matched by their first runs: a database may round the numbers in a key.
    by_key = {to_json(sweep.find_key(group.first_number)): group for group in groups}
    state = job.state if job.state.is_terminal else JobState.QUEUED
    for part in sweep.iterate_pending(n_created):
        text = to_json(part.key)
        if text not in by_key:
            if len(groups) > limit:
                break
            by_key[text] = _build_empty_group(part, keys)
            groups.append(by_key[text])
        by_key[text].states[state] += part.size
    return groups


class PendingGroup(NamedTuple):
    """Runs not yet created that share one position in every axis group of the keys."""

    key: tuple[Any, ...]
    first: int
    size: int


class _GroupedSweep:
    """Crossed axis groups of a job, viewed by the grouping keys of its runs."""

    def __init__(self, spec: Mapping[str, Any], keys: Sequence[GroupKey]) -> None:
        self._keys = keys
        self._groups = read_axis_groups(spec)
        self._lengths = [len(steps) for steps in self._groups]
        self._places = [
            index
            for index, steps in enumerate(self._groups)
            if any(_sets_key(steps, key) for key in keys)
        ]

    def find_key(self, number: int) -> tuple[Any, ...]:
        """Find the key of the group that a run belongs to."""
        positions = locate_cell(number, self._lengths)
        return self._build_key([positions[index] for index in self._places])

    def iterate_pending(self, start: int) -> Iterator[PendingGroup]:
        """Iterate over the runs from number `start`, group by group in the order of the sweep."""
        lengths = self._lengths
        total = prod(lengths)
        for positions in product(*(range(lengths[index]) for index in self._places)):
            fixed = dict(zip(self._places, positions, strict=True))
            size = count_cells_below(total, lengths, fixed) - count_cells_below(
                start, lengths, fixed
            )
            if size:
                first = sum(
                    position * prod(lengths[index + 1 :]) for index, position in fixed.items()
                )
                yield PendingGroup(self._build_key(positions), first, size)

    def _build_key(self, positions: Sequence[int]) -> tuple[Any, ...]:
        cells = [
            self._groups[index][position].cell
            for index, position in zip(self._places, positions, strict=True)
        ]
        return tuple(_get_key_value(cells, key) for key in self._keys)


def count_cells_below(end: int, lengths: Sequence[int], fixed: Mapping[int, int]) -> int:
    """Count the cells before number `end` that have the `fixed` positions, by axis group."""
    count = 0
    for index, _ in enumerate(lengths):
        later = range(index + 1, len(lengths))
        free = prod(lengths[axis] for axis in later if axis not in fixed)
        position, end = divmod(end, prod(lengths[axis] for axis in later))
        required = fixed.get(index)
        if required is None:
            count += position * free
        elif required != position:
            return count + (free if required < position else 0)
    return count + end  # without axes there is one cell


def _sets_key(steps: AxisGroup, key: GroupKey) -> bool:
    if key.kind == "axis":
        return any(axis.path == key.name for _, axis, _ in steps.columns)
    return any(key.name in labels for _, axis, _ in steps.columns for labels in axis.labels or [])


def _get_key_value(cells: Sequence[SweepCell], key: GroupKey) -> Any:
    """Return the value as the run's cell has it: of two labels with one name the later counts."""
    value = None
    for cell in cells:
        value = (cell.values if key.kind == "axis" else cell.labels).get(key.name, value)
    return value


def _build_empty_group(part: PendingGroup, keys: Sequence[GroupKey]) -> RunGroup:
    swept = dict(zip((key.name for key in keys), part.key, strict=True)).get(SIGMA_PATH)
    sigma = None if swept is None else (float(swept), float(swept))
    return RunGroup(
        key=part.key,
        first_number=part.first,
        states=dict.fromkeys(JobState, 0),
        n_valid=0,
        sigma=sigma,
        mean_evaluations=None,
        mean_seconds=None,
    )


CACHE_SIZE = 32
MAX_CACHED_GROUPS = 2_000
"""Larger results are not cached."""


class _GroupCache:
    """Cache of the groups requested last."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._groups: OrderedDict[Hashable, list[RunGroup]] = OrderedDict()

    def get(self, key: Hashable) -> list[RunGroup] | None:
        with self._lock:
            if key in self._groups:
                self._groups.move_to_end(key)
            return self._groups.get(key)

    def put(self, key: Hashable, groups: list[RunGroup]) -> None:
        with self._lock:
            self._groups[key] = groups
            while len(self._groups) > CACHE_SIZE:
                self._groups.popitem(last=False)


_cache = _GroupCache()


def get_groups(
    session: Session,
    job: Job,
    keys: Sequence[GroupKey],
    quantities: Sequence[SummaryQuantity],
    limit: int,
) -> list[RunGroup]:
    """Return `service.sweeps.groups.group_all_runs`, cached for jobs that have ended.

    A resumed job ends at another time, so its groups are computed again.
    """
    if not job.state.is_terminal:
        return group_all_runs(session, job, keys, quantities, limit)
    key = (job.id, job.attempt, job.finished_at, tuple(keys), tuple(quantities), limit)
    groups = _cache.get(key)
    if groups is None:
        groups = group_all_runs(session, job, keys, quantities, limit)
        if len(groups) <= MAX_CACHED_GROUPS:
            _cache.put(key, groups)
    return groups
