"""Expressions of time by NumPy: what the same expression gives as a model's output."""

import numpy as np
import pytest

from sysid.language.checker import check_expression
from sysid.language.evaluation import evaluate_signal
from sysid.language.scope import Scope
from sysid.models.parse import parse_model
from sysid.simulation.simulate import simulate

TIMES = np.arange(400) / 16  # exact, so that comparisons with them are


@pytest.mark.parametrize(
    "expression",
    [
        "12e3*(0.55*sin(2.2*t) + 0.6*cos(5.65*t + 1))",
        "3",
        "-t**2 + pi",
        "k*h",
        "exp(-t/2)*log(t + 1)",
        "where(t < 2 or not (t <= 4 and t != 3), 1, min(t, 5, k/7))",
        "sqrt(t - 3)",
        "1/(t - 3)",
        "abs(tan(t)) + sign(t - 4)*tanh(t) - atan(t)",
        "max(log(t - 1), 0)",
        "sinh(t/9) + cosh(t - 12)*erf(t - 3) + log10(t + 1)",
        "mod(t, 3) - floor(t/5) + clip(t, 2, 20 - t) + atan2(t - 4, 3 - t)",
        "mod(-t, 0.7) + mod(t - 4, -1.25)",
        "table(t, [1, 2.5, 11, 17], [3, -1, 8, 8])",
        "pchip(t, [1, 2.5, 11, 17, 20, 21], [3, -1, 8, 8, 7.5, 2])",
        "pchip(t - 3, [0, 15], [1, -2]) + table(log(t - 4), [0, 1], [2, 3])",
        "t**0.5 + 2**(-t)",
        "log(t - 3)",
        "where(t > 5, sqrt(t - 5), -1)",
        "(t - 3)**3",
    ],
)
def test_values_are_those_of_a_kernel(expression: str) -> None:
    tree = check_expression(expression, Scope("difference")).tree
    assert tree is not None
    model = parse_model(
        {
            "name": "wave",
            "form": "difference",
            "states": {"unused": "1"},
            "equations": {"unused": "0"},
            "initial": {"unused": 0},
            "outputs": {"y": expression},
        }
    )
    expected = simulate(model, [], {}, times=TIMES).channel("y").values
    small = 1e-12 * np.max(np.abs(expected[np.isfinite(expected)]))
    np.testing.assert_allclose(evaluate_signal(tree, TIMES), expected, rtol=1e-12, atol=small)


def test_what_it_has_no_value_for_is_nan() -> None:
    tree = check_expression("x(k-1) + 1", Scope("difference", states=("x",))).tree
    assert tree is not None
    assert np.all(np.isnan(evaluate_signal(tree, TIMES)))
