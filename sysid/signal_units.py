"""Whether the channels of all records are in the units of the model, and of one another."""

from collections.abc import Iterable, Sequence
from itertools import combinations

from sysid.errors import InvalidRecord
from sysid.models.model import Model
from sysid.records import Channel, Record
from sysid.units import difference, factor, is_blank, is_known, is_read, suggestion

_SHOWN = 40  # characters of a unit in a message


class SignalUnits:
    """Unit of every signal of a model: its own, or where it has none that of the first record.

    A channel without a unit, with the unit 1, or with one that cannot be read may be anything.
    """

    def __init__(self, model: Model) -> None:
        signals = [(one.name, one.unit) for one in model.inputs]
        signals += [(one.name, one.unit) for one in model.outputs]
        whose = f"model {model.name!r}"
        self._known = {name: (unit, whose) for name, unit in signals if not is_blank(unit)}

    def fault(self, signal: str, channel: str, unit: str | None, where: str) -> str:
        """What is wrong with the unit of a channel that is to be a signal; empty if nothing is.

        Parameters
        ----------
        channel, unit : str
            Of the record; `where` says which it is.
        """
        if unit is None or is_blank(unit):
            return ""
        own, whose = self._known.setdefault(signal, (unit, where))
        if is_read(unit) and not is_read(own):  # which tells more of the records that follow
            self._known[signal] = (unit, where)
        found = difference(unit, own)
        if not found:
            return ""
        if factor(unit, own) is None:
            cure = "correct the one that is wrong"
        else:
            cure = f'convert the data, by the derivation {{"unit": {{"{channel}": "{own}"}}}}'
        role = "" if channel == signal else f" (signal {signal!r})"
        return (
            f"channel {channel!r}{role} is in {unit} in {where}, but in {whose} it is in {own}: "
            f"{found}; {cure}"
        )


def check_units(model: Model, records: Sequence[Record]) -> None:
    """Raise if a channel is in another unit than the model has, or than a record before has.

    Raises
    ------
    InvalidRecord
        Naming the channel and both units.
    """
    units = SignalUnits(model)
    for number, record in enumerate(records, 1):
        where = f"record {record.name!r}" if record.name else f"record {number}"
        for channel in (*record.inputs, *record.outputs):
            fault = units.fault(channel.name, channel.name, channel.unit, where)
            if fault:
                raise InvalidRecord(fault)


def unknown_units(channels: Iterable[Channel]) -> list[str]:
    """What to say of channels whose units nobody knows, such as ``bat`` for ``bar``."""
    return [
        f"channel {one.name!r}: {_quoted(one.unit)} is no known unit, so it is kept as it is "
        f"written and compared with no other{suggestion(one.unit)}"
        for one in channels
        if not (is_blank(one.unit) or is_known(one.unit))
    ]


def unread_units(model: Model, records: Sequence[Record]) -> list[str]:
    """Channels of which nobody can tell whether they are in the unit of the model."""
    found = {}
    known = {one.name: one.unit for one in model.inputs}
    known |= {one.name: one.unit for one in model.outputs}
    for record in records:
        for channel in (*record.inputs, *record.outputs):
            unit, own = channel.unit, known.get(channel.name, "")
            unread = [one for one in (unit, own) if not is_read(one)]
            if unread and not (is_blank(unit) or is_blank(own) or unit.strip() == own.strip()):
                found[channel.name, unit] = (
                    f"channel {channel.name!r} is in {unit}, and in the model it is in {own}: "
                    f"{' and '.join(unread)} could not be read as a unit, so they were not compared"
                )
    return list(found.values())


def mixed_units(model: Model, records: Sequence[Record]) -> list[str]:
    """Channels of one quantity in two units, where the model does not give the units of both.

    What is found then holds for these units: a gain of 1 between kPa and Pa is one of 1000.
    """
    free = {one.name for one in model.inputs if is_blank(one.unit)}
    free |= {one.name for one in model.outputs if is_blank(one.unit)}
    units: dict[str, str] = {}
    for record in records:  # those of the first stand for all: `check_units` has compared them
        for channel in (*record.inputs, *record.outputs):
            if not is_blank(channel.unit):
                units.setdefault(channel.name, channel.unit)
    return [
        f"{a!r} is in {units[a]} and {b!r} in {units[b]}, and model {model.name!r} does not say in "
        "which units both are: the numbers were taken as they are, so a gain between the two is in "
        f"these units, whatever stands beside it ({difference(units[a], units[b])}); to have both "
        f'in one unit, convert the data, by the derivation {{"unit": {{"{a}": "{units[b]}"}}}}'
        for a, b in combinations(units, 2)
        if free & {a, b} and factor(units[a], units[b]) not in (None, 1.0)
    ]


def _quoted(unit: str) -> str:
    return repr(unit if len(unit) <= _SHOWN else f"{unit[:_SHOWN]}…")
