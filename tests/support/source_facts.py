"""What the rules of the house need to know of a module, from one look at its syntax tree.

The trees themselves are not held: they are half a million objects, which every later collection
of garbage would visit.
"""

import ast
import re
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from tests.support.checkout import ROOT


class NamedLine(NamedTuple):
    """A name that a line defines, or a text that it holds."""

    text: str
    line: int


class ModuleFacts(NamedTuple):
    """Functions and classes of a module, and its texts that a person may read.

    Properties and fixtures are values, and no functions.
    """

    functions: tuple[NamedLine, ...]
    values: tuple[NamedLine, ...]
    classes: tuple[NamedLine, ...]
    messages: tuple[NamedLine, ...]


def list_modules(parts: Iterable[str]) -> list[Path]:
    """List the Python files of some folders of the checkout."""
    return [path for part in parts for path in sorted((ROOT / part).rglob("*.py"))]


@cache
def read_facts(path: Path) -> ModuleFacts:
    """Parse a module, once for all rules."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    functions = [node for node in nodes if isinstance(node, kinds)]
    return ModuleFacts(
        tuple(NamedLine(node.name, node.lineno) for node in functions if not _is_value(node)),
        tuple(NamedLine(node.name, node.lineno) for node in functions if _is_value(node)),
        tuple(
            NamedLine(node.name, node.lineno) for node in nodes if isinstance(node, ast.ClassDef)
        ),
        tuple(_find_messages(nodes)),
    )


def _is_value(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    marks = {ast.unparse(mark).partition("(")[0] for mark in node.decorator_list}
    return not marks.isdisjoint(("property", "cached_property", "pytest.fixture"))


def _find_messages(nodes: Sequence[ast.AST]) -> Iterator[NamedLine]:
    """A value that is filled in counts as a word; docstrings are no messages."""
    skipped: set[ast.AST] = {node.value for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            skipped |= {inner for inner in ast.walk(node) if inner is not node}
    for node in nodes:
        if isinstance(node, ast.Constant | ast.JoinedStr) and node not in skipped:
            text = _read_text(node)
            if _is_prose(text):
                yield NamedLine(text, node.lineno)


def _read_text(node: ast.Constant | ast.JoinedStr) -> str:
    if isinstance(node, ast.JoinedStr):
        return "".join(
            str(part.value) if isinstance(part, ast.Constant) else "X" for part in node.values
        )
    return node.value if isinstance(node.value, str) else ""


def _is_prose(text: str) -> bool:
    """Whether it is a line of words, and no code, markup or SQL."""
    return (
        len(text.split()) >= 6
        and "\n" not in text
        and re.search(r"[a-z]{3} [a-z]{2}", text) is not None
        and re.search(r"<\w+|SELECT |UPDATE |INSERT |CREATE |\{%|= %|; ModuleID", text) is None
    )
