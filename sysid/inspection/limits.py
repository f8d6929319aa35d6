"""Limits: a moving signal that ends again and again at the same value."""

from collections.abc import Iterator

import numpy as np

from sysid.core.findings import Finding
from sysid.inspection.signal import Signal, are_many, build_finding

_STILL_SHARE = 0.5  # of the samples, that equal the one before: a command, or stored by a band
_MORE = 3.0  # times the samples of the next level: a pile at the end of the range
_QUANTA = 10.0  # a signal that comes to rest arrives by small moves, one that is cut off does not


def find_limits(signal: Signal) -> Iterator[Finding]:
    """Find samples at a limit of the sensor or of the logger."""
    if not signal.is_told or signal.is_held or np.mean(signal.steps == 0) > _STILL_SHARE:
        return
    values, (starts, lengths) = signal.values, signal.runs
    for index, beside in ((-1, -2), (0, 1)):
        limit, next_level = float(signal.levels[index]), float(signal.levels[beside])
        if not are_many(int(np.count_nonzero(values == limit)), values.size):
            continue
        at_limit = values[starts] == limit
        runs = [
            (start, length)
            for start, length in zip(
                starts[at_limit].tolist(), lengths[at_limit].tolist(), strict=True
            )
            if _is_cut_off(signal, start)
        ]
        count = sum(length for _, length in runs)
        if are_many(count, values.size) and count > _MORE * np.count_nonzero(values == next_level):
            yield build_finding(
                "limit of a sensor",
                "sensor",
                f"{signal.name} is exactly {signal.format_value(limit)} in {count} samples, and "
                f"never {'above' if index else 'below'}: it is at a limit.",
                (signal.name,),
                tuple(signal.take_span(start, start + length - 1) for start, length in runs[:100]),
                f"If {signal.name} is an output, leave these samples out: empty cells are not "
                "compared.",
            )


def _is_cut_off(signal: Signal, start: int) -> bool:
    """Whether a signal comes to a value by a clear move, and was not at rest there."""
    return start > 0 and bool(abs(signal.steps[start - 1]) >= _QUANTA * signal.quantum)
