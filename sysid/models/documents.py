"""Reading a document field by field: what does not fit is noted with its place.

YAML text to plain data: YAML 1.2 numbers and truth values, no tags, no aliases, no surprises.
"""

import re
from collections.abc import Iterable, Mapping
from reprlib import Repr
from typing import Any, NoReturn

import yaml

from sysid.core.errors import Fault, InvalidModel, join_pointer, nearest

MAX_CHARACTERS = 262_144
_MAX_DEPTH = 20

_TRUTH = re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$")
_FLOAT = re.compile(
    r"^(?:[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
_INTEGER = re.compile(r"^[-+]?[0-9]{1,300}$")
_NULL = re.compile(r"^(?:~|null|Null|NULL|)$")


class _Loader(yaml.SafeLoader):
    """The safe loader without aliases (a small text could stand for a huge document).

    Its numbers are those of YAML 1.2: ``1e-3`` is a number, and ``on``, ``no`` and ``12:30`` are
    texts.
    """

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012
    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.events.AliasEvent):
            _refuse("aliases are not allowed; write the value again", event)
        if getattr(event, "tag", None) not in (None, "!"):
            _refuse(f"the tag {event.tag[:60]!r} is not allowed; write plain data", event)
        if self._depth >= _MAX_DEPTH:
            _refuse(f"nested deeper than {_MAX_DEPTH} levels", event)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key.value, str):
                if key.value in seen:
                    _refuse(f"{key.value!r} is given twice", key)
                seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


def _refuse(detail: str, where: Any) -> NoReturn:
    raise yaml.composer.ComposerError(None, None, detail, where.start_mark)


def _integer(loader: Any, node: Any) -> int:
    return int(loader.construct_scalar(node))  # 010 is ten, as in YAML 1.2


for _tag, _pattern, _first in (
    ("bool", _TRUTH, "tTfF"),
    ("int", _INTEGER, "-+0123456789"),
    ("float", _FLOAT, "-+0123456789."),
    ("null", _NULL, ["~", "n", "N", ""]),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", _pattern, list(_first))
_Loader.add_constructor("tag:yaml.org,2002:int", _integer)


def read_yaml(text: str) -> Any:
    """The data of a YAML text (JSON is YAML, too).

    Raises
    ------
    InvalidModel
        In one line, with the line and column where reading stopped.
    """
    if len(text) > MAX_CHARACTERS:
        detail = f"the document has {len(text)} characters; at most {MAX_CHARACTERS} are allowed"
        raise InvalidModel([Fault("", detail)])
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        raise InvalidModel([Fault("", _told(error))]) from None


def _told(error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None)
    problem = str(getattr(error, "problem", None) or getattr(error, "reason", "unreadable"))
    if problem.startswith("but "):
        problem = f"{getattr(error, 'context', '')}, {problem}"
    if "'\\t' that cannot start" in problem:
        problem += "; indent with spaces, not tabs"
    place = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "
    return f"the YAML cannot be read: {place}{' '.join(problem.split())}"


_SHORT = Repr()
_SHORT.maxlevel, _SHORT.maxdict, _SHORT.maxlist = 2, 3, 3
_SHORT.maxstring, _SHORT.maxother = 60, 60


def shown(value: object) -> str:
    """A value as messages quote it: short, whatever was sent."""
    return _SHORT.repr(value)


def _printable(text: str) -> str:
    """The text in one line: a name that was sent may hold anything."""
    return "".join(one if one.isprintable() else "�" for one in text)


class Reader:
    """Takes values from a document and keeps every fault. Each method gives a usable default."""

    def __init__(self) -> None:
        self._faults: list[Fault] = []

    def fault(self, place: str, detail: str, column: int | None = None) -> None:
        """Note something wrong."""
        self._faults.append(Fault(_printable(place), _printable(detail), column))

    def count(self) -> int:
        """Faults so far."""
        return len(self._faults)

    def finish(self) -> None:
        """Stop here if anything was wrong.

        Raises
        ------
        InvalidModel
            With every fault noted so far.
        """
        if self._faults:
            raise InvalidModel(self._faults)

    def section(
        self, value: object, place: str, known: Iterable[str] | None = None, most: int = 256
    ) -> dict[str, Any]:
        """A mapping of names; None is an empty one.

        Parameters
        ----------
        value : object
        place : str
            JSON pointer of the mapping.
        known : iterable of str or None
            Fields it may have; None: any name.
        most : int
            How many fields at most.
        """
        if value is None:
            return {}
        if not isinstance(value, Mapping):
            self.fault(place, f"{shown(value)} is not a mapping of names to values")
            return {}
        if len(value) > most:
            self.fault(place, f"has {len(value)} entries; at most {most} are allowed")
            return {}
        names = tuple(known) if known is not None else None
        fields: dict[str, Any] = {}
        for key, item in value.items():
            if not isinstance(key, str):
                # YAML takes {lower: 0,2} for lower: 0 and a key 2 without a value
                comma = item is None and isinstance(key, int) and not isinstance(key, bool)
                meant = f", or write 0.{key} where 0,{key} was meant" if comma else ""
                self.fault(place, f"the key {shown(key)} is not a text; put it in quotes{meant}")
            elif names is not None and key not in names:
                self.fault(place + join_pointer(key[:80]), f"unknown field{nearest(key, names)}")
            else:
                fields[key] = item
        return fields

    def required(self, fields: Mapping[str, Any], name: str, place: str, what: str) -> Any:
        """A field that must be there; None if it is not."""
        if fields.get(name) is None:
            self.fault(place + join_pointer(name), f"is missing; {what}")
        return fields.get(name)

    def number(self, value: object, place: str, default: float = 0.0) -> float:
        """A finite number."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fault(place, f"{shown(value)} is not a number")
            return default
        if not -1e300 < value < 1e300:
            self.fault(place, f"{shown(value)} is not a finite number")
            return default
        return float(value)

    def whole(self, value: object, place: str, low: int, high: int) -> int:
        """A whole number between two."""
        found = self.number(value, place, float(low)) if not isinstance(value, int) else value
        if isinstance(found, bool) or found != int(found) or not low <= found <= high:
            self.fault(place, f"{shown(value)} is not a whole number from {low} to {high}")
            return low
        return int(found)

    def text(self, value: object, place: str, default: str = "", most: int = 4000) -> str:
        """A text; None is the default."""
        if value is None:
            return default
        if not isinstance(value, str):
            self.fault(place, f"{shown(value)} is not a text")
            return default
        if len(value) > most:
            self.fault(place, f"has {len(value)} characters; at most {most} are allowed")
            return default
        return " ".join(value.split())

    def unit(self, value: object, place: str) -> str:
        """A unit symbol; ``1`` for none."""
        if value is None or (value == 1 and not isinstance(value, bool)):
            return "1"
        return self.text(value, place, "1", 40) or "1"

    def choice(self, value: object, options: tuple[str, ...], place: str) -> str:
        """One of some words; the first if it is none of them."""
        if isinstance(value, str) and value in options:
            return value
        quoted = ", ".join(repr(option) for option in options)
        hint = nearest(value, options) if isinstance(value, str) else ""
        hint = hint if hint.startswith("; did") else ""
        self.fault(place, f"{shown(value)} is not one of {quoted}{hint}")
        return options[0]

    def expression(self, value: object, place: str) -> str:
        """The text of an expression; a bare number is one, too."""
        if isinstance(value, int | float) and not isinstance(value, bool):
            return repr(self.number(value, place))
        if not isinstance(value, str):
            self.fault(place, f"{shown(value)} is not an expression; write a text such as 'a*x'")
            return "0"
        return value
