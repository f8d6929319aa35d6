"""Checker: from syntax to an expression tree with resolved names and past values."""

from collections.abc import Sequence
from functools import reduce
from itertools import pairwise
from math import isfinite
from typing import NamedTuple

from sysid.core.errors import suggest_name
from sysid.language.delays import collect_past_values, has_varying_delay, split_index
from sysid.language.evaluation import evaluate_expression
from sysid.language.functions import FUNCTIONS, OPERATORS, Level
from sysid.language.hints import find_advice
from sysid.language.parser import (
    MAX_EXPRESSION_DEPTH,
    Apply,
    Infix,
    Name,
    NumberLiteral,
    Points,
    Prefix,
    SyntaxFault,
    SyntaxNode,
    TextFault,
    parse_expression,
)
from sysid.language.printer import format_number
from sysid.language.scope import Scope
from sysid.language.table_functions import MAX_POINTS, TABLE_FUNCTIONS
from sysid.language.transform import shift_expression
from sysid.language.tree import (
    Binary,
    Expression,
    FunctionCall,
    Number,
    PastValue,
    Symbol,
    Unary,
    measure_depth,
    walk,
)

MAX_NODES = 10_000
"""Numbers, names, operators and functions of a model; compiling takes milliseconds for each."""

_MAX_POSITION, _MIN_GAP = 1e100, 1e-100  # of the x of a table: squares of gaps must be numbers
_PI = 3.141592653589793
_ZERO = Number(0.0)


class SignalUse(NamedTuple):
    """A signal value in a text, and its column."""

    value: PastValue
    column: int


class CheckedExpression(NamedTuple):
    """Checked tree of a text, or None and its faults."""

    tree: Expression | None
    faults: tuple[TextFault, ...]
    uses: tuple[SignalUse, ...]


def check_expression(text: str, scope: Scope) -> CheckedExpression:
    """Check a text: return its tree, or all its faults.

    Examples
    --------
    >>> scope = Scope("difference", states=("x",), parameters={"L": (0.0, 1.0)})
    >>> check_expression("x(k-1-L/h)", scope).tree.offset
    1
    >>> check_expression("y(k-1)", scope).faults[0].detail
    "'y' is not declared; did you mean 'x'?"
    """
    syntax, faults = parse_expression(text)
    if syntax is None:
        return CheckedExpression(None, tuple(faults), ())
    checker = _ExpressionChecker(scope, faults)
    try:
        tree = checker.check_value(syntax, 1)
    except SyntaxFault as error:
        return CheckedExpression(None, (error.fault,), ())
    ordered = tuple(sorted(faults))
    return CheckedExpression(None if ordered else tree, ordered, tuple(checker.uses))


