"""Switches between samples: a held input changes before the sample that shows it.

Each change may come up to a period early. What that adds to the output is, for a small step, the
response to a pulse in the period before the sample. The model's response to one pulse, moved and
scaled, stands for all (so it is exact for a linear plant). How early each change comes is estimated
as a random effect with the mean and variance of what is uniform over a period (Robinson, Statist.
Sci. 6 (1991) 15). So the odds are those of the marginal likelihood, in which each change takes what
its prior does. What the changes share is a time lag, known to 1/√(12 q) of a period for q changes.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise, product
from math import ceil, sqrt
from typing import NamedTuple

import numpy as np

from sysid.core.errors import SysidError
from sysid.core.types import FloatArray, IntArray
from sysid.data.records import Channel, Record
from sysid.judgement.residual_context import Candidate, ResidualContext, find_gaps
from sysid.residuals.series import ResidualPart

_MOST_SHARE = 0.3  # changes for a sample: more of them explain anything
_FEWEST = 3  # changes, of which a common part is a time lag
_PRECISION = 12.0  # 1 over the variance of what is uniform over a period
_ROUNDS = 3  # of the estimate: a pulse does not grow from its end
_LATEST = 0.999  # of a period: the order of the samples stays
_FORGOTTEN = 1e-6  # of a pulse: a smaller rest of it is not looked at
_MOST_PRODUCTS = 1 << 32  # of numbers, for each input: less than a second
_FEWEST_IN_GROUP = 64  # changes: smaller matrices take no less time
_ROUNDING = 1e-12  # of the largest eigenvalue of ZᵀZ: less is rounding

_Group = list[tuple[slice, FloatArray]]
"""Changes that follow each other: rows and columns of each output."""


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose that held inputs switch between their samples."""
    for channel in context.moving_inputs:
        if channel.effective_hold != "zero" or not channel.sampling.is_regular:
            continue
        with suppress(SysidError):
            responses = _respond(context, channel.name)
            if responses is None:
                continue
            moved, used, records = np.zeros(context.times.size), 0, []
            early = np.zeros(responses.changes)  # against half a period
            for _ in range(_ROUNDS):
                early, used = _estimate_early(context, responses, early, moved)
                records = _switch_early(context.problem.records, channel.name, 0.5 + early)
                moved = context.simulate(records) - context.simulation
            if np.all(np.isfinite(moved)) and moved.any():
                known = channel.sampling.period / np.sqrt(_PRECISION * early.size)
                yield Candidate(
                    "switches between samples",
                    "reading",
                    context.weigh(moved),
                    f"{channel.name} switches between its samples",
                    f"the data say that {channel.name} switches between its samples, up to one "
                    "period before the sample that shows it. How early on average is known to "
                    f"{known:.2g} s only, and so is the time lag",
                    f"Record {channel.name} at the moments at which it changes.",
                    counted=used,
                    change={"records": records},
                    is_whole=True,
                    doubtful=context.delays,
                )


def _respond(context: ResidualContext, name: str) -> "_Responses | None":
    """Compute what each change adds a period early; None if it cannot be told.

    If a plant forgets so slowly that products of all changes take long, the first ones count. Each
    speaks for itself, so hundreds of them suffice.
    """
    records = context.problem.records
    changes = [_find_changes(one, name) for one in records]
    count = sum(found.size for found in changes)
    if not _FEWEST <= count <= _MOST_SHARE * context.times.size:
        return None
    experiment = next(number for number, found in enumerate(changes) if found.size)
    [channel] = _find_channel(records[experiment], name)
    first = int(changes[experiment][0])
    size, begin = float(np.ptp(channel.values)), float(channel.times[first])
    pulsed = channel.values.copy()
    pulsed[first - 1] += size
    others = list(records)
    others[experiment] = _replace_channel(records[experiment], replace(channel, values=pulsed))
    pulse = (context.simulate(others) - context.simulation) / size
    if not (np.all(np.isfinite(pulse)) and pulse.any()):
        return None
    known = {
        p.output: _Pulse(p.times - begin, pulse[p.rows])
        for p in context.parts
        if p.experiment == experiment
    }
    reach = max(one.reach for one in known.values())
    placed = [channel for one in records for channel in _find_channel(one, name)]
    moments = [channel.times[found] for channel, found in zip(placed, changes, strict=True)]
    length = max([_FEWEST_IN_GROUP, *(_count_together(times, reach) for times in moments)])
    most, left = count, _MOST_PRODUCTS / context.times.size
    if count * length > left:
        most = length = int(sqrt(left))
    groups = list[_Group]()
    for number, (channel, found) in enumerate(zip(placed, changes, strict=True)):
        parts = [p for p in context.parts if p.experiment == number and p.output in known]
        found, times = found[:most], moments[number][:most]
        most -= found.size
        if found.size:
            steps = np.diff(channel.values)[found - 1]
            for own in (slice(k, k + length) for k in range(0, found.size, length)):
                blocks = [known[p.output].move(p, times[own], steps[own], reach) for p in parts]
                nothing = slice(0, 0), np.zeros((0, times[own].size))
                groups.append(
                    [
                        (rows, context.weight[rows, None] * columns)
                        for rows, columns in (nothing, *blocks)
                    ]
                )
    return _Responses(context.times.size, groups)


