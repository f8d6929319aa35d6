"""Lags that change with recorded inputs: what they may read, and what the record must allow."""

from typing import Any

import numpy as np
import pytest

import sysid
from sysid.control.controllers import PidControl
from sysid.control.linear_form import NotLinear
from sysid.control.loop_document import LoopDocumentBuilder
from sysid.core.errors import (
    InvalidModel,
    InvalidRecord,
    InvalidSettings,
    RecordTooShort,
)
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate

PIPE: dict[str, Any] = {
    "name": "pipe",
    "form": "differential",
    "inputs": {"u": "degC", "q": "m3/s"},
    "states": {"x": "degC"},
    "parameters": {
        "V": {"lower": 0.1, "upper": 1, "unit": "m3"},
        "T": {"lower": 0.05, "upper": 2, "unit": "s"},
    },
    "equations": {"x": "(u(t - V/q(t)) - x)/T"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}
TIMES = 0.05 * np.arange(300)
FLOW = 1.0 + 0.5 * np.sin(0.7 * TIMES)


def make_record(flow: FloatArray, values: FloatArray | None = None) -> Record:
    steps = np.where(TIMES % 4 < 2, 0.0, 1.0) * (TIMES > 1)
    inputs = (Channel("u", TIMES, steps, hold="zero"), Channel("q", TIMES, flow, hold="first"))
    return Record(inputs, (Channel("y", TIMES, np.sin(TIMES) if values is None else values),))


def make_pipe(**changes: Any) -> Model:
    return parse_model(PIPE | changes)


def test_the_volume_of_a_pipe_is_found_from_a_record_with_a_varying_flow() -> None:
    truth = {"V": 0.6, "T": 0.3}
    data = make_record(FLOW)
    clean = simulate(make_pipe(), data.inputs, truth, times=TIMES).channel("y").values
    noisy = clean + np.random.default_rng(2).normal(0, 0.01, TIMES.size)
    small = sysid.GeneticAlgorithm(population=20, generations=40, islands=1)
    found = sysid.identify(make_pipe(), [make_record(FLOW, noisy)], small)
    for estimate in found.parameters:
        assert estimate.stderr is not None
        assert abs(estimate.value - truth[estimate.name]) < 4 * estimate.stderr
    # The flow swings by a factor of three: a constant lag cannot do that.
    constant = make_pipe(equations={"x": "(u(t - V) - x)/T"})
    assert sysid.identify(constant, [make_record(FLOW, noisy)], small).rms > 3 * found.rms


@pytest.mark.parametrize(
    ("flow", "part"),
    [
        (FLOW - FLOW.min(), r"u\(t - V/q\) can grow without limit, because q goes from 0 to 1 in"),
        (FLOW - 1.0, r"can be negative, because q goes from -0\.5 to 0\.5 in the record"),
        (-FLOW, r"can be negative, because q goes from -1\.5 to -0\.5 .*by max\(q, …\)"),
    ],
)
def test_a_flow_that_stops_or_turns_is_refused_with_its_range(flow: FloatArray, part: str) -> None:
    with pytest.raises(InvalidRecord, match=part):
        Problem.build(make_pipe(), [make_record(flow)])
    limited = make_pipe(equations={"x": "(u(t - V/max(q, 0.2)) - x)/T"})
    assert np.isfinite(
        Problem.build(limited, [make_record(flow)]).evaluate_fitness(np.ones((1, 2)))
    )


def test_a_lag_longer_than_the_record_is_refused_with_the_range_of_the_flow() -> None:
    with pytest.raises(
        RecordTooShort,
        match=r"the upper bound of V is 1 m3 and q goes from 0\.05 to .*smaller upper bound of V",
    ):
        Problem.build(make_pipe(), [make_record(0.1 * FLOW)])


@pytest.mark.parametrize(
    ("equation", "part"),
    [
        ("u(t - V/x)", "present inputs, not of states"),
        ("u(t - V/q(t - T))", "write q without a past"),
        ("x(t - V/q)", "the lag of 'x' changes with 'q'; only an input may have such a lag"),
        ("late(t - T)", "'late' contains a lag that changes with an input"),
        ("state(t - V/q)", "the lag of 'state' changes with 'q'"),
        ("u(t - V*t/q)", "the delay changes with time"),
    ],
)
def test_what_a_varying_lag_may_not_read_is_named(equation: str, part: str) -> None:
    with pytest.raises(InvalidModel, match=part):
        make_pipe(equations={"x": equation}, let={"late": "u(t - V/q)", "state": "2*x"})


@pytest.mark.parametrize(
    ("equation", "place", "found", "cure"),
    [
        ("u(t - V/q) - x/T", "/inputs/q", "m3/(m3/h)", "write t - 3600*V/q"),
        ("u(t - V/max(q, 0.1)) - x/T", "/inputs/q", "m3/(m3/h)", "t - 3600*V/max(q, 0.1)"),
        ("x(t - T*D) - x", "/parameters/D/unit", "%·s", "write t - 0.01*D*T"),
    ],
)
def test_a_lag_whose_units_are_no_seconds_is_refused(
    equation: str, place: str, found: str, cure: str
) -> None:
    percent = PIPE["parameters"] | {"D": {"lower": 0, "upper": 1, "unit": "%"}}
    hourly = {"inputs": {"u": "degC", "q": "m3/h"}, "parameters": percent}
    with pytest.raises(InvalidModel) as caught:
        make_pipe(**hourly, equations={"x": equation})
    [fault] = caught.value.faults
    assert fault.pointer == place
    assert f"found {found!r}" in fault.detail
    assert cure in fault.detail
    assert make_pipe(**hourly, equations={"x": "u(t - 3600*V/q) - x/T"}).name == "pipe"
    unknown = hourly | {"inputs": {"u": "degC", "q": "1"}}
    assert make_pipe(**unknown, equations={"x": "u(t - V/q) - x/T"}).name == "pipe"


def test_the_column_of_a_varying_lag_of_a_name_is_that_of_the_name() -> None:
    with pytest.raises(InvalidModel) as caught:
        make_pipe(equations={"x": "-x/T + late(t - T)"}, let={"late": "u(t - V/q)"})
    assert [fault.column for fault in caught.value.faults] == [8]


def test_a_polynomial_a_loop_and_a_transfer_function_need_constant_lags() -> None:
    polynomial = {
        "name": "p",
        "form": "polynomial",
        "output": "y",
        "inputs": {"u": "V", "q": "V"},
        "coefficients": {"lower": -1, "upper": 1},
        "terms": ["y(k-1)", "u(k - 1 - q)"],
    }
    with pytest.raises(InvalidModel, match="the lags of a polynomial do not change with inputs"):
        parse_model(polynomial)
    control = PidControl(output="y", input="u", gain=1.0)
    with pytest.raises(InvalidSettings, match="a lag that changes with an input"):
        LoopDocumentBuilder(make_pipe(), control, 0.05)
    with pytest.raises(NotLinear, match="with a lag that changes with an input"):
        sysid.export_model(make_pipe(), {"V": 0.6, "T": 0.3}, "control")
