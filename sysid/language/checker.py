"""Checker: from syntax to an expression tree with resolved names and past values."""

from typing import NamedTuple

from sysid.core.errors import suggest_name
from sysid.language.delays import split_index
from sysid.language.functions import FUNCTIONS, OPERATORS, Level
from sysid.language.parser import (
    MAX_EXPRESSION_DEPTH,
    Apply,
    Infix,
    Name,
    NumberLiteral,
    Prefix,
    SyntaxFault,
    SyntaxNode,
    TextFault,
    parse_expression,
)
from sysid.language.scope import Scope
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary

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
                return self._resolve_name(node)
            case Apply():
                return self._check_apply(node, depth)
            case Prefix("-", operand):
                return Unary("-", self.check_value(operand, depth + 1))
            case Infix(operator, left, right) if OPERATORS[operator].level >= Level.SUM:
                return self._check_binary(operator, left, right, depth)
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

    def _resolve_name(self, node: Name) -> Expression:
        name, scope = node.name, self._scope
        if name in scope.signals:
            return self._add_use(name, 0, None, node.column)
        if name in scope.constants:
            return Number(scope.constants[name])
        if name in scope.parameters:
            return Symbol(name, "parameter")
        return self._resolve_reserved(node)

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
        return f"{name!r} is not declared{suggest_name(name, self._scope.names)}"

    def _check_apply(self, node: Apply, depth: int) -> Expression:
        if node.name in self._scope.signals:
            return self._check_past_value(node, depth)
        if node.name in FUNCTIONS:
            return self._check_call(node, depth)
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
        if node.name == "where":
            condition = self._check_condition(node.arguments[0], depth + 1)
            branches = [self.check_value(branch, depth + 1) for branch in node.arguments[1:]]
            return FunctionCall("where", (condition, *branches))
        first, *others = (self.check_value(argument, depth + 1) for argument in node.arguments)
        if not others:
            return FunctionCall(node.name, (first,))
        for other in others:  # min and max of several arguments, pairwise
            first = FunctionCall(node.name, (first, other))
        return first

    def _check_past_value(self, node: Apply, depth: int) -> Expression:
        if len(node.arguments) != 1:
            detail = f"{node.name} takes one index, such as {node.name}({self._scope.clock} - 1)"
            return self._add_fault(node.column, detail)
        argument = node.arguments[0]
        outside, faults_before = self.uses, len(self._faults)
        self.uses = []
        index = self.check_value(argument, depth + 1)
        inside, self.uses = self.uses, outside
        if inside:
            name = inside[0].value.name
            detail = (
                f"the delay depends on {name!r}; a delay consists of parameters and constants only"
            )
            return self._add_fault(inside[0].column, detail)
        if len(self._faults) > faults_before:
            return _ZERO
        past_index = split_index(index, self._scope)
        if isinstance(past_index, str):
            return self._add_fault(node.column, past_index)
        return self._add_use(node.name, *past_index, node.column)

    def _add_use(self, name: str, offset: int, delay: Expression | None, column: int) -> PastValue:
        value = PastValue(name, "state" if name in self._scope.states else "input", offset, delay)
        self.uses.append(SignalUse(value, column))
        return value

    def _add_fault(self, column: int, detail: str) -> Expression:
        self._faults.append(TextFault(column, detail))
        return _ZERO
