"""Where in a body a validation error lies, and which fields are known there."""

from collections.abc import Callable, Iterator, Sequence
from inspect import get_annotations
from typing import Any, get_args

from pydantic import BaseModel

Location = Sequence[str | int]


def pointer_into(body: Any, loc: Location) -> str:
    """JSON pointer of a Pydantic location, without the names that unions put into it."""
    parts: list[str] = []
    here = body
    for position, part in enumerate(loc):
        inside = _is_in(here, part)
        if inside:
            here = here[part]
        if inside or (position == len(loc) - 1 and isinstance(here, dict | list)):
            parts.append(escaped(part))
    return "".join(f"/{part}" for part in parts)


def known_fields(endpoint: Callable[..., Any] | None, loc: Location) -> list[str]:
    """Fields that the body of an endpoint may have at a location."""
    annotation = get_annotations(endpoint, eval_str=True).get("body") if endpoint else None
    types = list(_models(annotation))
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
