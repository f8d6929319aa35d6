"""Intermediate names of a document: ``let: {rate: k*exp(-E/(R*T))}``.

Each name stands for its expression, which replaces it. So equations, lags, units and exports see
no names. A name may occur in others, in any order, but not in its own expression.
"""

from collections.abc import Mapping
from dataclasses import replace

from sysid.core.errors import join_pointer
from sysid.language.checker import check_expression
from sysid.language.parser import tokenize_expression
from sysid.language.scope import Scope
from sysid.language.tree import Expression, Number
from sysid.models.document_reader import DocumentReader
from sysid.models.equations import add_faults

MAX_INTERMEDIATES = 256


def read_intermediates(
    reader: DocumentReader, value: object, scope: Scope
) -> dict[str, Expression]:
    """Read the intermediate names; one with faults is 0, so that its use is no other fault."""
    fields = reader.read_section(value, "/let", most=MAX_INTERMEDIATES)
    texts = {
        name: reader.read_expression(text, join_pointer("let", name))
        for name, text in fields.items()
    }
    needs = {name: _collect_names(text) & set(texts) for name, text in texts.items()}
    trees: dict[str, Expression] = {}
    while len(trees) < len(texts):
        ready = [name for name in texts if name not in trees and needs[name] <= set(trees)]
        if not ready:
            _add_circle(reader, {n: needs[n] - set(trees) for n in texts if n not in trees})
            return dict.fromkeys(texts, Number(0.0))
        for name in ready:
            checked = check_expression(texts[name], replace(scope, intermediates=trees))
            add_faults(reader, checked, join_pointer("let", name))
            trees[name] = checked.tree or Number(0.0)
    return trees


def _collect_names(text: str) -> set[str]:
    return {token.text for token in tokenize_expression(text)[0] if token.kind == "name"}


def _add_circle(reader: DocumentReader, needs: Mapping[str, set[str]]) -> None:
    """Add a fault that names a circle; every name needs another one."""
    path = [next(iter(needs))]
    while (name := min(needs[path[-1]])) not in path:
        path.append(name)
    circle = " → ".join((*path[path.index(name) :], name))
    reader.add_fault(
        join_pointer("let", name), f"the names need each other, {circle}; write one without them"
    )
