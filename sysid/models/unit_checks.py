"""Unit checks: delays, time constants, and the channels of records.

A model treats units as labels. ``u(t - L)`` reads L in seconds, whatever its unit. A delay in
minutes would be estimated in seconds and reported in minutes, so it is refused. So is ``V/q`` of a
volume in m³ and a flow in m³/h.

dx/dt is per second, so ``(u - x)/T`` reads T in seconds. Equations that convert T, such as
``(u - x)/(60*T)``, multiply it, or the sum that contains it, by a number. Equations that read T
without a factor, or inside a function, may do so on purpose. They get a warning. A ratio of two
such parameters needs no conversion.

Channels of all records must have the units of the model, and the same units in every record.
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
from sysid.language.monomials import Monomial, collect_terms, to_expression
from sysid.language.printer import format_expression
from sysid.language.scope import EquationForm
from sysid.language.tree import (
    Binary,
    Expression,
    FunctionCall,
    PastValue,
    Symbol,
    find_children,
)
from sysid.models.document_reader import DocumentReader
from sysid.models.model import Model

_INVERSE_PERIOD = (Symbol("h", "period"), -1)
_SECONDS = "s"


def check_delay_units(reader: DocumentReader, model: Model) -> None:
    """Add a fault for each term of a delay that has no factor and a wrong unit."""
    inputs = {signal.name: signal.unit for signal in model.inputs}
    units = inputs | {parameter.name: parameter.unit for parameter in model.parameters}
    form: EquationForm = "differential" if model.form == "differential" else "difference"
    reported = set()
    for tree in (*model.equations, *(signal.expression for signal in model.outputs)):
        for past in collect_past_values(tree):
            for factors, in_periods in _find_bare_delays(past):
                unit = _multiply_factors(factors, units)
                size = None if unit is None else find_conversion_factor(unit, _SECONDS)
                in_seconds = form == "differential" or in_periods
                if size is None or (size == 1.0 and in_seconds) or factors in reported:
                    continue
                reported.add(factors)
                text = format_expression(to_expression({factors: 1.0}), "t")
                detail = _describe_delay_unit(text, unit or "", size, form, in_periods=in_periods)
                name = _find_quantity(factors[0][0])
                parts = ("inputs", name) if name in inputs else ("parameters", name, "unit")
                reader.add_fault(join_pointer(*parts), detail)


def _find_bare_delays(past: PastValue) -> Iterator[tuple[Monomial, bool]]:
    """Find products that a delay adds without a factor, and if they are divided by h."""
    if past.delay is None:
        return
    for monomial, coefficient in collect_terms(past.delay).items():
        factors = tuple(factor for factor in monomial if factor != _INVERSE_PERIOD)
        if coefficient == 1.0:
            yield factors, _INVERSE_PERIOD in monomial


def _multiply_factors(factors: Monomial, units: Mapping[str, str]) -> str | None:
    """Multiply the units of factors; None if one is missing or is that of a plain number."""
    above: list[str] = []
    below: list[str] = []
    for factor, power in factors:
        unit = units.get(_find_quantity(factor), "1")
        if is_blank_unit(unit):
            return None
        grouped = f"({unit})" if set(unit) & set("/·*") else unit
        (above if power > 0 else below).extend([grouped] * abs(power))
    return "/".join(["·".join(above) or "1", *below])


def _find_quantity(factor: Expression) -> str:
    """Find the parameter or input whose unit a factor has, also inside its limits; else empty."""
    match factor:
        case Symbol(name, "parameter") | PastValue(name, "input", 0, None):
            return name
        case FunctionCall("max" | "min" | "clip" | "abs", (limited, *_)):
            return _find_quantity(limited)
        case _:
            return ""


def _describe_delay_unit(
    name: str, unit: str, size: float, form: EquationForm, *, in_periods: bool
) -> str:
    if size == 1.0:
        return f"found {unit!r}, but this delay is in samples: write {name}/h, or the unit samples"
    clock = "t" if form == "differential" else "k"
    right = f"{clock} - {size:.12g}*{name}" + ("" if form == "differential" else "/h")
    if form == "difference" and not in_periods:
        return f"found {unit!r}, but this delay is in samples: write {right}, or the unit samples"
    given = "give it in s, or " if name.isidentifier() else ""
    return f"found {unit!r}, but this delay is in seconds: {given}write {right}"


def list_time_unit_warnings(model: Model) -> list[str]:
    """List warnings: parameters of a differential model that are read as if in seconds."""
    if model.form != "differential":
        return []
    sizes = {
        parameter.name: find_conversion_factor(parameter.unit, "s")
        for parameter in model.parameters
    }
    units = {parameter.name: parameter.unit for parameter in model.parameters}
    time_sizes = {name: size for name, size in sizes.items() if size is not None}
    bare = {name for tree in model.equations for name in _find_bare_parameters(tree, time_sizes)}
    return [
        f"{name} has the unit {units[name]}, but the equations read it unconverted, and their "
        f"rates are per second. Unless that is intended, give it in s, or write {size:.12g}*{name}."
        for name, size in sizes.items()
        if name in bare and size not in (None, 1.0)
    ]


def _find_bare_parameters(tree: Expression, sizes: Mapping[str, float]) -> Iterator[str]:
    """Find parameters that a term contains without a numeric factor; `sizes` in seconds."""
    for monomial, coefficient in collect_terms(tree).items():
        if abs(coefficient) == 1.0:
            yield from _collect_uncancelled_names(monomial, sizes)
        for factor, _ in monomial:
            for part in _list_inner_terms(factor):
                yield from _find_bare_parameters(part, sizes)


def _collect_uncancelled_names(monomial: Monomial, sizes: Mapping[str, float]) -> list[str]:
    """Collect the parameters of a product; none if their units cancel out."""
    powers = {
        factor.name: power
        for factor, power in monomial
        if isinstance(factor, Symbol) and factor.kind == "parameter" and factor.name in sizes
    }
    cancel = isclose(prod(sizes[name] ** power for name, power in powers.items()), 1.0)
    return [] if cancel else list(powers)


def _list_inner_terms(node: Expression) -> tuple[Expression, ...]:
    """List the terms inside a factor of a product."""
    match node:
        case PastValue():
            return ()
        case Binary() if collect_terms(node) != {((node, 1),): 1.0}:
            return (node,)  # a denominator has its own sum, with its factor in it
        case _:
            return find_children(node)


_MAX_SHOWN = 40  # characters of a unit in a message


class SignalUnits:
    """Unit of every signal of a model: the model's, else that of the first record.

    A channel may be in any unit if its unit is missing, 1, or cannot be parsed.
    """

    def __init__(self, model: Model) -> None:
        signals = [(signal.name, signal.unit) for signal in model.inputs]
        signals += [(signal.name, signal.unit) for signal in model.outputs]
        owner = f"model {model.name!r}"
        self._units = {name: (unit, owner) for name, unit in signals if not is_blank_unit(unit)}

    def describe_mismatch(self, signal: str, channel: str, unit: str | None, where: str) -> str:
        """Describe how a channel's unit differs from its signal's; empty if it does not.

        Parameters
        ----------
        channel, unit : str
            Of the record, which `where` names.
        """
        if unit is None or is_blank_unit(unit):
            return ""
        expected, owner = self._units.setdefault(signal, (unit, where))
        # A readable unit checks more of the records that follow.
        if is_readable_unit(unit) and not is_readable_unit(expected):
            self._units[signal] = (unit, where)
        difference = describe_difference(unit, expected)
        if not difference:
            return ""
        if find_conversion_factor(unit, expected) is None:
            cure = "correct the wrong unit"
        else:
            cure = f'convert the data with the derivation {{"unit": {{"{channel}": "{expected}"}}}}'
        role = "" if channel == signal else f" (signal {signal!r})"
        return (
            f"channel {channel!r}{role} is in {unit} in {where}, but in {owner} it is in "
            f"{expected}: {difference}; {cure}"
        )


def check_signal_units(model: Model, records: Sequence[Record]) -> None:
    """Raise if a channel's unit differs from the model's, or from an earlier record's.

    Raises
    ------
    InvalidRecord
        If so; the message names the channel and both units.
    """
    units = SignalUnits(model)
    for number, record in enumerate(records, 1):
        where = f"record {record.name!r}" if record.name else f"record {number}"
        for channel in (*record.inputs, *record.outputs):
            fault = units.describe_mismatch(channel.name, channel.name, channel.unit, where)
            if fault:
                raise InvalidRecord(fault)


def list_unknown_unit_warnings(channels: Iterable[Channel]) -> list[str]:
    """List warnings: channels with unknown units, such as ``bat`` for ``bar``."""
    return [
        f"channel {channel.name!r}: {_quote_unit(channel.unit)} is no known unit, so it is not "
        f"compared with other units{suggest_unit(channel.unit)}"
        for channel in channels
        if not (is_blank_unit(channel.unit) or is_known_unit(channel.unit))
    ]


def list_unread_unit_warnings(model: Model, records: Sequence[Record]) -> list[str]:
    """List warnings: channels whose unit cannot be compared with the model's."""
    warnings = {}
    model_units = {text.name: text.unit for text in model.inputs}
    model_units |= {text.name: text.unit for text in model.outputs}
    for record in records:
        for channel in (*record.inputs, *record.outputs):
            unit, expected = channel.unit, model_units.get(channel.name, "")
            unread = [text for text in (unit, expected) if not is_readable_unit(text)]
            if unread and not (
                is_blank_unit(unit) or is_blank_unit(expected) or unit.strip() == expected.strip()
            ):
                warnings[channel.name, unit] = (
                    f"channel {channel.name!r} is in {unit}, but in {expected} in the model. The "
                    f"units were not compared, because {' and '.join(unread)} could not be read as "
                    "a unit."
                )
    return list(warnings.values())


