"""What is wrong with one field, in our words: the one place that translates Pydantic's errors.

Every sentence tells what was found and what would be right. An error that a wire type raises
itself (`PydanticCustomError`) has its sentence with it; of a kind that is not known here nothing
is quoted, so that no other wording reaches a user.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

from pydantic_core.core_schema import ErrorType

from sysid.core.errors import nearest

SHOWN = 80
NOT_AN_OBJECT = ("model_type", "model_attributes_type", "dict_type", "mapping_type")
OWN_KINDS = frozenset(get_args(ErrorType))
"""Kinds of errors that are Pydantic's own."""

_NEEDS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "greater_than": lambda c: f"a number above {_number(c['gt'])}",
    "greater_than_equal": lambda c: f"{_number(c['ge'])} or more",
    "less_than": lambda c: f"a number below {_number(c['lt'])}",
    "less_than_equal": lambda c: f"{_number(c['le'])} or less",
    "finite_number": lambda _: "a finite number",
    "int_type": lambda _: "a whole number",
    "int_parsing": lambda _: "a whole number",
    "int_from_float": lambda _: "a whole number",
    "int_parsing_size": lambda _: "a whole number with fewer digits",
    "float_type": lambda _: "a number",
    "float_parsing": lambda _: "a number",
    "bool_type": lambda _: "true or false",
    "bool_parsing": lambda _: "true or false",
    "string_type": lambda _: "text",
    "string_sub_type": lambda _: "text",
    "string_unicode": lambda _: "text in UTF-8",
    "string_too_long": lambda c: f"at most {c['max_length']} characters",
    "string_too_short": lambda c: f"at least {_counted(c['min_length'], 'character')}",
    "string_pattern_mismatch": lambda c: f"text of the form {c['pattern']}",
    "literal_error": lambda c: str(c["expected"]),
    "enum": lambda c: str(c["expected"]),
    "list_type": lambda _: "a list",
    "tuple_type": lambda _: "a list",
    "too_short": lambda c: f"at least {_counted(c['min_length'], 'entry')}",
    "too_long": lambda c: f"at most {_counted(c['max_length'], 'entry')}",
    "invalid_key": lambda _: "text as the name of a field",
    "none_required": lambda _: "null",
    "union_tag_invalid": lambda c: f"{c['discriminator']} to be one of {c['expected_tags']}",
    "union_tag_not_found": lambda c: f"an object with the field {c['discriminator']}",
    "datetime_type": lambda _: "a time such as 2026-01-31T12:00:00Z",
    "datetime_parsing": lambda _: "a time such as 2026-01-31T12:00:00Z",
    "datetime_from_date_parsing": lambda _: "a time such as 2026-01-31T12:00:00Z",
}


def detail_of(entry: Mapping[str, Any], known: Sequence[str], elsewhere: Sequence[str] = ()) -> str:
    """What was wrong, what was found, what would be right.

    Parameters
    ----------
    entry : mapping
        As `pydantic.ValidationError.errors` gives them.
    known : sequence of str
        Fields that are known at its place; `elsewhere` are pointers to fields of its name.
    """
    kind, found = entry["type"], _found(entry.get("input"))
    if kind == "extra_forbidden":
        return f"unknown field {entry['loc'][-1]!r}{_hint(str(entry['loc'][-1]), known, elsewhere)}"
    if kind == "missing":
        return "this field is required"
    if kind in NOT_AN_OBJECT:
        some = f" with fields such as {', '.join(known)}" if known else " (name: value)"
        return f"found {found}; need an object{some}"
    if kind == "string_pattern_mismatch" and entry["loc"][-1] == "path":
        return f"found {found}; need a JSON pointer, such as /noise/sigma"
    if kind == "list_type":
        one = f", such as [{found}]" if isinstance(entry.get("input"), str) else ""
        return f"found {found}; need a list{one}"
    if kind in _NEEDS:
        return f"found {found}{_size(kind, entry)}; need {_NEEDS[kind](entry.get('ctx', {}))}"
    return _raised(entry, found)


def _raised(entry: Mapping[str, Any], found: str) -> str:
    """The sentence that a validator raised; of the other kinds what was found."""
    if entry["type"] in ("value_error", "assertion_error") and "error" in entry.get("ctx", {}):
        return str(entry["ctx"]["error"])
    if entry["type"] in OWN_KINDS:
        return f"found {found}; this cannot be used here"
    return f"{entry['msg']}; found {found}"


def _hint(name: str, known: Sequence[str], elsewhere: Sequence[str]) -> str:
    """Where a field of this very name is, else the nearest of those that are here."""
    return f"; there is {' and '.join(elsewhere[:2])}" if elsewhere else nearest(name, known)


def _found(value: Any) -> str:
    """A value as it is written in JSON where Python has another word for it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    try:
        text = repr(value)
    except RecursionError:
        return "lists or objects nested too deeply"
    return text if len(text) <= SHOWN else text[:SHOWN] + "…"


def _size(kind: str, entry: Mapping[str, Any]) -> str:
    """How much was found, where it is too much or too little."""
    if kind == "too_long" and (length := entry.get("ctx", {}).get("actual_length")):
        return f" ({_counted(length, 'entry')})"
    if kind == "string_too_long" and isinstance(entry.get("input"), str):
        return f" ({_counted(len(entry['input']), 'character')})"
    return ""


def _number(value: Any) -> str:
    """A bound as it is written by hand: 9223372036854775808 stays, 0.0 is 0."""
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _counted(count: int, what: str) -> str:
    plural = f"{what[:-1]}ies" if what.endswith("y") else f"{what}s"
    return f"1 {what}" if count == 1 else f"{count} {plural}"
