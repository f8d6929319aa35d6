"""Switches between samples: a held input changes before the sample that shows it.

Each change may come up to a period early. What that adds to the output is, for a small step, the
response to a pulse in the period before the sample. The model's response to one pulse, moved and
scaled, stands for all (so it is exact for a linear plant). How early each change comes is estimated
as a random effect with the mean and variance of what is uniform over a period (Robinson, Statist.
Sci. 6 (1991) 15). So the odds are those of the marginal likelihood, in which each change takes what
its prior does. What the changes share is a time lag, known to 1/√(12 q) of a period for q changes.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from math import ceil

import numpy as np

from sysid.core.errors import SysidError
from sysid.core.types import FloatArray, IntArray
from sysid.data.records import Channel, Record
from sysid.judgement.residual_context import Candidate, ResidualContext, find_gaps

_MOST_SHARE = 0.3  # changes for a sample: more of them explain anything
_FEWEST = 3  # changes, of which a common part is a time lag
_PRECISION = 12.0  # 1 over the variance of what is uniform over a period
_ROUNDS = 3  # of the estimate: a pulse does not grow from its end
_LATEST = 0.999  # of a period: the order of the samples stays


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose that held inputs switch between their samples."""
    for channel in context.moving_inputs:
        if channel.effective_hold != "zero" or not channel.sampling.is_regular:
            continue
        with suppress(SysidError):
            columns = _respond(context, channel.name)
            if columns is None:
                continue
            moved, used, records = np.zeros(context.times.size), 0, []
            early = np.zeros(columns.shape[1])  # against half a period
            for _ in range(_ROUNDS):
                early, used = _estimate_early(context, columns, early, moved)
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


def _respond(context: ResidualContext, name: str) -> FloatArray | None:
    """Compute what each change adds (n, q) a period early; None if it cannot be told."""
    records = context.problem.records
    changes = [(number, k) for number, one in enumerate(records) for k in _find_changes(one, name)]
    if not _FEWEST <= len(changes) <= _MOST_SHARE * context.times.size:
        return None
    experiment, first = changes[0]
    [channel] = _find_channel(records[experiment], name)
    size, begin = float(np.ptp(channel.values)), float(channel.times[first])
    pulsed = channel.values.copy()
    pulsed[first - 1] += size
    others = list(records)
    others[experiment] = _replace_channel(records[experiment], replace(channel, values=pulsed))
    pulse = (context.simulate(others) - context.simulation) / size
    if not np.all(np.isfinite(pulse)):
        return None
    columns = np.zeros((context.times.size, len(changes)))
    known = {
        p.output: (p.times - begin, pulse[p.rows])
        for p in context.parts
        if p.experiment == experiment
    }
    for number, (where, k) in enumerate(changes):
        [channel] = _find_channel(records[where], name)
        step = float(channel.values[k] - channel.values[k - 1])
        for part in context.parts:
            if part.experiment == where and part.output in known:
                since, values = known[part.output]
                at = part.times - float(channel.times[k])
                columns[part.rows, number] = step * np.interp(at, since, values, left=0.0)
    return columns


def _estimate_early(
    context: ResidualContext, columns: FloatArray, early: FloatArray, moved: FloatArray
) -> tuple[FloatArray, int]:
    """Estimate how early (q,) each change comes, in periods against the mean of all.

    They are corrected by what `moved` (n,), the outputs with those before, leaves. Returns also how
    many parameters of Schwarz's criterion take as much as the marginal likelihood does.
    """
    model, z = context.residual_model, context.weigh(columns)
    lengths = np.linalg.norm(model.columns, axis=0)
    basis, _ = np.linalg.qr(model.columns / np.where(lengths > 0, lengths, 1.0))
    rest = model.residuals - context.weigh(moved)[:, 0] + z @ early
    rest = rest - basis @ (basis.T @ rest)
    z = z - basis @ (basis.T @ z)
    n, q = z.shape
    left = rest - z @ np.linalg.lstsq(z, rest, rcond=1e-6)[0]
    variance = float(left @ left) / max(n - basis.shape[1] - q, 1)
    gram = z.T @ z
    ridged = gram + _PRECISION * variance * np.eye(q)
    early = np.linalg.solve(ridged, z.T @ rest)
    _, spread = np.linalg.slogdet(np.eye(q) + gram / (_PRECISION * variance))
    taken = float(spread) + _PRECISION * float(early @ early)
    return early, ceil(taken / np.log(n))


def _switch_early(records: tuple[Record, ...], name: str, early: FloatArray) -> list[Record]:
    """Let each change of an input come early, by (q,) in periods, within one."""
    early = np.clip(early, 0.0, _LATEST)
    moved, count = [], 0
    for record in records:
        for channel in _find_channel(record, name):
            changes = _find_changes(record, name)
            times = channel.times.copy()
            own = early[count : count + changes.size]
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
