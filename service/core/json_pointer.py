"""JSON pointers into a job's body (RFC 6901)."""

from collections.abc import Mapping
from copy import copy
from typing import Any

from sysid.core.errors import split_pointer


def build_run_body(document: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Body of one run: the job's normal form with the cell's values put in.

    What no value changes is the document's own: neither is to be changed.
    """
    body = {name: value for name, value in document.items() if name != "sweep"}
    for path, value in values.items():
        *parents, last = split_pointer(path)
        here: Any = body
        for part in parents:
            place: Any = int(part) if isinstance(here, list) else part
            child = here[place] if isinstance(here, list) else here.get(place)
            here[place] = {} if child is None else copy(child)
            here = here[place]
        if isinstance(here, list):
            here[int(last)] = value
        else:
            here[last] = [value] if path == "/datasets" and isinstance(value, str) else value
    return body


def get_value(document: Mapping[str, Any], path: str) -> Any:
    """The value of a field that is there."""
    here: Any = document
    for part in split_pointer(path):
        here = here[int(part)] if isinstance(here, list) else here[part]
    return here
