"""Write the contract of the interface to files: the OpenAPI document, and the types of the client.

`make openapi` does so after each change of the interface. A test holds both files against the
application::

    python -m service.api.contract.write_contract .
"""

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from service.api.app import create_app
from service.api.contract.openapi import list_operations

Schema = Mapping[str, Any]

DOCUMENT_FILE = Path("docs/openapi.json")
TYPES_FILE = Path("service/client/documents.pyi")
_HEAD = '''"""Types of the answers of the REST interface, written by `make openapi`. Do not edit.

They are dictionaries with the field names of the interface, for type checkers and editors.
"""

# ruff: noqa: E501

from typing import Any, Literal, NotRequired, TypedDict
'''
_LINE = 100
_PLAIN_TYPES = {"string": "str", "integer": "int", "number": "float", "boolean": "bool"}
_PLAIN_TYPES |= {"null": "None"}


def write_document(document: Mapping[str, Any]) -> str:
    """Write the OpenAPI document as text; its version is that of the interface, not of lagid."""
    info = {**document["info"], "version": "v1"}
    return json.dumps({**document, "info": info}, indent=1, ensure_ascii=False) + "\n"


def write_types(document: Mapping[str, Any]) -> str:
    """Write a ``TypedDict`` for each schema of an answer."""
    schemas = document["components"]["schemas"]
    return _HEAD + "".join(
        _write_class(name, schemas[name]) for name in sorted(_find_answer_schemas(document))
    )


def _find_answer_schemas(document: Mapping[str, Any]) -> set[str]:
    """Find the schemas with fields that answers consist of."""
    schemas, names = document["components"]["schemas"], set[str]()
    found = [
        name
        for _, operation in list_operations(document)
        for response in operation["responses"].values()
        for name in _find_references(response.get("content", {}))
    ]
    while found:
        name = found.pop()
        if name not in names and "properties" in schemas[name]:
            names.add(name)
            found += _find_references(schemas[name])
    return names


def _find_references(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        if "$ref" in value and value["$ref"].startswith("#/components/schemas/"):
            yield value["$ref"].rpartition("/")[2]
        for item in value.values():
            yield from _find_references(item)
    elif isinstance(value, list):
        for item in value:
            yield from _find_references(item)


def _write_class(name: str, schema: Schema) -> str:
    about = schema.get("description", name).split("\n\n")[0].replace("\n", " ")
    lines = [f"\nclass {_name_type(name)}(TypedDict):", f'    """{about}"""', ""]
    for field, kind in schema["properties"].items():
        text = _write_type(kind)
        is_required = field in schema.get("required", ())
        lines.append(_wrap_field(field, text if is_required else f"NotRequired[{text}]"))
        lines.append(f'    """{kind.get("description", field)}"""')
    return "\n".join(lines) + "\n"


def _wrap_field(field: str, text: str) -> str:
    """Write a field in one line, or as the formatter wraps a long list of names."""
    line = f"    {field}: {text}"
    if len(line) <= _LINE:
        return line
    head, _, inner = text.removesuffix("]").partition("[")
    parts = [inner] if head == "NotRequired" else [f"{name}," for name in inner.split(", ")]
    return "\n".join([f"    {field}: {head}[", *(f"        {part}" for part in parts), "    ]"])


def _name_type(schema: str) -> str:
    """Name the type of a schema: a `JobOut` is received as a `JobDocument`."""
    return f"{schema.removesuffix('Out')}Document"


def _write_type(schema: Schema) -> str:
    if "$ref" in schema:
        name = str(schema["$ref"].rpartition("/")[2])
        return "Any" if name == "JsonValue" else _name_type(name)
    if "anyOf" in schema or "oneOf" in schema:
        options = schema.get("anyOf") or schema["oneOf"]
        return _join_types(_write_type(option) for option in options)
    if "enum" in schema or "const" in schema:
        values = schema.get("enum") or [schema["const"]]
        return f"Literal[{', '.join(json.dumps(value) for value in values)}]"
    match schema.get("type"):
        case "array":
            items = schema.get("prefixItems") or [schema.get("items", {})]
            return f"list[{_join_types(_write_type(item) for item in items)}]"
        case "object":
            values = schema.get("additionalProperties", True)
            return f"dict[str, {_write_type(values) if isinstance(values, dict) else 'Any'}]"
        case kind:
            return _PLAIN_TYPES.get(str(kind), "Any")


def _join_types(types: Iterator[str]) -> str:
    names = dict.fromkeys(types)
    return "Any" if "Any" in names else " | ".join(names)


def main(root: Path) -> None:
    """Write both files below the root of the repository."""
    document = create_app().openapi()
    (root / DOCUMENT_FILE).write_text(write_document(document), encoding="utf-8")
    (root / TYPES_FILE).write_text(write_types(document), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
