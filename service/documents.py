"""Reading JSON and YAML that users write: data only, without aliases that grow without bound."""

import json
import re
from typing import Any

import yaml

from service.errors import InvalidRequest, TooLarge

MAX_DOCUMENT_BYTES = 4 * 1024**2

# YAML 1.1 takes `1e-3` for a text; whoever writes a bound means a number.
_FLOAT = re.compile(
    r"^[-+]?(?:[0-9][0-9_]*\.?[0-9_]*(?:[eE][-+]?[0-9]+)?|\.[0-9_]+(?:[eE][-+]?[0-9]+)?"
    r"|\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)


class _Loader(yaml.SafeLoader):
    """Plain YAML without aliases, without repeated keys, and with ``y`` and ``no`` as texts."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(problem="aliases are not read", problem_mark=mark)
        node: yaml.Node | None = super().compose_node(parent, index)
        if isinstance(node, yaml.MappingNode):
            _refuse_repeated_keys(node)
        return node


def _refuse_repeated_keys(node: yaml.MappingNode) -> None:
    seen: set[str] = set()
    for key, _ in node.value:
        if key.value in seen:
            problem = f"the key {key.value!r} is there twice"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
        seen.add(key.value)


def _resolvers() -> dict[str, list[tuple[str, re.Pattern[str]]]]:
    kept = {
        first: [(tag, rule) for tag, rule in rules if not tag.endswith((":bool", ":float"))]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    for first in "-+0123456789.":
        kept.setdefault(first, []).append(("tag:yaml.org,2002:float", _FLOAT))
    for first in "tTfF":  # `y`, `n`, `on`: names of signals, not truth values
        rule = re.compile("^(?:true|True|TRUE|false|False|FALSE)$")
        kept.setdefault(first, []).append(("tag:yaml.org,2002:bool", rule))
    return kept


_Loader.yaml_implicit_resolvers = _resolvers()


def read_yaml(text: str | bytes) -> Any:
    """What a YAML text says; JSON is YAML too.

    Raises
    ------
    InvalidRequest
        If it is not YAML; the message names line and column.
    TooLarge
        If it is longer than 4 MiB.
    """
    if len(text) > MAX_DOCUMENT_BYTES:
        raise TooLarge(f"the document has {len(text)} bytes; at most {MAX_DOCUMENT_BYTES}")
    try:
        return yaml.load(text, _Loader)  # a SafeLoader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise InvalidRequest.at("", f"not YAML: {place}{error.problem or error}") from None
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InvalidRequest.at("", f"not YAML: {str(error).splitlines()[0]}") from None


def read_json(text: bytes) -> Any:
    """What a JSON text says.

    Raises
    ------
    InvalidRequest
        If it is not JSON; the message names line and column.
    TooLarge
        If it is longer than 4 MiB.
    """
    if len(text) > MAX_DOCUMENT_BYTES:
        raise TooLarge(f"the document has {len(text)} bytes; at most {MAX_DOCUMENT_BYTES}")
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise InvalidRequest.at("", f"not JSON: {place}: {error.msg}") from None
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InvalidRequest.at("", f"not JSON: {error}") from None


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number")