class _ExpressionChecker:
    """Checker of one text; a faulty node becomes a zero in the tree."""

    def __init__(self, scope: Scope, faults: list[TextFault]) -> None:
        self._scope = scope
        self._faults = faults
        self._inserted_nodes = 0
        self.uses: list[SignalUse] = []

    def check_value(self, node: SyntaxNode, depth: int) -> Expression:
        """Build the tree of a node whose value is a number."""
        if depth > MAX_EXPRESSION_DEPTH:
            raise SyntaxFault(
                node.column, f"the expression is deeper than {MAX_EXPRESSION_DEPTH} levels"
            )
        match node:
            case NumberLiteral(value):
                return Number(value)
            case Name():
                return self._resolve_name(node, depth)
            case Apply():
                return self._check_apply(node, depth)
            case Prefix("-", operand):
                return Unary("-", self.check_value(operand, depth + 1))
            case Infix(operator, left, right) if OPERATORS[operator].level >= Level.SUM:
                return self._check_binary(operator, left, right, depth)
            case Points():
                detail = "a list is only for the points of table(u, [0, 1], [0, 5])"
                return self._add_fault(node.column, detail)
            case _:
                detail = f"{node.operator!r} is only for the condition of where(condition, a, b)"
                return self._add_fault(node.column, detail)

    def _check_condition(self, node: SyntaxNode, depth: int) -> Expression:
        """Build the tree of a node that is true or false."""
        if depth > MAX_EXPRESSION_DEPTH:
            raise SyntaxFault(
                node.column, f"the expression is deeper than {MAX_EXPRESSION_DEPTH} levels"
            )
        match node:
            case Prefix("not", operand):
                return Unary("not", self._check_condition(operand, depth + 1))
            case Infix(("and" | "or") as operator, left, right):
                first = self._check_condition(left, depth + 1)
                return Binary(operator, first, self._check_condition(right, depth + 1))
            case Infix(operator, left, right) if OPERATORS[operator].level == Level.COMPARISON:
                return self._check_binary(operator, left, right, depth)
            case _:
                detail = "a condition compares two values, such as x > 0"
                return self._add_fault(node.column, detail)

    def _check_binary(
        self, operator: str, left: SyntaxNode, right: SyntaxNode, depth: int
    ) -> Expression:
        first = self.check_value(left, depth + 1)
        return Binary(operator, first, self.check_value(right, depth + 1))

    def _resolve_name(self, node: Name, depth: int) -> Expression:
        name, scope = node.name, self._scope
        if name in scope.signals:
            return self._add_use(name, 0, None, node.column)
        if name in scope.intermediates:
            return self._insert_tree(scope.intermediates[name], node.column, depth)
        if name in scope.constants:
            return Number(scope.constants[name])
        if name in scope.parameters:
            return Symbol(name, "parameter")
        return self._resolve_reserved(node)

    def _insert_tree(self, tree: Expression, column: int, depth: int) -> Expression:
        """Insert the tree of an intermediate name, and what it reads.

        Names of names could make the expression arbitrarily long, so it is counted.
        """
        if depth + measure_depth(tree) > MAX_EXPRESSION_DEPTH:
            detail = (
                "with its intermediate names the expression is deeper than "
                f"{MAX_EXPRESSION_DEPTH} levels"
            )
            raise SyntaxFault(column, detail)
        self._inserted_nodes += sum(1 for _ in walk(tree))
        if self._inserted_nodes > MAX_NODES:
            detail = (
                f"with its intermediate names the expression has more than {MAX_NODES} numbers, "
                "names, operators and functions"
            )
            raise SyntaxFault(column, detail)
        self.uses += [SignalUse(value, column) for value in collect_past_values(tree)]
        return tree

    def _resolve_reserved(self, node: Name) -> Expression:
        name, discrete = node.name, self._scope.form == "difference"
        if name == "pi":
            return Number(_PI)
        if name == "t":
            return Symbol("t", "time")
        if discrete and name == "k":
            return Symbol("k", "index")
        if discrete and name == "h":
            return Symbol("h", "period")
        if name in FUNCTIONS:
            return self._add_fault(node.column, f"{name!r} is a function; write {name}(…)")
        return self._add_fault(node.column, self._describe_unknown(name))

    def _describe_unknown(self, name: str) -> str:
        if name == "h":
            return "'h' is not declared; it is the sampling period in the difference form only"
        if advice := find_advice(name, is_called=False):
            return f"{name!r} is not declared; {advice}"
        return f"{name!r} is not declared{suggest_name(name, self._scope.names)}"

    def _check_apply(self, node: Apply, depth: int) -> Expression:
        if node.name in self._scope.signals or node.name in self._scope.intermediates:
            return self._check_past_value(node, depth)
        if node.name in FUNCTIONS:
            return self._check_call(node, depth)
        if node.name not in self._scope.names and (advice := find_advice(node.name)):
            return self._add_fault(node.column, f"there is no function {node.name!r}; {advice}")
        for argument in node.arguments:
            self.check_value(argument, depth + 1)
        if node.name in self._scope.names:
            detail = f"{node.name!r} is not a signal, so it has no past; write {node.name}*(…)"
            return self._add_fault(node.column, detail)
        hint = suggest_name(node.name, (*FUNCTIONS, *self._scope.signals))
        return self._add_fault(node.column, f"there is no function or signal {node.name!r}{hint}")

    def _check_call(self, node: Apply, depth: int) -> Expression:
        fewest, most = FUNCTIONS[node.name].fewest, FUNCTIONS[node.name].most
        count = len(node.arguments)
        if count < fewest or (most is not None and count > most):
            need = f"{fewest}" if most == fewest else f"{fewest} or more"
            detail = f"{node.name} takes {need} argument{'s' * (need != '1')}, not {count}"
            return self._add_fault(node.column, detail)
        if node.name in TABLE_FUNCTIONS:
            return self._check_table(node, depth)
        if node.name == "where":
            condition = self._check_condition(node.arguments[0], depth + 1)
            branches = [self.check_value(branch, depth + 1) for branch in node.arguments[1:]]
            return FunctionCall("where", (condition, *branches))
        arguments = tuple(self.check_value(argument, depth + 1) for argument in node.arguments)
        if most is not None:
            return FunctionCall(node.name, arguments)
        # min and max of several arguments, pairwise
        return reduce(lambda a, b: FunctionCall(node.name, (a, b)), arguments)

    def _check_table(self, node: Apply, depth: int) -> Expression:
        argument, *lists = node.arguments
        faults_before = len(self._faults)
        for points in lists:
            if not isinstance(points, Points):
                example = f"{node.name}({{}}, [0, 1, 2], [0, 5, 7])".format(
                    argument.name if isinstance(argument, Name) else "u"
                )
                return self._add_fault(
                    points.column, f"the points of a table are two lists, such as {example}"
                )
        x, y = (
            [
                (self._check_point(item, depth + 1, is_position=points is lists[0]), item.column)
                for item in points.items
            ]
            for points in lists
            if isinstance(points, Points)
        )
        tree = self.check_value(argument, depth + 1)
        if not 2 <= len(x) <= MAX_POINTS or len(x) != len(y):
            detail = (
                f"the table has {len(x)} values of x and {len(y)} of y; "
                f"both need the same number, 2 to {MAX_POINTS}"
            )
            return self._add_fault(node.column, detail)
        if len(self._faults) == faults_before:
            self._check_increase(x)
        return FunctionCall(node.name, (tree, *(position for position, _ in x), *(v for v, _ in y)))

    def _check_point(self, item: SyntaxNode, depth: int, *, is_position: bool) -> Expression:
        """Check one number of a table: an x is a number, a y may have parameters."""
        outside, self.uses = self.uses, []
        tree, read = self.check_value(item, depth), self.uses
        self.uses = outside
        symbols = [node for node in walk(tree) if isinstance(node, Symbol)]
        if is_position:
            if read or symbols:
                detail = "the x of a table are numbers; only its y may have parameters"
                return self._add_fault(item.column, detail)
            value = evaluate_expression(tree, {})
            if not abs(value) <= _MAX_POSITION:
                detail = (
                    f"this x of the table is {value:g}; need a number within ±{_MAX_POSITION:g}"
                )
                return self._add_fault(item.column, detail)
            return Number(value)
        if read or any(symbol.kind in ("time", "index") for symbol in symbols):
            return self._add_fault(
                item.column,
                "the y of a table are numbers, parameters and constants; "
                "they do not change in time",
            )
        if not symbols and not isfinite(value := evaluate_expression(tree, {})):
            detail = f"this y of the table is {value:g}; need a finite number"
            return self._add_fault(item.column, detail)
        return tree

    def _check_increase(self, x: Sequence[tuple[Expression, int]]) -> None:
        """Check that the positions of a table increase."""
        for (before, _), (position, column) in pairwise(x):
            if isinstance(before, Number) and isinstance(position, Number):
                if position.value - before.value >= _MIN_GAP:
                    continue
                low, high = format_number(before.value), format_number(position.value)
                need = f", by {_MIN_GAP:g} or more" if position.value > before.value else ""
                detail = f"the x of a table must increase{need}, but {high} follows {low}"
                self._add_fault(column, detail)

    def _check_past_value(self, node: Apply, depth: int) -> Expression:
        if len(node.arguments) != 1:
            detail = f"{node.name} takes one index, such as {node.name}({self._scope.clock} - 1)"
            return self._add_fault(node.column, detail)
        argument = node.arguments[0]
        outside, faults_before = self.uses, len(self._faults)
        self.uses = []
        index = self.check_value(argument, depth + 1)
        inside, self.uses = self.uses, outside
        if (fault := self._find_delay_fault(node, inside)) is not None:
            return self._add_fault(*fault)
        if len(self._faults) > faults_before:
            return _ZERO
        past_index = split_index(index, self._scope)
        if isinstance(past_index, str):
            return self._add_fault(node.column, past_index)
        if node.name in self._scope.intermediates:
            tree, counts = self._scope.intermediates[node.name], self._scope.form == "difference"
            shifted = shift_expression(tree, *past_index, counts=counts)
            return self._insert_tree(shifted, node.column, depth)
        return self._add_use(node.name, *past_index, node.column)

    def _find_delay_fault(self, node: Apply, read: Sequence[SignalUse]) -> TextFault | None:
        """Find why a delay must not read these signals; None if it may.

        The lag of an input may change with the present values of inputs.
        """
        name = node.name
        for value, column in read:
            if value.kind == "state":
                detail = (
                    f"the delay depends on {value.name!r}; a delay consists of parameters, "
                    "constants and present inputs, not of states"
                )
                return TextFault(column, detail)
            if value.offset or value.delay is not None:
                detail = f"a delay reads present inputs only; write {value.name} without a past"
                return TextFault(column, detail)
        if read and name not in self._scope.inputs:
            detail = (
                f"the lag of {name!r} changes with {read[0].value.name!r}; "
                "only an input may have such a lag"
            )
            return TextFault(read[0].column, detail)
        tree = self._scope.intermediates.get(name, _ZERO)
        if any(map(has_varying_delay, collect_past_values(tree))):
            detail = f"{name!r} contains a lag that changes with an input, so it has no past here"
            return TextFault(node.column, detail)
        return None

    def _add_use(self, name: str, offset: int, delay: Expression | None, column: int) -> PastValue:
        value = PastValue(name, "state" if name in self._scope.states else "input", offset, delay)
        self.uses.append(SignalUse(value, column))
        return value

    def _add_fault(self, column: int, detail: str) -> Expression:
        self._faults.append(TextFault(column, detail))
        return _ZERO
