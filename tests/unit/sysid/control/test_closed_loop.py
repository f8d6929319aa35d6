"""A model under proportional control: against loops written by hand, and the paper's Figure 21."""

from math import degrees, pi
from typing import Any

import numpy as np
import pytest

from sysid.control.closed_loop import close_loop
from sysid.control.controllers import PidControl, Transport
from sysid.control.step_response import StepMetrics, measure_step_response
from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.records import Channel
from sysid.kernels.compilation.build import compute_kernel_key
from sysid.kernels.layout import KernelVariant
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.simulation.simulate import simulate
from tests.support.library.catalogue_cases import ARM
from tests.support.library.small_models import ARX

ACTUATOR = ARM | {"theta_s": 0.75 * pi, "theta(0)": 0.0}
TUBE = Transport(1.0, 0.35, 0.127)
TIMES: FloatArray = 0.01 * np.arange(601.0)


def make_step(height: float, unit: str = "rad") -> Channel:
    """A reference that is 0 before t = 0 and `height` from then on."""
    times = np.array([-0.01, 0.0, TIMES[-1]])
    return Channel("reference", times, np.array([0.0, height, height]), unit, hold="zero")


def arm(gain: float, transport: Transport | None = TUBE) -> tuple[FloatArray, StepMetrics]:
    """Angle of the arm after a step of 90°, and what it is judged by."""
    control = PidControl("P_a", "theta", gain, 0.25e6, transport)
    loop = close_loop(load_model("actuator"), control)
    angle = simulate(loop.model, [make_step(pi / 2)], ACTUATOR, times=TIMES).channel("theta").values
    return angle, measure_step_response(TIMES, angle, at=0.0, before=0.0, after=pi / 2)


def build_lag(output: str = "y", **fields: Any) -> Model:
    """First-order lag behind a dead time."""
    document = {
        "name": "lag",
        "form": "differential",
        "inputs": {"u": "V"},
        "states": {"y": "m"},
        "parameters": {"T": {"lower": 0.1, "upper": 2}, "L": {"lower": 0, "upper": 1}},
        "equations": {"y": "(u(t-L) - y)/T"},
        "outputs": {"y": output},
        "initial": {"y": 0},
    }
    return parse_model(document | fields)


def test_a_gain_of_10_kpa_per_radian_settles_in_a_second_and_a_half_with_1_percent_overshoot() -> (
    None
):
    _, found = arm(10e3)
    assert found.overshoot_percent == pytest.approx(1.0, abs=0.5)
    assert found.settling_time == pytest.approx(1.5, abs=0.2)


def test_twice_that_gain_overshoots_by_39_percent() -> None:
    _, found = arm(20e3)
    assert found.overshoot_percent == pytest.approx(39.0, abs=2.0)


def test_four_times_that_gain_reverses_at_the_end_stop() -> None:
    angle, found = arm(40e3)
    assert np.max(angle) == 0.75 * pi
    turns = np.count_nonzero(np.diff(np.sign(angle[TIMES > 0.5] - pi / 2)) != 0)
    assert turns >= 3
    assert not found.settling_time < 3.0


def test_without_the_tube_friction_leaves_14_degrees() -> None:
    angle, found = arm(10e3, None)
    coulomb = ACTUATOR["F_c"] / (ACTUATOR["A_m"] * 10e3)
    assert degrees(coulomb) == pytest.approx(14.1, abs=0.05)
    assert found.final_value == pytest.approx(pi / 2 - coulomb, abs=1e-3)
    assert np.all(np.diff(angle) >= 0)


