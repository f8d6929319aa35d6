"""Derivative of an expression by a value of a state, now or in the past.

Its values at other times do not depend on it. A jump has no derivative, and a bend has that of the
side on which the state is.
"""

from collections.abc import Callable, Mapping

from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Unary, walk

ZERO, ONE = Number(0.0), Number(1.0)
_ROOT_OF_PI = 1.772453850905516
_LOG_OF_10 = 2.302585092994046


class NoDerivativeError(Exception):
    """A function whose derivative the language cannot express."""


def differentiate(tree: Expression, value: PastValue) -> Expression:
    """Differentiate an expression by a value of a state; a value with a delay is another one.

    Raises
    ------
    NoDerivativeError
        If a function of the state is a table.

    Examples
    --------
    >>> x = PastValue("x", "state")
    >>> differentiate(Binary("*", Number(3.0), x), x)
    Number(value=3.0)
    """
    if value not in walk(tree):
        return ZERO
    match tree:
        case PastValue():
            return ONE if tree == value else ZERO
        case Unary(_, operand):
            return subtract(ZERO, differentiate(operand, value))
        case Binary(operator, left, right):
            dleft, dright = differentiate(left, value), differentiate(right, value)
            return _differentiate_operation(operator, left, right, dleft, dright)
        case FunctionCall(function, arguments):
            slopes = tuple(differentiate(argument, value) for argument in arguments[1:])
            if function == "where":
                return _choose(arguments[0], *slopes)
            if function not in _RULES:
                raise NoDerivativeError(function)
            return _RULES[function](arguments, (differentiate(arguments[0], value), *slopes))
    return ZERO


def add(left: Expression, right: Expression) -> Expression:
    """Add two expressions; a zero adds nothing."""
    if left == ZERO:
        return right
    return left if right == ZERO else Binary("+", left, right)


def subtract(left: Expression, right: Expression) -> Expression:
    """Subtract two expressions."""
    if right == ZERO:
        return left
    return Unary("-", right) if left == ZERO else Binary("-", left, right)


def multiply(left: Expression, right: Expression) -> Expression:
    """Multiply two expressions; zero and one need no product."""
    if ZERO in (left, right):
        return ZERO
    if left == ONE:
        return right
    return left if right == ONE else Binary("*", left, right)


def divide(left: Expression, right: Expression) -> Expression:
    """Divide two expressions."""
    return left if left == ZERO or right == ONE else Binary("/", left, right)


def _differentiate_operation(
    operator: str, left: Expression, right: Expression, dleft: Expression, dright: Expression
) -> Expression:
    match operator:
        case "+":
            return add(dleft, dright)
        case "-":
            return subtract(dleft, dright)
        case "*":
            return add(multiply(dleft, right), multiply(left, dright))
        case "/":
            quotient = multiply(divide(left, right), dright)
            return divide(subtract(dleft, quotient), right)
        case "**":
            lower = Binary("**", left, subtract(right, ONE))
            if isinstance(right, Number):
                lower = Binary("**", left, Number(right.value - 1.0))
            base = multiply(multiply(right, lower), dleft)
            grown = Binary("*", Binary("**", left, right), FunctionCall("log", (left,)))
            return add(base, multiply(grown, dright))
    return ZERO  # a comparison


def _choose(condition: Expression, first: Expression, second: Expression) -> Expression:
    return first if first == second else FunctionCall("where", (condition, first, second))


def _call(function: str, *arguments: Expression) -> Expression:
    return FunctionCall(function, arguments)


def _square(tree: Expression) -> Expression:
    return Binary("*", tree, tree)


_Slope = Callable[[Expression], Expression]
_Rule = Callable[[tuple[Expression, ...], tuple[Expression, ...]], Expression]


def _chain(slope: _Slope) -> _Rule:
    return lambda arguments, slopes: multiply(slope(arguments[0]), slopes[0])


def _take_least(arguments: tuple[Expression, ...], slopes: tuple[Expression, ...]) -> Expression:
    return _take_extreme("<=", "min", arguments, slopes)


def _take_most(arguments: tuple[Expression, ...], slopes: tuple[Expression, ...]) -> Expression:
    return _take_extreme(">=", "max", arguments, slopes)


def _take_extreme(
    operator: str, function: str, arguments: tuple[Expression, ...], slopes: tuple[Expression, ...]
) -> Expression:
    first, *others = arguments
    if not others:
        return slopes[0]
    rest = _call(function, *others) if len(others) > 1 else others[0]
    other = _take_extreme(operator, function, tuple(others), slopes[1:])
    return _choose(Binary(operator, first, rest), slopes[0], other)


def _turn(arguments: tuple[Expression, ...], slopes: tuple[Expression, ...]) -> Expression:
    (y, x), (dy, dx) = arguments, slopes
    change = subtract(multiply(x, dy), multiply(y, dx))
    return divide(change, Binary("+", _square(x), _square(y)))


def _clip(arguments: tuple[Expression, ...], slopes: tuple[Expression, ...]) -> Expression:
    value, lower, upper = arguments
    below = _choose(Binary("<", value, lower), slopes[1], slopes[0])
    return _choose(Binary(">", value, upper), slopes[2], below)


_RULES: Mapping[str, _Rule] = {
    "sin": _chain(lambda x: _call("cos", x)),
    "cos": _chain(lambda x: Unary("-", _call("sin", x))),
    "tan": _chain(lambda x: Binary("+", ONE, _square(_call("tan", x)))),
    "exp": _chain(lambda x: _call("exp", x)),
    "log": _chain(lambda x: Binary("/", ONE, x)),
    "log10": _chain(lambda x: Binary("/", ONE, Binary("*", Number(_LOG_OF_10), x))),
    "sqrt": _chain(lambda x: Binary("/", Number(0.5), _call("sqrt", x))),
    "abs": _chain(lambda x: _call("sign", x)),
    "sign": _chain(lambda _: ZERO),
    "floor": _chain(lambda _: ZERO),
    "tanh": _chain(lambda x: Binary("-", ONE, _square(_call("tanh", x)))),
    "atan": _chain(lambda x: Binary("/", ONE, Binary("+", ONE, _square(x)))),
    "sinh": _chain(lambda x: _call("cosh", x)),
    "cosh": _chain(lambda x: _call("sinh", x)),
    "erf": _chain(
        lambda x: Binary(
            "/", Binary("*", Number(2.0), _call("exp", Unary("-", _square(x)))), Number(_ROOT_OF_PI)
        )
    ),
    "atan2": _turn,
    "mod": lambda _, slopes: slopes[0],
    "clip": _clip,
    "min": _take_least,
    "max": _take_most,
}
