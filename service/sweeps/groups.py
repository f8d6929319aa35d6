"""Groups of a job's runs by axes or labels, and their aggregates.

The runs of a job are the cells of its sweep in order. So the axes alone tell the group of each run,
also of runs that are not created yet, and how many groups there are. No run is read for that.
"""

import json
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import inf, prod
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from service.core.bodies.job_fields import SIGMA_PATH
from service.core.states import RUN_STATES, JobState
from service.jobs.axes import AxisGroup
from service.jobs.stored_cells import read_axis_groups
from service.repositories.summary_rows import RunTable, SummaryQuantity

QUANTILES_PER_MILLE = (50, 250, 500, 750, 950)
"""Quantiles in thousandths, so that ranks are integers."""

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
_MISSING = object()


@dataclass(frozen=True, slots=True)
class GroupKey:
    """Key by which runs are grouped: an axis of the sweep, or a label."""

    kind: Literal["axis", "label"]
    name: str


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


@dataclass(frozen=True, slots=True)
class _Place:
    """An axis group that sets keys: the different entries of its positions, in order.

    `entries` has one value for each key, or `_MISSING`. `codes` has the entry of each position, and
    -1 after the last entry that the limit allows.
    """

    entries: list[tuple[Any, ...]]
    firsts: list[int]
    codes: Ints
    stride: int


