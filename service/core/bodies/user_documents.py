"""Read JSON and YAML documents of users: data only, with the position of every fault."""

import json
from math import isfinite
from typing import Any

from service.core.bodies.text_checks import find_json_fault
from service.core.errors import FieldError, InvalidRequest, TooLarge
from sysid.core.errors import InvalidModel
from sysid.models import document_reader

MAX_DOCUMENT_BYTES = 4 * 1024**2


def parse_yaml(text: bytes) -> Any:
    """Parse a YAML document; JSON is YAML too.

    Raises
    ------
    InvalidRequest
        If it is not YAML; the message names line and column.
    TooLarge
        If it is longer than 4 MiB.
    """
    _check_size(text)
    try:
        return _check_storable(document_reader.parse_yaml(text.decode("utf-8-sig")))
    except UnicodeDecodeError as error:
        raise InvalidRequest.from_fault(
            "", f"the document is not UTF-8 text: byte {error.start} is invalid"
        ) from None
    except InvalidModel as error:
        raise InvalidRequest(
            FieldError(fault.pointer, fault.detail) for fault in error.faults
        ) from None


def parse_json(text: bytes) -> Any:
    """Parse a JSON document.

    Raises
    ------
    InvalidRequest
        If it is not JSON; the message names line and column.
    TooLarge
        If it is longer than 4 MiB.
    """
    _check_size(text)
    try:
        document = json.loads(text, parse_constant=_refuse_constant)
    except json.JSONDecodeError as error:
        position = f"line {error.lineno}, column {error.colno}"
        raise InvalidRequest.from_fault(
            "", f"the body is not JSON: {position}: {error.msg}"
        ) from None
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InvalidRequest.from_fault("", f"the body is not JSON: {error}") from None
    return _check_storable(document)


def to_finite(value: float | None) -> float | None:
    """Return the number, or None if it is not finite: JSON has no such numbers."""
    return None if value is None or not isfinite(value) else float(value)


def _check_storable(document: Any) -> Any:
    """Check that a database can store every text; an escape may stand for an invalid character."""
    text = json.dumps(document, ensure_ascii=False, default=repr, skipkeys=True)
    fault = find_json_fault(text)
    if fault is not None:
        raise InvalidRequest.from_fault("", fault)
    return document


def _check_size(text: bytes) -> None:
    if len(text) > MAX_DOCUMENT_BYTES:
        raise TooLarge(
            f"the document has {len(text)} bytes; at most {MAX_DOCUMENT_BYTES} are allowed"
        )


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number")
