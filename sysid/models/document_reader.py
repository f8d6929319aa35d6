"""Reading of YAML documents, field by field; every fault is recorded with its pointer.

Numbers and truth values are those of YAML 1.2. Tags and aliases are not allowed.
"""

import re
from collections.abc import Iterable, Mapping
from reprlib import Repr
from typing import Any, NoReturn

import yaml

from sysid.core.errors import Fault, InvalidModel, join_pointer, suggest_name

MAX_DOCUMENT_CHARACTERS = 262_144
MAX_EXPRESSION_CHARACTERS = 100_000
"""Of all expressions of a model; reading them takes seconds."""
_MAX_DEPTH, _MAX_NODES = 20, 20_000

_BOOLEAN = re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$")
_FLOAT = re.compile(
    r"^(?:[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
_INTEGER = re.compile(r"^[-+]?[0-9]{1,300}$")
_FOREIGN_START = re.compile(r"character '(.)' that cannot start any token")
_NULL = re.compile(r"^(?:~|null|Null|NULL|)$")


class _YamlLoader(yaml.SafeLoader):
    """Safe YAML loader without aliases, by which a small text could expand to a huge document.

    Numbers are those of YAML 1.2: ``1e-3`` is a number; ``on``, ``no`` and ``12:30`` are texts.
    """

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012
    _depth = _nodes = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.events.AliasEvent):
            _reject_node("aliases are not allowed; write the value again", event)
        if getattr(event, "tag", None) not in (None, "!"):
            _reject_node(f"the tag {event.tag[:60]!r} is not allowed; write plain data", event)
        if self._depth >= _MAX_DEPTH:
            _reject_node(f"nested deeper than {_MAX_DEPTH} levels", event)
        self._nodes += 1
        if self._nodes > _MAX_NODES:  # each takes tens of microseconds
            _reject_node(f"more than {_MAX_NODES} names, values and lists", event)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key.value, str):
                if key.value in seen:
                    _reject_node(f"{key.value!r} is given twice", key)
                seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


def _reject_node(detail: str, where: Any) -> NoReturn:
    raise yaml.composer.ComposerError(None, None, detail, where.start_mark)


def _construct_integer(loader: Any, node: Any) -> int:
    return int(loader.construct_scalar(node))  # 010 is ten, as in YAML 1.2


for _tag, _pattern, _first in (
    ("bool", _BOOLEAN, "tTfF"),
    ("int", _INTEGER, "-+0123456789"),
    ("float", _FLOAT, "-+0123456789."),
    ("null", _NULL, ["~", "n", "N", ""]),
):
    _YamlLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", _pattern, list(_first))
_YamlLoader.add_constructor("tag:yaml.org,2002:int", _construct_integer)


def parse_yaml(text: str) -> Any:
    """Parse a YAML text (JSON is YAML, too).

    Raises
    ------
    InvalidModel
        If it cannot be read; the message has the line and column.
    """
    if len(text) > MAX_DOCUMENT_CHARACTERS:
        detail = (
            f"the document has {len(text)} characters; "
            f"at most {MAX_DOCUMENT_CHARACTERS} are allowed"
        )
        raise InvalidModel([Fault("", detail)])
    try:
        return yaml.load(text, Loader=_YamlLoader)
    except yaml.YAMLError as error:
        raise InvalidModel([Fault("", _describe_yaml_error(error))]) from None


def _describe_yaml_error(error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None)
    problem = str(getattr(error, "problem", None) or getattr(error, "reason", "unreadable"))
    if problem.startswith("but "):
        problem = f"{getattr(error, 'context', '')}, {problem}"
    if "'\\t' that cannot start" in problem:
        problem += "; indent with spaces, not tabs"
    elif "expected ',' or '" in problem:
        problem += "; put an expression with commas or brackets in quotes"
    elif match := _FOREIGN_START.search(problem):
        problem = f"a text cannot begin with {match[1]}; put it in quotes, such as '{match[1]}'"
    position = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "
    return f"the YAML cannot be read: {position}{' '.join(problem.split())}"


_SHORT_REPR = Repr()
_SHORT_REPR.maxlevel, _SHORT_REPR.maxdict, _SHORT_REPR.maxlist = 2, 3, 3
_SHORT_REPR.maxstring, _SHORT_REPR.maxother = 60, 60


def quote_value(value: object) -> str:
    """Quote a value for a message, shortened if it is long."""
    return _SHORT_REPR.repr(value)


def _replace_unprintable(text: str) -> str:
    """Replace unprintable characters, such as line breaks in a name."""
    return "".join(letter if letter.isprintable() else "�" for letter in text)


