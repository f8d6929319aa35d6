"""Past values: any arrangement of the index gives the same whole samples and unknown lag."""

import pytest

from sysid.language.checker import check_expression
from sysid.language.printer import format_expression
from sysid.language.scope import Scope
from sysid.language.tree import Binary, Number, PastValue, Symbol
from sysid.language.value_intervals import bound_expression

L, D, H = Symbol("L", "parameter"), Symbol("d", "parameter"), Symbol("h", "period")
SAMPLES = Binary("/", L, H)

DISCRETE = Scope(
    "difference",
    states=("x",),
    inputs=("q",),
    parameters={"L": (0.0, 1.0), "d": (1.0, 20.0), "z": (0.0, 2.0)},
    constants={"n": 3.0},
)
CONTINUOUS = Scope(
    "differential", states=("x",), inputs=("q",), parameters={"L": (0.0, 1.0), "d": (1.0, 20.0)}
)


def past(written: str, scope: Scope = DISCRETE) -> PastValue:
    found = check_expression(written, scope)
    assert found.faults == ()
    assert isinstance(found.tree, PastValue)
    return found.tree


@pytest.mark.parametrize(
    "written",
    [
        "x(k-1-L/h)",
        "x(k - L/h - 1)",
        "x(k - (L/h + 1))",
        "x(-L/h + k - 1)",
        "x((k*h - L - h)/h)",
        "x((2*k - 2*L/h)/2 - 1)",
        "x(k - (L + h)/h)",
        "x(k - n + 2 - L/h)",
        "x(k - 1 - (L*h + L)/h + L)",
    ],
)
def test_every_arrangement_of_one_index_is_one_past_value(written: str) -> None:
    assert past(written) == PastValue("x", "state", 1, SAMPLES)


@pytest.mark.parametrize(
    ("written", "offset", "lag"),
    [
        ("x(k-2)", 2, None),
        ("x(k - n)", 3, None),
        ("x(k-1.5)", 1, Number(0.5)),
        ("q(k - L/h)", 0, SAMPLES),
        ("q(k-2 - L/h)", 2, SAMPLES),
        ("q(k)", 0, None),
        ("q(k-0)", 0, None),
        ("q", 0, None),
        ("x(k-d)", 1, Binary("-", D, Number(1.0))),
        ("x(k-(1+d))", 1, D),
        ("q(k - 2*d)", 1, Binary("-", Binary("*", Number(2.0), D), Number(1.0))),
        ("q(k - 2 + z)", 0, None),
    ],
)
def test_an_index_is_split_into_whole_samples_and_an_unknown_lag(
    written: str, offset: int, lag: object
) -> None:
    found = past(written)
    assert found.offset == offset
    if written != "q(k - 2 + z)":
        assert found.delay == lag
    else:  # between 0 and 2 samples: nothing of it is fixed
        assert format_expression(found) == "q(k-2 - -z)"


@pytest.mark.parametrize(("lower", "offset"), [(0.0, 0), (0.5, 0), (0.999, 0), (1.0, 1), (3.0, 1)])
def test_a_whole_sample_is_split_off_only_if_the_delay_is_never_shorter(
    lower: float, offset: int
) -> None:
    scope = Scope("difference", inputs=("q",), parameters={"d": (lower, 20.0)})
    found = past("q(k - d)", scope)
    assert found.offset == offset
    assert found.delay is not None
    assert bound_expression(found.delay, scope.parameters) == (lower - offset, 20.0 - offset)


@pytest.mark.parametrize(
    ("written", "lag"),
    [
        ("x(t)", None),
        ("x", None),
        ("x(t - L)", L),
        ("x(-L + t)", L),
        ("x(t - (L + 0.5))", Binary("+", L, Number(0.5))),
        ("x(t - 0.5)", Number(0.5)),
        ("x(t - L + L)", None),
    ],
)
def test_the_differential_form_keeps_the_whole_lag_in_seconds(written: str, lag: object) -> None:
    assert past(written, CONTINUOUS) == PastValue("x", "state", 0, lag)  # type: ignore[arg-type]


def test_equal_lags_of_neighbouring_samples_are_equal_trees() -> None:
    assert past("x(k-1 - L/h)").delay == past("x((k*h - L)/h - 2)").delay


def test_a_function_of_parameters_may_be_a_lag() -> None:
    assert past("x(t - sqrt(L*d))", CONTINUOUS).delay is not None


def test_the_sum_of_two_lags_that_cancel_in_part_is_not_thought_negative() -> None:
    assert past("x(t - (L + d - L))", CONTINUOUS).delay == D
