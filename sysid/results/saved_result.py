"""Save a result as JSON and read it again, with every number the same.

The document has the fields of `Identification`, by their names. A number that is not finite is a
text, because JSON has none. A model is its document. What a document has is checked field by field
against the declared types, so that a damaged file is told by the place of its fault.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from datetime import datetime
from functools import cache
from os import PathLike
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from sysid.core.errors import (
    InvalidModel,
    InvalidRecord,
    UnreadableResult,
    UnwritableFile,
    join_pointer,
)
from sysid.core.files import write_whole
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.results.result import Identification

FORMAT = "lagid-identification/1"
_NOT_FINITE = {"nan": float("nan"), "inf": float("inf"), "-inf": float("-inf")}
_OTHER_FORMATS = {
    "lagid-model/1": "it is an exported model; read it with load_identified",
}


def write_result(found: Identification, path: str | PathLike[str]) -> None:
    """Write a result to a JSON file.

    Raises
    ------
    UnwritableFile
        If the file cannot be written; what was there before is whole.
    """
    document = {"format": FORMAT, **_encode(found)}
    text = json.dumps(document, ensure_ascii=False, allow_nan=False) + "\n"
    try:
        write_whole(Path(path), text)
    except OSError as error:
        raise UnwritableFile(path, error.strerror or str(error)) from None


def read_result(path: str | PathLike[str]) -> Identification:
    """Read a result from a file that `write_result` wrote.

    Raises
    ------
    UnreadableResult
        If the file cannot be read, or is something else; the message names the field.
    """
    document = read_json(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise UnreadableResult(path, _describe_other_document(document))
    try:
        found = _decode(Identification, {k: v for k, v in document.items() if k != "format"}, "")
    except (_Misfit, InvalidModel, InvalidRecord) as error:
        raise UnreadableResult(path, str(error)) from None
    assert isinstance(found, Identification)
    return found


def have_same_content(first: Identification, second: Identification) -> bool:
    """Test whether two results would be saved as the same document."""
    return bool(_encode(first) == _encode(second))


def read_json(path: str | PathLike[str]) -> Any:
    """Read a JSON file.

    Raises
    ------
    UnreadableResult
        If it cannot be read, or is not JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise UnreadableResult(path, f"it cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise UnreadableResult(path, f"it is not JSON: {error}") from None


def _describe_other_document(document: Any) -> str:
    if not isinstance(document, dict):
        return f"found no object; need a document of format {FORMAT!r}"
    name = document.get("format")
    if name is None and "parameters" in document and "fit_percent" in document:
        return "it is the document of a run, which has no signals. Save the result itself"
    hint = _OTHER_FORMATS.get(str(name), f"need {FORMAT!r}, which Identification.save writes")
    return f"its format is {name!r}; {hint}"


class _Misfit(Exception):
    """A value of a document does not fit its field."""

    def __init__(self, pointer: str, value: object, need: str) -> None:
        text = repr(value)
        shown = text if len(text) <= 60 else f"{text[:57]}…"
        super().__init__(f"{pointer or '/'}: found {shown}; need {need}")


def _encode(value: Any) -> Any:
    if isinstance(value, Model):
        return dict(value.document)
    if isinstance(value, np.ndarray):
        return {"shape": value.shape} if value.size == 0 else _encode(value.tolist())
    if is_dataclass(value) or hasattr(value, "_fields"):
        return {name: _encode(getattr(value, name)) for name in _list_fields(value.__class__)}
    if isinstance(value, Mapping):
        return {str(key): _encode(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_encode(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return "nan" if np.isnan(value) else "inf" if value > 0 else "-inf"
    if isinstance(value, datetime):
        return value.isoformat()
    return value.item() if isinstance(value, np.generic) else value


@cache
def _list_fields(kind: type) -> dict[str, bool]:
    """List the fields of a class, and whether each must be there."""
    if is_dataclass(kind):
        return {
            field.name: field.default is MISSING and field.default_factory is MISSING
            for field in fields(kind)
            if field.init
        }
    names: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]
    defaults: Mapping[str, object] = kind._field_defaults  # type: ignore[attr-defined]
    return {name: name not in defaults for name in names}


@cache
def _list_hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _decode(hint: Any, value: Any, pointer: str) -> Any:
    """Convert a value of a document to a declared type."""
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return _decode_optional(hint, value, pointer)
    if origin is Literal:
        return _require(value in get_args(hint), value, pointer, _join(get_args(hint)))
    if origin is np.ndarray:
        return _decode_array(value, pointer)
    if origin is tuple:
        return _decode_tuple(get_args(hint), value, pointer)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        _require(isinstance(value, dict), value, pointer, "an object")
        part = get_args(hint)[1]
        return {k: _decode(part, item, pointer + join_pointer(k)) for k, item in value.items()}
    if hint is Model:
        return parse_model(value)
    if is_dataclass(hint) or hasattr(hint, "_fields"):
        return _decode_fields(hint, value, pointer)
    return _decode_scalar(hint, value, pointer)


def _decode_optional(hint: Any, value: Any, pointer: str) -> Any:
    kinds = [kind for kind in get_args(hint) if kind is not NoneType]
    if value is None and len(kinds) < len(get_args(hint)):
        return None
    return _decode(kinds[0], value, pointer)


def _decode_fields(kind: Any, value: Any, pointer: str) -> Any:
    _require(isinstance(value, dict), value, pointer, "an object")
    known = _list_fields(kind)
    for name in value:
        _require(name in known, name, pointer, f"one of the fields {', '.join(known)}")
    for name, is_required in known.items():
        _require(name in value or not is_required, None, f"{pointer}/{name}", "this field")
    hints = _list_hints(kind)
    return kind(
        **{
            name: _decode(hints[name], item, pointer + join_pointer(name))
            for name, item in value.items()
        }
    )


def _decode_tuple(kinds: tuple[Any, ...], value: Any, pointer: str) -> tuple[Any, ...]:
    _require(isinstance(value, list), value, pointer, "a list")
    if kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    _require(len(value) == len(kinds), value, pointer, f"{len(kinds)} entries")
    return tuple(
        _decode(kind, item, pointer + join_pointer(number))
        for number, (kind, item) in enumerate(zip(kinds, value, strict=True))
    )


def _decode_array(value: Any, pointer: str) -> Any:
    if isinstance(value, dict):
        shape = value.get("shape")
        is_shape = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
        _require(is_shape and 0 in shape, value, pointer, "the shape of an empty array")  # type: ignore[operator]
        return np.zeros(tuple(shape))  # type: ignore[arg-type]
    _require(isinstance(value, list), value, pointer, "a list of numbers")
    try:
        return np.array(value, dtype=np.float64)  # "nan" and "inf" are numbers here too
    except (TypeError, ValueError):
        raise _Misfit(pointer, value, "a list of numbers") from None


def _decode_scalar(hint: Any, value: Any, pointer: str) -> Any:
    if hint is float:
        if isinstance(value, str) and value in _NOT_FINITE:
            return _NOT_FINITE[value]
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return float(_require(is_number, value, pointer, "a number"))
    if hint is datetime:
        return _decode_moment(value, pointer)
    if hint is int:
        return _require(type(value) is int, value, pointer, "a whole number")
    names = {str: "a text", bool: "true or false"}
    return _require(type(value) is hint, value, pointer, names.get(hint, str(hint)))


def _decode_moment(value: Any, pointer: str) -> datetime:
    try:
        return datetime.fromisoformat(value)
    except (TypeError, ValueError):
        raise _Misfit(pointer, value, "a date such as 2026-01-31T12:00:00") from None


def _require(holds: bool, value: Any, pointer: str, need: str) -> Any:
    if not holds:
        raise _Misfit(pointer, value, need)
    return value


def _join(names: Sequence[object]) -> str:
    return f"one of {', '.join(map(str, names))}"
