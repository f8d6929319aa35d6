"""Translate the errors of Pydantic into faults with JSON pointers.

This is the only place that does so. Every message says what was received and what would be right.
An error that a wire type raises itself (`PydanticCustomError`) brings its own message. An error of
an unknown kind is not quoted, so that no foreign wording reaches a user.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from inspect import get_annotations
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic_core.core_schema import ErrorType

from service.core.errors import FieldError
from sysid.core.errors import join_pointer, suggest_name

MAX_SHOWN_CHARACTERS = 80
NOT_AN_OBJECT_KINDS = ("model_type", "model_attributes_type", "dict_type", "mapping_type")
PYDANTIC_KINDS = frozenset(get_args(ErrorType))
"""Kinds of errors that Pydantic defines."""

_EXPECTATIONS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "greater_than": lambda c: f"a number above {_format_number(c['gt'])}",
    "greater_than_equal": lambda c: f"{_format_number(c['ge'])} or more",
    "less_than": lambda c: f"a number below {_format_number(c['lt'])}",
    "less_than_equal": lambda c: f"{_format_number(c['le'])} or less",
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
    "string_too_short": lambda c: f"at least {_format_count(c['min_length'], 'character')}",
    "string_pattern_mismatch": lambda c: f"text of the form {c['pattern']}",
    "literal_error": lambda c: str(c["expected"]),
    "enum": lambda c: str(c["expected"]),
    "list_type": lambda _: "a list",
    "tuple_type": lambda _: "a list",
    "too_short": lambda c: f"at least {_format_count(c['min_length'], 'entry')}",
    "too_long": lambda c: f"at most {_format_count(c['max_length'], 'entry')}",
    "invalid_key": lambda _: "text as the name of a field",
    "none_required": lambda _: "null",
    "union_tag_invalid": lambda c: f"{c['discriminator']} to be one of {c['expected_tags']}",
    "union_tag_not_found": lambda c: f"an object with the field {c['discriminator']}",
    "datetime_type": lambda _: "a time such as 2026-01-31T12:00:00Z",
    "datetime_parsing": lambda _: "a time such as 2026-01-31T12:00:00Z",
    "datetime_from_date_parsing": lambda _: "a time such as 2026-01-31T12:00:00Z",
}


def describe_error(
    entry: Mapping[str, Any], fields: Sequence[str], elsewhere: Sequence[str] = ()
) -> str:
    """Describe one error: what was wrong, what was received, what would be right.

    Parameters
    ----------
    entry : mapping
        As `pydantic.ValidationError.errors` returns them.
    fields : sequence of str
        Names of the fields at this position.
    elsewhere : sequence of str
        Pointers to fields of the same name at other positions.
    """
    kind, received = entry["type"], _format_value(entry.get("input"))
    if kind == "extra_forbidden":
        suggestion = _suggest_field(str(entry["loc"][-1]), fields, elsewhere)
        return f"unknown field {entry['loc'][-1]!r}{suggestion}"
    if kind == "missing":
        return "this field is required"
    if kind in NOT_AN_OBJECT_KINDS:
        example = f" with fields such as {', '.join(fields)}" if fields else " (name: value)"
        return f"found {received}; need an object{example}"
    if kind == "string_pattern_mismatch" and entry["loc"][-1] == "path":
        return f"found {received}; need a JSON pointer, such as /noise/sigma"
    if kind == "list_type":
        example_list = f", such as [{received}]" if isinstance(entry.get("input"), str) else ""
        return f"found {received}; need a list{example_list}"
    if kind in _EXPECTATIONS:
        expected = _EXPECTATIONS[kind](entry.get("ctx", {}))
        return f"found {received}{_format_size(kind, entry)}; need {expected}"
    return _describe_raised_error(entry, received)


def _describe_raised_error(entry: Mapping[str, Any], received: str) -> str:
    """Describe an error by the message that a validator raised, else by the received value."""
    if entry["type"] in ("value_error", "assertion_error") and "error" in entry.get("ctx", {}):
        return str(entry["ctx"]["error"])
    if entry["type"] in PYDANTIC_KINDS:
        return f"found {received}; this cannot be used here"
    return f"{entry['msg']}; found {received}"


def _suggest_field(name: str, fields: Sequence[str], elsewhere: Sequence[str]) -> str:
    """Name the position where a field of this name exists, else the most similar field here."""
    return f"; there is {' and '.join(elsewhere[:2])}" if elsewhere else suggest_name(name, fields)


def _format_value(value: Any) -> str:
    """Format a value as JSON writes it, where Python writes it differently."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    try:
        text = repr(value)
    except RecursionError:
        return "lists or objects nested too deeply"
    return text if len(text) <= MAX_SHOWN_CHARACTERS else text[:MAX_SHOWN_CHARACTERS] + "…"


