"""List the operations of the REST interface from its OpenAPI document, for the page /docs."""

import json
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

HTTP_METHODS = ("get", "post", "put", "patch", "delete")


class ApiField(NamedTuple):
    """One field of a body, or one parameter of a path or query."""

    name: str
    kind: str
    required: bool
    default: str
    about: str


class ApiOperation(NamedTuple):
    """One method of one path."""

    method: str
    path: str
    summary: str
    parameters: tuple[ApiField, ...]
    media_types: tuple[str, ...]
    body: str
    fields: tuple[ApiField, ...]
    answers: tuple[tuple[str, str], ...]
    example: str


def list_operations(document: Mapping[str, Any]) -> tuple[ApiOperation, ...]:
    """List every operation of an OpenAPI document, in its order."""
    return tuple(
        _to_operation(document, method, path, item[method])
        for path, item in document["paths"].items()
        for method in HTTP_METHODS
        if method in item
    )


def _to_operation(
    document: Mapping[str, Any], method: str, path: str, item: Mapping[str, Any]
) -> ApiOperation:
    content = item.get("requestBody", {}).get("content", {})
    schema = content.get("application/json", {}).get("schema", {})
    return ApiOperation(
        method=method.upper(),
        path=path,
        summary=item.get("description") or item.get("summary", ""),
        parameters=tuple(
            ApiField(
                parameter["name"],
                f"{_describe_schema(parameter.get('schema', {}))}, {parameter['in']}",
                parameter.get("required", False),
                _format_default(parameter.get("schema", {})),
                parameter.get("description", ""),
            )
            for parameter in item.get("parameters", ())
        ),
        media_types=tuple(content),
        body=_describe_schema(schema) if schema else "",
        fields=tuple(_iterate_fields(document, schema)),
        answers=tuple(
            (code, _follow(document, response)["description"])
            for code, response in item["responses"].items()
        ),
        example=_format_example(content),
    )


def _format_example(content: Mapping[str, Any]) -> str:
    """Format the first example of a body; empty if there is none."""
    examples = (entry["example"] for entry in content.values() if "example" in entry)
    example = next(examples, "")
    return example if isinstance(example, str) else json.dumps(example, indent=2)


def _iterate_fields(document: Mapping[str, Any], schema: Mapping[str, Any]) -> Iterator[ApiField]:
    target = _follow(document, schema)
    required = target.get("required", ())
    for name, field in target.get("properties", {}).items():
        yield ApiField(
            name,
            _describe_schema(field),
            name in required,
            _format_default(field),
            field.get("description", ""),
        )


def _follow(document: Mapping[str, Any], value: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what a value refers to, or the value."""
    if "$ref" not in value:
        return value
    _, _, kind, name = value["$ref"].split("/")
    target: Mapping[str, Any] = document["components"][kind][name]
    return target


def _describe_schema(schema: Mapping[str, Any]) -> str:
    """Describe a schema in a word or two."""
    if "$ref" in schema:
        return str(schema["$ref"].rpartition("/")[2])
    if "anyOf" in schema or "oneOf" in schema:
        return " or ".join(
            _describe_schema(option) for option in schema.get("anyOf") or schema["oneOf"]
        )
    if "enum" in schema:
        return " | ".join(str(value) for value in schema["enum"])
    if "const" in schema:
        return str(schema["const"])
    if schema.get("type") == "array":
        return f"list of {_describe_schema(schema.get('items', {}))}"
    return str(schema.get("type", "any"))


def _format_default(schema: Mapping[str, Any]) -> str:
    value = schema.get("default")
    return "" if value is None or value in ({}, []) or isinstance(value, dict) else str(value)