class SweepGroups:
    """Groups of a sweep, in its order; at most `limit` of them.

    Parameters
    ----------
    spec : mapping
        A stored job.
    keys : sequence of GroupKey
        What distinguishes the groups. Runs without a label have None.

    Attributes
    ----------
    by : tuple of GroupKey
        The keys.
    n_runs : int
        Runs of the whole sweep.
    keys : list of tuple
        Values of the keys, by group.
    first_numbers : list of int
        Number of the first run, by group.
    is_cut : bool
        Whether there are more groups than the limit.
    """

    def __init__(self, spec: Mapping[str, Any], keys: Sequence[GroupKey], limit: int) -> None:
        axes = read_axis_groups(spec)
        lengths = [len(steps) for steps in axes]
        self.n_runs, self.by = prod(lengths), tuple(keys)
        self.keys: list[tuple[Any, ...]] = []
        self.first_numbers: list[int] = []
        self._places = [
            _build_place(steps, keys, prod(lengths[number + 1 :]), limit)
            for number, steps in enumerate(axes)
            if any(_sets_key(steps, key) for key in keys)
        ]
        self.is_cut = any(place.codes.min() < 0 for place in self._places)
        self._groups = np.full(prod(len(place.entries) for place in self._places), -1)
        known: dict[Hashable, int] = {}
        for number, entries in enumerate(product(*(place.entries for place in self._places))):
            key = _merge_entries(entries, len(keys))
            identity = tuple(map(_identify, key))
            if identity not in known:
                if len(known) == limit:
                    self.is_cut = True
                    break
                known[identity] = len(known)
                self.keys.append(key)
                self.first_numbers.append(self._find_first_number(number))
            self._groups[number] = known[identity]

    def locate_runs(self, numbers: Ints) -> Ints:
        """Return the group of each run (N,) by its number; -1 beyond the limit."""
        combinations, is_beyond = np.zeros_like(numbers), np.zeros(len(numbers), np.bool_)
        for place in self._places:
            codes = place.codes[numbers // place.stride % len(place.codes)]
            is_beyond |= codes < 0
            combinations = combinations * len(place.entries) + codes
        located: Ints = np.where(is_beyond, -1, self._groups[np.where(is_beyond, 0, combinations)])
        return located

    def _find_first_number(self, combination: int) -> int:
        number = 0
        for place in reversed(self._places):
            combination, entry = divmod(combination, len(place.entries))
            number += place.firsts[entry] * place.stride
        return number


def _sets_key(steps: AxisGroup, key: GroupKey) -> bool:
    if key.kind == "axis":
        return any(axis.path == key.name for _, axis, _ in steps.columns)
    return any(key.name in labels for _, axis, _ in steps.columns for labels in axis.labels or [])


def _build_place(steps: AxisGroup, keys: Sequence[GroupKey], stride: int, limit: int) -> _Place:
    columns = [_list_key_values(steps, key) for key in keys]
    known: dict[Hashable, int] = {}
    entries, firsts = [], []
    codes = np.full(len(steps), -1, dtype=np.int64)
    for position, entry in enumerate(zip(*columns, strict=True)):
        identity = tuple(map(_identify, entry))
        if identity not in known:
            if len(known) == limit:
                break
            known[identity] = len(known)
            entries.append(entry)
            firsts.append(position)
        codes[position] = known[identity]
    return _Place(entries, firsts, codes, stride)


def _list_key_values(steps: AxisGroup, key: GroupKey) -> Iterable[Any]:
    """List the values of a key at each position; of two labels with one name the later counts."""
    values: Sequence[Any] = [_MISSING] * len(steps)
    for _, axis, column in steps.columns:
        if key.kind == "axis" and axis.path == key.name:
            values = column
        elif key.kind == "label" and axis.labels:
            pairs = zip(values, axis.labels, strict=True)
            values = [labels.get(key.name, before) for before, labels in pairs]
    return values


def _merge_entries(entries: Sequence[tuple[Any, ...]], n_keys: int) -> tuple[Any, ...]:
    merged: list[Any] = [None] * n_keys
    for entry in entries:
        merged = [old if new is _MISSING else new for old, new in zip(merged, entry, strict=True)]
    return tuple(merged)


def _identify(value: Any) -> Hashable:
    """Return what distinguishes a value: 0 is 0.0, but neither is false."""
    if value is _MISSING or isinstance(value, str):
        return (value,)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value
    return json.dumps(value, sort_keys=True)


def aggregate_runs(
    table: RunTable, groups: SweepGroups, pending: JobState = JobState.QUEUED
) -> list[RunGroup]:
    """Aggregate the runs of each group, in the order of the sweep.

    Quantiles are those of successful runs, interpolated linearly between neighbours.

    Parameters
    ----------
    pending : JobState
        State that runs count in that are not created yet.
    """
    n_groups = len(groups.keys)
    located = groups.locate_runs(table.numbers)
    inside = located >= 0
    succeeded = inside & table.is_in_state(JobState.SUCCEEDED)
    counts: dict[JobState, Any] = {
        state: np.bincount(located[inside & table.is_in_state(state)], minlength=n_groups)
        for state in RUN_STATES
    }
    all_runs = groups.locate_runs(np.arange(groups.n_runs))
    sizes = np.bincount(all_runs[all_runs >= 0], minlength=n_groups)
    counts[pending] = counts[pending] + sizes - sum(counts.values())
    valid = np.bincount(located[inside & table.is_valid], minlength=n_groups)
    evaluations = _compute_means(table.evaluations, located, succeeded, n_groups)
    seconds = _compute_means(table.seconds, located, succeeded, n_groups)
    low, high = _find_ranges(table.sigma, located, inside, n_groups)
    made = [
        RunGroup(
            key=key,
            first_number=groups.first_numbers[group],
            states={state: int(counts[state][group]) for state in RUN_STATES},
            n_valid=int(valid[group]),
            sigma=_choose_sigma(low[group], high[group], groups, group),
            mean_evaluations=_to_optional(evaluations[group]),
            mean_seconds=_to_optional(seconds[group]),
        )
        for group, key in enumerate(groups.keys)
    ]
    for quantity, values in table.values.items():
        used = succeeded & np.isfinite(values)
        for group, quantiles in _compute_quantiles(values[used], located[used], n_groups):
            made[group].quantiles[quantity] = quantiles
    return made


def _compute_means(values: Floats, located: Ints, chosen: NDArray[np.bool_], n: int) -> Floats:
    """Compute the mean of the chosen runs' values in each group (n,); NaN without any."""
    used = chosen & np.isfinite(values)
    counts = np.bincount(located[used], minlength=n)
    sums = np.bincount(located[used], values[used], minlength=n)
    means: Floats = np.divide(sums, counts, out=np.full(n, np.nan), where=counts > 0)
    return means


def _find_ranges(
    values: Floats, located: Ints, chosen: NDArray[np.bool_], n: int
) -> tuple[Floats, Floats]:
    """Find the least and the largest value of each group (n,)."""
    used = chosen & np.isfinite(values)
    low, high = np.full(n, inf), np.full(n, -inf)
    np.minimum.at(low, located[used], values[used])
    np.maximum.at(high, located[used], values[used])
    return low, high


def _choose_sigma(
    low: float, high: float, groups: SweepGroups, group: int
) -> tuple[float, float] | None:
    """Return the range of the runs' noise; without runs that of the keys, None if unknown."""
    if low <= high:
        return float(low), float(high)
    named = {key.name: value for key, value in zip(groups.by, groups.keys[group], strict=True)}
    swept = named.get(SIGMA_PATH)
    return None if swept is None else (float(swept), float(swept))


def _compute_quantiles(
    values: Floats, located: Ints, n: int
) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Yield each group that has values, and its quantiles."""
    counts = np.bincount(located, minlength=n)
    ranked = values[np.lexsort((values, located))]
    starts = np.cumsum(counts) - counts
    for group in np.flatnonzero(counts).tolist():
        of_group = ranked[starts[group] : starts[group] + counts[group]].tolist()
        yield group, tuple(_interpolate_quantile(of_group, q) for q in QUANTILES_PER_MILLE)


def _interpolate_quantile(ranked: Sequence[float], thousandths: int) -> float:
    whole, rest = divmod(thousandths * (len(ranked) - 1), 1000)
    low = ranked[whole]
    return low if rest == 0 else low + (ranked[whole + 1] - low) * rest / 1000


def _to_optional(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