def _count_together(times: FloatArray, reach: float) -> int:
    """Count the changes at most, at times (q,), whose pulses are not forgotten at a time."""
    ends = np.searchsorted(times, times + reach, side="right")
    return int(np.max(ends - np.arange(times.size), initial=0))


class _Pulse(NamedTuple):
    """Response (m,) of an output to a pulse of size 1, at times since its change (s)."""

    since: FloatArray
    values: FloatArray

    @property
    def reach(self) -> float:
        """Time (s) after which the pulse is forgotten."""
        sizes = np.abs(self.values)
        return float(self.since[np.flatnonzero(sizes >= _FORGOTTEN * np.max(sizes))[-1]])

    def move(
        self, part: ResidualPart, times: FloatArray, steps: FloatArray, reach: float
    ) -> tuple[slice, FloatArray]:
        """Move it to changes at times (q,) and scale it to steps; return rows and columns."""
        first = int(np.searchsorted(part.times, times[0]))
        last = int(np.searchsorted(part.times, times[-1] + reach, side="right"))
        at = part.times[first:last, None] - times
        columns = steps * np.interp(at, self.since, self.values, left=0.0)
        return slice(part.rows.start + first, part.rows.start + last), columns


class _Responses:
    """What each of q changes adds to the weighted outputs (n,) a period early: Z, (n, q).

    A plant forgets a pulse, so each column has few rows. Changes that follow each other are a
    group, and only neighbouring groups share rows. So ZᵀZ is block tridiagonal, and solutions take
    time in proportion to the record (Golub and Van Loan, Matrix Computations, 2013, ch. 4.5).
    """

    def __init__(self, samples: int, groups: Sequence[_Group]) -> None:
        self._samples, self._groups = samples, groups
        ends = np.cumsum([0, *(group[0][1].shape[1] for group in groups)]).tolist()
        self._own = [slice(*ends_of) for ends_of in pairwise(ends)]
        self._diagonal = [_multiply(group, group) for group in groups]
        self._beside = [_multiply(*pair) for pair in pairwise(groups)]
        self.changes: int = ends[-1]
        rows = [np.sum(np.abs(one), axis=1) for one in self._diagonal]
        for number, one in enumerate(self._beside):
            rows[number] += np.sum(np.abs(one), axis=1)
            rows[number + 1] += np.sum(np.abs(one), axis=0)
        self.largest = float(np.max(np.concatenate(rows)))

    def respond(self, early: FloatArray) -> FloatArray:
        """Compute Z x (n,) for changes that are early by x (q,)."""
        moved = np.zeros(self._samples)
        for own, group in zip(self._own, self._groups, strict=True):
            for rows, columns in group:
                moved[rows] += columns @ early[own]
        return moved

    def project(self, values: FloatArray) -> FloatArray:
        """Compute Zᵀ V (q, k) of values (n, k)."""
        of_groups = (
            np.sum([columns.T @ values[rows] for rows, columns in group], axis=0)
            for group in self._groups
        )
        return np.vstack(list(of_groups))

    def solve(self, ridge: float, right: FloatArray) -> tuple[FloatArray, float]:
        """Solve (ZᵀZ + ridge) X = right (q, k); return the logarithm of the determinant too."""
        k, spread, solved = right.shape[1], 0.0, list[FloatArray]()
        for number, own in enumerate(self._own):
            matrix = self._diagonal[number] + ridge * np.eye(own.stop - own.start)
            values = right[own]
            if number:
                left = self._beside[number - 1].T @ solved[-1]
                matrix, values = matrix - left[:, k:], values - left[:, :k]
            after = self._beside[number : number + 1]
            solved.append(np.asarray(np.linalg.solve(matrix, np.hstack([values, *after]))))
            spread += float(np.linalg.slogdet(matrix)[1])
        found = [solved[-1]]
        for one in solved[-2::-1]:
            found.append(one[:, :k] - one[:, k:] @ found[-1])
        return np.vstack(found[::-1]), spread


