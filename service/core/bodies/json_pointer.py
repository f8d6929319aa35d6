"""JSON pointers into a job's body (RFC 6901)."""

from collections.abc import Mapping
from copy import copy
from typing import Any

from sysid.core.errors import split_pointer


def build_run_body(document: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Build the body of one run: the job's normal form with the values of its cell.

    Parts that no value changes are shared with `document`. Neither must be modified.
    """
    body = {name: value for name, value in document.items() if name != "sweep"}
    for path, value in values.items():
        *parents, last = split_pointer(path)
        node: Any = body
        for part in parents:
            key: Any = int(part) if isinstance(node, list) else part
            child = node[key] if isinstance(node, list) else node.get(key)
            node[key] = {} if child is None else copy(child)
            node = node[key]
        if isinstance(node, list):
            node[int(last)] = value
        else:
            node[last] = [value] if path == "/datasets" and isinstance(value, str) else value
    return body


def get_value(document: Mapping[str, Any], path: str) -> Any:
    """Return the value of an existing field."""
    node: Any = document
    for part in split_pointer(path):
        node = node[int(part)] if isinstance(node, list) else node[part]
    return node
