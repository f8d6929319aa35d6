"""What is not in the language is refused, with the column and what would be right."""

import pytest

from sysid.language.checker import check_expression
from sysid.language.scope import Scope

SCOPE = Scope(
    "difference",
    states=("x", "speed"),
    inputs=("q",),
    parameters={"L": (0.0, 1.0), "c": (0.0, 1.0)},
)


@pytest.mark.parametrize(
    ("written", "column", "part"),
    [
        ("2*sped(k-1)", 3, "did you mean 'speed'?"),
        ("x(k-1) + sped", 10, "did you mean 'speed'?"),
        ("sinn(x)", 1, "did you mean 'sin'?"),
        ("sin*2", 1, "write sin(…)"),
        ("sin(x, x)", 1, "takes 1 argument, not 2"),
        ("min(x)", 1, "takes 2 or more arguments, not 1"),
        ("where(x > 0, 1)", 1, "takes 3 arguments, not 2"),
        ("c(x)", 1, "'c' is not a signal"),
        ("x()", 1, "takes one index"),
        ("x(k, 1)", 1, "takes one index"),
        ("x > 1", 3, "only for the condition of where"),
        ("not x", 1, "only for the condition of where"),
        ("where(x, 1, 2)", 7, "a condition compares two values"),
        ("where(0 < x < 1, 1, 2)", 13, "comparisons do not chain"),
        ("(x + 1", 1, "is not closed"),
        ("sin(x + (1)", 4, "is not closed"),
        ("x + 1)", 6, "never opened"),
        ("2 x", 3, "an operator such as * is missing"),
        ("x +", 4, "the expression ends"),
        ("*x", 1, "unexpected '*'"),
        ("+x", 1, "leave it out"),
        ("x, c", 2, "only separates the arguments of a function"),
        ("", 1, "empty"),
        ("x^2", 2, "write ** for a power"),
        ("x = 2", 3, "write == to compare"),
        ("x[k", 2, "write a past value with parentheses"),
        ("if(x > 0, 1, 2)", 1, "write where(condition, a, b)"),
        ("1 if x > 0 else 2", 3, "write where(condition, a, b)"),
        ("sat(x, 1)", 1, "write clip(x, lower, upper)"),
        ("interp1(x, c)", 1, "write table(u, [x1, x2], [y1, y2])"),
        ("ln(x)", 1, "write log(x)"),
        ("delay(q, L)", 1, "write u(t - L)"),
        ("2*x'", 4, "' marks a derivative"),
        ("-x'' + c", 3, "write that expression, or name it in let"),
        ("c*x²", 3, "write x**2 for a power"),
        ("e**x", 1, "write exp(x)"),
        ("0,5*x", 2, "0.5 is written with a point"),
        ("x ≤ 1", 3, "write <="),
        ("[1, 2]", 1, "only for the points of table"),
        ("table(x, [0, 1], [0, 1)", 18, "the bracket opened at column 18 is not closed"),
        ("table(x, [0 1], [0, 1])", 13, "a comma is missing before '1'"),
        ("table(x, 0, 1)", 10, "two lists, such as table(x, [0, 1, 2], [0, 5, 7])"),
        ("table(x, [0, 1])", 1, "takes 3 arguments, not 2"),
        ("table(x, [0], [1])", 1, "1 values of x and 1 of y"),
        ("pchip(x, [0, 1], [1])", 1, "2 values of x and 1 of y"),
        ("table(x, [0, 2, 2], [1, 2, 3])", 17, "must increase, but 2 follows 2"),
        ("table(x, [0, c], [1, 2])", 14, "the x of a table are numbers"),
        ("table(x, [0, 1/0], [1, 2])", 15, "is inf; need a number within ±1e+100"),
        ("table(x, [0, 1e200], [1, 2])", 14, "is 1e+200; need a number within ±1e+100"),
        ("pchip(x, [0, 1e-200, 1], [1, 2, 3])", 14, "must increase, by 1e-100 or more, but"),
        ("pchip(x, [0, 1], [0/0, 2])", 20, "this y of the table is nan; need a finite number"),
        ("table(x, [0, 1], [1, q])", 22, "do not change in time"),
        ("table(x, [0, 1], [1, t])", 22, "do not change in time"),
        ("table(x, [" + "1, " * 128 + "1], [0, 1])", 1, "2 to 128"),
        ("x.real", 2, "attributes are not part"),
        ("'x'", 1, "strings are not part"),
        ("1e999", 1, "too large"),
        ("lambda: 1", 7, "':' is not part"),
        ("x\x00", 2, "is not part of the language"),
        ("x(3)", 1, "does not count from k"),
        ("x(2*k)", 1, "changes with time"),
        ("x(k - k**2)", 1, "changes with time"),
        ("x(t - L)", 1, "write x(k - n - L/h)"),
        ("x(k - L*t)", 1, "counts seconds"),
        ("x(k + 1)", 1, "value in the future"),
        ("x(k - 1 - x)", 11, "the delay depends on 'x'"),
        ("q(k - speed(k-1))", 7, "the delay depends on 'speed'"),
        ("q(k + 1 - c)", 1, "the delay c - 1 may be negative"),
        ("x(k - 1.5 + 2*c)", 1, "its smallest value is -0.5 samples"),
        ("q(k + c)", 1, "its smallest value is -1 samples"),
        ("q(k - 1/c)", 1, "has no upper limit"),
        ("q(k - 1e9)", 1, "reaches 1e+09, above 1e+06,"),
        ("q(k - 1e300*1e300)", 1, "has no upper limit"),
        ("q(k - 1/0)", 1, "may be negative"),
        ("q(k + L/h)", 1, "its smallest value is -1 s"),
    ],
)
def test_a_fault_names_its_column_and_what_would_be_right(
    written: str, column: int, part: str
) -> None:
    found = check_expression(written, SCOPE)
    assert found.tree is None
    assert [fault.column for fault in found.faults] == [column]
    assert part in found.faults[0].detail