@pytest.mark.parametrize("transport", [None, Transport(0.8, 0.0, 0.1), Transport(1.2, 0.3, 0.1)])
@pytest.mark.parametrize("limit", [None, 1.5])
def test_a_loop_in_the_differential_form_equals_the_same_loop_written_by_hand(
    transport: Transport | None, limit: float | None
) -> None:
    loop = close_loop(build_lag(), PidControl("u", "y", 3.0, limit, transport))
    with_limit = "max(-1.5, min(1.5, 3*({0})))" if limit else "3*({0})"
    element = transport or Transport()
    error = with_limit.format(f"r(t - {element.delay}) - y(t - {element.delay})")
    states, equations = {"y": "m"}, {"y": "(u(t-L) - y)/T"}
    if element.time_constant:
        states["u"] = "V"
        equations["u"] = f"({element.gain}*{error} - u)/{element.time_constant}"
    else:
        late = f"t - L - {element.delay}"
        drive = with_limit.format(f"r({late}) - y({late})")
        equations["y"] = f"({element.gain}*{drive} - y)/T"
    twin = parse_model(
        {
            **build_lag().document,
            "inputs": {"r": "m"},
            "states": states,
            "equations": equations,
            "initial": {},
        }
    )
    values = {"T": 0.7, "L": 0.15}
    found = simulate(loop.model, [make_step(2.0, "m")], values, times=TIMES)
    reference = make_step(2.0)
    given = Channel("r", reference.times, reference.values, hold="zero")
    expected = simulate(twin, [given], values, times=TIMES).channel("y").values
    np.testing.assert_allclose(found.channel("y").values, expected, rtol=1e-9, atol=1e-12)
    command = found.channel(loop.command).values
    wanted = 3.0 * (2.0 - expected)
    np.testing.assert_allclose(
        command, wanted if limit is None else np.clip(wanted, -1.5, 1.5), rtol=1e-9
    )


def test_a_recursion_that_answers_at_once_has_a_controller_one_step_late() -> None:
    direct = {
        "name": "d",
        "form": "difference",
        "inputs": {"u": "V"},
        "states": {"x": "m"},
        "equations": {"x": "0.5*x(k-1) + 0.4*u"},
        "outputs": {"y": "x"},
    }
    late = direct | {"equations": {"x": "0.5*x(k-1) + 0.4*u(k-1)"}}
    control = PidControl("u", "y", 1.1)
    loops = [close_loop(parse_model(one), control) for one in (direct, late)]
    assert [loop.controller_delay_steps for loop in loops] == [1, 0]
    first, second = (simulate(loop.model, [make_step(1.0, "m")], {}, times=TIMES) for loop in loops)
    x, expected = 0.0, []
    for _ in TIMES:
        expected.append(x)
        x = 0.5 * x + 0.4 * 1.1 * (1.0 - x)
    np.testing.assert_allclose(second.channel("y").values, expected, rtol=1e-12)
    np.testing.assert_allclose(first.channel("y").values[1:], expected[1:], rtol=1e-12)


DIRECT = {
    "name": "d",
    "form": "difference",
    "inputs": {"u": "V"},
    "states": {"x": "m"},
    "equations": {"x": "0.5*x(k-1) + 0.4*u"},
    "outputs": {"y": "x"},
}


@pytest.mark.parametrize(
    ("delay", "steps_late", "back"),
    [(0.03, 0, 3), (0.01, 0, 1), (0.005, 1, 1.5), (0.025, 0, 2.5), (0.0, 1, 1)],
)
def test_a_delay_of_a_step_or_more_is_no_circle(delay: float, steps_late: int, back: float) -> None:
    control = PidControl("u", "y", 0.9, None, Transport(1.0, 0.0, delay))
    loop = close_loop(parse_model(DIRECT), control, 0.01)
    assert loop.controller_delay_steps == steps_late
    found = simulate(loop.model, [make_step(1.0, "m")], {}, times=TIMES).channel("y").values
    x = np.zeros(TIMES.size)
    grid = np.arange(TIMES.size)
    for k in range(1, TIMES.size):  # the command between samples is on a straight line
        command = 0.9 * (np.where(grid >= 0, 1.0, 0.0) - x)
        entered = np.interp(k - back, grid, command) if k >= back else 0.0
        x[k] = 0.5 * x[k - 1] + 0.4 * entered
    np.testing.assert_allclose(found[5:], x[5:], rtol=0.02, atol=2e-3)


