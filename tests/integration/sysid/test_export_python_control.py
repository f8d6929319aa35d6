"""An exported transfer function is that of the equations, and of the simulation."""

from typing import Any

import numpy as np
import pytest
import yaml
from scipy.signal import lfilter

import sysid
from sysid.control.linear_form import NotLinear
from sysid.core.errors import InvalidSettings
from sysid.data.records import Hold
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from tests.support.library.exported_programs import run_control, simulate_outputs

N = 240
VALUES: dict[str, dict[str, float]] = {
    "fopdt": {"K": 2, "T": 0.8, "L": 0.4337, "y0": 0.3},
    "sopdt": {"K": 2, "T1": 0.8, "r": 0.4, "L": 0.4337, "y0": 0.3},
    "topdt": {"K": 2, "T1": 0.8, "r2": 0.4, "r3": 0.5, "L": 0.4337, "y0": 0.3},
    "foipdt": {"K": 0.8, "T": 0.3, "L": 0.4337},
    "tube": {"K": 1, "T": 0.3, "L": 0.2137},
    "tube-second-order": {"K": 1, "w": 5, "z": 0.5, "L": 0.4337},
}
OMEGA = np.array([0.02, 0.3, 1.0, 3.0, 11.0])
S = 1j * OMEGA
DELAYED_DAMPER = {
    "name": "damper",
    "form": "differential",
    "inputs": {"q": "N", "r": "N"},
    "states": {"x": "m", "v": "m/s"},
    "parameters": {"L": {"lower": 0, "upper": 1, "unit": "s"}, "c": {"lower": 0, "upper": 9}},
    "equations": {"x": "v", "v": "q(t - 2*L) - 0.5*r - c*v(t - L) - 4*x + 0.1"},
    "outputs": {"y": "x + 1", "z": "v(t - L) + 0.3*q"},
    "initial": {"x": 0, "v": 0},
}
DAMPER = 1 / (S**2 + 0.4 * S * np.exp(-0.3 * S) + 4)
EXPECTED = {
    "fopdt": {("u", "y"): 2 * np.exp(-0.4337 * S) / (0.8 * S + 1)},
    "sopdt": {("u", "y"): 2 * np.exp(-0.4337 * S) / ((0.8 * S + 1) * (0.32 * S + 1))},
    "topdt": {
        ("u", "y"): 2 * np.exp(-0.4337 * S) / ((0.8 * S + 1) * (0.32 * S + 1) * (0.16 * S + 1))
    },
    "foipdt": {("u", "y"): 0.8 * np.exp(-0.4337 * S) / (S * (0.3 * S + 1))},
    "tube": {("u", "y"): np.exp(-0.2137 * S) / (0.3 * S + 1)},
    "tube-second-order": {("u", "y"): 25 * np.exp(-0.4337 * S) / (S**2 + 5 * S + 25)},
    "damper": {
        ("q", "y"): DAMPER * np.exp(-0.6 * S),
        ("r", "y"): -0.5 * DAMPER,
        ("q", "z"): DAMPER * S * np.exp(-0.9 * S) + 0.3,
        ("r", "z"): -0.5 * DAMPER * S * np.exp(-0.3 * S),
    },
}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_transfer_function_is_that_of_the_equations(name: str) -> None:
    if name == "damper":
        model, values = parse_model(DELAYED_DAMPER), {"L": 0.3, "c": 0.4}
    else:
        model, values = load_model(name), VALUES[name]
    script = run_control(sysid.export_model(model, values, "control", pade_order=4))
    assert set(script["pairs"]) == set(script["systems"]) == set(EXPECTED[name])
    for pair, expected in EXPECTED[name].items():
        exact = script["response"](script["pairs"][pair], OMEGA)
        np.testing.assert_allclose(exact, expected, rtol=1e-12)
        rational = np.array([script["systems"][pair].at(s) for s in S])
        np.testing.assert_allclose(rational[:4], expected[:4], rtol=1e-3)


