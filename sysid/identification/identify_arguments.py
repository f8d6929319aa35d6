"""Read what a user gives to `identify`: recordings and tables, channels, changes of parameters."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from math import isfinite
from numbers import Real
from os import PathLike
from typing import Any, NamedTuple, TypeAlias

from sysid.core.errors import InvalidRecord, InvalidSettings, join_pointer, suggest_name
from sysid.data.foreign_tables import (
    Column,
    Labelled,
    describe_object,
    is_labelled,
    read_columns,
)
from sysid.data.holds import MEANS, HoldSetting
from sysid.data.records import Channel, Record, Recording, to_channel
from sysid.data.value_checks import find_infinite_value
from sysid.inspection.inspect import check_recording, extract_inspected
from sysid.models.channel_assignment import (
    Assignment,
    assign_channels,
    assign_record,
    assign_recording,
    check_holds,
)
from sysid.models.kalman_filter import is_noise_parameter
from sysid.models.model import Model
from sysid.residuals.onset_delay import find_unprompted_output

Data: TypeAlias = Record | Recording | Labelled
"""One recording: a record, a recording without roles, or a table of another library."""
_NUMBER = re.compile(r"[-+]?[\d.]+(e[-+]?\d+)?")
Change: TypeAlias = Mapping[str, Any] | Sequence[float] | float
"""Change of a parameter: its fields, its two bounds, or its fixed value."""


class ReadRecords(NamedTuple):
    """Records of a model, notes about what was assumed, and the channel of each signal."""

    records: tuple[Record, ...]
    notes: tuple[str, ...]
    channels: Mapping[str, str]


def read_records(
    model: Model,
    data: Data | Sequence[Data],
    channels: Mapping[str, str] | None,
    hold: Mapping[str, HoldSetting] | None = None,
) -> ReadRecords:
    """Read recordings as records of a model, with the given holds of its signals.

    A recording of several segments gives one record for each. So does one with outages.

    Raises
    ------
    InvalidRecord
        If an object is no recording, or a signal has no channel.
    InvalidSettings
        If `channels` names a signal or channel that does not exist, or `hold` a signal or a hold.
        If values at irregular times are to be means.
    """
    holds = dict(hold or {})
    check_holds(model, holds)
    each = data if isinstance(data, list | tuple) else [data]
    parts = [part for one in each for part in _read_one(model, one, channels)]
    records = tuple(record.replace_holds(holds) for record, _ in parts)
    for record in records:
        if fault := find_infinite_value((*record.inputs, *record.outputs)):
            raise InvalidRecord(fault)
        _check_means(record, holds)
    assignments = {assigned.note: assigned for _, assigned in parts if assigned.note}
    notes = tuple(describe_assignment(one, records) for one in assignments.values())
    by_signal = parts[0][1].by_signal if parts else {}
    return ReadRecords(records, notes, by_signal)


def _check_means(record: Record, holds: Mapping[str, HoldSetting]) -> None:
    for channel in (*record.inputs, *record.outputs):
        if holds.get(channel.name) in MEANS:
            try:
                channel.read_period()
            except InvalidRecord as error:
                raise InvalidSettings(join_pointer("hold", channel.name), str(error)) from None


def write_setting(place: Sequence[str], entries: Mapping[str, str]) -> str:
    """Write a setting of a job as the argument of `identify` that gives it.

    Examples
    --------
    >>> write_setting(["hold"], {"u": "first"})
    "hold={'u': 'first'}"
    >>> write_setting(["loss"], {"kind": "soft-l1", "scale": "0.3"})
    "loss=Loss(kind='soft-l1', scale=0.3)"
    >>> write_setting([], {"prediction": "one-step"})
    "prediction='one-step'"
    >>> write_setting(["parameters", "r"], {"physical": "upper"})
    "parameters={'r': {'physical': 'upper'}}"
    """
    values = {
        name: text if _NUMBER.fullmatch(text) else repr(text) for name, text in entries.items()
    }
    arguments = ", ".join(f"{name}={value}" for name, value in values.items())
    if not place:
        return arguments
    field, *parts = place
    if field == "loss":
        return f"loss=Loss({arguments})"
    written = f"{{{', '.join(f'{name!r}: {value}' for name, value in values.items())}}}"
    for part in parts:
        written = f"{{{part!r}: {written}}}"
    return f"{field}={written}"


def describe_assignment(assigned: Assignment, records: Sequence[Record]) -> str:
    """Describe how channels were guessed, and whether inputs and outputs may be swapped.

    They may be where the order alone decided and an output moves before any input. Empty if no
    channel was guessed.
    """
    if assigned.may_be_swapped and any(map(find_unprompted_output, records)):
        return (
            f"{assigned.note}. Perhaps inputs and outputs are swapped: an output begins to move "
            "before any input"
        )
    return assigned.note


def _read_one(
    model: Model, data: Data, channels: Mapping[str, str] | None
) -> Iterator[tuple[Record, Assignment]]:
    if isinstance(data, Record):
        record, note = assign_record(model, data, channels)
        record = replace(record, findings=data.findings or check_recording(data))
        pairs = zip((*record.inputs, *record.outputs), (*data.inputs, *data.outputs), strict=True)
        yield record, Assignment({named.name: channel.name for named, channel in pairs}, note)
        return
    if isinstance(data, Recording):
        assigned = assign_recording(model, data, channels)
        recording = data
    elif is_labelled(data):
        columns = read_columns(data, "the table")
        signals = len(model.inputs) + len(model.outputs)
        if len(columns) == 1 < signals:
            raise InvalidRecord(
                f"found {describe_object(data)}, one signal; model {model.name!r} has {signals}. "
                "Join series in a record: Record(inputs, outputs)"
            )
        by_label = {column.label: column.name for column in columns}
        plain = {key: by_label.get(str(name), name) for key, name in (channels or {}).items()}
        assigned = assign_channels(model, [column.name for column in columns], plain)
        used = set(assigned.by_signal.values())
        others = _read_others([column for column in columns if column.name not in used])
        recording = Recording((*(to_channel(c) for c in columns if c.name in used), *others))
    else:
        raise InvalidRecord(_describe_wrong_data(data))
    inputs = {signal.name: assigned.by_signal[signal.name] for signal in model.inputs}
    outputs = {output.name: assigned.by_signal[output.name] for output in model.outputs}
    for record in extract_inspected(recording, inputs, outputs):
        yield record, assigned


def _read_others(columns: Sequence[Column]) -> Iterator[Channel]:
    """Read columns that the model does not use; those without numbers are left out."""
    for column in columns:
        times, start, _ = column.axis
        with suppress(InvalidRecord):
            channel = Channel(column.name, times, column.values, column.unit, started_at=start)
            if find_infinite_value([channel]) is None:
                yield channel


def _describe_wrong_data(data: object) -> str:
    found = f"found {describe_object(data)}; need a record, a recording or a table"
    if isinstance(data, str | PathLike):
        return f"{found}. Read a file first, with read_recording"
    if isinstance(data, Channel):
        return f"{found}. Join channels in a record: Record(inputs, outputs)"
    return f"{found} with named columns"


def check_warm(warm: Mapping[str, float] | None, known: Sequence[str]) -> None:
    """Check the values that the search starts from; sizes of noise may be of a chosen filter.

    Raises
    ------
    InvalidSettings
        If a name is no parameter, or a value is no finite number.
    """
    for name, value in (warm or {}).items():
        if name not in known and not is_noise_parameter(name):
            detail = f"there is no parameter {name!r}{suggest_name(str(name), known)}"
            raise InvalidSettings(join_pointer("warm", str(name)), detail)
        if not _is_number(value) or not isfinite(value):
            detail = f"found {value!r}; need a finite number"
            raise InvalidSettings(join_pointer("warm", name), detail)


def read_changes(
    parameters: Mapping[str, Change] | None,
) -> dict[str, Mapping[str, Any]]:
    """Read changes of parameters: ``{"L": (0, 2)}`` are bounds, ``{"K": 1.5}`` fixes a value.

    Raises
    ------
    InvalidSettings
        If a change is neither of these nor a mapping of a parameter's fields.
    """
    if parameters is None:
        return {}
    return {name: _read_change(name, change) for name, change in parameters.items()}


def _read_change(name: str, change: object) -> Mapping[str, Any]:
    if isinstance(change, Mapping):
        return change
    if _is_number(change):
        return {"fixed": change}
    if isinstance(change, list | tuple) and len(change) == 2 and all(map(_is_number, change)):
        return {"lower": change[0], "upper": change[1]}
    raise InvalidSettings(
        f"/parameters/{name}",
        f"found {change!r}; need bounds (lower, upper), one number that fixes it, or fields such "
        "as {'upper': 2}",
    )


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
