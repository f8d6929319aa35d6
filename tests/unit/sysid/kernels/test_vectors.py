"""Functions of the vector library give what NumPy gives, in every lane, and hide no divergence."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy import special
from scipy.interpolate import PchipInterpolator

from sysid import load_model
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.kernels import vectors
from sysid.kernels.compilation import machine_code
from sysid.kernels.vectors import VectorFunctions, load_vector_functions
from sysid.simulation.problem import Problem

FUNCTIONS = {
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "tanh": np.tanh,
    "atan": np.arctan,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "log10": np.log10,
    "erf": special.erf,
    "floor": np.floor,
}
PLACES = np.array([-800.0, -3.0, -0.5, -1e-9, 0.0, 1e-300, 0.7, 1.0, 30.0, 709.0, 710.0, 1e5])


def values_of(expression: str, candidates: FloatArray) -> FloatArray:
    """The second sample of a recursion that gives an expression of its parameters p and q."""
    bounds = {"lower": -1e6, "upper": 1e6}
    model = load_model(
        {
            "name": "function",
            "form": "difference",
            "states": {"x": "1"},
            "parameters": {"p": bounds, "q": bounds},
            "equations": {"x": expression},
            "outputs": {"y": "x"},
            "initial": {"x": 0},
        }
    )
    times = np.arange(2.0)
    record = Record((), (Channel("y", times, times, "1"),))
    return np.asarray(Problem.build(model, [record]).predict(candidates)[:, 1])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_is_that_of_numpy_also_where_it_overflows_or_is_undefined(name: str) -> None:
    candidates = np.column_stack([PLACES, PLACES])
    with np.errstate(all="ignore"):
        expected = FUNCTIONS[name](PLACES)
    np.testing.assert_allclose(
        values_of(f"{name}(p) + 0*x(k-1)", candidates), expected, rtol=1e-14, atol=1e-300
    )


PAIRS = np.array([-7.5, -1.0, -0.3, 0.0, 1e-9, 0.1, 0.3, 1.0, 2.0, 7.7, 1e5])


@pytest.mark.parametrize(("name", "expected"), [("mod", np.mod), ("atan2", np.arctan2)])
def test_a_function_of_two_numbers_is_that_of_numpy(
    name: str, expected: Callable[[FloatArray, FloatArray], FloatArray]
) -> None:
    candidates = np.array([(a, b) for a in PAIRS for b in PAIRS])
    found = values_of(f"{name}(p, q) + 0*x(k-1)", candidates)
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(
            found, expected(candidates[:, 0], candidates[:, 1]), rtol=1e-14, atol=1e-300
        )


@pytest.mark.parametrize("name", ["table", "pchip"])
@pytest.mark.parametrize(
    ("x", "y"),
    [
        ([-3.0, 4.0], [2.0, -1.0]),
        ([-3.0, 0.5, 1.0], [2.0, 2.5, 9.0]),
        ([-3.0, -2.0, 0.0, 0.5, 2.0, 7.0], [0.0, 0.0, 3.0, 2.0, 2.5, 2.6]),
        ([-3.0, -2.9, 0.0, 0.5, 2.0], [5.0, 0.0, -1e-3, 1e6, 1e6]),
    ],
)
def test_a_table_is_that_of_scipy_also_with_parameters(
    name: str, x: list[float], y: list[float]
) -> None:
    places = np.concatenate([np.linspace(-4, 8, 97), x, [-1e300, 1e300, np.nextafter(0.5, 0)]])
    candidates = np.column_stack([places, np.full(places.size, y[-2])])
    inside = np.clip(places, x[0], x[-1])
    expected = np.interp(places, x, y) if name == "table" else PchipInterpolator(x, y)(inside)
    for middle in (repr(y[-2]), "q"):
        values = ", ".join([*map(repr, y[:-2]), middle, repr(y[-1])])
        found = values_of(f"{name}(p, {x}, [{values}]) + 0*x(k-1)", candidates)
        np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-15 * np.max(np.abs(y)))
    lost = values_of(f"{name}(log(-1 - p**2), {x}, {y}) + 0*x(k-1)", candidates)
    assert np.all(np.isnan(lost))


def test_limits_pass_a_divergence_on() -> None:
    candidates = np.array([(a, b) for a in (-3.0, 0.2, 5.0) for b in (-1.0, 0.5)])
    expected = np.clip(candidates[:, 0], candidates[:, 1], 1.0)
    np.testing.assert_array_equal(values_of("clip(p, q, 1) + 0*x(k-1)", candidates), expected)
    assert np.all(np.isnan(values_of("clip(log(-1 - p**2), q, 1) + 0*x(k-1)", candidates)))


def test_a_power_is_that_of_numpy_for_any_base_and_exponent() -> None:
    bases, exponents = np.array([-2.0, -2.0, 0.0, 0.3, 5.0]), np.array([3.0, 0.5, 2.0, -1.7, 400.0])
    candidates = np.array([(a, b) for a in bases for b in exponents])
    with np.errstate(all="ignore"):
        expected = np.power(candidates[:, 0], candidates[:, 1])
    found = values_of("p**q + 0*x(k-1)", candidates)
    np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_a_lane_does_not_depend_on_its_neighbours() -> None:
    candidates = np.column_stack([PLACES, PLACES])
    alone = np.array([values_of("exp(p) + 0*x(k-1)", one[None])[0] for one in candidates])
    np.testing.assert_array_equal(values_of("exp(p) + 0*x(k-1)", candidates), alone)


def test_a_machine_without_the_library_computes_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    candidates = np.column_stack([PLACES, PLACES])
    text = "tanh(p) + sin(q) + erf(p) + atan2(p, q) + 0*x(k-1)"
    with_library = values_of(text, candidates)
    monkeypatch.setattr(vectors, "load_vector_functions", lambda: VectorFunctions(1, {}))
    monkeypatch.setattr(machine_code, "load_vector_functions", lambda: VectorFunctions(1, {}))
    machine_code.describe_machine.cache_clear()
    try:
        without = values_of(text, candidates)
    finally:
        machine_code.describe_machine.cache_clear()
    np.testing.assert_allclose(without, with_library, rtol=1e-13)


def test_each_symbol_names_its_lanes_and_arguments() -> None:
    offered = load_vector_functions()
    for name, symbol in offered.symbols.items():
        arguments = "vv" if name in ("pow", "atan2") else "v"
        assert symbol[5:] == f"N{offered.lanes}{arguments}_{name}"