def test_the_frequency_response_is_that_of_the_simulation() -> None:
    model, values = parse_model(DELAYED_DAMPER), {"L": 0.3, "c": 0.4}
    script = run_control(sysid.export_model(model, values, "control"))
    times, omega = 0.01 * np.arange(12_000), 1.0
    inputs = {"q": np.sin(omega * times), "r": np.zeros(times.size)}
    outputs = simulate_outputs(model, values, times, inputs, "first")
    last = times > times[-1] - 4 * np.pi / omega
    columns = [np.sin(omega * times[last]), np.cos(omega * times[last]), np.ones(int(last.sum()))]
    for output, signal in zip(("y", "z"), outputs, strict=True):
        real, imaginary, _ = np.linalg.lstsq(np.stack(columns, 1), signal[last])[0]
        expected = script["response"](script["pairs"]["q", output], [omega])[0]
        assert abs(complex(real, imaginary) - expected) < 1e-4 * abs(expected)


LINEAR_RECURSION = """
name: linear
form: difference
inputs: {u: "1"}
states: {x: "1", w: "1"}
parameters: {L: {lower: 0, upper: 1, unit: s}, d: {lower: 0, upper: 3}}
equations:
  x: 0.4*w(k-1 - L/h) + 0.3*x(k - 1.25) + 0.1*u(k - d)
  w: 0.5*x + 0.2*x(k - L/h) - 0.1*x(k-2 - L/h) + 2*h*u(k-1)
outputs: {y: x(k - 1.6), z: w + 0.1*u}
initial: {x: 0, w: 0}
"""


def recursion_with(**solver: Any) -> Model:
    return parse_model({**yaml.safe_load(LINEAR_RECURSION), "solver": solver})


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("interpolation", ["linear", "cubic", "nearest"])
@pytest.mark.parametrize(("lag", "substeps"), [(0.03, 1), (0.0712, 1), (0.0712, 2)])
def test_a_recursion_filters_as_its_transfer_function_in_z(
    hold: Hold, interpolation: str, lag: float, substeps: int
) -> None:
    model = recursion_with(interpolation=interpolation, substeps=substeps)
    values, h = {"L": lag, "d": 1.3}, 0.05
    text = sysid.export_model(model, values, "control", sample_time=h, hold={"u": hold})
    script = run_control(text)
    assert script["period"] == h / substeps
    times = h * np.arange(N)
    u = np.repeat(np.random.default_rng(2).choice([0.0, 1.0, -0.5], N // 12), 12)
    u[:12] = 0.0
    fine = np.arange((N - 1) * substeps + 1) / substeps
    between = np.interp(fine, np.arange(N), u) if hold == "first" else u[fine.astype(int)]
    for output, told in zip(
        ("y", "z"), simulate_outputs(model, values, times, {"u": u}, hold), strict=True
    ):
        found = lfilter(*script["pairs"]["u", output], between)[::substeps]
        np.testing.assert_allclose(found, told, rtol=1e-9, atol=1e-9)


def read_refusal(model: Model, values: dict[str, float], **given: Any) -> str:
    with pytest.raises((NotLinear, InvalidSettings)) as caught:
        sysid.export_model(model, values, "control", **given)
    return str(caught.value)


def test_what_has_no_transfer_function_is_refused_with_the_term_in_the_way() -> None:
    assert "x**3" in read_refusal(load_model("duffing-delay"), {"c": 0.2, "L": 0.5, "b": 5, "a": 1})
    assert "sign" in read_refusal(
        load_model("emps"), {"M": 95, "Fv": 200, "Fc": 20, "o": -3}, sample_time=0.01
    )
    assert "no input" in read_refusal(load_model("delayed-logistic"), {"r": 1, "K": 2, "L": 1})
    recursion = recursion_with()
    assert "sampling period" in read_refusal(recursion, {"L": 0.1, "d": 1.0})
    changing = yaml.safe_load(LINEAR_RECURSION)
    changing["equations"]["x"] = "0.1*t*u"
    assert "changes with t" in read_refusal(
        parse_model(changing), {"L": 0.1, "d": 1.0}, sample_time=1.0
    )
