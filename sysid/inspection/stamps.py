"""Stamps: times that are rounded to a grid, scatter, or follow no pace.

Rounding is seen by the steps of the stamps: two neighbouring multiples of the grid, mixed so that
no stamp is farther than the grid from an even clock (Beatty sequences: Fraenkel, Canad. J. Math. 21
(1969) 6).
"""

from collections.abc import Iterator

import numpy as np

from sysid.core.findings import Finding
from sysid.core.types import FloatArray
from sysid.data.outages import count_lost_rows, find_outages, is_paced, keeps_step
from sysid.data.records import REGULARITY_TOLERANCE
from sysid.inspection.signal import MIN_SAMPLES, Signal, build_finding, list_names

_PRINTED = 1e-4  # of a period: finer differences of steps are digits of the file
_ON_GRID = 1e-2  # of the grid: distance of its multiples


def find_stamp_faults(signal: Signal, names: tuple[str, ...]) -> Iterator[Finding]:
    """Find what the stamps of a clock are like, if they are not even."""
    times = signal.whole.times
    if times.size < 3 or signal.whole.sampling.is_regular or signal.whole.repeats is not None:
        return
    steps = np.diff(times)
    is_complete = keeps_step(times) and not count_lost_rows(times).any()
    if times.size < MIN_SAMPLES or not (is_complete or is_paced(times)):
        yield build_finding(
            "irregular sampling",
            "clocks",
            f"sampling of {list_names(names)} is irregular: {np.min(steps):.4g} to "
            f"{np.max(steps):.4g} s between samples, median {np.median(steps):.4g} s. Each sample "
            "is used at its own time.",
            names,
        )
        return
    times = times if is_complete else _take_longest_stretch(times)
    rows = np.concatenate([[0], np.cumsum(1 + count_lost_rows(times))])
    if rows.size < MIN_SAMPLES:
        return
    slope, offset = np.polyfit(rows, times, 1)
    scatter = times - (offset + slope * rows)
    if np.max(np.abs(scatter)) <= REGULARITY_TOLERANCE * slope:
        return
    grid = _find_grid(times, float(slope))
    if grid is not None and np.ptp(scatter) <= 1.5 * grid:
        yield build_finding(
            "rounded stamps",
            "clocks",
            f"the stamps of {list_names(names)} are rounded to {grid:.4g} s, and the samples are "
            f"{slope:.6g} s apart. So each stamp is off by up to {grid:.4g} s.",
            names,
            advice=f"Read the file with a sampling period of {slope:.6g} s." if is_complete else "",
        )
        return
    yield build_finding(
        "jitter",
        "clocks",
        f"the stamps of {list_names(names)} scatter by {np.std(scatter):.3g} s about an even clock "
        f"of {slope:.6g} s ({100 * np.std(scatter) / slope:.0f} % of a period). Each sample is "
        "used at its own time.",
        names,
        advice="If the samples were even and only their stamps scatter, read the file with a "
        f"sampling period of {slope:.6g} s."
        if is_complete
        else "",
    )


def _take_longest_stretch(times: FloatArray) -> FloatArray:
    """Take the longest stretch between outages, which may have shifted the pace."""
    edges = np.searchsorted(times, [one.stop for one in find_outages(times)])
    return max(np.split(times, edges), key=len)


def _find_grid(times: FloatArray, period: float) -> float | None:
    """Find the grid (s) whose multiples all steps are; None if there is none."""
    steps = np.sort(np.diff(times))
    groups = np.split(steps, np.flatnonzero(np.diff(steps) > _PRINTED * period) + 1)
    sizes = np.array([float(np.mean(group)) for group in groups])
    gaps = np.diff(sizes)
    if not gaps.size:
        return None
    grid = float(np.min(gaps))
    multiples = sizes / grid
    is_grid = np.max(np.abs(multiples - np.rint(multiples))) <= _ON_GRID * max(multiples[0], 1.0)
    return grid if is_grid and grid > REGULARITY_TOLERANCE * period else None
