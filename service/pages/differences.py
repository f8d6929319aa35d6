"""Settings in which requests differ, for a comparison of their results."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from service.core.label_text import format_value
from sysid.core.text import DASH

UNLISTED = ("name", "note", "tags", "priority", "sweep", "trend", "seed")
"""Fields that say nothing about the identification; the seed is that of a draw."""


def list_differences(bodies: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """List the fields in which requests differ, each with the text of its value in each request.

    Examples
    --------
    >>> list_differences([{"skip": 0, "loss": {"kind": "squares"}}, {"skip": 3}])
    [('skip', ['0', '3']), ('loss.kind', ['squares', '–'])]
    """
    flat = [dict(_flatten(body)) for body in bodies]
    names = dict.fromkeys(name for fields in flat for name in fields)
    rows = ((name, [fields.get(name, DASH) for fields in flat]) for name in names)
    return [(name, texts) for name, texts in rows if len(set(texts)) > 1]


def _flatten(body: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Yield each field that has a value, by its path; a model stands for itself."""
    for key, value in body.items():
        path = f"{above}{key}"
        if not above and key in UNLISTED:
            continue
        if isinstance(value, Mapping) and "equations" not in value and path != "model":
            yield from _flatten(value, f"{path}.")
        elif value is not None and value != []:
            yield path, format_value(value)
