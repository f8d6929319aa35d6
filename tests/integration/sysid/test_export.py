"""An exported program does what `sysid.simulate` does, for every model of the catalogue."""

import ast
import ctypes
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml

import sysid
from sysid.core.errors import InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.records import Hold
from sysid.models.catalogue.load import catalogue, load_model
from sysid.models.model import Model
from sysid.models.parse import keep_terms, parse_model
from tests.support.library.exported_programs import (
    add_entry,
    compile_library,
    run_c,
    run_python,
    simulate_outputs,
)

N = 240


class ExportCase(NamedTuple):
    """A model with values; its inputs are steps of this amplitude, its period `h` is in s."""

    values: dict[str, float]
    h: float = 0.05
    amplitude: float = 1.0


NARX = {p.name: 0.02 for p in load_model("narx").parameters} | {"dh": 2.4, "dk": 1.7}
CASES = {
    "actuator": ExportCase(
        {
            "J": 6e-4,
            "F_c": 0.01,
            "F_max": 0.03,
            "k_a": 60,
            "k_b": 60,
            "k_c": 8e5,
            "A_m": 5e-6,
            "B": 1e-3,
            "theta_s": 2.36,
            "theta(0)": 0.3,
        },
        0.01,
        3e4,
    ),
    "coulomb-delay": ExportCase({"c": 0.2, "L": 0.3337, "b": 5, "mu": 0.5}, 0.02, 10),
    "coulomb-eq16": ExportCase({"c": 0.2, "L": 0.3337, "b": 5, "mu": 0.5}, 0.02, 10),
    "delayed-logistic": ExportCase({"r": 1.2, "K": 2, "L": 1.237, "x(0)": 0.3}, 0.1),
    "delayed-van-der-pol": ExportCase(
        {"mu": 0.7, "w": 2, "g": -0.5, "L": 0.4337, "x(0)": 0.3, "v(0)": -0.2}
    ),
    "duffing-delay": ExportCase({"c": 0.2, "L": 0.5137, "b": 5, "a": 1}, 0.02, 10),
    "duffing-eq16": ExportCase({"c": 0.2, "L": 0.5137, "b": 5, "a": 1}, 0.02, 10),
    "emps": ExportCase({"M": 95, "Fv": 200, "Fc": 20, "o": -3, "y(0)": 0.1}, 0.01),
    "exponential": ExportCase({"L": 0.8}, 0.02),
    "fopdt": ExportCase({"K": 2, "T": 0.8, "L": 0.4337, "y0": 0.3, "x(0)": 0.3}),
    "foipdt": ExportCase({"K": 0.8, "T": 0.5, "L": 0.2337, "w(0)": 0.4, "y(0)": 0.3}),
    "ipdt": ExportCase({"K": 0.8, "L": 0.2337, "y(0)": 0.3}),
    "mackey-glass": ExportCase({"beta": 0.2, "gamma": 0.1, "n": 10, "L": 17.3, "x(0)": 0.9}, 0.5),
    "narx": ExportCase({**NARX, "y(0)": 0.3}),
    "silverbox": ExportCase(
        {
            "b": 1e5,
            "d": 50,
            "k1": 2e5,
            "k2": 1e4,
            "k3": 5e5,
            "c": 10,
            "L": 0.0013,
            "y(0)": 0.02,
            "v(0)": 1.0,
        },
        0.001,
        0.1,
    ),
    "silverbox-9": ExportCase(
        {
            "b": 1e5,
            "d": 50,
            "d1": 5,
            "d2": 20,
            "k1": 2e5,
            "k2": 1e4,
            "k3": 5e5,
            "k5": 1e4,
            "c": 10,
            "L": 0.0013,
            "y(0)": 0.02,
            "v(0)": 1.0,
        },
        0.001,
        0.1,
    ),
    "sopdt": ExportCase(
        {"K": 2, "T1": 0.8, "r": 0.4, "L": 0.4337, "y0": 0.3, "x(0)": 0.3, "w(0)": 0}
    ),
    "topdt": ExportCase(
        {"K": 2, "T1": 0.8, "r2": 0.4, "r3": 0.9, "L": 0.4337, "y0": 0.3}
        | {"x(0)": 0.3, "w(0)": 0, "v(0)": 0.1}
    ),
    "tube": ExportCase({"K": 1, "T": 0.3, "L": 0.2137, "y(0)": 0.3}),
    "tube-second-order": ExportCase({"K": 1, "w": 5, "z": 0.5, "L": 0.4337, "y(0)": 0.3}),
}