def test_during_a_dead_time_of_whole_steps_the_plant_goes_on() -> None:
    """Ten steps of delay are no ten samples that a recursion is given."""
    plant = parse_model(
        {**DIRECT, "inputs": {"u": "V", "v": "V"}, "equations": {"x": "0.5*x(k-1) + 0.4*u + v"}}
    )
    control = PidControl("u", "y", 0.9, None, Transport(1.0, 0.0, 0.1))
    loop = close_loop(plant, control, 0.01)
    steady = Channel("v", TIMES, np.ones(TIMES.size), "V")
    found = simulate(loop.model, [make_step(0.0, "m"), steady], {}, times=TIMES).channel("y").values
    np.testing.assert_allclose(found[:10], 2.0 * (1.0 - 0.5 ** np.arange(10.0)), rtol=1e-12)


@pytest.mark.parametrize(
    "plant", [build_lag(), parse_model(DIRECT)], ids=["differential", "difference"]
)
@pytest.mark.parametrize("time_constant", [0.0, 1.0])
def test_other_numbers_of_controller_and_transport_need_no_other_kernel(
    plant: Model, time_constant: float
) -> None:
    variant = KernelVariant(one_step=False, soft=False, on_grid=True, weighted=False)
    keys = set()
    for size in (1.0, 1.7, -2.0):
        transport = Transport(size, abs(size) * time_constant, 0.05 * abs(size))
        control = PidControl("u", "y", 3.0 * size, 2.0 * abs(size), transport)
        keys.add(compute_kernel_key(close_loop(plant, control, 0.01).model, variant))
    assert len(keys) == 1


def test_a_delay_whose_step_is_not_known_is_taken_for_less_than_one() -> None:
    control = PidControl("u", "y", 0.9, None, Transport(1.0, 0.0, 0.03))
    assert close_loop(parse_model(DIRECT), control).controller_delay_steps == 1


def test_a_polynomial_can_be_controlled() -> None:
    arx = parse_model(ARX)
    loop = close_loop(arx, PidControl("u", "y", 2.0))
    names = [parameter.name for parameter in arx.parameters]
    values = loop.rename_values(dict(zip(names, (0.8, 0.1), strict=True)))
    found = simulate(loop.model, [make_step(1.0, "1")], values, times=TIMES).channel("y").values
    assert found[-1] == pytest.approx(0.2 / (1 - 0.8 + 0.2), rel=1e-9)


def test_an_output_with_the_input_in_it_needs_a_transport_that_takes_time() -> None:
    direct = build_lag("y + 0.1*u")
    with pytest.raises(InvalidSettings, match="algebraic loop"):
        close_loop(direct, PidControl("u", "y", 1.0, None, Transport(1.0, 0.0, 0.2)))
    loop = close_loop(direct, PidControl("u", "y", 1.0, None, Transport(1.0, 0.1, 0.0)))
    found = simulate(loop.model, [make_step(1.0, "m")], {"T": 0.5, "L": 0.0}, times=TIMES)
    # y = x + 0.1 u and u = 1 - y at rest, where x = u
    assert found.channel("y").values[-1] == pytest.approx(1.1 / 2.1, rel=1e-6)


def test_the_loop_names_its_signals_anew_where_the_plant_has_those_names() -> None:
    taken = build_lag(
        parameters={
            "T": {"lower": 0.1, "upper": 2},
            "L": {"lower": 0, "upper": 1},
            "reference": {"lower": 0, "upper": 1},
        }
    )
    loop = close_loop(taken, PidControl("u", "y", 1.0))
    assert [one.name for one in loop.model.inputs] == [loop.reference] == ["reference_"]
    assert [one.name for one in loop.model.outputs] == ["y", "u", "command"]
    assert [one.unit for one in loop.model.outputs] == ["m", "V", "V"]


@pytest.mark.parametrize(
    ("make", "pointer", "part"),
    [
        (lambda: PidControl("v", "y", 1.0), "/input", "no input 'v'"),
        (lambda: PidControl("u", "x", 1.0), "/output", "no output 'x'"),
        (lambda: PidControl("u", "y", float("nan")), "/gain", "finite"),
        (lambda: PidControl("u", "y", 1.0, 0.0), "/limit", "above 0"),
        (lambda: Transport(1.0, -1.0), "/transport/time_constant", "0 or more"),
        (lambda: Transport(float("nan")), "/transport/gain", "finite"),
    ],
)
def test_what_cannot_be_controlled_is_told(make: Any, pointer: str, part: str) -> None:
    with pytest.raises(InvalidSettings, match=part) as caught:
        close_loop(build_lag(), make())
    assert caught.value.pointer == pointer