def list_mixed_unit_warnings(model: Model, records: Sequence[Record]) -> list[str]:
    """List warnings: one quantity in two units, if the model does not declare both units.

    The estimates hold for these units: a gain of 1 between kPa and Pa is a gain of 1000.
    """
    undeclared = {signal.name for signal in model.inputs if is_blank_unit(signal.unit)}
    undeclared |= {signal.name for signal in model.outputs if is_blank_unit(signal.unit)}
    units: dict[str, str] = {}
    for record in records:  # the first unit stands for all: `check_signal_units` has compared them
        for channel in (*record.inputs, *record.outputs):
            if not is_blank_unit(channel.unit):
                units.setdefault(channel.name, channel.unit)
    return [
        f"{a!r} is in {units[a]} and {b!r} in {units[b]}, and model {model.name!r} does not "
        "declare both units. A gain between them is in these units "
        f"({describe_difference(units[a], units[b])}). "
        f'To convert, derive the data with {{"unit": {{"{a}": "{units[b]}"}}}}.'
        for a, b in combinations(units, 2)
        if undeclared & {a, b} and find_conversion_factor(units[a], units[b]) not in (None, 1.0)
    ]


def _quote_unit(unit: str) -> str:
    return repr(unit if len(unit) <= _MAX_SHOWN else f"{unit[:_MAX_SHOWN]}…")
