"""Splitting of a record in time: estimation first, then validation."""

from dataclasses import replace

import numpy as np

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.records import Record


def split_record(record: Record, fraction: float) -> tuple[Record, Record]:
    """Split a record in time: first the part for estimation, then `fraction` for validation.

    The validation part begins at a sample of the longest output. Earlier samples of the inputs
    become its history.

    Raises
    ------
    InvalidSettings
        If the fraction is not between 0 and 1, or leaves a channel of a part without samples.
    """
    cut = find_validation_start(record, fraction)
    parts = []
    for start, stop in ((-np.inf, np.nextafter(cut, -np.inf)), (cut, np.inf)):
        try:
            parts.append(
                replace(
                    record,
                    inputs=tuple(
                        channel.slice_with_history(start, stop) for channel in record.inputs
                    ),
                    outputs=tuple(channel.slice_time(start, stop) for channel in record.outputs),
                )
            )
        except InvalidRecord as error:
            raise InvalidSettings("/validation/fraction", f"found {fraction!r}: {error}") from None
    return parts[0], parts[1]


def find_validation_start(record: Record, fraction: float) -> float:
    """Find the time (s) at which the last `fraction` of a record's longest output begins.

    Raises
    ------
    InvalidSettings
        If the fraction is not between 0 and 1, or one part would be empty.
    """
    return find_cut_time(max((output.times for output in record.outputs), key=len), fraction)


def find_cut_time(
    times: FloatArray, fraction: float, pointer: str = "/validation/fraction"
) -> float:
    """Find the time (s) of the sample at which the last `fraction` of the samples begins.

    Raises
    ------
    InvalidSettings
        If the fraction is not between 0 and 1, or one part would be empty.
    """
    if not 0 < fraction < 1:
        raise InvalidSettings(pointer, f"found {fraction!r}; need a number between 0 and 1")
    first = times.size - round(fraction * times.size)
    if not 0 < first < times.size:
        raise InvalidSettings(
            pointer, f"found {fraction!r}: one part of {times.size} samples would be empty"
        )
    return float(times[first])