def test_metrics_of_a_second_order_step_are_those_of_its_formula() -> None:
    damping, rate = 0.4, 3.0
    times = np.linspace(0, 12, 12001)
    free = rate * np.sqrt(1 - damping**2)
    shape = np.cos(free * times) + damping * rate / free * np.sin(free * times)
    values = 1 + 2 * (1 - np.exp(-damping * rate * times) * shape)
    found = measure_step_response(times + 5, values, at=5.0, before=1.0, after=3.0)
    overshoot = 100 * np.exp(-pi * damping / np.sqrt(1 - damping**2))
    assert found.overshoot_percent == pytest.approx(overshoot, rel=1e-3)
    assert found.steady_error == pytest.approx(0.0, abs=1e-4)
    last = np.flatnonzero(np.abs(values - found.final_value) > 0.04)[-1]
    assert found.settling_time == pytest.approx(times[last + 1])
    way = (values - 1) / 2
    assert found.rise_time == pytest.approx(
        float(np.interp(0.9, way[:1000], times[:1000]) - np.interp(0.1, way[:1000], times[:1000]))
    )


def test_with_a_steady_error_rise_and_overshoot_of_the_final_value_are_told_besides() -> None:
    values = 4 * (1 - np.exp(-TIMES) * np.cos(4 * TIMES))  # towards 4 of a reference of 10
    found = measure_step_response(TIMES, values, at=0.0, before=0.0, after=10.0)
    other = measure_step_response(TIMES, values, at=0.0, before=0.0, after=found.final_value)
    assert found.overshoot_percent == 0.0
    assert found.overshoot_of_final_percent == pytest.approx(other.overshoot_percent)
    assert found.overshoot_of_final_percent > 30
    assert found.rise_time == pytest.approx(other.rise_time)
    down = measure_step_response(TIMES, -values, at=0.0, before=0.0, after=-10.0)
    assert down.overshoot_of_final_percent == pytest.approx(found.overshoot_of_final_percent)


@pytest.mark.parametrize(("before", "after"), [(60.0, 70.0), (60.0, 50.0), (42.0, 52.0)])
def test_rise_and_overshoot_count_from_where_a_steady_error_kept_the_output(
    before: float, after: float
) -> None:
    settles = [42 + 0.47 * (reference - 42) for reference in (before, after)]
    way = 1 - np.exp(-SINCE) * np.cos(2 * SINCE)
    values = settles[0] + (settles[1] - settles[0]) * way
    found = measure_step_response(LONG, values, at=1.0, before=before, after=after)
    plain = measure_step_response(LONG, way, at=1.0, before=0.0, after=1.0)
    assert plain.rise_time > 0.3
    assert plain.overshoot_of_final_percent > 10
    assert found.rise_time == pytest.approx(plain.rise_time)
    assert found.overshoot_of_final_percent == pytest.approx(plain.overshoot_of_final_percent)


def test_an_output_that_does_not_answer_has_no_rise() -> None:
    found = measure_step_response(LONG, 3 + 1e-12 * np.sin(LONG), at=1.0, before=0.0, after=1.0)
    assert np.isnan([found.rise_time, found.overshoot_of_final_percent]).all()


def test_a_response_that_grows_or_is_not_finite_runs_away() -> None:
    swing: FloatArray = np.exp(0.5 * TIMES) * np.sin(8 * TIMES)
    for values in (1 + swing, np.where(TIMES < 3, swing, np.inf), -0.1 * TIMES):
        found = measure_step_response(TIMES, values, at=0.0, before=0.0, after=1.0)
        assert found.runs_away
        assert np.isnan([found.overshoot_percent, found.settling_time, found.final_value]).all()


