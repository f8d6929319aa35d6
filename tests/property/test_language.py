"""Laws of the language: printing and parsing, intervals, and that no text whatever does harm."""

import math
from fractions import Fraction
from xml.etree import ElementTree

from hypothesis import assume, example, given
from hypothesis import strategies as st

from sysid.language.checker import check_expression
from sysid.language.functions import FUNCTIONS
from sysid.language.mathml import format_mathml
from sysid.language.monomials import collect_terms, to_expression
from sysid.language.printer import format_expression
from sysid.language.scope import Scope
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary
from sysid.language.value_intervals import bound_expression
from tests.support.library.expression_values import meaning

SCOPE = Scope(
    "difference",
    states=("x", "y"),
    inputs=("q",),
    parameters={"L": (0.0, 1.0), "d": (1.0, 20.0), "μ": (-2.0, 3.0)},
)
PERIOD = 0.02

numbers = st.one_of(st.integers(0, 9).map(float), st.floats(0, 1e6)).map(Number)
symbols = st.sampled_from(
    [Symbol(n, "parameter") for n in ("L", "d", "μ")] + [Symbol("h", "period")]
)
pasts = st.sampled_from(
    ["x", "q", "x(k-1)", "y(k-2)", "x(k-1 - L/h)", "q(k - L/h)", "y(k - d)", "x(k-1.5)"]
).map(lambda written: check_expression(written, SCOPE).tree)


def _table(name: str, argument: Expression, count: int) -> Expression:
    x = (Number(-1.5), Number(0.0), Number(0.25), Number(1e3))[:count]
    y = (Number(2.0), Symbol("μ", "parameter"), Unary("-", Number(7.5)), Symbol("L", "parameter"))[
        -count:
    ]
    return FunctionCall(name, (argument, *x, *y))


def _grown(inner: st.SearchStrategy[Expression]) -> st.SearchStrategy[Expression]:
    comparison = st.builds(
        Binary, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), inner, inner
    )
    condition = st.one_of(
        comparison,
        comparison.map(lambda one: Unary("not", one)),
        st.builds(Binary, st.sampled_from(["and", "or"]), comparison, comparison),
    )
    single = [name for name, function in FUNCTIONS.items() if function.most == 1]
    return st.one_of(
        st.builds(Binary, st.sampled_from(["+", "-", "*", "/", "**"]), inner, inner),
        inner.map(lambda one: Unary("-", one)),
        st.builds(lambda f, a: FunctionCall(f, (a,)), st.sampled_from(single), inner),
        st.builds(
            lambda f, a, b: FunctionCall(f, (a, b)),
            st.sampled_from(["min", "max", "mod", "atan2"]),
            inner,
            inner,
        ),
        st.builds(lambda *inside: FunctionCall("clip", inside), inner, inner, inner),
        st.builds(_table, st.sampled_from(["table", "pchip"]), inner, st.integers(2, 4)),
        st.builds(lambda c, a, b: FunctionCall("where", (c, a, b)), condition, inner, inner),
    )


trees = st.recursive(st.one_of(numbers, symbols, pasts), _grown, max_leaves=12)
still = st.recursive(st.one_of(numbers, symbols), _grown, max_leaves=8)
values = st.fixed_dictionaries(
    {"L": st.floats(0, 1), "d": st.floats(1, 20), "μ": st.floats(-2, 3), "h": st.just(PERIOD)}
)


@given(trees)
def test_a_printed_tree_parses_to_itself(tree: Expression) -> None:
    assert check_expression(format_expression(tree), SCOPE).tree == tree


@given(still, values)
def test_a_value_lies_inside_its_interval(tree: Expression, at: dict[str, float]) -> None:
    low, high = bound_expression(tree, SCOPE.parameters, PERIOD)
    try:
        value = meaning(tree, at, _no_signal)
    except (ArithmeticError, ValueError):
        return
    assume(not math.isnan(value))
    slack = 1e-9 * (1 + abs(value)) if math.isfinite(value) else 0.0
    assert low - slack <= value <= high + slack


@given(still, values, st.floats(1e-4, 10))
def test_an_interval_for_any_period_holds_that_of_one_period(
    tree: Expression, at: dict[str, float], period: float
) -> None:
    low, high = bound_expression(tree, SCOPE.parameters)
    inner_low, inner_high = bound_expression(tree, SCOPE.parameters, period)
    assert low <= inner_low
    assert inner_high <= high