# What the catalogue does not have: methods, grids, interpolation, names that a program needs
# itself, two inputs and outputs, states before they are updated, time itself.
TWO = """
name: double
form: differential
inputs: {i: N, q: N}
states: {int: m, ω: m/s}
parameters:
  lambda: {lower: 0, upper: 5, unit: s}
  n: {lower: 0, upper: 9}
  p: {lower: 0, upper: 9, tied: 2*n}
  np: {lower: 0, upper: 9}
equations:
  int: ω(t - lambda/2)
  ω: >-
    i(t - lambda) + 0.5*q - p*int - np*ω(t - 0.013)
    + 0.1*min(q, t)*where(int > 0 and not q < 0, 1, -2)
outputs: {int: int + i, step: "max(ω(t - lambda), -abs(int))**2"}
initial: {int: {lower: -1, upper: 1}, ω: 0.5}
"""
RECURSION = """
name: while
form: difference
inputs: {u: "1"}
states: {x: "1", w: "1"}
parameters: {L: {lower: 0, upper: 1, unit: s}, d: {lower: 0, upper: 3}}
equations:
  x: 0.4*w(k-1 - L/h) + 0.3*x(k - 1.25) + 0.1*u(k - d) + 0.01*sin(t)
  w: 0.5*x + 0.2*x(k - L/h) - 0.1*x(k-2 - L/h) - 0.1*where(k > 20, u(k-1), 0) + (-0.3)**2/7
outputs: {y: x(k - 1.6), z: w}
initial: {x: 0.2, w: 0.1}
"""
LINEAR_NARX = {
    "name": "chosen",
    "form": "polynomial",
    "output": "y",
    "inputs": {"u": "1"},
    "degree": 2,
    "lags": {"y": [1, 2], "u": [1, "1 + d"]},
    "parameters": {"d": {"lower": 0, "upper": 4}},
    "coefficients": {"lower": -2, "upper": 2},
    "terms": {"select": "frols", "keep": 3},
}


def written(text: str, **solver: Any) -> Model:
    document = yaml.safe_load(text)
    return parse_model({**document, "solver": solver} if solver else document)


def starting(text: str, initial: Any, **solver: Any) -> Model:
    """A model whose states start there."""
    return parse_model({**yaml.safe_load(text), "initial": initial, "solver": solver})


def select_terms() -> Model:
    """A polynomial whose terms were selected."""
    labels = [term.label for term in parse_model(LINEAR_NARX).terms]
    return keep_terms(parse_model(LINEAR_NARX), [labels[0], labels[1], labels[-1]])


