"""The table of all settings of the search in docs/job.md: ``python -m tests.documents.job``."""

import json
from collections.abc import Iterator
from typing import Any

from service.jobs.job_schemas import JobIn
from tests.documents.settings import replace_table
from tests.support.checkout import ROOT

PAGE = ROOT / "docs" / "job.md"


def iterate_references(field: Any) -> Iterator[str]:
    """Names of the object types that a field of the schema may hold, on its own or in a list."""
    if isinstance(field, dict):
        if "$ref" in field:
            yield field["$ref"].rpartition("/")[2]
        for key in ("anyOf", "items", "additionalProperties"):
            inside = field.get(key, [])
            for one in inside if isinstance(inside, list) else [inside]:
                yield from iterate_references(one)


def iterate_fields(
    schema: dict[str, Any], kind: dict[str, Any], path: str = ""
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Path and schema of every field of a body."""
    for name, field in kind["properties"].items():
        yield path + name, field
        for inner in iterate_references(field):
            yield from iterate_fields(schema, schema["$defs"][inner], f"{path}{name}.")


SCHEMA = JobIn.model_json_schema()
FIELDS = dict(iterate_fields(SCHEMA, SCHEMA))


def write_page() -> str:
    """Write the page with the table of today."""
    rows = [
        f"| `{path}` | {write_kind(field)} | {write_default(field)} "
        f"| {field['description'].replace('null', '`null`')} |\n"
        for path, field in FIELDS.items()
        if path.startswith("algorithm")
    ]
    head = "| field | type | default | meaning |\n|---|---|---|---|\n"
    return replace_table(PAGE.read_text(encoding="utf-8"), [head, *rows])


def write_default(field: dict[str, Any]) -> str:
    """Write a default as JSON; that of an object stands in the rows below."""
    return "as below" if "$ref" in field else f"`{json.dumps(field['default'])}`"


def write_kind(field: dict[str, Any]) -> str:
    """Write what a field may be: names, bounds, or the kind of its value."""
    if "anyOf" in field:
        kinds = [write_kind(one) for one in field["anyOf"] if one.get("type") != "null"]
        return " or ".join(kinds)
    if "enum" in field:
        *others, last = [f"`{name}`" for name in field["enum"]]
        return f"{', '.join(others)} or {last}"
    match field.get("type"):
        case "boolean":
            return "true or false"
        case "array":
            return "pair" if "prefixItems" in field else f"list of {write_kind(field['items'])}s"
        case "integer":
            return ", ".join(filter(None, ["whole number", write_bounds(field)]))
        case "number":
            return write_bounds(field) or "number"
    return "object"


def write_bounds(field: dict[str, Any]) -> str:
    """Write the bounds of a number; none are the empty text."""
    match [field.get(f"exclusive{end}", field.get(end.lower())) for end in ("Minimum", "Maximum")]:
        case None, None:
            return ""
        case 0, None if "exclusiveMinimum" in field:
            return "positive"
        case least, None:
            return f"{least:,} or more"
        case least, most:
            excluded = ", both excluded" if "exclusiveMinimum" in field else ""
            return f"{least:,} to {most:,}{excluded}"
    raise AssertionError


if __name__ == "__main__":
    PAGE.write_text(write_page(), encoding="utf-8")
