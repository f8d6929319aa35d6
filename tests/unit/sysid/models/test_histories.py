"""History functions: what a document may say of states before the start, and what follows."""

from typing import Any

import numpy as np
import pytest

import sysid
from service.models.catalogue import check_model
from sysid.control.closed_loop import close_loop
from sysid.control.controllers import PidControl
from sysid.core.errors import InvalidModel, RecordTooShort
from sysid.data.records import Channel, Record
from sysid.identifiability.bound_limits import find_widest_bounds
from sysid.identifiability.scaling_symmetries import find_scalings
from sysid.models.model import DerivedInitial, EstimatedInitial, FixedInitial, Model
from sysid.models.parse import parse_model
from sysid.models.unused import find_unused_names
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from tests.support.library.exported_programs import run_python

RATE = {"lower": -1, "upper": 1, "unit": "1/s"}
DOCUMENT: dict[str, Any] = {
    "name": "growth",
    "form": "differential",
    "inputs": {"u": "V"},
    "states": {"x": "1", "w": "1"},
    "parameters": {
        "a": {"lower": 0.1, "upper": 2},
        "b": RATE,
        "L": {"lower": 0.2, "upper": 2, "unit": "s"},
    },
    "let": {"past": "a*exp(b*t)"},
    "equations": {"x": "-x(t - L)", "w": "x - w"},
    "outputs": {"y": "x"},
    "history": {"x": "past"},
}


def written(**changes: Any) -> Model:
    return parse_model(DOCUMENT | changes)


def test_a_state_starts_where_its_history_ends_unless_a_start_is_given() -> None:
    start, other = written().initial
    assert isinstance(start, DerivedInitial)
    assert start.text == "history"
    assert other == FixedInitial(0.0)
    values = {"a": 1.5, "b": 0.3, "L": 1.0}
    found = simulate(written(inputs={}), [], values, times=0.1 * np.arange(3))
    assert found.channel("y").values[0] == pytest.approx(1.5)
    given = written(initial={"x": {"lower": 0, "upper": 1}}).initial[0]
    assert isinstance(given, EstimatedInitial)
    assert written(initial={"x": "history"}) == written()
    assert written(history={"x": "2 + t"}, initial={"x": 2}).initial[0] == FixedInitial(2.0)


def test_the_normal_form_keeps_the_history() -> None:
    document = written().document
    assert document["history"] == {"x": "past"}
    assert document["initial"] == {"x": "history", "w": 0.0}
    assert parse_model(document) == written()
    assert "history" not in written(history={}).document
    checked = check_model(DOCUMENT)
    assert checked.valid
    assert [fault.pointer for fault in checked.warnings] == ["/inputs/u"]


@pytest.mark.parametrize(
    ("changes", "pointer", "part"),
    [
        ({"history": {"x": "2*w"}}, "/history/x", "does not depend on 'w'"),
        ({"history": {"x": "t + u"}}, "/history/x", "does not depend on 'u'"),
        ({"history": {"x": "k"}}, "/history/x", "'k' is not declared"),
        ({"history": {"x": [1]}}, "/history/x", "not an expression"),
        ({"history": {"z": "t"}}, "/history/z", "no such state"),
        ({"history": "t"}, "/history", "not a mapping"),
        ({"history": {"x": "log(t)"}}, "/history/x", "is -inf at t = 0; need a finite number"),
        ({"initial": {"x": 3}}, "/initial/x", "starts at 3, but its history ends at a*exp(b*0)"),
        ({"history": {"x": "1 + t"}, "initial": {"x": "0"}}, "/initial/x", "ends at 1 + 0"),
        ({"initial": {"w": "history"}}, "/initial/w", "there is no history of 'w'"),
        ({"initial": {"w": "steady"}}, "/initial/w", "/history says what 'x' did"),
        (
            {"form": "difference", "equations": {"x": "x(k-1)", "w": "w(k-1)"}},
            "/history",
            "belongs to the differential form",
        ),
    ],
)
def test_a_history_that_cannot_be_used_is_refused(
    changes: dict[str, Any], pointer: str, part: str
) -> None:
    with pytest.raises(InvalidModel) as caught:
        written(**changes)
    assert any(f.pointer == pointer and part in f.detail for f in caught.value.faults)


def test_a_history_that_no_lag_reads_is_told() -> None:
    model = written(equations={"x": "u - x", "w": "x - w(t - L)"})
    assert [fault.pointer for fault in find_unused_names(model)] == ["/history/x"]


def test_the_parameters_of_a_history_are_found_with_the_lag() -> None:
    truth = {"a": 1.2, "b": 0.4, "L": 0.9}
    model, times = written(inputs={}), 0.05 * np.arange(80)
    clean = simulate(model, [], truth, times=times).channel("y").values
    noisy = clean + np.random.default_rng(3).normal(0, 0.01, times.size)
    small = sysid.GeneticAlgorithm(population=20, generations=30, islands=1)
    found = sysid.identify(model, [Record((), (Channel("y", times, noisy),))], small)
    for estimate in found.parameters:
        assert estimate.stderr is not None
        assert abs(estimate.value - truth[estimate.name]) < 4 * estimate.stderr


def test_a_lag_with_a_history_may_be_longer_than_the_record() -> None:
    """dx/dt = -φ(t - L): the integral of the history."""
    values, times = {"a": 1.2, "b": 0.4, "L": 1.7}, 0.05 * np.arange(21)
    found = simulate(written(inputs={}), [], values, times=times).channel("y").values
    integral = (np.exp(0.4 * (times - 1.7)) - np.exp(-0.4 * 1.7)) / 0.4
    np.testing.assert_allclose(found, 1.2 * (1 - integral), atol=1e-8)
    text = sysid.export_model(written(inputs={}), values, "python")
    np.testing.assert_allclose(run_python(text, times, [])[0], found, rtol=1e-12)
    data = Record((), (Channel("y", times, found),))
    problem = Problem.build(written(inputs={}), [data])
    delay = next(p for p in problem.all_parameters if p.name == "L")
    assert find_widest_bounds(problem, delay)[1] > 10 * times[-1]
    with pytest.raises(RecordTooShort, match="delay of 'x'"):
        simulate(written(inputs={}, history={}), [], values, times=times)


def test_ties_scalings_and_loops_know_the_history() -> None:
    # A history with a free factor scales with its state; one with a fixed factor does not.
    equations = {"x": "-b*x(t - L)", "w": "x/a - w"}
    free = written(equations=equations, outputs={"y": "w"}, history={"x": "a*t"})
    assert len(find_scalings(free, free.parameters)) == 1
    held = written(equations=equations, outputs={"y": "w"}, history={"x": "t"})
    assert len(find_scalings(held, held.parameters)) == 0
    parameters = DOCUMENT["parameters"] | {"a": {"lower": 0, "upper": 4, "tied": "2*L"}}
    tied, plain = (
        written(parameters=parameters, history={"x": text}, inputs={})
        for text in ("a + t", "2*L + t")
    )
    times = 0.1 * np.arange(30)
    data = Record((), (Channel("y", times, np.sin(times)),))
    expected, found = (
        Problem.build(one, [data]).predict(np.array([[0.3, 0.7]])) for one in (plain, tied)
    )
    np.testing.assert_array_equal(found, expected)
    loop = close_loop(
        written(equations={"x": "u - x(t - L)", "w": "x - w"}), PidControl("u", "y", 0.5)
    )
    assert [one.state for one in loop.model.histories] == ["x"]