def _format_size(kind: str, entry: Mapping[str, Any]) -> str:
    """Describe the size that was received, if it is too large."""
    if kind == "too_long" and (length := entry.get("ctx", {}).get("actual_length")):
        return f" ({_format_count(length, 'entry')})"
    if kind == "string_too_long" and isinstance(entry.get("input"), str):
        return f" ({_format_count(len(entry['input']), 'character')})"
    return ""


def _format_number(value: Any) -> str:
    """Format a bound as it is written by hand: 9223372036854775808 stays, 0.0 becomes 0."""
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _format_count(count: int, what: str) -> str:
    plural = f"{what[:-1]}ies" if what.endswith("y") else f"{what}s"
    return f"1 {what}" if count == 1 else f"{count} {plural}"


ErrorLocation = Sequence[str | int]


def explain_errors(
    entries: Iterable[Mapping[str, Any]], body: Any, kind: Any
) -> Iterator[FieldError]:
    """Convert Pydantic's errors of a body into faults with JSON pointers.

    Parameters
    ----------
    entries : iterable of mapping
        As `pydantic.ValidationError.errors` returns them.
    kind : type
        Wire type of the body, for the names of its fields.
    """
    seen: set[str] = set()
    for entry in entries:
        pointer = to_pointer(body, entry["loc"], is_missing=entry["type"] == "missing")
        # A union has one entry per member; the first concerns the member that is meant most often.
        if pointer not in seen:
            seen.add(pointer)
            location = entry["loc"] if entry["type"] in NOT_AN_OBJECT_KINDS else entry["loc"][:-1]
            elsewhere = find_field_pointers(kind, entry["loc"][-1]) if entry["loc"] else []
            yield FieldError(pointer, describe_error(entry, list_fields(kind, location), elsewhere))


def to_pointer(body: Any, loc: ErrorLocation, *, is_missing: bool = False) -> str:
    """Return the JSON pointer of a Pydantic location, without the names that unions add to it.

    With `is_missing` the last part is not in the body, but should be.
    """
    parts: list[str | int] = []
    node = body
    for position, part in enumerate(loc):
        if _contains_part(node, part):
            node = node[part]
            parts.append(part)
        elif is_missing and position == len(loc) - 1:
            parts.append(part)
    return join_pointer(*parts)


def find_body_type(endpoint: Callable[..., Any] | None) -> Any:
    """Return the wire type of the body of an endpoint."""
    return get_annotations(endpoint, eval_str=True).get("body") if endpoint else None


def list_fields(kind: Any, loc: ErrorLocation) -> list[str]:
    """List the fields of a wire type at a location."""
    types = list(_iterate_models(kind))
    for part in loc:
        fields = [t.model_fields[part] for t in types if part in t.model_fields]
        # A list index, a key of a mapping or a union's own name leaves the types as they are.
        if fields:
            types = [model for field in fields for model in _iterate_models(field.annotation)]
    return sorted({name for model in types for name in model.model_fields})


def find_field_pointers(kind: Any, name: str | int, above: str = "") -> list[str]:
    """List pointers to the fields of a name that need no list index, the shortest first."""
    pointers = []
    for model in _iterate_models(kind):
        for field_name, field in model.model_fields.items():
            if field_name == name:
                pointers.append(f"{above}/{field_name}")
            if get_origin(field.annotation) not in (dict, list):
                pointers += find_field_pointers(field.annotation, name, f"{above}/{field_name}")
    return sorted(dict.fromkeys(pointers), key=lambda pointer: pointer.count("/"))


def _contains_part(value: Any, part: str | int) -> bool:
    if isinstance(value, dict):
        return part in value
    return isinstance(value, list) and isinstance(part, int) and part < len(value)


def _iterate_models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _iterate_models(inner)