COEFFICIENTS = dict(
    zip([p.name for p in select_terms().parameters if p.name != "d"], (0.6, 0.2, 0.1), strict=True)
)
_TWO = ExportCase({"lambda": 0.1337, "n": 2.5, "np": 0.7, "int(0)": 0.2})
_RECURSION = ExportCase({"L": 0.0712, "d": 1.3})
RESTING = """
name: resting
form: differential
inputs: {u: "1", q: "1"}
states: {w: "1", x: "1"}
parameters: {K: {lower: 0, upper: 5}, T: {lower: 0, upper: 5}, L: {lower: 0, upper: 1, unit: s}}
equations: {w: (K*(u(t - L) - 0.3*q) - w)/T, x: 2*w(t - L) - 3*x + K}
outputs: {y: x}
"""
# Every function that the catalogue does not use.
FUNCTIONS = """
name: functions
form: differential
inputs: {u: "1"}
states: {x: "1", w: "1"}
parameters: {K: {lower: 0, upper: 5}, T: {lower: 0.1, upper: 5}, L: {lower: 0, upper: 1, unit: s}}
equations:
  x: (K*erf(u(t - L)) - 2*x + clip(x, -0.4, 0.2) + atan2(w, x + 2) - mod(w, -0.3))/T
  w: 0.1*floor(9*x) - 3*sinh(w) + 0.1*cosh(x) + log10(1 + x**2) - mod(t, 0.371)
outputs: {y: "x + mod(w, T) + erf(x)", z: "clip(w, x, 0.3)"}
initial: {x: 0.2, w: erf(K)}
"""
_FUNCTIONS = ExportCase({"K": 1.5, "T": 0.2, "L": 0.0737})
# Intermediate names everywhere, also of other names and of the past.
NAMES = """
name: names
form: differential
inputs: {u: "1"}
states: {x: "1", w: "1"}
parameters: {K: {lower: 0, upper: 5}, T: {lower: 0.1, upper: 5}, L: {lower: 0, upper: 1, unit: s}}
let: {drive: rate + u(t - late), rate: "K*exp(-abs(x)/T)", late: L/2 + 0.02}
equations: {x: "drive - rate(t - late) - x", w: "rate - w(t - late)"}
outputs: {y: drive - w, z: rate(t - L)}
initial: {x: late, w: 0.1}
"""
RECURSION_OF_NAMES = """
name: recursion_of_names
form: difference
inputs: {u: "1"}
states: {x: "1", w: "1"}
parameters: {L: {lower: 0, upper: 1, unit: s}, d: {lower: 0, upper: 3}}
let: {late: L/h + d, mix: 0.3*x(k-1) + u(k - d) + 0.01*t}
equations: {x: 0.4*mix + 0.1*mix(k - 1 - late), w: 0.5*w(k-1 - late) + tanh(mix)}
outputs: {y: x + mix(k-1), z: w}
initial: {x: 0.2, w: 0.1}
"""
# Tables of states, of inputs and of past values, with parameters among the points.
TABLES = """
name: tables
form: differential
inputs: {u: "1"}
states: {x: "1", w: "1"}
parameters: {K: {lower: 0, upper: 5}, T: {lower: 0.1, upper: 5}, L: {lower: 0, upper: 1, unit: s}}
constants: {last: 1.5}
equations:
  x: >-
    (K*table(u(t - L), [-0.6, 0.1, last], [-1, 0.2, 2*T])
    - pchip(x, [-1, 0, 0.4, last], [-2, 0, 0.1, K]))/T
  w: >-
    pchip(t, [2, 3, 5, 6], [0, 1, 1, K]) - pchip(w, [-0.1, 4], [-K, 3])
    - table(x(t - L), [0, 1], [0, 2])
outputs: {y: x, z: "w + pchip(x - w, [-1, 0, 1], [T, 0.1, 3])"}
initial: {x: "pchip(K, [0, 1, 2], [0, 0.1, 0.2])", w: 0.1}
"""
# Transport with a variable flow, behind a name, and in an output.
FLOW = """
name: transport_by_flow
form: differential
inputs: {u: "1", q: "1"}
states: {x: "1"}
parameters: {K: {lower: 0, upper: 5}, T: {lower: 0.1, upper: 5}, L: {lower: 0, upper: 1, unit: s}}
let: {transport: "0.4*L/max(q, 0.2) + 0.01*exp(-q)"}
equations: {x: (K*u(t - transport) + 0.1*u - x)/T}
outputs: {y: x, z: "u(t - transport - L)"}
initial: {x: 0.2}
"""
RECURSION_OF_FLOW = """
name: recursion_of_flow
form: difference
inputs: {u: "1", q: "1"}
states: {x: "1"}
parameters: {L: {lower: 0, upper: 1, unit: s}, d: {lower: 0, upper: 3}}
equations: {x: 0.9*x(k-1) + 0.1*u(k - 1 - d/(1.2 + q)) + 0.1*u(k - L*abs(q)/h)}
outputs: {y: x}
initial: {x: 0.2}
"""
# Histories before the start, and outputs that are named as what a program needs itself.
HISTORY = """
name: past_of_states
form: differential
inputs: {u: "1", q: "1"}
states: {x: "1", w: "1"}
parameters: {K: {lower: 0, upper: 5}, T: {lower: 0.1, upper: 5}, L: {lower: 0, upper: 1, unit: s}}
equations:
  x: (K*u(t - L) - x - 0.5*x(t - 2*L))/T + 0.1*q
  w: x(t - L/2) - w - w(t - 0.11)
outputs: {ramp: x(t - L) + w(t - 3*L), between: "u(t - L)", dt: x, y: w}
history: {x: K*exp(t/T) - 0.2, w: "where(t < -0.1, T, 3*sin(9*t)) + 0.3"}
initial: {w: {lower: -1, upper: 1}}
"""
# Switches in time: jumps, bends, several in a step, in a period, and beside lags and inputs.
SWITCHES = """
name: most
form: differential
inputs: {u: "1"}
states: {x: "1", begin: "1"}
parameters: {K: {lower: 0, upper: 5}, T: {lower: 0.1, upper: 5}, L: {lower: 0, upper: 1, unit: s}}
equations:
  x: >-
    where(t > T and not t >= T + L, K*sqrt(t - T), 0) + u + u(t - L) - x - 0.5*begin(t - 2*L)
    + max(t - 3*T, 0, x)*sign(2.113 - t) + 0.1*u(t - 0.4*L/(1.2 + tanh(u)))
  begin: x(t - L) - begin + where(mod(t - L, K) < T, 2, floor(t/T)) + clip(t, T, K)
outputs: {x: x, y: begin + x(t - L)}
history: {x: "where(t < -L, T, 3*sin(9*t)) + 0.3"}
initial: {begin: 0.1}
"""
_SWITCHES = ExportCase({"K": 1.5171, "T": 0.7013, "L": 0.0737})
_SWITCHES_SOON = ExportCase({"K": 1.5171, "T": 0.7013, "L": 0.0237})
_HISTORY = ExportCase({"K": 0.5, "T": 0.2, "L": 0.0737, "w(0)": 0.4})
_RESTING = ExportCase({"K": 1.5, "T": 0.2, "L": 0.0737})
WRITTEN: dict[str, tuple[Model, ExportCase]] = {
    "rk4": (written(TWO), _TWO),
    "rk4_substeps": (written(TWO, substeps=3), _TWO),
    "rk4_linear": (written(TWO, interpolation="linear"), _TWO),
    "rk4_own_step": (written(TWO, step=0.017, history="zero"), _TWO),
    "euler_nearest": (written(TWO, method="euler", substeps=2, interpolation="nearest"), _TWO),
    "euler_cubic": (written(TWO, method="euler", interpolation="cubic"), _TWO),
    "semi_implicit": (written(TWO, method="semi-implicit", history="zero", step=0.03), _TWO),
    "steady": (starting(RESTING, "steady"), _RESTING),
    "names": (written(NAMES), _FUNCTIONS),
    "recursion_of_names": (written(RECURSION_OF_NAMES), _RECURSION),
    "tables": (written(TABLES), _FUNCTIONS),
    "flow": (written(FLOW), _FUNCTIONS),
    "flow_substeps": (written(FLOW, substeps=3), _FUNCTIONS),
    "flow_own_step": (written(FLOW, step=0.017), _FUNCTIONS),
    "flow_euler_nearest": (written(FLOW, method="euler", interpolation="nearest"), _FUNCTIONS),
    "recursion_of_flow": (written(RECURSION_OF_FLOW), _RECURSION),
    "functions": (written(FUNCTIONS), _FUNCTIONS),
    "history": (written(HISTORY), _HISTORY),
    "history_linear": (written(HISTORY, interpolation="linear", substeps=2), _HISTORY),
    "history_own_step": (written(HISTORY, step=0.017, history="zero"), _HISTORY),
    "history_euler_cubic": (written(HISTORY, method="euler", interpolation="cubic"), _HISTORY),
    "history_semi_implicit": (written(HISTORY, method="semi-implicit"), _HISTORY),
    "switches": (written(SWITCHES), _SWITCHES),
    "switches_linear": (written(SWITCHES, interpolation="linear", substeps=2), _SWITCHES_SOON),
    "switches_own_step": (written(SWITCHES, step=0.0171, history="zero"), _SWITCHES),
    "switches_euler_nearest": (
        written(SWITCHES, method="euler", interpolation="nearest"),
        _SWITCHES,
    ),
    "switches_semi_implicit": (written(SWITCHES, method="semi-implicit"), _SWITCHES_SOON),
    "steady_substeps": (starting(RESTING, "steady", substeps=2), _RESTING),
    "steady_own_step": (starting(RESTING, "steady", step=0.017), _RESTING),
    "steady_off_samples": (starting(RESTING, "steady", step=0.0171), _RESTING),
    "start_of_recursion": (starting(RECURSION, {"x": "d*u0 - L", "w": "u0/d"}), _RECURSION),
    "selected": (select_terms(), ExportCase({"d": 1.6, **COEFFICIENTS, "y(0)": 0.1})),
    "recursion": (written(RECURSION), _RECURSION),
    "recursion_cubic": (written(RECURSION, interpolation="cubic", history="zero"), _RECURSION),
    "recursion_substeps": (written(RECURSION, substeps=3), _RECURSION),
    "recursion_nearest": (written(RECURSION, interpolation="nearest"), _RECURSION),
}
MODELS = {
    name.replace("-", "_"): (load_model(name), case) for name, case in CASES.items()
} | WRITTEN


