"""The page of the REST interface, written from its OpenAPI document; nothing remote is loaded."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

METHODS = ("get", "post", "put", "patch", "delete")


class Field(NamedTuple):
    """One field of a body, or one value of a path or query."""

    name: str
    kind: str
    required: bool
    default: str
    about: str


class Operation(NamedTuple):
    """One method of one path."""

    method: str
    path: str
    summary: str
    parameters: tuple[Field, ...]
    media_types: tuple[str, ...]
    body: str
    fields: tuple[Field, ...]
    answers: tuple[tuple[str, str], ...]


def operations(document: Mapping[str, Any]) -> tuple[Operation, ...]:
    """Every operation of an OpenAPI document, in its order."""
    return tuple(
        _operation(document, method, path, item[method])
        for path, item in document["paths"].items()
        for method in METHODS
        if method in item
    )


def _operation(
    document: Mapping[str, Any], method: str, path: str, item: Mapping[str, Any]
) -> Operation:
    content = item.get("requestBody", {}).get("content", {})
    schema = content.get("application/json", {}).get("schema", {})
    return Operation(
        method=method.upper(),
        path=path,
        summary=item.get("description") or item.get("summary", ""),
        parameters=tuple(
            Field(
                one["name"], f"{_kind(one.get('schema', {}))}, {one['in']}",
                one.get("required", False), _default(one.get("schema", {})),
                one.get("description", ""),
            )
            for one in item.get("parameters", ())
        ),
        media_types=tuple(content),
        body=_kind(schema) if schema else "",
        fields=tuple(_fields(document, schema)),
        answers=tuple((code, one["description"]) for code, one in item["responses"].items()),
    )  # fmt: skip


def _fields(document: Mapping[str, Any], schema: Mapping[str, Any]) -> Iterator[Field]:
    target = schema
    if "$ref" in schema:
        target = document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    required = target.get("required", ())
    for name, one in target.get("properties", {}).items():
        yield Field(name, _kind(one), name in required, _default(one), one.get("description", ""))


def _kind(schema: Mapping[str, Any]) -> str:
    """A schema in a word or two."""
    if "$ref" in schema:
        return str(schema["$ref"].rpartition("/")[2])
    if "anyOf" in schema or "oneOf" in schema:
        return " or ".join(_kind(one) for one in schema.get("anyOf") or schema["oneOf"])
    if "enum" in schema:
        return " | ".join(str(value) for value in schema["enum"])
    if "const" in schema:
        return str(schema["const"])
    if schema.get("type") == "array":
        return f"list of {_kind(schema.get('items', {}))}"
    return str(schema.get("type", "any"))


def _default(schema: Mapping[str, Any]) -> str:
    value = schema.get("default")
    return "" if value is None or value in ({}, []) or isinstance(value, dict) else str(value)
