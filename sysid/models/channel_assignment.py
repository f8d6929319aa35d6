"""Assign the channels of a recording to the signals of a model: by name, else by order.

Some names say which side a channel is on, in any case: ``U`` and ``Y``, ``input`` and ``output``.
The names of a controller's output, ``OP``, ``CO`` and ``MV``, say so beside the process value
``PV`` only. Alone, ``CO`` may be a gas.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

from sysid.core.errors import InvalidRecord, InvalidSettings, join_pointer, suggest_name
from sysid.data.holds import HOLDS, OUTPUT_HOLDS
from sysid.data.records import Channel, Record, Recording
from sysid.data.table_rules import split_headings
from sysid.models.model import Model

ChannelOption: TypeAlias = Callable[[Mapping[str, str]], str]
"""Writes the option that gives the channel of each signal, as the user would type it."""

_USUAL_INPUTS = re.compile(r"(u|in|input)[ _]*[0-9]*", re.IGNORECASE)
_USUAL_OUTPUTS = re.compile(r"(y|out|output|pv)[ _]*[0-9]*", re.IGNORECASE)
_CONTROLLER_OUTPUTS = re.compile(r"(op|mv)[ _]*[0-9]*|co", re.IGNORECASE)
_PROCESS_VALUES = re.compile(r"pv[ _]*[0-9]*", re.IGNORECASE)


class Assignment(NamedTuple):
    """The channel of every signal, and a note about those that were guessed.

    Attributes
    ----------
    by_signal : dict of str to str
        Signal → channel.
    note : str
        How signals were assigned whose channels do not have their names; empty if there are none.
    may_be_swapped : bool
        Whether the order alone decided which channel is an input and which is an output.
    """

    by_signal: dict[str, str]
    note: str = ""
    may_be_swapped: bool = False


def write_argument(channels: Mapping[str, str]) -> str:
    """Write the argument that gives the channel of each signal in Python.

    Examples
    --------
    >>> write_argument({"u": "P1"})
    "channels={'u': 'P1'}"
    """
    pairs = ", ".join(
        f"{signal!r}: {channel if channel == '…' else repr(channel)}"
        for signal, channel in channels.items()
    )
    return f"channels={{{pairs}}}"


def assign_channels(
    model: Model,
    names: Sequence[str],
    channels: Mapping[str, str] | None = None,
    option: ChannelOption = write_argument,
) -> Assignment:
    """Assign channels to all signals of a model: as given, else by name, else by order.

    The order decides only if as many channels are left as signals. Inputs come first, except
    channels with usual names of the other side.

    Parameters
    ----------
    names : sequence of str
        The channels.
    channels : mapping of str to str, optional
        Model's name → channel's name.
    option : callable, optional
        Writes the option that gives channels, for the note and the message.

    Raises
    ------
    InvalidSettings
        If `channels` names a signal or channel that does not exist.
    InvalidRecord
        If a signal has no channel; the message lists both.
    """
    signals = [signal.name for signal in model.inputs]
    signals += [output.name for output in model.outputs]
    given = dict(channels or {})
    _check_given(given, signals, names)
    assigned, left, free = match_names(signals, names, given)
    guessed, basis = _guess_channels(model, left, free)
    if len(guessed) < len(left):
        inputs = ", ".join(signal.name for signal in model.inputs) or "none"
        outputs = ", ".join(output.name for output in model.outputs)
        raise InvalidRecord(
            f"model {model.name!r} has inputs {inputs} and outputs {outputs}; the recording has "
            f"{', '.join(names) or 'no channels'}. Say which channel is which: "
            f"{' or '.join(option({**given, **one}) for one in _list_choices(model, left, free))}"
        )
    has_inputs = any(signal.name in guessed for signal in model.inputs)
    has_outputs = any(output.name in guessed for output in model.outputs)
    return Assignment(
        {**assigned, **guessed},
        _describe_guess(guessed, basis, option),
        basis == _ORDER and has_inputs and has_outputs,
    )


def assign_recording(
    model: Model,
    recording: Recording,
    channels: Mapping[str, str] | None = None,
    option: ChannelOption = write_argument,
) -> Assignment:
    """Assign the channels of a recording, as `assign_channels` does.

    A channel may also be given as its heading in the file, with its unit: ``Heater [%]``.

    Raises
    ------
    InvalidSettings
        If `channels` names a signal or channel that does not exist.
    InvalidRecord
        If a signal has no channel; the message lists both.
    """
    units = {channel.name: channel.unit for channel in recording.channels}
    given = {}
    for signal, channel in (channels or {}).items():
        [(name, unit)] = split_headings([str(channel)])
        is_heading = channel not in units and unit and units.get(name) == unit
        given[signal] = name if is_heading else channel
    return assign_channels(model, recording.names, given, option)


def assign_record(
    model: Model, record: Record, channels: Mapping[str, str] | None = None
) -> tuple[Record, str]:
    """Name the channels of a record as the model does, within its inputs and its outputs.

    A signal without a channel is left to the checks of the problem.

    Raises
    ------
    InvalidSettings
        If `channels` names a signal or channel that does not exist.
    """
    given = dict(channels or {})
    sides: tuple[tuple[list[str], tuple[Channel, ...]], ...] = (
        ([signal.name for signal in model.inputs], record.inputs),
        ([output.name for output in model.outputs], record.outputs),
    )
    signals = [name for side, _ in sides for name in side]
    _check_given(given, signals, [c.name for _, side in sides for c in side])
    _check_sides(model, record, given)
    renamed: list[tuple[Channel, ...]] = []
    by_order: dict[str, str] = {}
    for wanted, side in sides:
        names = [channel.name for channel in side]
        chosen = {name: given[name] for name in wanted if name in given}
        assigned, left, free = match_names(wanted, names, chosen)
        if len(left) == len(free) and not set(free) & set(signals):
            assigned.update(zip(left, free, strict=True))
            by_order.update(zip(left, free, strict=True))
        renamed.append(_rename_channels(side, assigned))
    if renamed == [record.inputs, record.outputs]:
        return record, ""
    note = _describe_guess(by_order, _ORDER, write_argument)
    return replace(record, inputs=renamed[0], outputs=renamed[1]), note


def name_inputs(
    model: Model,
    channels: tuple[Channel, ...],
    given: Mapping[str, str] | None = None,
    usual: Mapping[str, str] | None = None,
) -> tuple[Channel, ...]:
    """Name channels as the inputs of a model: as given, else by name, else as usual.

    A single channel may have any name if the model has one input, but that of an output. Other
    channels follow.

    Parameters
    ----------
    given, usual : mapping of str to str, optional
        Model's name → channel's name. Channels of outputs are no inputs.

    Raises
    ------
    InvalidSettings
        If `given` names a signal or channel that does not exist.
    """
    signals = [signal.name for signal in model.inputs]
    names = [channel.name for channel in channels]
    outputs = [output.name for output in model.outputs]
    chosen = {key: name for key, name in (given or {}).items() if key not in outputs}
    _check_given(chosen, signals, names)
    missing = [name for name in signals if name not in {*names, *chosen}]
    chosen |= {key: name for key, name in (usual or {}).items() if key in missing and name in names}
    assigned, left, free = match_names(signals, names, chosen)
    measured = {name for key, name in (usual or {}).items() if key in outputs}
    if len(signals) == len(left) == len(free) == 1 and free[0] not in measured:
        assigned = {left[0]: free[0]}
    named = [
        replace(channel, name=signal)
        for signal, name in assigned.items()
        for channel in channels
        if channel.name == name
    ]
    used = {*assigned, *assigned.values()}
    return (*named, *(channel for channel in channels if channel.name not in used))


def _check_sides(model: Model, record: Record, given: Mapping[str, str]) -> None:
    """Check that an input is given a channel of the inputs, and an output one of the outputs."""
    inputs = {signal.name for signal in model.inputs}
    for signal, channel in given.items():
        side, others = (
            ("inputs", record.inputs) if signal in inputs else ("outputs", record.outputs)
        )
        if channel not in [one.name for one in others]:
            raise InvalidSettings(
                f"/channels/{signal}", f"channel {channel!r} is not among the {side} of the record"
            )


def _rename_channels(
    channels: tuple[Channel, ...], by_signal: Mapping[str, str]
) -> tuple[Channel, ...]:
    new_names = {channel: signal for signal, channel in by_signal.items()}
    return tuple(
        channel
        if new_names.get(channel.name, channel.name) == channel.name
        else replace(channel, name=new_names[channel.name])
        for channel in channels
    )


def match_names(
    signals: Sequence[str], names: Sequence[str], given: Mapping[str, str]
) -> tuple[dict[str, str], list[str], list[str]]:
    """Match signals and channels by name, after those that are given: model's name → channel's.

    Returns what is matched, and the signals and the channels that are left.
    """
    used = set(given.values())
    assigned = {name: given[name] for name in signals if name in given}
    for signal in signals:
        if signal not in assigned and signal in names and signal not in used:
            assigned[signal] = signal
    left = [signal for signal in signals if signal not in assigned]
    return assigned, left, [name for name in names if name not in assigned.values()]


def _check_given(given: Mapping[str, str], signals: Sequence[str], names: Sequence[str]) -> None:
    for signal, channel in given.items():
        if signal not in signals:
            is_turned = channel in signals and signal in names
            turned = f". Write {{{channel!r}: {signal!r}}}" if is_turned else ""
            hint = turned or suggest_name(str(signal), signals)
            detail = f"the model has no signal {signal!r}{hint}"
            raise InvalidSettings(f"/channels/{signal}", detail)
        if channel not in names:
            detail = f"there is no channel {channel!r}{suggest_name(str(channel), names)}"
            raise InvalidSettings(f"/channels/{signal}", detail)


_ORDER = "their order"
_MAX_CHOICES = 4
_NAMES = "usual names of inputs and outputs"


def _guess_channels(
    model: Model, left: Sequence[str], free: Sequence[str]
) -> tuple[dict[str, str], str]:
    """Guess the channels of the signals that are left, and say by what; empty if it is unclear."""
    guessed = _match_letters(left, free)
    rest = [name for name in free if name not in guessed.values()]
    inputs = [s.name for s in model.inputs if s.name in left and s.name not in guessed]
    outputs = [s.name for s in model.outputs if s.name in left and s.name not in guessed]
    by_side = {name: _find_side(name, free) for name in rest}
    usual_inputs = [name for name in rest if by_side[name] == "input"]
    usual_outputs = [name for name in rest if by_side[name] == "output"]
    if all(
        len(usual) == len(wanted)
        for usual, wanted in ((usual_inputs, inputs), (usual_outputs, outputs))
        if wanted
    ):
        guessed |= dict(zip(inputs, usual_inputs, strict=False))
        guessed |= dict(zip(outputs, usual_outputs, strict=False))
        return guessed, _NAMES
    if len(rest) != len(inputs) + len(outputs):
        return {}, ""
    if len(usual_inputs) > len(inputs) or len(usual_outputs) > len(outputs):
        usual_inputs, usual_outputs = [], []
    others = [name for name in rest if name not in (*usual_inputs, *usual_outputs)]
    chosen = {*usual_inputs, *others[: len(inputs) - len(usual_inputs)]}
    ordered = [name for name in rest if name in chosen]
    ordered += [name for name in rest if name not in chosen]
    bases = [_NAMES] if guessed or usual_inputs or usual_outputs else []
    guessed |= dict(zip((*inputs, *outputs), ordered, strict=True))
    return guessed, " and ".join([*bases, _ORDER])


def _list_choices(model: Model, left: Sequence[str], free: Sequence[str]) -> list[dict[str, str]]:
    """List possible channels of the signals that are left: one for each channel of the first.

    Outputs take the last channels, except those that are usual names of outputs. Too many choices
    are shown by the first. What there is no channel for is left open.
    """
    if len(free) < len(left):
        return [dict.fromkeys(left, "…")]
    outputs = [output.name for output in model.outputs if output.name in left]
    usual = [name for name in free if _find_side(name, free) == "output"]
    ordered = [*(name for name in free if name not in usual), *usual]
    taken = dict(zip(outputs, ordered[len(ordered) - len(outputs) :], strict=True))
    rest = [name for name in ordered if name not in taken.values()]
    inputs = [name for name in left if name not in outputs]
    if len(inputs) == 1 and len(rest) <= _MAX_CHOICES:
        return [{inputs[0]: name, **taken} for name in rest]
    return [{**dict(zip(inputs, rest, strict=False)), **taken}]


def _match_letters(signals: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Match signals and channels whose names differ in upper and lower case only."""
    matched = {}
    for signal in signals:
        alike = [name for name in names if name.casefold() == signal.casefold()]
        rivals = [other for other in signals if other.casefold() == signal.casefold()]
        if len(alike) == len(rivals) == 1:
            matched[signal] = alike[0]
    return matched


