"""Whether the channels of all records are in the units of the model, and of one another."""

from collections.abc import Sequence

from sysid.errors import InvalidRecord
from sysid.models.model import Model
from sysid.records import Record
from sysid.units import difference, factor, is_blank


class SignalUnits:
    """Unit of every signal of a model: its own, or where it has none that of the first record.

    A channel without a unit, or with the unit 1, may be anything.
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