def make_excitation(model: Model, case: ExportCase) -> tuple[FloatArray, dict[str, FloatArray]]:
    draw = np.random.default_rng(7)
    times = 1.5 + case.h * np.arange(N)
    levels = case.amplitude * np.array([0.0, 1.0, 0.4, -1.0])
    return times, {one.name: np.repeat(draw.choice(levels, N // 12), 12) for one in model.inputs}


def test_every_model_of_the_catalogue_has_a_case() -> None:
    assert set(CASES) == set(catalogue())


# Each construct once, for the gate; at night every model for both holds.
GATE: dict[Hold, set[str]] = {
    "zero": {
        *("actuator", "mackey_glass", "narx", "silverbox"),
        *("rk4", "rk4_own_step", "euler_nearest", "euler_cubic", "semi_implicit"),
        *("names", "tables", "functions", "selected", "flow"),
        *("history", "history_own_step", "history_semi_implicit"),
        *("switches", "switches_linear", "switches_own_step"),
        *("switches_euler_nearest", "switches_semi_implicit"),
        *("recursion", "recursion_cubic", "recursion_nearest", "recursion_of_flow"),
        *("recursion_of_names", "start_of_recursion", "steady", "steady_off_samples"),
    },
    "first": {
        "duffing_eq16",
        "rk4_linear",
        "flow_substeps",
        "history_linear",
        "switches",
        "recursion",
    },
}
EXPORTS = [
    pytest.param(name, hold, marks=[] if name in names else [pytest.mark.night])
    for hold, names in GATE.items()
    for name in MODELS
]


@pytest.fixture(scope="module")
def c_library(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> ctypes.CDLL:
    """The models of the tests that run as C in one library, for the holds of their inputs."""
    sources = {}
    for item in request.session.items:
        if not item.name.startswith("test_exported_programs_compute_what_the_simulation_does["):
            continue
        name, hold = (item.callspec.params[key] for key in ("name", "hold"))  # type: ignore[attr-defined]
        model, case = MODELS[name]
        holds = {one.name: hold for one in model.inputs}
        text = sysid.export_model(model, case.values, "c", hold=holds)
        plain = add_entry(text, f"run_{hold}_{name}", len(model.inputs), len(model.outputs))
        stem = text.split("_identified(void)")[0].split()[-1]
        sources[f"{name}_{hold}"] = plain.replace(f"{stem}_", f"{name}_{hold}_own_")
    return compile_library(tmp_path_factory.mktemp("exported"), sources)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "hold"), EXPORTS)
def test_exported_programs_compute_what_the_simulation_does(
    name: str, hold: Hold, c_library: ctypes.CDLL
) -> None:
    model, case = MODELS[name]
    times, inputs = make_excitation(model, case)
    expected = simulate_outputs(model, case.values, times, inputs, hold)
    text = sysid.export_model(model, case.values, "python", hold=dict.fromkeys(inputs, hold))
    python = run_python(text, times, list(inputs.values()))
    c = run_c(c_library, f"run_{hold}_{name}", times, list(inputs.values()), len(model.outputs))
    for told, *found in zip(expected, python, c, strict=True):
        assert np.ptp(told) > 0
        for one in found:
            np.testing.assert_allclose(one, told, rtol=1e-9, atol=1e-9 * np.max(np.abs(told)))


def test_the_models_of_the_gate_are_there() -> None:
    assert set().union(*GATE.values()) <= set(MODELS)


def test_a_lag_without_a_value_is_none() -> None:
    """0/0 on other inputs than those of the record: as a kernel and C read it."""
    document = {**yaml.safe_load(FLOW), "equations": {"x": "u(t - abs(u)/q) - x"}, "let": {}}
    model = parse_model(document | {"outputs": {"y": "x"}})
    text = sysid.export_model(model, {"K": 1, "T": 1, "L": 0}, "python")
    times, u, q = 0.1 * np.arange(9), np.ones(9), np.ones(9)
    u[4] = q[4] = 0.0
    assert np.all(np.isfinite(run_python(text, times, [u, q])[0]))


def case_of(name: str) -> tuple[Model, ExportCase]:
    return load_model(name), CASES[name]


def test_the_document_has_all_that_is_needed_to_simulate_again() -> None:
    model, case = MODELS["rk4"]
    text = sysid.export_model(model, case.values, "json", sample_time=0.05, hold={"i": "zero"})
    document = json.loads(text)
    again = parse_model(document["model"])
    values = {one["name"]: one["value"] for one in document["values"]}
    units = {one["name"]: one["unit"] for one in document["values"]}
    assert values == {**case.values, "p": 2 * case.values["n"]}
    assert units["lambda"] == "s"
    assert units["int(0)"] == "m"
    units = document["data"].pop("units")
    assert units == {"i": "N", "q": "N", "int": "1", "step": "1"}
    assert document["data"] == {"sample_time": 0.05, "hold": {"i": "zero", "q": "first"}}
    times, inputs = make_excitation(model, case)
    for one, other in zip(
        simulate_outputs(again, values, times, inputs, "first"),
        simulate_outputs(model, case.values, times, inputs, "first"),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


def test_an_identification_is_exported_with_its_uncertainty() -> None:
    model = load_model("tube")
    times = 0.05 * np.arange(200)
    u = np.where(times % 3 < 1.5, 0.0, 1.0)
    truth = {"K": 1.0, "T": 0.3, "L": 0.21, "y(0)": 0.0}
    noise = np.random.default_rng(1).normal(0, 0.01, times.size)
    y = simulate_outputs(model, truth, times, {"u": u}, "zero")[0] + noise
    record = sysid.Record(
        (sysid.Channel("u", times, u, "V", hold="zero"),), (sysid.Channel("y", times, y, "bar"),)
    )
    small = sysid.GeneticAlgorithm(population=16, generations=20, islands=1)
    found = sysid.identify(model, [record], small, parameters={"L": {"upper": 1.0}})
    document = json.loads(sysid.export_model(model, found, "json", provenance={"made": "here"}))
    stderr = {one["name"]: one["stderr"] for one in document["values"]}
    covariance = document["covariance"]
    variances = dict(zip(covariance["names"], np.diag(covariance["matrix"]), strict=True))
    for name, variance in variances.items():
        assert stderr[name] ** 2 == pytest.approx(variance)
    assert document["provenance"] == {"made": "here"}
    assert document["data"] == {
        "sample_time": pytest.approx(0.05),
        "hold": {"u": "zero"},
        "units": {"u": "V", "y": "bar"},
    }
    text = sysid.export_model(model, found, "python")  # held as the data of the result were
    assert f"standard error {stderr['T']:.3g}" in text
    # The tube starts where it was measured, so that is to be given.
    expected = simulate_outputs(
        model,
        {one.name: one.value for one in found.parameters} | {"y(0)": y[0]},
        times,
        {"u": u},
        "zero",
    )
    np.testing.assert_allclose(run_python(text, times, [u], y_0=y[0]), expected, rtol=1e-9)
    with pytest.raises(TypeError, match="y_0"):
        run_python(text, times, [u])


# ---- what is refused, and what names and titles may hold ------------------------------------
@pytest.mark.parametrize(
    ("change", "pointer"),
    [
        ({"format": "pascal"}, "/format"),
        ({"format": "control", "pade_order": 0}, "/pade_order"),
        ({"hold": {"u": "second"}}, "/hold/u"),
        ({"hold": {"v": "zero"}}, "/hold/v"),
        ({"sample_time": float("nan")}, "/sample_time"),
    ],
)
def test_an_option_that_cannot_be_used_is_named(change: dict[str, Any], pointer: str) -> None:
    with pytest.raises(InvalidSettings) as caught:
        sysid.export_model(*case_of("tube")[:1], CASES["tube"].values, **change)
    assert caught.value.pointer == pointer


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"K": 1.0, "T": 0.3}, "L"),
        ({"K": 1.0, "T": 0.3, "L": 0.1, "W": 1.0}, "W"),
        ({"K": 1.0, "T": float("inf"), "L": 0.1}, "T"),
    ],
)
def test_a_value_that_is_missing_unknown_or_not_finite_is_named(
    values: dict[str, float], name: str
) -> None:
    with pytest.raises(InvalidSettings) as caught:
        sysid.export_model(load_model("tube"), values, "python")
    assert caught.value.pointer == f"/values/{name}"