class DocumentReader:
    """Reader of a document that records every fault; each method returns a usable default."""

    def __init__(self) -> None:
        self._faults: list[Fault] = []
        self._expression_characters = 0

    def add_fault(self, pointer: str, detail: str, column: int | None = None) -> None:
        """Record a fault; `pointer` is where it is."""
        self._faults.append(
            Fault(_replace_unprintable(pointer), _replace_unprintable(detail), column)
        )

    def count_faults(self) -> int:
        """Return the number of faults so far."""
        return len(self._faults)

    def raise_faults(self) -> None:
        """Raise if there are faults.

        Raises
        ------
        InvalidModel
            With every fault so far.
        """
        if self._faults:
            raise InvalidModel(self._faults)

    def read_section(
        self, value: object, pointer: str, allowed: Iterable[str] | None = None, most: int = 256
    ) -> dict[str, Any]:
        """Read a mapping of names to values; None is an empty one.

        Parameters
        ----------
        value : object
        pointer : str
            JSON pointer of the mapping.
        allowed : iterable of str or None
            Fields that it may have; None: any name.
        most : int
            Largest number of fields.
        """
        if value is None:
            return {}
        if not isinstance(value, Mapping):
            self.add_fault(pointer, f"{quote_value(value)} is not a mapping of names to values")
            return {}
        if len(value) > most:
            self.add_fault(pointer, f"has {len(value)} entries; at most {most} are allowed")
            return {}
        names = tuple(allowed) if allowed is not None else None
        fields: dict[str, Any] = {}
        for key, item in value.items():
            if not isinstance(key, str):
                # YAML reads {lower: 0,2} as lower: 0 and a key 2 without a value
                comma = item is None and isinstance(key, int) and not isinstance(key, bool)
                meant = f", or write 0.{key} where 0,{key} was meant" if comma else ""
                self.add_fault(
                    pointer, f"the key {quote_value(key)} is not a text; put it in quotes{meant}"
                )
            elif item is None and key.count(")") > key.count("("):
                # YAML reads {x: max(a, b)} as x: max(a and a key b) without a value
                self.add_fault(
                    pointer,
                    f"the comma before {quote_value(key)} ends a value in braces; "
                    "put the expression in quotes, such as {x: 'max(a, b)'}",
                )
            elif names is not None and key not in names:
                self.add_fault(
                    pointer + join_pointer(key[:80]), f"unknown field{suggest_name(key, names)}"
                )
            else:
                fields[key] = item
        return fields

    def require_field(self, fields: Mapping[str, Any], name: str, pointer: str, what: str) -> Any:
        """Return a required field; None, with a fault, if it is missing."""
        if fields.get(name) is None:
            self.add_fault(pointer + join_pointer(name), f"is missing; {what}")
        return fields.get(name)

    def read_number(self, value: object, pointer: str, default: float = 0.0) -> float:
        """Read a finite number."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.add_fault(pointer, f"{quote_value(value)} is not a number")
            return default
        if not -1e300 < value < 1e300:
            self.add_fault(pointer, f"{quote_value(value)} is not a finite number")
            return default
        return float(value)

    def read_whole_number(self, value: object, pointer: str, low: int, high: int) -> int:
        """Read a whole number from `low` to `high`."""
        number = (
            self.read_number(value, pointer, float(low)) if not isinstance(value, int) else value
        )
        if isinstance(number, bool) or number != int(number) or not low <= number <= high:
            self.add_fault(
                pointer, f"{quote_value(value)} is not a whole number from {low} to {high}"
            )
            return low
        return int(number)

    def read_text(self, value: object, pointer: str, default: str = "", most: int = 4000) -> str:
        """Read a text of at most `most` characters; None is the default."""
        if value is None:
            return default
        if not isinstance(value, str):
            self.add_fault(pointer, f"{quote_value(value)} is not a text")
            return default
        if len(value) > most:
            self.add_fault(pointer, f"has {len(value)} characters; at most {most} are allowed")
            return default
        return " ".join(value.split())

    def read_unit(self, value: object, pointer: str) -> str:
        """Read a unit symbol; ``1`` for none."""
        if value is None or (value == 1 and not isinstance(value, bool)):
            return "1"
        return self.read_text(value, pointer, "1", 40) or "1"

    def read_choice(self, value: object, options: tuple[str, ...], pointer: str) -> str:
        """Read one of some words; the first, with a fault, if it is none of them."""
        if isinstance(value, str) and value in options:
            return value
        quoted = ", ".join(repr(option) for option in options)
        hint = suggest_name(value, options) if isinstance(value, str) else ""
        hint = hint if hint.startswith("; did") else ""
        self.add_fault(pointer, f"{quote_value(value)} is not one of {quoted}{hint}")
        return options[0]

    def read_expression(self, value: object, pointer: str) -> str:
        """Read the text of an expression; a bare number is one, too.

        Beyond `MAX_EXPRESSION_CHARACTERS` of the whole document, texts count as 0.
        """
        if isinstance(value, int | float) and not isinstance(value, bool):
            return repr(self.read_number(value, pointer))
        if not isinstance(value, str):
            self.add_fault(
                pointer, f"{quote_value(value)} is not an expression; write a text such as 'a*x'"
            )
            return "0"
        before = self._expression_characters
        self._expression_characters += len(value)
        if self._expression_characters <= MAX_EXPRESSION_CHARACTERS:
            return value
        if before <= MAX_EXPRESSION_CHARACTERS:
            self.add_fault(
                pointer,
                "from here on, the expressions of the model have more than "
                f"{MAX_EXPRESSION_CHARACTERS} characters together; write fewer or shorter ones",
            )
        return "0"
