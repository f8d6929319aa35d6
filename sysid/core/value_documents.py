"""Write values as JSON documents, and read them again: the one encoding of dataclasses.

A frozen dataclass, or a named tuple, *is* its document: an object with its fields, by their names.
Tuples are lists, arrays are lists of rows. JSON has no number that is not finite. There are two
ways with it:

plain
    It is null, as the REST interface sends it and as runs are stored. A field may say with how many
    digits its numbers are written: ``field(metadata={"digits": 8})``.
exact
    It is a text such as ``"nan"``. All digits are written, so the value that is read is equal to
    the one that was written.

What is read is checked field by field against the declared types, so that a damaged document is
told by the place of its fault. Of an array the entries are checked, not the shape.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields, is_dataclass
from datetime import datetime
from functools import cache
from math import isfinite, isnan, nan
from operator import attrgetter
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

from sysid.core.errors import join_pointer
from sysid.core.types import FloatArray

Value = TypeVar("Value")
Writers = Mapping[type, Callable[[Any], Any]]
Readers = Mapping[type, Callable[[Any], Any]]

_PLAIN = frozenset({NoneType, str, int, bool})
_NUMBERS = frozenset({float, int})
_LARGE = 100  # numbers of an array: NumPy finds those that are not finite in less time than Python
_NOT_FINITE = {"nan": nan, "inf": float("inf"), "-inf": float("-inf")}


class Misfit(Exception):
    """A value of a document does not fit its field; the message begins with its JSON pointer."""

    def __init__(self, value: object, need: str) -> None:
        self._pointer = ""
        text = repr(value)
        self._fault = f"found {text if len(text) <= 60 else f'{text[:57]}…'}; need {need}"
        super().__init__()

    def __str__(self) -> str:
        return f"{self._pointer or '/'}: {self._fault}"

    def move_below(self, name: str | int) -> "Misfit":
        """Say that the value is below a field, or an entry of a list."""
        self._pointer = join_pointer(name) + self._pointer
        return self


@dataclass(frozen=True, slots=True)
class FieldOfDocument:
    """One field of a document: its name, its type, whether it must be there, and its digits."""

    name: str
    hint: Any
    is_required: bool
    digits: int | None = None


def encode(value: object, kind: type | None = None) -> Any:
    """Write a value as its plain document.

    Parameters
    ----------
    kind : type
        Class whose fields are written, if it is a base of the value's own class.

    Examples
    --------
    >>> encode({"ends": (0.5, float("inf"))})
    {'ends': [0.5, None]}
    """
    return _PLAIN_ENCODERS[kind or value.__class__](value)


def encode_exactly(value: object, writers: Writers | None = None) -> Any:
    """Write a value as its exact document; `writers` write the values of other classes.

    Examples
    --------
    >>> encode_exactly({"ends": (0.5, float("inf"))})
    {'ends': [0.5, 'inf']}
    """
    return _Encoders(writers or {}, is_exact=True)[value.__class__](value)


def decode(kind: type[Value], document: object) -> Value:
    """Read a value of a class from its plain document.

    Null stands for a number that is not finite: ``nan`` where the field cannot be None.

    Raises
    ------
    Misfit
        If the document does not fit the class.
    """
    return cast("Value", _PLAIN_READERS[kind](document))


def decode_exactly(kind: type[Value], document: object, readers: Readers | None = None) -> Value:
    """Read a value of a class from its exact document; `readers` read values of other classes.

    Raises
    ------
    Misfit
        If the document does not fit the class.
    """
    return cast("Value", _Readers(readers or {}, is_exact=True)[kind](document))


@cache
def list_fields(kind: type) -> tuple[FieldOfDocument, ...]:
    """List the fields of a dataclass or named tuple, in their order."""
    hints = get_type_hints(kind)
    if is_dataclass(kind):
        return tuple(
            FieldOfDocument(
                field.name,
                hints[field.name],
                field.default is MISSING and field.default_factory is MISSING,
                field.metadata.get("digits"),
            )
            for field in fields(kind)
            if field.init
        )
    defaults: Mapping[str, object] = kind._field_defaults  # type: ignore[attr-defined]
    names: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]
    return tuple(FieldOfDocument(name, hints[name], name not in defaults) for name in names)


def has_fields(kind: object) -> bool:
    """Whether a class is a dataclass or a named tuple."""
    return is_dataclass(kind) or hasattr(kind, "_fields")


class _Encoders(dict[type, Callable[[Any], Any]]):
    """What encodes the values of each class, made once: to plain documents or to exact ones.

    Parameters
    ----------
    others : mapping of type to callable
        Encoders of other classes.
    """

    def __init__(self, others: Writers, *, is_exact: bool) -> None:
        encode_items, encode_entries = self._encode_items, self._encode_entries
        super().__init__(
            {
                float: _encode_exact_number if is_exact else _encode_number,
                tuple: encode_items,
                list: encode_items,
                dict: encode_entries,
                np.ndarray: self._encode_exact_array if is_exact else self._encode_array,
                datetime: datetime.isoformat,
                **dict.fromkeys(_PLAIN, _return_unchanged),
                **others,
            }
        )
        self._is_exact = is_exact

    def __missing__(self, kind: type) -> Callable[[Any], Any]:
        encode_value = self[kind] = self._make_encoder(kind)
        return encode_value

    def _make_encoder(self, kind: type) -> Callable[[Any], Any]:
        if has_fields(kind):
            return self._make_field_encoder(kind)
        if issubclass(kind, Mapping):
            return self._encode_entries
        if issubclass(kind, np.generic):
            return lambda value: self._encode_items([value.item()])[0]
        raise TypeError(f"a document has no {kind.__name__}")

    def _make_field_encoder(self, kind: type) -> Callable[[Any], Any]:
        """Make what encodes a class.

        For speed plain documents take texts and whole numbers as they are, without a look.
        """
        listed = list_fields(kind)
        names = tuple(field.name for field in listed)
        numbers = [field.name for field in listed if _is_number(field.hint)]
        others = [name for name in names if name not in numbers]
        digits: dict[str, int] = {}
        if not self._is_exact:
            others = [f.name for f in listed if f.name in others and not _is_plain(f.hint)]
            digits = {f.name: f.digits for f in listed if f.digits}
        get = attrgetter(*names) if len(names) > 1 else lambda value: (getattr(value, names[0]),)

        def encode_fields(value: object) -> dict[str, Any]:
            document = dict(zip(names, get(value), strict=True))
            for name in numbers:
                item = document[name]
                if item is not None and not (item.__class__ is float and isfinite(item)):
                    document[name] = self[item.__class__](item)
            for name in others:
                item = document[name]
                if item is not None:
                    document[name] = self[item.__class__](item)
            for name, count in digits.items():
                document[name] = _round(document[name], count)
            return document

        return encode_fields

    def _encode_items(self, value: Sequence[Any]) -> list[Any]:
        return [item if (part := item.__class__) in _PLAIN else self[part](item) for item in value]

    def _encode_entries(self, value: Mapping[str, Any]) -> dict[str, Any]:
        return {str(name): self[item.__class__](item) for name, item in value.items()}

    def _encode_array(self, value: FloatArray) -> list[Any]:
        rows: list[Any] = value.tolist()
        is_large = value.size > _LARGE
        return rows if is_large and np.isfinite(value).all() else self._encode_items(rows)

    def _encode_exact_array(self, value: FloatArray) -> Any:
        if value.size == 0:
            return {"shape": list(value.shape)}
        return self._encode_items(value.tolist())


def _is_plain(hint: Any) -> bool:
    """Whether all values of a declared type are documents themselves."""
    if get_origin(hint) in (Union, UnionType):
        return all(map(_is_plain, get_args(hint)))
    return hint in _PLAIN or get_origin(hint) is Literal


def _is_number(hint: Any) -> bool:
    return hint is float or hint == float | None


def _return_unchanged(value: Any) -> Any:
    return value


def _encode_number(value: float) -> float | None:
    return value if isfinite(value) else None


def _encode_exact_number(value: float) -> float | str:
    if isfinite(value):
        return value
    return "nan" if isnan(value) else "inf" if value > 0 else "-inf"


def _round(value: Any, digits: int) -> Any:
    if isinstance(value, list):
        return [_round(item, digits) for item in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


_PLAIN_ENCODERS = _Encoders({}, is_exact=False)


class _Readers(dict[Any, Callable[[Any], Any]]):
    """What reads the values of each declared type, made once: from plain documents or exact ones.

    Parameters
    ----------
    others : mapping of type to callable
        Readers of other classes.
    """

    def __init__(self, others: Readers, *, is_exact: bool) -> None:
        super().__init__(others)
        self._is_exact = is_exact

    def __missing__(self, hint: Any) -> Callable[[Any], Any]:
        read = self[hint] = self._make_reader(hint)
        return read

    def _make_reader(self, hint: Any) -> Callable[[Any], Any]:
        origin = get_origin(hint)
        if origin in (Union, UnionType):
            return self._make_optional_reader(get_args(hint))
        if origin is Literal:
            return _make_choice_reader(get_args(hint))
        if origin is np.ndarray:
            return _read_exact_array if self._is_exact else _read_array
        if origin is tuple:
            return self._make_tuple_reader(get_args(hint))
        if isinstance(origin, type) and issubclass(origin, Mapping):
            return self._make_mapping_reader(get_args(hint)[1])
        if has_fields(hint):
            return self._make_field_reader(hint)
        if hint is float:
            return _read_exact_number if self._is_exact else _read_number
        return _read_moment if hint is datetime else _make_scalar_reader(hint)

    def _make_optional_reader(self, kinds: tuple[Any, ...]) -> Callable[[Any], Any]:
        read = self[next(kind for kind in kinds if kind is not NoneType)]
        return lambda value: None if value is None else read(value)

    def _make_mapping_reader(self, kind: Any) -> Callable[[Any], Any]:
        read = self[kind]
        return lambda value: dict(_read_entries(value, lambda _: read))

    def _make_field_reader(self, kind: Any) -> Callable[[Any], Any]:
        known = {field.name: self[field.hint] for field in list_fields(kind)}
        required = frozenset(field.name for field in list_fields(kind) if field.is_required)
        need = f"one of the fields {', '.join(known)}"

        def read_value(document: Any) -> Any:
            values = dict(_read_entries(document, known.get, need))
            if not required <= values.keys():
                missing = next(name for name in known if name in required - values.keys())
                raise Misfit(None, "this field").move_below(missing)
            return kind(**values)

        return read_value

    def _make_tuple_reader(self, kinds: tuple[Any, ...]) -> Callable[[Any], Any]:
        reads = [self[kind] for kind in kinds if kind is not Ellipsis]
        count = None if kinds[-1] is Ellipsis else len(kinds)
        return lambda value: tuple(_read_items(value, reads, count))


def _read_entries(
    document: Any, find_reader: Callable[[str], Callable[[Any], Any] | None], need: str = ""
) -> Iterator[tuple[str, Any]]:
    if document.__class__ is not dict:
        raise Misfit(document, "an object")
    for name, item in document.items():
        read = find_reader(name)
        if read is None:
            raise Misfit(name, need)
        try:
            yield name, read(item)
        except Misfit as misfit:
            raise misfit.move_below(name) from None


def _read_items(
    value: Any, reads: Sequence[Callable[[Any], Any]], count: int | None
) -> Iterator[Any]:
    if value.__class__ is not list:
        raise Misfit(value, "a list")
    if count is not None and len(value) != count:
        raise Misfit(value, f"{count} entries")
    for number, item in enumerate(value):
        try:
            yield reads[0 if count is None else number](item)
        except Misfit as misfit:
            raise misfit.move_below(number) from None


def _make_choice_reader(choices: tuple[Any, ...]) -> Callable[[Any], Any]:
    def read_choice(value: Any) -> Any:
        if value not in choices:
            raise Misfit(value, f"one of {', '.join(map(str, choices))}")
        return value

    return read_choice


def _make_scalar_reader(kind: type) -> Callable[[Any], Any]:
    need = {str: "a text", bool: "true or false", int: "a whole number"}.get(kind, str(kind))

    def read_scalar(value: Any) -> Any:
        if value.__class__ is not kind:
            raise Misfit(value, need)
        return value

    return read_scalar


def _read_number(value: Any) -> float:
    if value.__class__ is float:
        return value
    if value is None:
        return nan
    if value.__class__ is int:
        with suppress(OverflowError):  # JSON has whole numbers of any size
            return float(value)
    raise Misfit(value, "a number")


def _read_exact_number(value: Any) -> float:
    if value.__class__ is str and value in _NOT_FINITE:
        return _NOT_FINITE[value]
    if value is None:
        raise Misfit(value, "a number")
    return _read_number(value)


def _read_array(value: Any, others: tuple[Any, ...] = (None,)) -> FloatArray:
    """Read rows of numbers, and of others that NumPy takes for numbers."""
    with suppress(TypeError, ValueError, OverflowError):
        array = np.array(value, dtype=np.float64)
        if isinstance(value, list) and _has_only_numbers(value, others):
            return array
    raise Misfit(value, "a list of numbers")


def _has_only_numbers(items: list[Any], others: tuple[Any, ...]) -> bool:
    return {*map(type, items)} <= _NUMBERS or all(
        _has_only_numbers(item, others)
        if isinstance(item, list)
        else type(item) in _NUMBERS or item in others
        for item in items
    )


def _read_exact_array(value: Any) -> FloatArray:
    if not isinstance(value, dict):
        return _read_array(value, tuple(_NOT_FINITE))
    shape = value.get("shape")
    is_shape = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    if is_shape and 0 in shape:  # type: ignore[operator]
        with suppress(ValueError, OverflowError):  # too many axes, or too long ones
            return np.zeros(tuple(shape))  # type: ignore[arg-type]
    raise Misfit(value, "the shape of an empty array")


def _read_moment(value: Any) -> datetime:
    try:
        return datetime.fromisoformat(value)
    except (TypeError, ValueError):
        raise Misfit(value, "a date such as 2026-01-31T12:00:00") from None


_PLAIN_READERS = _Readers({}, is_exact=False)