factors = st.sampled_from([Symbol(name, "parameter") for name in "abc"])
rational = st.recursive(
    st.one_of(st.integers(-8, 8).map(lambda n: Number(float(n))), factors),
    lambda inner: st.builds(Binary, st.sampled_from(["+", "-", "*", "/"]), inner, inner),
    max_leaves=8,
)


def _raise(base: Expression, exponent: int) -> Expression:
    return Binary("**", base, Number(float(exponent)))


@given(rational)
def test_collecting_terms_keeps_the_value(tree: Expression) -> None:
    at = {"a": Fraction(3, 7), "b": Fraction(-5, 3), "c": Fraction(11, 2)}
    try:
        expected = float(meaning(tree, at, _no_signal))  # type: ignore[arg-type]
        found = float(meaning(to_expression(collect_terms(tree)), at, _no_signal))  # type: ignore[arg-type]
    except ZeroDivisionError:
        return
    assert math.isclose(expected, found, rel_tol=1e-6, abs_tol=1e-6)


powers = st.recursive(
    rational, lambda inner: st.builds(_raise, inner, st.integers(0, 3)), max_leaves=4
)


@given(powers)
@example(check_expression("L - (L - (d - L*-d))/-(L + d)**2", SCOPE).tree)
@example(check_expression("1 - L - d - L - d - L - d - L - d - L - d - L", SCOPE).tree)
def test_an_equation_as_shown_has_the_value_of_its_text(tree: Expression) -> None:
    at = {"a": Fraction(3, 7), "b": Fraction(-5, 3), "c": Fraction(11, 2)}
    at |= {"L": Fraction(2, 9), "d": Fraction(7, 4)}
    shown = _read(ElementTree.fromstring(f"<math>{format_mathml(format_expression(tree))}</math>"))
    scope = Scope("differential", parameters=dict.fromkeys(at, (-9.0, 9.0)))
    seen = check_expression(shown, scope)
    assert seen.tree is not None, (shown, seen.faults)
    try:
        expected = meaning(tree, at, _no_signal)  # type: ignore[arg-type]
    except ZeroDivisionError:
        return
    assert math.isclose(expected, meaning(seen.tree, at, _no_signal), rel_tol=1e-9), shown  # type: ignore[arg-type]


def _read(shown: ElementTree.Element) -> str:
    """Read MathML as a reader does: what stands in a row is a text, whoever made the row."""
    parts = [_read(child) for child in shown]
    match shown.tag:
        case "mfrac":
            return f"(({parts[0]})/({parts[1]}))"
        case "msup":
            return f"{parts[0]}**({parts[1]})"
        case _:
            text = {"−": "-", "⋅": "*"}.get(shown.text or "", shown.text or "")
            return text + "".join(parts)


@given(st.text(max_size=200))
@example("__import__('os')")
@example("x" * 3999)
@example("9" * 4000)
@example("(" * 4000)
@example("x(" * 1999)
@example("-" * 4000)
@example("x(k-" * 60 + "1" + ")" * 60)
@example("x**9" * 900)
def test_no_text_raises_or_gives_both_a_tree_and_faults(written: str) -> None:
    found = check_expression(written, SCOPE)
    assert (found.tree is None) == bool(found.faults)
    assert all(1 <= fault.column <= len(written) + 1 for fault in found.faults)


words = st.lists(
    st.sampled_from(
        [*"xyqLdhkt19(),+-*/<", "2.5", "(k-1)", "(k-L/h)", "**", "==", "and", "or", "not"]
    ),
    max_size=25,
).map(" ".join)


@given(words)
def test_no_arrangement_of_the_language_s_own_words_raises(written: str) -> None:
    found = check_expression(written, SCOPE)
    if found.tree is not None:
        assert check_expression(format_expression(found.tree), SCOPE).tree is not None


@given(st.integers(0, 5), st.permutations(["+ k", "- {n}", "- L/h", "+ 1", "- 1", "+ d - d"]))
def test_the_order_of_an_index_does_not_matter(n: int, parts: list[str]) -> None:
    index = " ".join(["0", *parts]).format(n=n)
    samples = Binary("/", Symbol("L", "parameter"), Symbol("h", "period"))
    assert check_expression(f"q({index})", SCOPE).tree == PastValue("q", "input", n, samples)


def _no_signal(past: PastValue, lag: float) -> float:
    raise AssertionError("no signal here")
