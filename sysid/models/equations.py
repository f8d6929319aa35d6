"""Equations and outputs of a document: trees, order of computation, memory."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sysid.core.errors import join_pointer, nearest
from sysid.language.checker import Checked, check
from sysid.language.delays import past_values
from sysid.language.intervals import bounds
from sysid.language.scope import Scope
from sysid.language.tree import Expression, Number, Past
from sysid.models.documents import Reader
from sysid.models.model import Output, Quantity
from sysid.models.sections import MAX_EQUATIONS

_ZERO = Number(0.0)


class OutputText(NamedTuple):
    """An output as written."""

    expression: str
    unit: str | None


def equations(
    reader: Reader, value: object, scope: Scope
) -> tuple[dict[str, str], tuple[Expression, ...]]:
    """Texts, and one tree per state in the states' order."""
    fields = reader.section(value, "/equations", most=MAX_EQUATIONS)
    for name in fields:
        if name not in scope.states:
            detail = f"there is no such state{nearest(name, scope.states)}"
            reader.fault(join_pointer("equations", name), detail)
    texts, trees = {}, []
    for state in scope.states:
        place = join_pointer("equations", state)
        if fields.get(state) is None:
            reader.fault(place, f"is missing; every state needs its equation, {_form(scope)}")
            continue
        texts[state] = reader.expression(fields[state], place)
        found = check(texts[state], scope)
        note(reader, found, place)
        _fault_own_present(reader, found, state, scope)
        trees.append(found.tree or _ZERO)
    return texts, tuple(trees)


def note(reader: Reader, found: Checked, place: str) -> None:
    """Hand the faults of a text to the reader."""
    for column, detail in found.faults:
        reader.fault(place, detail, column)


def outputs(
    reader: Reader, value: object, scope: Scope, states: Sequence[Quantity]
) -> tuple[tuple[str, ...], tuple[Output, ...]]:
    """Texts, and the outputs. One that is just a state has the state's unit."""
    fields = reader.section(value, "/outputs", most=MAX_EQUATIONS)
    if not fields:
        reader.fault("/outputs", "is missing; name the measured channel, such as {y: x}")
    units = {state.name: state.unit for state in states}
    texts, found = [], []
    for name, entry in fields.items():
        place = join_pointer("outputs", name)
        written = _output_text(reader, entry, place)
        at = place + "/expression" if isinstance(entry, Mapping) else place
        checked = check(written.expression, scope)
        note(reader, checked, at)
        tree = checked.tree or _ZERO
        own = units.get(tree.name) if isinstance(tree, Past) else None
        texts.append(written.expression)
        found.append(Output(name, tree, written.unit or own or "1"))
    return tuple(texts), tuple(found)


def order(reader: Reader, trees: Sequence[Expression], scope: Scope) -> tuple[int, ...]:
    """Indices of the states, each after those whose present value it uses."""
    if scope.form == "differential":
        return tuple(range(len(trees)))
    needs = {
        number: {scope.states.index(v.name) for v in past_values(tree) if _is_present(v, scope)}
        for number, tree in enumerate(trees)
    }
    done: list[int] = []
    while len(done) < len(trees):
        ready = [n for n in needs if n not in done and needs[n] <= {*done, n}]
        if not ready:
            circle = ", ".join(scope.states[n] for n in needs if n not in done)
            detail = f"the present values of {circle} depend on each other; use (k-1) in one"
            reader.fault("/equations", detail)
            return tuple(range(len(trees)))
        done.append(ready[0])
    return tuple(done)


def memory(trees: Sequence[Expression]) -> int:
    """Largest fixed offset of any past value, in samples."""
    return max((value.offset for tree in trees for value in past_values(tree)), default=0)


def _form(scope: Scope) -> str:
    return "x(k) = …" if scope.form == "difference" else "dx/dt = …"


def _is_present(value: Past, scope: Scope) -> bool:
    """Whether a state's value may touch the sample that is being computed."""
    if value.kind == "input" or value.offset > 0:
        return False
    return value.lag is None or bounds(value.lag, scope.parameters)[0] < 1


def _fault_own_present(reader: Reader, found: Checked, state: str, scope: Scope) -> None:
    if scope.form == "differential" or found.tree is None:
        return
    for value, column in found.uses:
        if value.name == state and _is_present(value, scope):
            what = "is" if value.lag is None else "may reach"
            detail = (
                f"this {what} the present {state}(k), which the equation is to give; "
                f"write {state}(k-1…), or bounds that keep the lag at one sample or more"
            )
            reader.fault(join_pointer("equations", state), detail, column)


def _output_text(reader: Reader, entry: object, place: str) -> OutputText:
    if not isinstance(entry, Mapping):
        return OutputText(reader.expression(entry, place), None)
    fields = reader.section(entry, place, ("expression", "unit"))
    reader.required(fields, "expression", place, "say what is measured, such as x")
    expression = reader.expression(fields.get("expression", "0"), place + "/expression")
    unit = fields.get("unit")
    return OutputText(expression, None if unit is None else reader.unit(unit, place + "/unit"))
