"""YAML text to plain data: YAML 1.2 numbers and truth values, no tags, no aliases, no surprises."""

import re
from typing import Any, NoReturn

import yaml

from sysid.errors import Fault, InvalidModel

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
