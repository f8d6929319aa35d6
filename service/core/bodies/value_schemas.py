"""Wire types of the core's dataclasses: their fields, with the descriptions of their docstrings.

A value of the core is sent as `sysid.core.value_documents` writes it, and its schema says the same.
The core knows no Pydantic, so the types are built here, from the declared types of the fields and
the section *Attributes* of each class.
"""

import inspect
from collections.abc import Callable, Mapping
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import numpy as np
from pydantic import Field, create_model
from pydantic.fields import FieldInfo

from service.core.bodies.descriptions import describe_field
from service.core.bodies.wire import Answer, DescribedBy, Finite
from sysid.core.value_documents import has_fields, list_fields

Wire = TypeVar("Wire", bound=Answer)


def extend_by(kind: type) -> Callable[[type[Wire]], type[Wire]]:
    """Extend a wire type by the fields of a dataclass, but for those that it declares itself."""

    def extend(wire: type[Wire]) -> type[Wire]:
        fields = {
            name: field
            for name, field in _list_fields(kind).items()
            if name not in wire.model_fields
        }
        return _create(wire.__name__, wire, wire.__doc__, fields)

    return extend


def extend_later_by(kind: type, **defaults: object) -> Callable[[type[Wire]], type[Wire]]:
    """Extend a wire type in the same way if there is no value from the start.

    Its fields are sent as they were stored. Until then each is null, unless `defaults` say
    otherwise.
    """

    def extend(wire: type[Wire]) -> type[Wire]:
        fields = {
            name: (
                Annotated[Any, DescribedBy(sent if name in defaults else sent | None)],
                Field(default=defaults.get(name), description=field.description),
            )
            for name, (sent, field) in _list_fields(kind).items()
            if name not in wire.model_fields
        }
        return _create(wire.__name__, wire, wire.__doc__, fields)

    return extend


@cache
def describe_value(kind: type) -> type[Answer]:
    """Build the wire type of a dataclass or named tuple; an `Estimate` becomes an `EstimateOut`."""
    summary = inspect.cleandoc(kind.__doc__ or "").split("\n\n")[0].replace("\n", " ")
    return _create(f"{kind.__name__}Out", Answer, summary, _list_fields(kind))


def _create(name: str, base: type[Wire], doc: str | None, fields: Mapping[str, Any]) -> type[Wire]:
    return create_model(name, __base__=base, __doc__=doc, __module__=base.__module__, **fields)


def _list_fields(kind: type) -> dict[str, tuple[Any, FieldInfo]]:
    """List the wire type of each field, with its description.

    A document has all of them. Numbers that are written with few digits are many: lists of values
    leave them out.
    """
    fields = {}
    for field in list_fields(kind):
        text, axes = describe_field(kind, field.name)
        default: Any = ... if field.digits is None else None
        fields[field.name] = _to_wire(field.hint, axes), Field(default, description=text)
    return fields


def _to_wire(hint: Any, axes: int) -> Any:
    """Convert the type of a field to that of its document; a number may be null."""
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        parts = [_to_wire(part, axes) for part in get_args(hint) if part is not NoneType]
        return Union[*parts, None]
    if hint is float:
        return Finite
    if origin is np.ndarray:
        wire: Any = Finite
        for _ in range(axes):
            wire = list[wire]
        return wire
    if origin is tuple:
        return list[_to_wire(get_args(hint)[0], 0)]  # type: ignore[misc]
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return dict[str, _to_wire(get_args(hint)[1], 0)]  # type: ignore[misc]
    return describe_value(hint) if has_fields(hint) else hint