def test_a_model_whose_terms_are_not_selected_yet_is_refused() -> None:
    model = parse_model(LINEAR_NARX)
    with pytest.raises(InvalidSettings, match="not selected"):
        sysid.export_model(model, {one.name: 0.1 for one in model.parameters}, "c")


HOSTILE = (
    '"""\nimport os\nos.abort()\n"""',
    "*/ int main(void) { abort(); } /*",
    "\\",
    'end\\"""',
    "'''",
    "// \\\nint x;",
    "*\\\n/ int x; /\\\n*",
    "??/\n#error",
    "\u202e\u2028\u0085#error",
    "%s {x} @PAIRS@ @ORDER@",
    "\\N{x}\\u",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_no_text_of_a_model_gets_out_of_comments(text: str, tmp_path: Path) -> None:
    document = dict(load_model("tube").document)
    document |= {"title": text, "source": text, "description": f"{text} {text[::-1]}"}
    document["inputs"] = {"u": text}
    document["parameters"] = {
        name: {**one, "description": text, "unit": "s" if name == "L" else text}
        for name, one in document["parameters"].items()
    }
    plain, model, values = load_model("tube"), parse_model(document), CASES["tube"].values
    provenance = {text: text, "list": [text, {"a": text}]}
    for format in ("python", "control"):
        found = sysid.export_model(model, values, format, provenance=provenance)
        assert is_visible(found)
        # As a tree, the program is that of the model without these texts.
        told, expected = (
            without_docstrings(one) for one in (found, sysid.export_model(plain, values, format))
        )
        assert told == expected
    found = sysid.export_model(model, values, "c", provenance=provenance)
    assert is_visible(found)
    assert without_comments(found) == without_comments(sysid.export_model(plain, values, "c"))
    assert json.loads(sysid.export_model(model, values, "json"))["model"]["title"] == model.title


def is_visible(source: str) -> bool:
    """No character is hidden or changes the direction of writing: what one reads is what runs."""
    return all(character.isprintable() or character == "\n" for character in source)


def without_docstrings(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.FunctionDef):
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                del node.body[0]
    return ast.unparse(tree)


def without_comments(source: str) -> str:
    """As a C compiler sees it: lines are joined before comments are taken out."""
    assert "??" not in source
    joined = source.replace("\\\n", "")
    return " ".join(re.sub(r"/\*.*?\*/", " ", joined, flags=re.S).split())
