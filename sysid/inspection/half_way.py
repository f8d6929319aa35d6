"""Half-way values: a command that shows a value between two levels for one sample.

A logger that stores means of a period writes one such value at each jump. So does one that reads
while the jump goes on.
"""

from collections.abc import Iterator

import numpy as np

from sysid.core.findings import Finding
from sysid.inspection.signal import Signal, build_finding

_PLATEAU = 2  # samples
_MIN_JUMPS = 4
_HALF_WAY_SHARE = 0.5  # of the jumps


def find_half_way_values(signal: Signal) -> Iterator[Finding]:
    """Find jumps between plateaus that most often have one value on their way."""
    if not signal.is_told or signal.role == "output":
        return
    starts, lengths = signal.runs
    values = signal.values[starts]
    is_level = lengths >= _PLATEAU
    between = np.flatnonzero(is_level[:-2] & ~is_level[1:-1] & is_level[2:]) + 1
    inside = (values[between] - values[between - 1]) * (values[between + 1] - values[between]) > 0
    direct = int(np.count_nonzero(is_level[:-1] & is_level[1:]))
    count = int(np.count_nonzero(inside))
    levels = int(np.count_nonzero(is_level))
    if count < _MIN_JUMPS or count < _HALF_WAY_SHARE * max(direct + between.size, levels - 1):
        return
    places = starts[between[inside]]
    yield build_finding(
        "half-way values",
        "reading",
        f"{signal.name} has a value between two levels at {count} of its jumps: its samples are "
        "means of a period, or it moves for a while.",
        (signal.name,),
        tuple(signal.take_span(max(k - 1, 0), k) for k in places[:100].tolist()),
        f"If they are means, use hold: {{{signal.name}: mean}} or hold: {{{signal.name}: "
        "mean-after}.",
    )