def _find_side(name: str, names: Sequence[str]) -> str:
    """Find the side that the usual name of a channel says: input or output; empty if none."""
    has_process_value = any(_PROCESS_VALUES.fullmatch(other) for other in names)
    if _USUAL_INPUTS.fullmatch(name) or (has_process_value and _CONTROLLER_OUTPUTS.fullmatch(name)):
        return "input"
    return "output" if _USUAL_OUTPUTS.fullmatch(name) else ""


def _describe_guess(guessed: Mapping[str, str], basis: str, option: ChannelOption) -> str:
    if not guessed:
        return ""
    return f"channels were assigned by {basis}. To choose, give {option(guessed)}"


def check_commands(model: Model, commands: Sequence[str] | None) -> None:
    """Check the names of inputs that a controller computes.

    Raises
    ------
    InvalidSettings
        If there is no such input.
    """
    inputs = [signal.name for signal in model.inputs]
    for i, name in enumerate(commands or ()):
        if name not in inputs:
            detail = f"model {model.name!r} has no input {name!r}{suggest_name(name, inputs)}"
            raise InvalidSettings(f"/commands/{i}", detail)


def hold_commands(
    model: Model, records: Sequence[Record], commands: Sequence[str] | None
) -> tuple[Record, ...]:
    """Hold those inputs that a controller computes, unless it is given how they are read.

    Raises
    ------
    InvalidSettings
        If there is no such input.
    """
    check_commands(model, commands)
    return tuple(
        record.replace_holds(
            {
                channel.name: "zero"
                for channel in record.inputs
                if channel.name in (commands or ()) and channel.hold == "auto"
            }
        )
        for record in records
    )


def check_holds(model: Model, holds: Mapping[str, object]) -> None:
    """Check the holds of signals.

    Raises
    ------
    InvalidSettings
        If there is no such signal, or no such hold of an input or an output.
    """
    inputs = [signal.name for signal in model.inputs]
    outputs = [signal.name for signal in model.outputs]
    for name, hold in holds.items():
        pointer = join_pointer("hold", str(name))
        if name not in (*inputs, *outputs):
            hint = suggest_name(str(name), (*inputs, *outputs))
            detail = f"model {model.name!r} has no input or output {name!r}{hint}"
            raise InvalidSettings(pointer, detail)
        known, side = (HOLDS, "") if name in inputs else (OUTPUT_HOLDS, " for an output")
        if not isinstance(hold, str) or hold not in known:
            detail = f"found {hold!r}; need one of {', '.join(known)}{side}"
            raise InvalidSettings(pointer, detail)