def test_python_is_not_the_language() -> None:
    found = check_expression("__import__('os').system('ls')", SCOPE)
    assert found.tree is None
    assert [fault.column for fault in found.faults] == [12, 17, 25]


def test_an_unknown_call_and_its_argument_are_both_told() -> None:
    found = check_expression("__import__('os')", SCOPE)
    assert [fault.column for fault in found.faults] == [1, 12]
    assert "no function or signal '__import__'" in found.faults[0].detail


def test_every_unknown_name_of_a_text_is_told_in_the_order_of_the_text() -> None:
    found = check_expression("foo + 2*bar(baz) + x", SCOPE)
    assert [fault.column for fault in found.faults] == [1, 9, 13]


@pytest.mark.parametrize("written", ["(" * 65 + "x" + ")" * 65, "-" * 70 + "x", "x**" * 70 + "x"])
def test_nesting_deeper_than_64_levels_is_refused(written: str) -> None:
    [fault] = check_expression(written, SCOPE).faults
    assert "deeper than 64" in fault.detail


def test_nesting_of_sums_in_sums_is_measured_on_the_tree() -> None:
    written = "x"
    for _ in range(40):
        written = f"({written} + x + x + x)"
    [fault] = check_expression(written, SCOPE).faults
    assert "deeper than 64" in fault.detail


def test_a_text_of_more_than_4000_characters_is_refused_unread() -> None:
    [fault] = check_expression("x" * 4001, SCOPE).faults
    assert "4001 characters" in fault.detail


def test_the_sampling_period_is_not_known_in_the_differential_form() -> None:
    [fault] = check_expression("h*x", Scope("differential", states=("x",))).faults
    assert "difference form only" in fault.detail


@pytest.mark.parametrize(
    ("written", "part"),
    [("x(t - L)", "smallest value is -0.5 s"), ("x(1)", "write x(t - L)"), ("x(2*t)", "with time")],
)
def test_lags_of_the_differential_form_are_checked_in_seconds(written: str, part: str) -> None:
    [fault] = check_expression(
        written, Scope("differential", ("x",), (), {"L": (-0.5, 1.0)})
    ).faults
    assert part in fault.detail
