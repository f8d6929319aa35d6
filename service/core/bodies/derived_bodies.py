"""Wire types derived from the settings of the core, and settings read back from documents.

A setting is declared once, in a dataclass of the core: name, type, default, bounds, meaning. Here
it becomes the field of a body with the same name, default, bounds and sentence. A type checker does
not know the fields that a body derives: what is read are the settings, by `read_settings`.
"""

from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import reduce
from operator import or_
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import pydantic

from service.core.bodies.descriptions import describe_field
from service.core.bodies.wire import Body
from sysid.core.errors import InvalidSettings, join_pointer, suggest_name
from sysid.core.settings import Bounds, find_bounds, list_members

Settings = TypeVar("Settings")
BodyType = TypeVar("BodyType", bound=Body)
Limits = Mapping[str, Any]
"""Constraints that a request has besides those of the core, as `pydantic.Field` takes them."""

_CONSTRAINTS = {"least": "ge", "above": "gt", "below": "lt", "most": "le"}


def derive_fields(
    kind: type,
    groups: Mapping[type, type[Body]] = {},
    limits: Mapping[str, Limits] = {},
) -> Callable[[type[BodyType]], type[BodyType]]:
    """Give a body the fields of settings of the core.

    Parameters
    ----------
    kind : type
        Dataclass of the settings.
    groups : mapping of type to type
        Bodies of the settings that are fields of these.
    limits : mapping of str to Limits
        What one request may ask of a server, by field.
    """

    def derive(body: type[BodyType]) -> type[BodyType]:
        hints = get_type_hints(kind, include_extras=True)
        definitions: Any = {
            field.name: (
                _to_wire_type(hints[field.name], groups, limits.get(field.name, {})),
                pydantic.Field(
                    default=_to_default(field, groups),
                    description=describe_field(kind, field.name).text,
                ),
            )
            for field in fields(kind)
        }
        return pydantic.create_model(
            body.__name__,
            __base__=body,
            __module__=body.__module__,
            __doc__=body.__doc__,
            **definitions,
        )

    return derive


def take_setting(kind: type, name: str) -> Any:
    """Return the field of a body that is one setting of the core; the body states its type."""
    [field] = [field for field in fields(kind) if field.name == name]
    members = list_members(get_type_hints(kind, include_extras=True)[name])
    bounds = next(filter(None, map(find_bounds, members)), None)
    return pydantic.Field(
        default=_to_default(field, {}),
        description=describe_field(kind, name).text,
        **_write_bounds(bounds),
    )


def read_settings(kind: type[Settings], document: Mapping[str, Any], pointer: str = "") -> Settings:
    """Build settings of the core from a document of them; `pointer` is that of the document.

    Raises
    ------
    InvalidSettings
        With the pointer of the field that cannot be used, or that is unknown.
    """
    hints = get_type_hints(kind)
    values = {}
    for name, value in document.items():
        place = pointer + join_pointer(name)
        if name not in hints:
            raise InvalidSettings(place, f"unknown setting{suggest_name(name, hints)}")
        values[name] = _read_value(hints[name], value, place)
    return kind(**values)


def _to_wire_type(annotation: Any, groups: Mapping[type, type[Body]], limits: Limits) -> Any:
    members = list_members(annotation)
    if len(members) > 1:
        return reduce(or_, [_to_wire_type(member, groups, limits) for member in members])
    bounds = find_bounds(annotation)
    if bounds is not None:
        constraints = pydantic.Field(**{**_write_bounds(bounds), **limits})
        return Annotated[get_args(annotation)[0], constraints]
    if annotation in groups:
        return groups[annotation]
    if get_origin(annotation) is not tuple:
        return annotation
    inner = get_args(annotation)
    entries: Any = tuple(_to_wire_type(item, groups, {}) for item in inner if item is not ...)
    if inner[1:] == (...,):
        return Annotated[list[entries], pydantic.Field(**limits)]
    return tuple[entries]


def _write_bounds(bounds: Bounds | None) -> dict[str, Any]:
    ends = {key: getattr(bounds, end, None) for end, key in _CONSTRAINTS.items()}
    return {key: end for key, end in ends.items() if end is not None}


def _to_default(field: "Field[Any]", groups: Mapping[type, type[Body]]) -> Any:
    value = field.default if field.default_factory is MISSING else field.default_factory()
    if value is MISSING:
        return ...
    if is_dataclass(value):
        return groups[type(value)]()
    return [*value] if isinstance(value, tuple) else value


def _read_value(annotation: Any, value: Any, pointer: str) -> Any:
    members = list_members(annotation)
    kinds: list[Any] = [member for member in members if is_dataclass(member)]
    if kinds and value is not None:
        if not isinstance(value, Mapping):
            raise InvalidSettings(pointer, f"found {value!r}; need an object")
        return read_settings(kinds[0], value, pointer)
    if isinstance(value, list):
        inner = next((get_args(one) for one in members if get_origin(one) is tuple), ())
        entries = inner[:1] * len(value) if inner[1:] == (...,) else inner
        if len(entries) != len(value):
            raise InvalidSettings(pointer, f"found {value!r}; need another kind of value")
        places = (f"{pointer}/{index}" for index in range(len(value)))
        return tuple(map(_read_value, entries, value, places))
    return float(value) if float in members and type(value) is int else value
