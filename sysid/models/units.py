"""Whether the channels of all records are in the units of the model, and of one another.

Whether parameters in another unit of time than seconds are read in seconds.

Units are labels to a model: dx/dt is per second, so ``(u - x)/T`` reads T in seconds, whatever its
unit says. A time constant in minutes would be estimated in seconds and told in minutes. Equations
that convert it, as ``(u - x)/(60*T)``, multiply it by a number wherever they read it, or the sum in
which it stands; those that read it as it stands, or within a function, may do so on purpose: they
are warned of, not refused. Of a ratio of two such parameters nothing is to be converted.
Lags, which have nothing but a time in them, are refused (`sysid.models.units`).

Whether the unit of an unknown lag is the one in which lags are counted.

Units are labels to a model: ``u(t - L)`` reads L in seconds, whatever its unit says. A lag in
minutes would be estimated in seconds and told in minutes.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from math import isclose, prod

from sysid.core.errors import InvalidRecord, join_pointer
from sysid.core.units import (
    describe_difference,
    find_conversion_factor,
    is_blank_unit,
    is_known_unit,
    is_readable_unit,
    suggest_unit,
)
from sysid.data.records import Channel, Record
from sysid.language.delays import collect_past_values
from sysid.language.monomials import Monomial, collect_terms
from sysid.language.scope import EquationForm
from sysid.language.tree import Binary, Expression, PastValue, Symbol, find_children
from sysid.models.documents import DocumentReader
from sysid.models.model import Model

_INVERSE_PERIOD = (Symbol("h", "period"), -1)
_SECONDS = "s"


def check_delay_units(reader: DocumentReader, model: Model) -> None:
    """Report each parameter that is a lag as it stands, in another unit than that of lags."""
    units = {one.name: one.unit for one in model.parameters}
    form: EquationForm = "differential" if model.form == "differential" else "difference"
    told = set()
    for tree in (*model.equations, *(one.expression for one in model.outputs)):
        for past in collect_past_values(tree):
            for name, in_periods in _find_bare_delays(past):
                size = find_conversion_factor(units.get(name, "1"), _SECONDS)
                in_seconds = form == "differential" or in_periods
                if size is None or (size == 1.0 and in_seconds) or name in told:
                    continue
                told.add(name)
                detail = _describe_delay_unit(name, units[name], size, form, in_periods=in_periods)
                reader.add_fault(join_pointer("parameters", name, "unit"), detail)


def _find_bare_delays(past: PastValue) -> Iterator[tuple[str, bool]]:
    """Parameters that a lag adds without a factor, and whether they are divided by the period."""
    if past.delay is None:
        return
    for monomial, coefficient in collect_terms(past.delay).items():
        name = _match_single_parameter(tuple(one for one in monomial if one != _INVERSE_PERIOD))
        if name is not None and coefficient == 1.0:
            yield name, _INVERSE_PERIOD in monomial


def _match_single_parameter(monomial: Monomial) -> str | None:
    match monomial:
        case ((Symbol(name, "parameter"), 1),):
            return name
        case _:
            return None


def _describe_delay_unit(
    name: str, unit: str, size: float, form: EquationForm, *, in_periods: bool
) -> str:
    if size == 1.0:
        return f"found {unit!r}, but this lag counts samples: write {name}/h, or the unit samples"
    clock = "t" if form == "differential" else "k"
    right = f"{clock} - {size:.12g}*{name}" + ("" if form == "differential" else "/h")
    if form == "difference" and not in_periods:
        return f"found {unit!r}, but this lag counts samples: write {right}, or the unit samples"
    return f"found {unit!r}, but this lag counts seconds: give it in s, or write {right}"


def list_time_unit_warnings(model: Model) -> list[str]:
    """One sentence for each parameter of a differential model that is read as if in seconds."""
    if model.form != "differential":
        return []
    sizes = {one.name: find_conversion_factor(one.unit, "s") for one in model.parameters}
    units = {one.name: one.unit for one in model.parameters}
    known = {name: size for name, size in sizes.items() if size is not None}
    bare = {name for tree in model.equations for name in _find_bare_parameters(tree, known)}
    return [
        f"{name} has the unit {units[name]}, but the equations read it as it stands, and their "
        f"rates are per second: unless that is meant, give it in s, or write {size:.12g}*{name}"
        for name, size in sizes.items()
        if name in bare and size not in (None, 1.0)
    ]


def _find_bare_parameters(tree: Expression, sizes: Mapping[str, float]) -> Iterator[str]:
    """Parameters that a term has without a number to multiply them; `sizes` in seconds."""
    for monomial, coefficient in collect_terms(tree).items():
        if abs(coefficient) == 1.0:
            yield from _collect_uncancelled_names(monomial, sizes)
        for one, _ in monomial:
            for part in _list_inner_terms(one):
                yield from _find_bare_parameters(part, sizes)


def _collect_uncancelled_names(monomial: Monomial, sizes: Mapping[str, float]) -> list[str]:
    """Parameters of a product, none where their units cancel out."""
    found = {
        one.name: power
        for one, power in monomial
        if isinstance(one, Symbol) and one.kind == "parameter" and one.name in sizes
    }
    cancel = isclose(prod(sizes[name] ** power for name, power in found.items()), 1.0)
    return [] if cancel else list(found)


def _list_inner_terms(node: Expression) -> tuple[Expression, ...]:
    """Of what stands in a product as a whole, the terms inside."""
    match node:
        case PastValue():
            return ()
        case Binary() if collect_terms(node) != {((node, 1),): 1.0}:
            return (node,)  # a denominator has its own sum, with its factor in it
        case _:
            return find_children(node)


_MAX_SHOWN = 40  # characters of a unit in a message


class SignalUnits:
    """Unit of every signal of a model: its own, or where it has none that of the first record.

    A channel without a unit, with the unit 1, or with one that cannot be read may be anything.
    """

    def __init__(self, model: Model) -> None:
        signals = [(one.name, one.unit) for one in model.inputs]
        signals += [(one.name, one.unit) for one in model.outputs]
        whose = f"model {model.name!r}"
        self._known = {name: (unit, whose) for name, unit in signals if not is_blank_unit(unit)}

    def describe_mismatch(self, signal: str, channel: str, unit: str | None, where: str) -> str:
        """What is wrong with the unit of a channel that is to be a signal; empty if nothing is.

        Parameters
        ----------
        channel, unit : str
            Of the record; `where` says which it is.
        """
        if unit is None or is_blank_unit(unit):
            return ""
        own, whose = self._known.setdefault(signal, (unit, where))
        if is_readable_unit(unit) and not is_readable_unit(
            own
        ):  # which tells more of the records that follow
            self._known[signal] = (unit, where)
        found = describe_difference(unit, own)
        if not found:
            return ""
        if find_conversion_factor(unit, own) is None:
            cure = "correct the one that is wrong"
        else:
            cure = f'convert the data, by the derivation {{"unit": {{"{channel}": "{own}"}}}}'
        role = "" if channel == signal else f" (signal {signal!r})"
        return (
            f"channel {channel!r}{role} is in {unit} in {where}, but in {whose} it is in {own}: "
            f"{found}; {cure}"
        )


def check_signal_units(model: Model, records: Sequence[Record]) -> None:
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
            fault = units.describe_mismatch(channel.name, channel.name, channel.unit, where)
            if fault:
                raise InvalidRecord(fault)


def list_unknown_unit_warnings(channels: Iterable[Channel]) -> list[str]:
    """What to say of channels whose units nobody knows, such as ``bat`` for ``bar``."""
    return [
        f"channel {one.name!r}: {_quote_unit(one.unit)} is no known unit, so it is kept as it is "
        f"written and compared with no other{suggest_unit(one.unit)}"
        for one in channels
        if not (is_blank_unit(one.unit) or is_known_unit(one.unit))
    ]


def list_unread_unit_warnings(model: Model, records: Sequence[Record]) -> list[str]:
    """Channels of which nobody can tell whether they are in the unit of the model."""
    found = {}
    known = {one.name: one.unit for one in model.inputs}
    known |= {one.name: one.unit for one in model.outputs}
    for record in records:
        for channel in (*record.inputs, *record.outputs):
            unit, own = channel.unit, known.get(channel.name, "")
            unread = [one for one in (unit, own) if not is_readable_unit(one)]
            if unread and not (
                is_blank_unit(unit) or is_blank_unit(own) or unit.strip() == own.strip()
            ):
                found[channel.name, unit] = (
                    f"channel {channel.name!r} is in {unit}, and in the model it is in {own}: "
                    f"{' and '.join(unread)} could not be read as a unit, so they were not compared"
                )
    return list(found.values())


def list_mixed_unit_warnings(model: Model, records: Sequence[Record]) -> list[str]:
    """Channels of one quantity in two units, where the model does not give the units of both.

    What is found then holds for these units: a gain of 1 between kPa and Pa is one of 1000.
    """
    free = {one.name for one in model.inputs if is_blank_unit(one.unit)}
    free |= {one.name for one in model.outputs if is_blank_unit(one.unit)}
    units: dict[str, str] = {}
    for (
        record
    ) in records:  # those of the first stand for all: `check_signal_units` has compared them
        for channel in (*record.inputs, *record.outputs):
            if not is_blank_unit(channel.unit):
                units.setdefault(channel.name, channel.unit)
    return [
        f"{a!r} is in {units[a]} and {b!r} in {units[b]}, and model {model.name!r} does not say in "
        "which units both are: the numbers were taken as they are, so a gain between the two is in "
        f"these units, whatever stands beside it ({describe_difference(units[a], units[b])}); to have both "
        f'in one unit, convert the data, by the derivation {{"unit": {{"{a}": "{units[b]}"}}}}'
        for a, b in combinations(units, 2)
        if free & {a, b} and find_conversion_factor(units[a], units[b]) not in (None, 1.0)
    ]


def _quote_unit(unit: str) -> str:
    return repr(unit if len(unit) <= _MAX_SHOWN else f"{unit[:_MAX_SHOWN]}…")
