"""Assign the channels of a recording to the signals of a model: by name, else by order."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from sysid.core.errors import InvalidRecord, InvalidSettings, suggest_name
from sysid.data.records import Channel, Record
from sysid.models.model import Model


class Assignment(NamedTuple):
    """The channel of every signal, and a note about those that were assigned by their order."""

    by_signal: dict[str, str]
    note: str = ""


def assign_channels(
    model: Model, names: Sequence[str], channels: Mapping[str, str] | None = None
) -> Assignment:
    """Assign channels to all signals of a model: as given, else by name, else by order.

    The order decides only if as many channels are left as signals. Inputs come first.

    Parameters
    ----------
    names : sequence of str
        The channels.
    channels : mapping of str to str, optional
        Model's name → channel's name.

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
    if left and len(left) != len(free):
        inputs = ", ".join(signal.name for signal in model.inputs) or "none"
        outputs = ", ".join(output.name for output in model.outputs)
        example = ", ".join(f"{signal!r}: …" for signal in left)
        raise InvalidRecord(
            f"model {model.name!r} has inputs {inputs} and outputs {outputs}; the recording has "
            f"{', '.join(names) or 'no channels'}. Say which channel is which: "
            f"channels={{{example}}}"
        )
    by_order = dict(zip(left, free, strict=True)) if left else {}
    return Assignment({**assigned, **by_order}, _describe_order(by_order))


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
    return replace(record, inputs=renamed[0], outputs=renamed[1]), _describe_order(by_order)


def name_inputs(
    model: Model,
    channels: tuple[Channel, ...],
    given: Mapping[str, str] | None = None,
    usual: Mapping[str, str] | None = None,
) -> tuple[Channel, ...]:
    """Name channels as the inputs of a model: as given, else by name, else as usual.

    A single channel may have any name if the model has one input. Other channels follow.

    Parameters
    ----------
    given, usual : mapping of str to str, optional
        Model's name → channel's name. Outputs in them are ignored.

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
    if len(signals) == len(left) == len(free) == 1:
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


def _describe_order(by_order: Mapping[str, str]) -> str:
    if not by_order:
        return ""
    pairs = ", ".join(f"{signal!r}: {channel!r}" for signal, channel in by_order.items())
    return f"channels were assigned by their order. To choose, give channels={{{pairs}}}"
