"""JSON text of documents, as both databases store it."""

import json

from service.core.bodies.text_checks import find_json_fault

_ENCODER = json.JSONEncoder(allow_nan=False, ensure_ascii=False, separators=(",", ":"))


def write_json(value: object) -> str:
    """Write a document as JSON text.

    Raises
    ------
    ValueError
        If it contains NaN, an infinite number, NUL or half of a surrogate pair.
    """
    try:
        text = _ENCODER.encode(value)
    except ValueError as error:
        raise ValueError(f"a document contains NaN or an infinite number: {error}") from error
    fault = find_json_fault(text)
    if fault is not None:
        raise ValueError(fault)
    return text
