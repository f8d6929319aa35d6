"""Intervals of expressions, exact where every parameter occurs once; and long chains."""

from math import cosh, erf, exp, inf, log, log10, pi, sinh, sqrt, tan

import pytest

from sysid.language.checker import check_expression
from sysid.language.evaluation import evaluate_expression
from sysid.language.printer import format_expression
from sysid.language.scope import Scope
from sysid.language.transform import add_delays, shift_expression
from sysid.language.tree import Expression
from sysid.language.value_intervals import bound_expression

PARAMETERS = {
    "a": (-2.0, 3.0),
    "b": (1.0, 4.0),
    "n": (-4.0, -1.0),
    "z": (0.0, 2.0),
    "m": (-2.0, 0.0),
    "s": (-1.0, 1.5),
}
SCOPE = Scope("difference", states=("x",), inputs=("u",), parameters=PARAMETERS)


def parse(text: str) -> Expression:
    tree = check_expression(text, SCOPE).tree
    assert tree is not None
    return tree


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-a", (-3, 2)),
        ("a + b", (-1, 7)),
        ("a - b", (-6, 2)),
        ("a*n", (-12, 8)),
        ("z*(1/z)", (0, inf)),
        ("a/b", (-2, 3)),
        ("b/n", (-4, -0.25)),
        ("b/z", (0.5, inf)),
        ("b/m", (-inf, -0.5)),
        ("b/a", (-inf, inf)),
        ("a**2", (0, 9)),
        ("n**2", (1, 16)),
        ("a**3", (-8, 27)),
        ("a**0", (1, 1)),
        ("b**a", (1 / 16, 64)),
        ("a**b", (-inf, inf)),
        ("abs(a)", (0, 3)),
        ("abs(n)", (1, 4)),
        ("exp(a)", (exp(-2), exp(3))),
        ("log(z)", (-inf, log(2))),
        ("sqrt(a)", (0, sqrt(3))),
        ("sign(a)", (-1, 1)),
        ("sign(b)", (1, 1)),
        ("tan(s)", (tan(-1), tan(1.5))),
        ("tan(z)", (-inf, inf)),
        ("sin(b)", (-1, 1)),
        ("min(a, b)", (-2, 3)),
        ("max(a, b)", (1, 4)),
        ("pchip(x, [0, 1, 5], [a, n, 2])", (-4, 3)),
        ("clip(a, n, z)", (-2, 2)),
        ("floor(a/2)", (-1, 1)),
        ("floor(b/z)", (0, inf)),
        ("mod(a, b)", (0, 4)),
        ("mod(b, n)", (-4, 0)),
        ("sinh(a)", (sinh(-2), sinh(3))),
        ("sinh(1000*a)", (-inf, inf)),
        ("cosh(a)", (1, cosh(3))),
        ("cosh(n)", (cosh(1), cosh(4))),
        ("cosh(1000*b)", (cosh(710), inf)),
        ("log10(z)", (-inf, log10(2))),
        ("atan2(a, b)", (-pi / 2, pi / 2)),
        ("atan2(b, a)", (-pi, pi)),
        ("erf(a)", (erf(-2), erf(3))),
        ("where(a > 0, b, n)", (-4, 4)),
        ("h", (0, inf)),
        ("x + a", (-inf, inf)),
        ("exp(1000*b) - exp(1000*b)", (-inf, inf)),
    ],
)
def test_the_interval_of_an_operation_has_its_own_ends(
    text: str, expected: tuple[float, float]
) -> None:
    assert bound_expression(parse(text), PARAMETERS) == pytest.approx(expected)


def test_a_known_period_has_one_value() -> None:
    assert bound_expression(parse("b/h"), PARAMETERS, 0.5) == (2.0, 8.0)


@pytest.mark.parametrize("links", [5, 7, 8, 9, 16, 40])
@pytest.mark.parametrize("operators", ["+-", "-", "*/", "/", "--+", "/**"])
def test_a_chain_is_worth_what_it_is_from_left_to_right(links: int, operators: str) -> None:
    text, expected = "3", 3.0
    for k in range(links):
        operator, operand = operators[k % len(operators)], k + 2.0
        text += f" {operator} {operand!r}"
        expected = {
            "+": expected + operand,
            "-": expected - operand,
            "*": expected * operand,
            "/": expected / operand,
        }[operator]
    assert evaluate_expression(parse(text), {}) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "counts", "expected"),
    [
        ("x(k-1)*u", True, "x(k-3 - b)*u(k-2 - b)"),
        ("u(k-1 - z)", True, "u(k-3 - (z + b))"),
        ("k", True, "k - (2 + b)"),
        ("t", True, "t - (2 + b)*h"),
        ("t", False, "t - (2 + b)"),
        ("a + h", True, "a + h"),
    ],
)
def test_a_shift_goes_back_by_whole_steps_and_a_delay(
    text: str, counts: bool, expected: str
) -> None:
    shifted = shift_expression(parse(text), 2, parse("b"), counts=counts)
    assert format_expression(shifted) == format_expression(parse(expected))


def test_no_shift_and_no_delay_change_nothing() -> None:
    tree, delay = parse("x(k-1) + t"), parse("b")
    assert shift_expression(tree, 0, None, counts=True) is tree
    assert add_delays(None, delay) is add_delays(delay, None) is delay
    assert add_delays(None, None) is None
