"""History functions of a document: ``history: {x: a*exp(b*t)}``, the past of states for t < 0.

A delay differential equation starts from a function, not from a value. The state begins where its
history ends, because a state does not jump. A start that is given as well may differ, if it is
estimated, measured or an expression: then something happened to the plant at the start.
"""

from collections.abc import Mapping
from dataclasses import replace
from math import isfinite

from sysid.core.errors import join_pointer, suggest_name
from sysid.language.checker import check_expression
from sysid.language.evaluation import evaluate_expression
from sysid.language.printer import format_expression
from sysid.language.scope import Scope
from sysid.language.transform import substitute
from sysid.language.tree import Expression, Number, PastValue, Symbol, walk
from sysid.models.document_reader import DocumentReader
from sysid.models.equations import add_faults
from sysid.models.model import DerivedInitial, FixedInitial, HistoryFunction, InitialState
from sysid.models.sections import HISTORY, MAX_EQUATIONS, STEADY

_TOLERANCE = 1e-9  # of a start and the end of its history, relative


def read_histories(
    reader: DocumentReader, value: object, scope: Scope
) -> tuple[HistoryFunction, ...]:
    """Read the history functions, in the order of the states; one with faults is 0."""
    fields = reader.read_section(value, "/history", most=MAX_EQUATIONS)
    if fields and scope.form != "differential":
        detail = "belongs to the differential form; a recursion begins with its first samples"
        reader.add_fault("/history", detail)
        return ()
    for name in fields:
        if name not in scope.states:
            detail = f"there is no such state{suggest_name(name, scope.states)}"
            reader.add_fault(join_pointer("history", name), detail)
    return tuple(
        HistoryFunction(name, _read_function(reader, fields[name], name, scope))
        for name in scope.states
        if name in fields
    )


def _read_function(reader: DocumentReader, value: object, state: str, scope: Scope) -> Expression:
    pointer = join_pointer("history", state)
    checked = check_expression(reader.read_expression(value, pointer), scope)
    add_faults(reader, checked, pointer)
    for signal, column in checked.uses:
        detail = f"a history does not depend on {signal.name!r}; write a function of t"
        reader.add_fault(pointer, detail, column)
    return checked.tree or Number(0.0)


def derive_starts(
    reader: DocumentReader,
    starts: Mapping[str, InitialState],
    histories: tuple[HistoryFunction, ...],
) -> tuple[InitialState, ...]:
    """Derive the starts that follow from histories, and check the others against them."""
    trees = {history.state: history.expression for history in histories}
    return tuple(_derive_start(reader, name, start, trees) for name, start in starts.items())


def _derive_start(
    reader: DocumentReader, state: str, start: InitialState, trees: Mapping[str, Expression]
) -> InitialState:
    pointer = join_pointer("initial", state)
    text = start.text if isinstance(start, DerivedInitial) else ""
    if text == STEADY and trees:
        detail = (
            f"a steady start has been at rest, but /history says what {next(iter(trees))!r} did"
        )
        reader.add_fault(pointer, f"{detail}; leave one of them out")
    if state not in trees:
        if text == HISTORY:
            detail = f"there is no history of {state!r}; write one, history: {{{state}: …}}"
            reader.add_fault(pointer, detail)
        return start
    end = substitute(trees[state], _stop_clock)
    if isinstance(start, DerivedInitial) and text == HISTORY:
        if (last := _evaluate_known(end)) is not None and not isfinite(last):
            detail = f"is {last:g} at t = 0; need a finite number, because the state starts there"
            reader.add_fault(join_pointer("history", state), detail)
        return replace(start, expression=end)
    value = _find_number(start)
    if value is not None and not _is_close(value, _evaluate_known(end)):
        detail = (
            f"the state starts at {value:g}, but its history ends at {format_expression(end)}; "
            "leave the start out, or give {lower, upper}, measured or an expression of parameters"
        )
        reader.add_fault(pointer, detail)
    return start


def _stop_clock(node: Expression) -> Expression | None:
    return Number(0.0) if isinstance(node, Symbol) and node.kind == "time" else None


def _find_number(start: InitialState) -> float | None:
    """Find the number of a start that has no names."""
    if isinstance(start, FixedInitial):
        return start.value
    return _evaluate_known(start.expression) if isinstance(start, DerivedInitial) else None


def _evaluate_known(tree: Expression) -> float | None:
    """Evaluate an expression without parameters and inputs; None for any other."""
    has_names = any(isinstance(node, Symbol | PastValue) for node in walk(tree))
    return None if has_names else evaluate_expression(tree, {})


def _is_close(value: float, end: float | None) -> bool:
    return end is not None and abs(value - end) <= _TOLERANCE * max(abs(value), abs(end))
