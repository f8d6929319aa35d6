"""Equations and outputs of a document: their trees, order of computation and memory."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from sysid.core.errors import join_pointer, suggest_name
from sysid.language.checker import MAX_NODES, CheckedExpression, check_expression
from sysid.language.delays import collect_past_values
from sysid.language.scope import Scope
from sysid.language.tree import Expression, Number, PastValue, walk
from sysid.language.value_intervals import bound_expression
from sysid.models.document_reader import DocumentReader
from sysid.models.model import ModelSignal, Output
from sysid.models.sections import MAX_EQUATIONS

_ZERO = Number(0.0)
_DERIVATIVE = re.compile(r"d(\w+?)(?:/dt)?|der\((\w+)\)|(\w+?)(?:['’]+|_dot|\([tk]\))")


class OutputText(NamedTuple):
    """Text and unit of an output as written."""

    expression: str
    unit: str | None


def read_equations(
    reader: DocumentReader, value: object, scope: Scope
) -> tuple[dict[str, str], tuple[Expression, ...]]:
    """Read the equations: their texts, and one tree for each state, in the states' order."""
    fields = reader.read_section(value, "/equations", most=MAX_EQUATIONS)
    for name in fields:
        if name not in scope.states:
            detail = f"there is no such state{suggest_name(name, scope.states)}"
            if (state := _find_derived_state(name)) in scope.states:
                detail = f"an equation has the name of its state: write {state}: …, which is "
                detail += "x(k)" if scope.form == "difference" else f"d{state}/dt"
            reader.add_fault(join_pointer("equations", name), detail)
    texts, trees = {}, []
    for state in scope.states:
        pointer = join_pointer("equations", state)
        if fields.get(state) is None:
            reader.add_fault(
                pointer, f"is missing; every state needs its equation, {_describe_form(scope)}"
            )
            continue
        texts[state] = reader.read_expression(fields[state], pointer)
        checked = check_expression(texts[state], scope)
        add_faults(reader, checked, pointer)
        _check_own_present(reader, checked, state, scope)
        trees.append(checked.tree or _ZERO)
    return texts, tuple(trees)


def _find_derived_state(name: str) -> str | None:
    """Find the state whose derivative or present value a name of an equation means."""
    match = _DERIVATIVE.fullmatch(name)
    return next(filter(None, match.groups()), None) if match else None


def add_faults(reader: DocumentReader, checked: CheckedExpression, pointer: str) -> None:
    """Add the faults of an expression to the reader."""
    for column, detail in checked.faults:
        reader.add_fault(pointer, detail, column)


def read_outputs(
    reader: DocumentReader, value: object, scope: Scope, states: Sequence[ModelSignal]
) -> tuple[tuple[str, ...], tuple[Output, ...]]:
    """Read the outputs and their texts; an output that is just a state has the state's unit."""
    fields = reader.read_section(value, "/outputs", most=MAX_EQUATIONS)
    if not fields:
        reader.add_fault("/outputs", "is missing; name the measured channel, such as {y: x}")
    units = {state.name: state.unit for state in states}
    texts, outputs = [], []
    for name, entry in fields.items():
        entry_pointer = join_pointer("outputs", name)
        written = _read_output_text(reader, entry, entry_pointer)
        part = "/expression" if isinstance(entry, Mapping) else ""
        pointer = entry_pointer + part
        checked = check_expression(written.expression, scope)
        add_faults(reader, checked, pointer)
        tree = checked.tree or _ZERO
        state_unit = units.get(tree.name) if isinstance(tree, PastValue) else None
        texts.append(written.expression)
        outputs.append(Output(name, tree, written.unit or state_unit or "1"))
    return tuple(texts), tuple(outputs)


def check_size(reader: DocumentReader, trees: Iterable[Expression], pointer: str) -> None:
    """Add a fault if the trees of a model have more nodes together than are compiled."""
    nodes = sum(1 for tree in trees for _ in walk(tree))
    if nodes > MAX_NODES:
        detail = (
            f"the model has {nodes} numbers, names, operators and functions; at most {MAX_NODES} "
            "are compiled. Write fewer or shorter expressions"
        )
        reader.add_fault(pointer, detail)


def order_states(
    reader: DocumentReader, trees: Sequence[Expression], scope: Scope
) -> tuple[int, ...]:
    """Order the states (as indices): each follows those whose present value it reads."""
    if scope.form == "differential":
        return tuple(range(len(trees)))
    needs = {
        number: {
            scope.states.index(v.name)
            for v in collect_past_values(tree)
            if _may_read_present(v, scope)
        }
        for number, tree in enumerate(trees)
    }
    ordered: list[int] = []
    while len(ordered) < len(trees):
        ready = [n for n in needs if n not in ordered and needs[n] <= {*ordered, n}]
        if not ready:
            circle = ", ".join(scope.states[n] for n in needs if n not in ordered)
            detail = f"the present values of {circle} depend on each other; use (k-1) in one"
            reader.add_fault("/equations", detail)
            return tuple(range(len(trees)))
        ordered.append(ready[0])
    return tuple(ordered)


def compute_memory(trees: Sequence[Expression]) -> int:
    """Compute the largest fixed offset of any past value, in samples."""
    return max((value.offset for tree in trees for value in collect_past_values(tree)), default=0)


def _describe_form(scope: Scope) -> str:
    return "x(k) = …" if scope.form == "difference" else "dx/dt = …"


def _may_read_present(value: PastValue, scope: Scope) -> bool:
    """Whether a past value may reach the sample that is being computed."""
    if value.kind == "input" or value.offset > 0:
        return False
    return value.delay is None or bound_expression(value.delay, scope.parameters)[0] < 1


def _check_own_present(
    reader: DocumentReader, checked: CheckedExpression, state: str, scope: Scope
) -> None:
    if scope.form == "differential" or checked.tree is None:
        return
    for value, column in checked.uses:
        if value.name == state and _may_read_present(value, scope):
            verb = "is" if value.delay is None else "may reach"
            detail = (
                f"this {verb} the present {state}(k), which the equation computes; "
                f"write {state}(k-1…), or bounds that keep the delay at one sample or more"
            )
            reader.add_fault(join_pointer("equations", state), detail, column)


def _read_output_text(reader: DocumentReader, entry: object, pointer: str) -> OutputText:
    if not isinstance(entry, Mapping):
        return OutputText(reader.read_expression(entry, pointer), None)
    fields = reader.read_section(entry, pointer, ("expression", "unit"))
    reader.require_field(fields, "expression", pointer, "say what is measured, such as x")
    expression = reader.read_expression(fields.get("expression", "0"), pointer + "/expression")
    unit = fields.get("unit")
    return OutputText(
        expression, None if unit is None else reader.read_unit(unit, pointer + "/unit")
    )
