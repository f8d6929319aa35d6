"""What happened to this record: all kinds of this folder, asked of each channel.

`inspect_recording` needs no model. It is called before any search, and its findings go with the
records into the result.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain

from sysid.core.findings import Finding
from sysid.data.foreign_tables import Labelled
from sysid.data.outages import cut_segments, extract_records
from sysid.data.records import Channel, Record, Recording
from sysid.inspection.gaps import find_gaps
from sysid.inspection.half_way import find_half_way_values
from sysid.inspection.limits import find_limits
from sysid.inspection.quantisation import find_quantisation
from sysid.inspection.repeats import find_repeats
from sysid.inspection.resampling import find_resampling
from sysid.inspection.signal import Role, Signal
from sysid.inspection.stamps import find_stamp_faults
from sysid.inspection.units import find_unit_change

_KINDS: tuple[Callable[[Signal], Iterator[Finding]], ...] = (
    find_quantisation,
    find_repeats,
    find_limits,
    find_half_way_values,
    find_resampling,
    find_unit_change,
)
"""Kinds that are asked of each channel."""


def check_recording(recording: Recording | Record | Labelled) -> tuple[Finding, ...]:
    """Check what happened to a recording: gaps, stamps, repeats, steps, limits and more.

    No model is needed, and nothing is changed. A table of pandas, xarray or polars, or a mapping of
    lists, is read as `Recording` reads it.

    Returns
    -------
    tuple of Finding
        What was found, each with its channels and where it is (s). Empty for a sound recording.

    Raises
    ------
    InvalidRecord
        If an object is no recording.

    Examples
    --------
    >>> t = [float(k) for k in (*range(100), *range(900, 1000))]
    >>> (found,) = check_recording({"t": t, "u": [k % 20 // 10 for k in range(200)]})
    >>> found.explanation, found.spans
    ('outage', ((99.0, 900.0),))
    """
    if isinstance(recording, Record):
        roles: dict[str, Role] = dict.fromkeys((one.name for one in recording.inputs), "input")
        roles |= dict.fromkeys((one.name for one in recording.outputs), "output")
        return inspect_recording(Recording((*recording.inputs, *recording.outputs)), roles)
    return inspect_recording(
        recording if isinstance(recording, Recording) else Recording(recording)
    )


def inspect_recording(
    recording: Recording, roles: Mapping[str, Role] | None = None
) -> tuple[Finding, ...]:
    """Inspect the channels of a recording, or only those that have a role.

    Every segment is inspected by itself. What several of them have is told once.
    """
    chosen = tuple(one for one in recording.channels if roles is None or one.name in roles)
    found = [
        finding
        for part in cut_segments(replace(recording, channels=chosen))
        if part.channels
        for finding in _inspect_part(part, roles or {})
    ]
    merged: dict[tuple[str, tuple[str, ...]], list[Finding]] = {}
    for finding in found:
        merged.setdefault((finding.explanation, finding.channels), []).append(finding)
    return tuple(_join(several) for several in merged.values())


def _join(several: Sequence[Finding]) -> Finding:
    first, *others = several
    if not others:
        return first
    spans = tuple(chain.from_iterable(one.spans for one in several))
    count = f"{len(others)} other segment{'s have' if len(others) > 1 else ' has'} the same."
    return replace(first, text=f"{first.text} {count}", spans=spans)


def _inspect_part(recording: Recording, roles: Mapping[str, Role]) -> Iterator[Finding]:
    signals = [
        Signal(one, recording, roles.get(one.name)) for one in recording.channels if _has_value(one)
    ]
    for group in _group(signals, lambda one: one.times.tobytes()):
        yield from find_gaps(group)
    for group in _group(signals, lambda one: one.whole.times.tobytes()):
        yield from find_stamp_faults(group[0], tuple(one.name for one in group))
    for signal in signals:
        for find in _KINDS:
            yield from find(signal)


def _has_value(channel: Channel) -> bool:
    return bool((channel.values == channel.values).any())


def _group(signals: Sequence[Signal], read: Callable[[Signal], bytes]) -> list[list[Signal]]:
    """Group signals of one clock."""
    groups: dict[bytes, list[Signal]] = {}
    for signal in signals:
        groups.setdefault(read(signal), []).append(signal)
    return list(groups.values())


def extract_inspected(
    recording: Recording, inputs: Mapping[str, str], outputs: Mapping[str, str], name: str = ""
) -> tuple[Record, ...]:
    """Extract the experiments of a recording, as `extract_records` does, with what happened to it.

    Raises
    ------
    InvalidRecord
        If a channel is missing, or is both an input and an output. If a channel has no value.
    """
    records = extract_records(recording, inputs, outputs, name)
    roles: dict[str, Role] = {
        **dict.fromkeys(outputs.values(), "output"),
        **dict.fromkeys(inputs.values(), "input"),
    }
    findings = inspect_recording(recording, roles)
    return tuple(replace(record, findings=findings) for record in records)