def _multiply(first: _Group, second: _Group) -> FloatArray:
    """Multiply the columns of two groups over the rows that they share."""
    products = np.zeros((first[0][1].shape[1], second[0][1].shape[1]))
    for (rows, columns), (others, more) in product(first, second):
        begin, end = max(rows.start, others.start), min(rows.stop, others.stop)
        if begin < end:
            own = columns[begin - rows.start : end - rows.start]
            products += own.T @ more[begin - others.start : end - others.start]
    return products


def _estimate_early(
    context: ResidualContext, responses: _Responses, early: FloatArray, moved: FloatArray
) -> tuple[FloatArray, int]:
    """Estimate how early (q,) each change comes, in periods against the mean of all.

    They are corrected by what `moved` (n,), the outputs with those before, leaves. Returns also how
    many parameters of Schwarz's criterion take as much as the marginal likelihood does.
    """
    model = context.residual_model
    lengths = np.linalg.norm(model.columns, axis=0)
    basis, _ = np.linalg.qr(model.columns / np.where(lengths > 0, lengths, 1.0))
    rest = model.residuals - context.weigh(moved)[:, 0] + responses.respond(early)
    rest = rest - basis @ (basis.T @ rest)
    shared, along = responses.project(basis), responses.project(rest[:, None])
    n, q, d = rest.size, responses.changes, basis.shape[1]

    def solve(ridge: float) -> tuple[FloatArray, float]:
        """Solve beside the basis, whose part of each column is taken out (Woodbury 1950)."""
        solved, spread = responses.solve(ridge, np.hstack([shared, along]))
        inner = np.eye(d) - shared.T @ solved[:, :d]
        more = np.linalg.solve(inner, shared.T @ solved[:, d:])
        return (solved[:, d:] + solved[:, :d] @ more)[:, 0], spread + np.linalg.slogdet(inner)[1]

    least = _ROUNDING * responses.largest
    fitted, _ = solve(least)
    moved = responses.respond(fitted)
    left = rest - moved + basis @ (basis.T @ moved)
    ridge = max(_PRECISION * float(left @ left) / max(n - d - q, 1), least)
    early, spread = solve(ridge)
    taken = spread - q * np.log(ridge) + _PRECISION * float(early @ early)
    return early, ceil(taken / np.log(n))


def _switch_early(records: tuple[Record, ...], name: str, early: FloatArray) -> list[Record]:
    """Let each change of an input come early, by (q,) in periods, within one; others by half."""
    early = np.clip(early, 0.0, _LATEST)
    moved, count = [], 0
    for record in records:
        for channel in _find_channel(record, name):
            changes = _find_changes(record, name)
            times = channel.times.copy()
            own = np.full(changes.size, 0.5)
            known = early[count : count + changes.size]
            own[: known.size] = known
            times[changes] -= own * (times[changes] - times[changes - 1])
            count += changes.size
            record = _replace_channel(record, replace(channel, times=times))
        moved.append(record)
    return moved


def _find_changes(record: Record, name: str) -> IntArray:
    """Find the samples of an input that differ from those before, but for those after a gap."""
    for one in _find_channel(record, name):
        return np.flatnonzero((np.diff(one.values) != 0) & ~find_gaps(one.times)) + 1
    return np.zeros(0, dtype=np.int64)


def _find_channel(record: Record, name: str) -> list[Channel]:
    return [replace(one, hold=one.effective_hold) for one in record.inputs if one.name == name]


def _replace_channel(record: Record, channel: Channel) -> Record:
    return replace(
        record, inputs=tuple(channel if one.name == channel.name else one for one in record.inputs)
    )
