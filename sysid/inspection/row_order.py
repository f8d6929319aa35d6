"""Order of rows: some out of order or written twice, and clocks that restart.

It is asked while a file is read, because a channel has increasing times. Rows out of order are
those outside a longest increasing subsequence of the times (Schensted, Canad. J. Math. 13 (1961)
179).
"""

from bisect import bisect_left
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sysid.core.findings import Finding
from sysid.core.types import BoolArray, FloatArray, IntArray
from sysid.inspection.signal import MIN_SAMPLES, build_finding

_MIN_ROWS = 10  # that are earlier than the row before them, if the clock restarts
_MOST_SHARE = 0.05  # of the rows, that may be out of order: more are no fault of a few rows
_HOLE = 0.5  # of a period: so far from its neighbours, a row belongs between them


class RowOrder(NamedTuple):
    """Rows in the order of their times, where each measurement begins, and what was found."""

    rows: IntArray
    starts: IntArray
    findings: tuple[Finding, ...]


def repair_order(times: FloatArray, are_equal: Callable[[IntArray], BoolArray]) -> RowOrder | None:
    """Repair the order of the rows of a file; None if nothing has to be, or it cannot be.

    A row out of order goes where its time belongs if there is a hole, and is left out if not. Rows
    that are written twice count once. After a restart of the clock another measurement begins.

    Parameters
    ----------
    times : FloatArray, shape (N,)
        As they are written (s).
    are_equal : callable
        Whether the values of rows equal those of the rows before them.

    Examples
    --------
    >>> order = repair_order(np.r_[2.8, 0.0:9.0:0.4], lambda rows: rows < 0)
    >>> order.rows.tolist()[:3], order.findings[0].explanation
    ([1, 2, 3], 'rows out of order')
    """
    steps = np.diff(times)
    if times.size < MIN_SAMPLES or np.all(steps > 0):
        return None
    same = np.flatnonzero(steps == 0) + 1
    if not np.all(are_equal(same)):
        return None
    restarts = np.flatnonzero(steps < 0) + 1
    if restarts.size and not same.size and _restarts(times, restarts):
        return _divide(times, restarts)
    return _sort(times, same)


def _restarts(times: FloatArray, places: IntArray) -> bool:
    """Whether each time that goes back begins a part that is earlier for many rows."""
    parts = np.split(times, places)
    return all(
        earlier.size >= _MIN_ROWS and int(np.count_nonzero(later < earlier[-1])) >= _MIN_ROWS
        for earlier, later in pairwise(parts)
    )


def _divide(times: FloatArray, restarts: IntArray) -> RowOrder:
    first = float(times[restarts[0] - 1])
    finding = build_finding(
        "restart of the clock",
        "clocks",
        f"the clock goes back {restarts.size} time{'s' if restarts.size > 1 else ''}, first from "
        f"{first:.6g} to {times[restarts[0]]:.6g} s. Each part is a measurement of its own, with "
        "an unknown past.",
        (),
    )
    starts = np.concatenate([[0], restarts]).astype(np.int64)
    return RowOrder(np.arange(times.size), starts, (finding,))


def _sort(times: FloatArray, twice: IntArray) -> RowOrder | None:
    findings = []
    single = np.setdiff1d(np.arange(times.size), twice)
    kept = single[_find_increasing(times[single])]
    astray = np.setdiff1d(single, kept)
    if astray.size > max(_MOST_SHARE * times.size, 1.0):
        return None
    period = float(np.median(np.diff(times[kept])))
    fitting = [row for row in astray.tolist() if _fits(float(times[row]), times[kept], period)]
    if len({float(times[row]) for row in fitting}) < len(fitting):
        return None
    if twice.size:
        findings.append(
            build_finding(
                "rows twice",
                "record",
                f"{twice.size} of {times.size} rows are written twice, and count once.",
                (),
            )
        )
    if astray.size:
        left_out = astray.size - len(fitting)
        parts = [
            f"{len(fitting)} put where the time belongs" if fitting else "",
            f"{left_out} left out, whose place is taken" if left_out else "",
        ]
        findings.append(
            build_finding(
                "rows out of order",
                "clocks",
                f"{astray.size} of {times.size} rows are out of order, the first at "
                f"{times[astray[0]]:.6g} s: {', and '.join(part for part in parts if part)}.",
                (),
            )
        )
    rows = np.concatenate([kept, np.array(fitting, dtype=np.int64)])
    rows = rows[np.argsort(times[rows], kind="stable")]
    return RowOrder(rows, np.zeros(1, dtype=np.int64), tuple(findings))


def _fits(time: float, times: FloatArray, period: float) -> bool:
    """Whether a row belongs in a hole, or beyond an end."""
    place = int(np.searchsorted(times, time))
    beside = times[max(place - 1, 0) : place + 1]
    return bool(np.min(np.abs(beside - time)) > _HOLE * period)


def _find_increasing(times: FloatArray) -> IntArray:
    """Find the rows of a longest increasing subsequence of times, by patience sorting."""
    tops, ends = list[float](), list[int]()
    before = np.full(times.size, -1, dtype=np.int64)
    for row, time in enumerate(times.tolist()):
        place = bisect_left(tops, time)
        before[row] = ends[place - 1] if place else -1
        if place == len(tops):
            tops.append(time)
            ends.append(row)
        else:
            tops[place], ends[place] = time, row
    rows = [ends[-1]]
    while before[rows[-1]] >= 0:
        rows.append(int(before[rows[-1]]))
    return np.array(rows[::-1], dtype=np.int64)
