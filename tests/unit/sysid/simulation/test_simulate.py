"""Simulation for a user: values in, a recording out."""

from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.data.records import Channel
from sysid.simulation.simulate import simulate
from tests.support.library.small_models import differential, lag_element, record

TIMES = 0.05 * np.arange(60)
STEP = Channel("u", TIMES, np.where(TIMES >= 0.5, 1.0, 0.0), hold="zero")


def test_the_step_response_of_a_lag_element_is_known() -> None:
    values = {"c": 2.0, "L": 0.2, "b": 0.3}
    found = simulate(lag_element(solver={"substeps": 4}), [STEP], values, times=TIMES)
    since = np.maximum(TIMES - 0.7, 0.0)
    expected = 2.0 * (1 - np.exp(-since / 0.3))
    assert found.names == ("y",)
    np.testing.assert_allclose(found.channels[0].values, expected, atol=1e-2)


def test_values_may_lie_outside_the_bounds_and_times_be_irregular() -> None:
    times = np.sort(np.random.default_rng(0).random(50)) * 3
    values = {"c": 9.0, "L": 1.2, "b": 3.0}
    found = simulate(lag_element(), [STEP], values, times=times).channels[0].values
    expected = 9.0 * (1 - np.exp(-np.maximum(times - 1.7, 0.0) / 3.0))
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_outputs_are_on_the_clock_of_the_inputs() -> None:
    began = datetime.fromisoformat("2026-03-14 08:00")
    values, step = {"c": 2.0, "L": 0.2, "b": 0.3}, replace(STEP, started_at=began)
    late = np.datetime64(began) + np.timedelta64(500, "ms") * np.arange(5)
    for times, first in ((None, 0.0), (late + np.timedelta64(1, "s"), 1.0), (late, 0.0)):
        found = simulate(lag_element(), step, values, times=times)
        assert found.started_at == began
        assert found.channels[0].times[0] == first


def test_inputs_are_named_as_in_identify() -> None:
    values = {"c": 2.0, "L": 0.2, "b": 0.3}
    expected = simulate(lag_element(), STEP, values).channels[0].values
    table = {"t": TIMES, "heater [%]": STEP.values, "oven": 0 * TIMES}
    for name in ("heater", "heater [%]"):
        found = simulate(lag_element(), table, values, channels={"u": name, "y": "none"})
        np.testing.assert_array_equal(found.channels[0].values, expected)
    both = table | {"u": -STEP.values}
    found = simulate(lag_element(), both, values, channels={"u": "heater"})
    np.testing.assert_array_equal(found.channels[0].values, expected)
    for channels, told in (
        ({"u": "heatr"}, "/channels/u: there is no channel 'heatr'; did you mean 'heater'"),
        ({"v": "heater"}, "/channels/v: the model has no signal 'v'"),
        ("heater", "/channels: found the text 'heater'; need a mapping"),
    ):
        with pytest.raises(InvalidSettings, match=told):
            simulate(lag_element(), table, values, channels=channels)


def test_initial_values_can_be_given() -> None:
    model = differential({"x": "-x"}, "x", initial={"x": {"lower": 0, "upper": 1}})
    values = {"c": 0, "L": 0, "b": 0}
    found = simulate(model, record(60).inputs, values | {"x(0)": 4.0}, times=TIMES)
    np.testing.assert_allclose(found.channels[0].values, 4 * np.exp(-TIMES), rtol=1e-6)
    with pytest.raises(InvalidSettings, match=r"/parameters/x\(0\): a value is missing"):
        simulate(model, record(60).inputs, values, times=TIMES)


def test_what_is_missing_or_unknown_is_said() -> None:
    values = {"c": 1.0, "L": 0.1, "b": 1.0}
    with pytest.raises(InvalidSettings, match="/parameters/b: a value is missing"):
        simulate(lag_element(), [STEP], {"c": 1.0, "L": 0.1}, times=TIMES)
    with pytest.raises(InvalidSettings, match="no parameter 'B'"):
        simulate(lag_element(), [STEP], values | {"B": 1.0}, times=TIMES)
    with pytest.raises(InvalidSettings, match="not a finite number"):
        simulate(lag_element(), [STEP], values | {"b": np.nan}, times=TIMES)
    with pytest.raises(InvalidRecord, match="no input 'u'"):
        simulate(lag_element(), [], values, times=TIMES)
    with pytest.raises(InvalidRecord, match="Need two times or more"):
        simulate(lag_element(), [STEP], values, times=TIMES[:1])
