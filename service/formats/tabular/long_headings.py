"""Headings of long tables: which column has the names of signals, their values and their units."""

from collections.abc import Sequence
from typing import Final, NamedTuple

from sysid.data.table_rules import STAMP_KINDS, Heading, simplify_name

_KEYS: Final = frozenset(
    (
        *("entity id", "entity", "tag", "tagname", "tag name", "tagid", "tag id", "point"),
        *("point name", "point id", "data point", "datapoint", "signal", "signal name"),
        *("signal id", "channel", "channel name", "channel id", "variable", "variable name"),
        *("varname", "parameter", "parameter name", "sensor", "sensor name", "sensor id"),
        *("measurement", "metric", "series", "series name", "item", "item name", "topic"),
        *("field", "quantity", "attribute", "node id", "dvid", "name", "kanal", "messstelle"),
    )
)
_ENTRIES: Final = frozenset(
    (
        *("value", "val", "values", "state", "reading", "data value", "measured value", "dv"),
        *("wert", "messwert", "valeur", "valor", "waarde"),
    )
)
_UNITS: Final = frozenset(
    ("unit", "units", "uom", "unit of measurement", "engineering unit", "einheit")
)


class LongPlaces(NamedTuple):
    """Places of the columns of a long table: names, values, units."""

    key: int
    entry: int
    unit: int | None


def names_signals(name: str) -> bool:
    """Whether a column of this name may hold the names of signals."""
    return simplify_name(name).strip() in _KEYS


def find_entry(names: Sequence[str]) -> int | None:
    """Find the column of values of several signals by its name."""
    return next(
        (i for i, name in enumerate(names) if simplify_name(name).strip() in _ENTRIES), None
    )


def find_long_places(headings: Sequence[Heading | None]) -> LongPlaces | None:
    """Find the columns of a long table by their headings; None if the names are no texts.

    A column that is None has another role.
    """
    known = [(i, heading) for i, heading in enumerate(headings) if heading is not None]
    key = next((i for i, one in known if one.kind == "text" and names_signals(one.name)), None)
    if key is None:
        return None
    others = [(i, one) for i, one in known if i != key and one.kind not in STAMP_KINDS]
    units = [i for i, one in others if simplify_name(one.name).strip() in _UNITS]
    others = [(i, one) for i, one in others if i not in units]
    place = find_entry([one.name for _, one in others])
    numbers = [i for i, one in others if one.kind in ("number", "flag")]
    if place is None and len(numbers) != 1:
        return None
    entry = numbers[0] if place is None else others[place][0]
    return LongPlaces(key, entry, units[0] if units else None)
