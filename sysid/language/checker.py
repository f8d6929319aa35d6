"""Syntax to a checked tree: names resolved, past values taken apart, every fault named."""

from typing import NamedTuple

from sysid.core.errors import nearest
from sysid.language.delays import delay
from sysid.language.functions import FUNCTIONS, OPERATORS, Level
from sysid.language.parser import (
    MAX_DEPTH,
    Apply,
    Infix,
    Name,
    NumberSyntax,
    Prefix,
    Syntax,
    SyntaxFault,
    TextFault,
    parse,
)
from sysid.language.scope import Scope
from sysid.language.tree import Binary, Call, Expression, Number, Past, Symbol, Unary

_PI = 3.141592653589793
_NOTHING = Number(0.0)


class Use(NamedTuple):
    """A signal value in a text, and the column where it stands."""

    value: Past
    column: int


class Checked(NamedTuple):
    """What a text is: its tree, or None and the faults."""

    tree: Expression | None
    faults: tuple[TextFault, ...]
    uses: tuple[Use, ...]


def check(text: str, scope: Scope) -> Checked:
    """The checked tree of a text, or everything that is wrong with it.

    Examples
    --------
    >>> scope = Scope("difference", states=("x",), parameters={"L": (0.0, 1.0)})
    >>> check("x(k-1-L/h)", scope).tree.offset
    1
    >>> check("y(k-1)", scope).faults[0].detail
    "'y' is not declared; did you mean 'x'?"
    """
    syntax, faults = parse(text)
    if syntax is None:
        return Checked(None, tuple(faults), ())
    checker = _Checker(scope, faults)
    try:
        tree = checker.value(syntax, 1)
    except SyntaxFault as error:
        return Checked(None, (error.fault,), ())
    found = tuple(sorted(faults))
    return Checked(None if found else tree, found, tuple(checker.uses))


class _Checker:
    """One pass over the syntax of one text; a fault stands in the tree as a zero."""

    def __init__(self, scope: Scope, faults: list[TextFault]) -> None:
        self._scope = scope
        self._faults = faults
        self.uses: list[Use] = []

    def value(self, node: Syntax, depth: int) -> Expression:
        """The tree of a node that stands for a number."""
        if depth > MAX_DEPTH:
            raise SyntaxFault(node.column, f"the expression is deeper than {MAX_DEPTH} levels")
        match node:
            case NumberSyntax(value):
                return Number(value)
            case Name():
                return self._name(node)
            case Apply():
                return self._apply(node, depth)
            case Prefix("-", operand):
                return Unary("-", self.value(operand, depth + 1))
            case Infix(operator, left, right) if OPERATORS[operator].level >= Level.SUM:
                return self._binary(operator, left, right, depth)
            case _:
                detail = f"{node.operator!r} is only for the condition of where(condition, a, b)"
                return self._fault(node.column, detail)

    def _condition(self, node: Syntax, depth: int) -> Expression:
        """The tree of a node that is true or false."""
        if depth > MAX_DEPTH:
            raise SyntaxFault(node.column, f"the expression is deeper than {MAX_DEPTH} levels")
        match node:
            case Prefix("not", operand):
                return Unary("not", self._condition(operand, depth + 1))
            case Infix(("and" | "or") as operator, left, right):
                first = self._condition(left, depth + 1)
                return Binary(operator, first, self._condition(right, depth + 1))
            case Infix(operator, left, right) if OPERATORS[operator].level == Level.COMPARISON:
                return self._binary(operator, left, right, depth)
            case _:
                detail = "a condition compares two values, such as x > 0"
                return self._fault(node.column, detail)

    def _binary(self, operator: str, left: Syntax, right: Syntax, depth: int) -> Expression:
        first = self.value(left, depth + 1)
        return Binary(operator, first, self.value(right, depth + 1))

    def _name(self, node: Name) -> Expression:
        name, scope = node.name, self._scope
        if name in scope.signals:
            return self._use(name, 0, None, node.column)
        if name in scope.constants:
            return Number(scope.constants[name])
        if name in scope.parameters:
            return Symbol(name, "parameter")
        return self._reserved(node)

    def _reserved(self, node: Name) -> Expression:
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
            return self._fault(node.column, f"{name!r} is a function; write {name}(…)")
        return self._fault(node.column, self._unknown(name))

    def _unknown(self, name: str) -> str:
        if name == "h":
            return "'h' is not declared; the sampling period is known in the difference form only"
        return f"{name!r} is not declared{nearest(name, self._scope.known)}"

    def _apply(self, node: Apply, depth: int) -> Expression:
        if node.name in self._scope.signals:
            return self._past(node, depth)
        if node.name in FUNCTIONS:
            return self._call(node, depth)
        for argument in node.arguments:
            self.value(argument, depth + 1)
        if node.name in self._scope.known:
            detail = f"{node.name!r} is not a signal, so it has no past; write {node.name}*(…)"
            return self._fault(node.column, detail)
        hint = nearest(node.name, (*FUNCTIONS, *self._scope.signals))
        return self._fault(node.column, f"there is no function or signal {node.name!r}{hint}")

    def _call(self, node: Apply, depth: int) -> Expression:
        fewest, most = FUNCTIONS[node.name].fewest, FUNCTIONS[node.name].most
        count = len(node.arguments)
        if count < fewest or (most is not None and count > most):
            need = f"{fewest}" if most == fewest else f"{fewest} or more"
            detail = f"{node.name} takes {need} argument{'s' * (need != '1')}, not {count}"
            return self._fault(node.column, detail)
        if node.name == "where":
            condition = self._condition(node.arguments[0], depth + 1)
            branches = [self.value(one, depth + 1) for one in node.arguments[1:]]
            return Call("where", (condition, *branches))
        first, *others = (self.value(one, depth + 1) for one in node.arguments)
        if not others:
            return Call(node.name, (first,))
        for other in others:  # min and max of several, two by two
            first = Call(node.name, (first, other))
        return first

    def _past(self, node: Apply, depth: int) -> Expression:
        if len(node.arguments) != 1:
            detail = f"{node.name} takes one index, such as {node.name}({self._scope.clock} - 1)"
            return self._fault(node.column, detail)
        argument = node.arguments[0]
        outside, known = self.uses, len(self._faults)
        self.uses = []
        index = self.value(argument, depth + 1)
        inside, self.uses = self.uses, outside
        if inside:
            name = inside[0].value.name
            detail = f"the lag depends on {name!r}; a lag is made of parameters and constants only"
            return self._fault(inside[0].column, detail)
        if len(self._faults) > known:
            return _NOTHING
        found = delay(index, self._scope)
        if isinstance(found, str):
            return self._fault(node.column, found)
        return self._use(node.name, *found, node.column)

    def _use(self, name: str, offset: int, lag: Expression | None, column: int) -> Past:
        value = Past(name, "state" if name in self._scope.states else "input", offset, lag)
        self.uses.append(Use(value, column))
        return value

    def _fault(self, column: int, detail: str) -> Expression:
        self._faults.append(TextFault(column, detail))
        return _NOTHING
