"""Equations and outputs of a document: trees, order of computation, memory."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sysid.core.errors import join_pointer, suggest_name
from sysid.language.checker import CheckedExpression, check_expression
from sysid.language.delays import collect_past_values
from sysid.language.intervals import bound_expression
from sysid.language.scope import Scope
from sysid.language.tree import Expression, Number, PastValue
from sysid.models.documents import DocumentReader
from sysid.models.model import ModelSignal, Output
from sysid.models.sections import MAX_EQUATIONS

_ZERO = Number(0.0)


class OutputText(NamedTuple):
    """An output as written."""

    expression: str
    unit: str | None


def read_equations(
    reader: DocumentReader, value: object, scope: Scope
) -> tuple[dict[str, str], tuple[Expression, ...]]:
    """Texts, and one tree per state in the states' order."""
    fields = reader.read_section(value, "/equations", most=MAX_EQUATIONS)
    for name in fields:
        if name not in scope.states:
            detail = f"there is no such state{suggest_name(name, scope.states)}"
            reader.add_fault(join_pointer("equations", name), detail)
    texts, trees = {}, []
    for state in scope.states:
        place = join_pointer("equations", state)
        if fields.get(state) is None:
            reader.add_fault(
                place, f"is missing; every state needs its equation, {_describe_form(scope)}"
            )
            continue
        texts[state] = reader.read_expression(fields[state], place)
        found = check_expression(texts[state], scope)
        add_faults(reader, found, place)
        _check_own_present(reader, found, state, scope)
        trees.append(found.tree or _ZERO)
    return texts, tuple(trees)


def add_faults(reader: DocumentReader, found: CheckedExpression, place: str) -> None:
    """Hand the faults of a text to the reader."""
    for column, detail in found.faults:
        reader.add_fault(place, detail, column)


def read_outputs(
    reader: DocumentReader, value: object, scope: Scope, states: Sequence[ModelSignal]
) -> tuple[tuple[str, ...], tuple[Output, ...]]:
    """Texts, and the outputs. One that is just a state has the state's unit."""
    fields = reader.read_section(value, "/outputs", most=MAX_EQUATIONS)
    if not fields:
        reader.add_fault("/outputs", "is missing; name the measured channel, such as {y: x}")
    units = {state.name: state.unit for state in states}
    texts, found = [], []
    for name, entry in fields.items():
        place = join_pointer("outputs", name)
        written = _read_output_text(reader, entry, place)
        at = place + "/expression" if isinstance(entry, Mapping) else place
        checked = check_expression(written.expression, scope)
        add_faults(reader, checked, at)
        tree = checked.tree or _ZERO
        own = units.get(tree.name) if isinstance(tree, PastValue) else None
        texts.append(written.expression)
        found.append(Output(name, tree, written.unit or own or "1"))
    return tuple(texts), tuple(found)


def order_states(
    reader: DocumentReader, trees: Sequence[Expression], scope: Scope
) -> tuple[int, ...]:
    """Indices of the states, each after those whose present value it uses."""
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
    done: list[int] = []
    while len(done) < len(trees):
        ready = [n for n in needs if n not in done and needs[n] <= {*done, n}]
        if not ready:
            circle = ", ".join(scope.states[n] for n in needs if n not in done)
            detail = f"the present values of {circle} depend on each other; use (k-1) in one"
            reader.add_fault("/equations", detail)
            return tuple(range(len(trees)))
        done.append(ready[0])
    return tuple(done)


def compute_memory(trees: Sequence[Expression]) -> int:
    """Largest fixed offset of any past value, in samples."""
    return max((value.offset for tree in trees for value in collect_past_values(tree)), default=0)


def _describe_form(scope: Scope) -> str:
    return "x(k) = …" if scope.form == "difference" else "dx/dt = …"


def _may_read_present(value: PastValue, scope: Scope) -> bool:
    """Whether a state's value may touch the sample that is being computed."""
    if value.kind == "input" or value.offset > 0:
        return False
    return value.delay is None or bound_expression(value.delay, scope.parameters)[0] < 1


def _check_own_present(
    reader: DocumentReader, found: CheckedExpression, state: str, scope: Scope
) -> None:
    if scope.form == "differential" or found.tree is None:
        return
    for value, column in found.uses:
        if value.name == state and _may_read_present(value, scope):
            what = "is" if value.delay is None else "may reach"
            detail = (
                f"this {what} the present {state}(k), which the equation is to give; "
                f"write {state}(k-1…), or bounds that keep the lag at one sample or more"
            )
            reader.add_fault(join_pointer("equations", state), detail, column)


def _read_output_text(reader: DocumentReader, entry: object, place: str) -> OutputText:
    if not isinstance(entry, Mapping):
        return OutputText(reader.read_expression(entry, place), None)
    fields = reader.read_section(entry, place, ("expression", "unit"))
    reader.require_field(fields, "expression", place, "say what is measured, such as x")
    expression = reader.read_expression(fields.get("expression", "0"), place + "/expression")
    unit = fields.get("unit")
    return OutputText(expression, None if unit is None else reader.read_unit(unit, place + "/unit"))
