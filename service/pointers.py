"""What a validation error says to a user: where in the body, what was found, what is known."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from inspect import get_annotations
from typing import Any, get_args

from pydantic import BaseModel

from service.errors import FieldError
from sysid.errors import nearest

Location = Sequence[str | int]
SHOWN = 80
NOT_AN_OBJECT = ("model_type", "model_attributes_type", "dict_type")


def explained(entries: Iterable[Mapping[str, Any]], body: Any, kind: Any) -> Iterator[FieldError]:
    """Pydantic's errors of a body as faults with JSON pointers.

    Parameters
    ----------
    entries : iterable of mapping
        As `pydantic.ValidationError.errors` gives them.
    kind : type
        The body's wire type, for the names of known fields.
    """
    seen: set[str] = set()
    for entry in entries:
        pointer = pointer_into(body, entry["loc"], is_missing=entry["type"] == "missing")
        # A union gives one entry per member; the first is about the member most often meant.
        if pointer not in seen:
            seen.add(pointer)
            at = entry["loc"] if entry["type"] in NOT_AN_OBJECT else entry["loc"][:-1]
            yield FieldError(pointer, detail_of(entry, known_fields(kind, at)))


def detail_of(entry: Mapping[str, Any], known: Sequence[str]) -> str:
    """What was wrong, what was found."""
    if entry["type"] == "extra_forbidden":
        return f"unknown field {entry['loc'][-1]!r}{nearest(str(entry['loc'][-1]), known)}"
    if entry["type"] == "missing":
        return "this field is required"
    found = repr(entry.get("input"))
    found = found if len(found) <= SHOWN else found[:SHOWN] + "…"
    if entry["type"] in NOT_AN_OBJECT:
        return f"found {found}; need an object with fields such as {', '.join(known)}"
    if entry["type"] == "list_type":
        return f"found {found}; need a list, such as [{entry.get('input')}]"
    if entry["type"] == "string_pattern_mismatch" and entry["loc"][-1] == "path":
        return f"found {found}; need a JSON pointer, such as /noise/sigma"
    return f"{entry['msg']}; found {found}"


def pointer_into(body: Any, loc: Location, *, is_missing: bool = False) -> str:
    """JSON pointer of a Pydantic location, without the names that unions put into it.

    `is_missing`: the last part is not in the body, and should be.
    """
    parts: list[str] = []
    here = body
    for position, part in enumerate(loc):
        if _is_in(here, part):
            here = here[part]
            parts.append(escaped(part))
        elif is_missing and position == len(loc) - 1:
            parts.append(escaped(part))
    return "".join(f"/{part}" for part in parts)


def body_type(endpoint: Callable[..., Any] | None) -> Any:
    """Wire type of an endpoint's body."""
    return get_annotations(endpoint, eval_str=True).get("body") if endpoint else None


def known_fields(kind: Any, loc: Location) -> list[str]:
    """Fields that a wire type knows at a location."""
    types = list(_models(kind))
    for part in loc:
        fields = [t.model_fields[part] for t in types if part in t.model_fields]
        # A list index, a key of a mapping or a union's own name leaves the types as they are.
        if fields:
            types = [model for field in fields for model in _models(field.annotation)]
    return sorted({name for model in types for name in model.model_fields})


def escaped(part: str | int) -> str:
    """One part of a JSON pointer (RFC 6901)."""
    return str(part).replace("~", "~0").replace("/", "~1")


def _is_in(value: Any, part: str | int) -> bool:
    if isinstance(value, dict):
        return part in value
    return isinstance(value, list) and isinstance(part, int) and part < len(value)


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)
