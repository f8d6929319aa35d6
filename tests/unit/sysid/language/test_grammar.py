"""The grammar: what parses, to which tree, with which precedence."""

import pytest

from sysid.language.checker import check_expression
from sysid.language.printer import format_expression
from sysid.language.scope import Scope
from sysid.language.tree import Binary, FunctionCall, Number, PastValue, Symbol, Unary

X, Y, Q = PastValue("x", "state"), PastValue("y", "state"), PastValue("q", "input")
C = Symbol("c", "parameter")

SCOPE = Scope(
    "difference",
    states=("x", "y"),
    inputs=("q",),
    parameters={"c": (0.0, 1.0)},
    constants={"m": 2.5},
)


def tree(written: str) -> object:
    found = check_expression(written, SCOPE)
    assert found.faults == ()
    return found.tree


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("1.5", Number(1.5)),
        (".5", Number(0.5)),
        ("2.", Number(2.0)),
        ("1e-3", Number(1e-3)),
        ("pi", Number(3.141592653589793)),
        ("m", Number(2.5)),
        ("c", C),
        ("t", Symbol("t", "time")),
        ("k", Symbol("k", "index")),
        ("h", Symbol("h", "period")),
        ("x", X),
        ("q", Q),
        ("(((x)))", X),
    ],
)
def test_names_and_numbers_stand_for_what_is_declared(written: str, expected: object) -> None:
    assert tree(written) == expected


def test_products_bind_tighter_than_sums_and_both_group_to_the_left() -> None:
    assert tree("x - y + q*c/c") == Binary(
        "+", Binary("-", X, Y), Binary("/", Binary("*", Q, C), C)
    )


def test_powers_bind_tighter_than_the_sign_and_group_to_the_right() -> None:
    assert tree("-x**2") == Unary("-", Binary("**", X, Number(2.0)))
    assert tree("x**y**2") == Binary("**", X, Binary("**", Y, Number(2.0)))
    assert tree("x**-y") == Binary("**", X, Unary("-", Y))


def test_conditions_know_not_before_and_before_or() -> None:
    positive, small = Binary(">", X, Number(0.0)), Binary("<=", Y, Number(1.0))
    both = Binary("and", Unary("not", positive), small)
    expected = FunctionCall("where", (Binary("or", positive, both), X, Y))
    assert tree("where(x > 0 or not x > 0 and y <= 1, x, y)") == expected


def test_min_and_max_of_several_are_taken_two_by_two() -> None:
    assert tree("min(x, y, q)") == FunctionCall("min", (FunctionCall("min", (X, Y)), Q))


def test_a_table_has_its_argument_all_x_and_all_y() -> None:
    points = (Number(-1.0), Number(0.0), Number(2.5), C, Number(1.0), Binary("*", Number(2.0), C))
    assert tree("pchip(x, [-1, 0, m], [c, 1, 2*c])") == FunctionCall("pchip", (X, *points))


def test_a_sum_of_a_thousand_terms_makes_a_shallow_tree() -> None:
    found = check_expression("+".join(["x"] * 1000), SCOPE)
    assert found.faults == ()
    assert len(found.uses) == 1000


def test_words_of_the_difference_form_are_free_in_the_differential_form() -> None:
    scope = Scope("differential", states=("h",), parameters={"k": (0.0, 1.0)})
    found = check_expression("-k*h", scope)
    assert found.tree == Binary("*", Unary("-", Symbol("k", "parameter")), PastValue("h", "state"))


@pytest.mark.parametrize(
    "written",
    [
        "x - (y - q)",
        "x/(y*c)",
        "(-x)**2",
        "(x**y)**2",
        "-(x + y)",
        "where(x < 1, -x, x(k-1 - c/h))",
        "table(x - y, [-1, 2.5, 4], [c, -2, 3*c])",
    ],
)
def test_the_printer_keeps_the_parentheses_that_matter(written: str) -> None:
    assert format_expression(tree(written)) == written  # type: ignore[arg-type]