@pytest.mark.parametrize("rate", [-0.5, 0.0])
def test_a_swing_that_stays_or_decays_does_not_run_away(rate: float) -> None:
    values = 1 + 1.2 * np.exp(rate * TIMES) * np.cos(8 * TIMES)
    found = measure_step_response(TIMES, values, at=0.0, before=0.0, after=1.0)
    assert not found.runs_away
    assert found.overshoot_percent > 100


LONG = np.arange(0, 20, 0.05)
SINCE = np.maximum(LONG - 1.0, 0.0)


@pytest.mark.parametrize("rate", [0.005, 0.01, 0.1])
def test_a_swing_that_grows_slowly_runs_away(rate: float) -> None:
    values = 1 - np.exp(rate * SINCE) * np.cos(3 * SINCE)
    assert measure_step_response(LONG, values, at=1.0, before=0.0, after=1.0).runs_away


@pytest.mark.parametrize(
    ("values", "is_settled"),
    [
        (2.5 * (1 - np.exp(-SINCE / 6)), False),
        (3.0 * (1 - np.exp(-SINCE)), True),
        (np.where(SINCE < 14, 0.0, -0.05), True),
        (np.where(SINCE < 13.5, 0.0, 1.5 * (1 - np.exp(13.5 - SINCE)) - 0.1), False),
        (-(1 - np.exp(-SINCE / 6)), True),
        (1 - np.cos(3 * SINCE), False),
        (
            1 - np.exp(-SINCE) * np.cos(3 * SINCE) + 1e-15 * np.cos(40 * SINCE) * np.exp(SINCE / 9),
            True,
        ),
    ],
)
def test_a_response_that_is_far_off_late_or_slow_does_not_run_away(
    values: FloatArray, is_settled: bool
) -> None:
    found = measure_step_response(LONG, values, at=1.0, before=0.0, after=1.0)
    assert not found.runs_away
    assert found.is_settled is is_settled
    assert np.isfinite(found.settling_time) == is_settled
    assert np.isfinite([found.overshoot_percent, found.final_value, found.steady_error]).all()


def test_metrics_need_a_step_that_was_recorded() -> None:
    with pytest.raises(InvalidRecord, match="fewer than two samples after"):
        measure_step_response(TIMES, TIMES, at=6.0, before=0.0, after=1.0)
    with pytest.raises(InvalidRecord, match="does not change"):
        measure_step_response(TIMES, TIMES, at=1.0, before=1.0, after=1.0)


@pytest.mark.parametrize("rate", [0.0, -0.002])
def test_a_swing_that_lasts_is_told_with_its_size_and_period(rate: float) -> None:
    values = 1 + np.exp(rate * LONG) * 0.4 * np.cos(3 * LONG)
    found = measure_step_response(LONG, values, at=0.0, before=0.0, after=1.0)
    assert not found.runs_away
    assert np.isnan(found.settling_time)
    assert found.swing == pytest.approx(0.8, rel=0.05)
    assert found.swing_period == pytest.approx(2 * pi / 3, rel=0.01)


@pytest.mark.parametrize(
    "values",
    [
        1 - np.exp(-SINCE) * np.cos(3 * SINCE),  # settles
        1 - np.exp(-0.02 * SINCE) * np.cos(3 * SINCE),  # will settle
        1 - np.exp(0.1 * SINCE) * np.cos(3 * SINCE),  # runs away
        SINCE / 20,  # is under way
        1 + 0.01 * np.cos(3 * SINCE),  # stays inside the band
    ],
)
def test_what_settles_grows_or_is_under_way_does_not_keep_swinging(values: FloatArray) -> None:
    found = measure_step_response(LONG, values, at=1.0, before=0.0, after=1.0)
    assert np.isnan([found.swing, found.swing_period]).all()


def test_integrals_of_the_error_are_those_of_an_exponential() -> None:
    times = np.arange(0, 40, 0.01)
    found = measure_step_response(
        times + 3, 2 * (1 - np.exp(-times / 2)), at=3.0, before=0.0, after=2.0
    )
    assert found.iae == pytest.approx(2 * 2, rel=1e-4)
    assert found.itae == pytest.approx(2 * 2**2, rel=1e-4)
