"""What a validation error says to a user: where in the body, what was found, what is known."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from inspect import get_annotations
from typing import Any, get_args, get_origin

from pydantic import BaseModel

from service.errors import FieldError
from service.sentences import NOT_AN_OBJECT, detail_of

Location = Sequence[str | int]


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
            elsewhere = places_of(kind, entry["loc"][-1]) if entry["loc"] else []
            yield FieldError(pointer, detail_of(entry, known_fields(kind, at), elsewhere))


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


def places_of(kind: Any, name: str | int, above: str = "") -> list[str]:
    """Pointers of the fields of a name that can be reached by names alone, the shortest first."""
    found = []
    for model in _models(kind):
        for own, field in model.model_fields.items():
            if own == name:
                found.append(f"{above}/{own}")
            if get_origin(field.annotation) not in (dict, list):
                found += places_of(field.annotation, name, f"{above}/{own}")
    return sorted(dict.fromkeys(found), key=lambda place: place.count("/"))


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
