"""PI, PD and PID control of a model: against loops written by hand, and laws of control."""

from dataclasses import dataclass, replace
from math import exp, inf, nan
from typing import Any

import numpy as np
import pytest

from sysid.control.closed_loop import ClosedLoop, close_loop
from sysid.control.controllers import PidControl, Transport
from sysid.control.step_response import measure_step_response
from sysid.core.errors import InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording
from sysid.kernels.compilation.build import compute_kernel_key
from sysid.kernels.layout import KernelVariant
from sysid.models.model import Model
from sysid.models.parse import parse_model

STEP = 0.01
TIMES: FloatArray = STEP * np.arange(901.0)
VALUES = {"K": 1.6, "T": 0.7, "L": 0.2, "y(0)": 0.0}


def build_lag(**fields: Any) -> Model:
    """First-order lag behind a dead time, with a load that is added to its input."""
    document = {
        "name": "lag",
        "form": "differential",
        "inputs": {"u": "V", "d": "V"},
        "states": {"y": "m"},
        "parameters": {
            "K": {"lower": 0, "upper": 5},
            "T": {"lower": 0.1, "upper": 2},
            "L": {"lower": 0, "upper": 1},
        },
        "equations": {"y": "(K*(u(t-L) + d) - y)/T"},
        "outputs": {"y": "y"},
        "initial": {"y": {"lower": -1, "upper": 1}},
    }
    return parse_model(document | fields)


RECURSION = parse_model(
    {
        "name": "r",
        "form": "difference",
        "inputs": {"u": "V", "d": "V"},
        "states": {"x": "m"},
        "parameters": {"a": {"lower": 0, "upper": 1}, "b": {"lower": 0, "upper": 1}},
        "equations": {"x": "a*x(k-1) + b*(u(k-1) + d(k-1))"},
        "outputs": {"y": "x"},
        "initial": {"x": {"lower": -1, "upper": 1}},
    }
)


def make_step(name: str, height: float, at: float = 0.0, before: float = 0.0) -> Channel:
    """A held signal that steps once."""
    times = np.array([-1e-11, at, TIMES[-1]])
    return Channel(name, times, np.array([before, height, height]), hold="zero")


def simulate_loop(
    model: Model,
    control: PidControl,
    values: dict[str, float] = VALUES,
    *,
    reference: float = 1.0,
    load: float = 0.0,
) -> tuple[ClosedLoop, Recording]:
    """A step of the reference at the start, and one of the load at 4 s."""
    loop = close_loop(model, control, STEP)
    given = [make_step(loop.reference, reference), make_step("d", load, at=4.0)]
    return loop, loop.simulate(given, values, times=TIMES)


def by_hand(
    control: PidControl,
    *,
    reference: float = 1.0,
    load: float = 0.0,
    start: float = 0.0,
    fine: int = 40,
) -> tuple[FloatArray, FloatArray]:
    """Output and command of the lag under continuous control, by Euler's method in fine steps."""
    h, element = STEP / fine, control.transport or Transport()
    late = round((VALUES["L"] + element.delay) / h) if not element.time_constant else None
    n = (TIMES.size - 1) * fine + 1
    low, high = (
        -inf if control.output_limits[0] is None else control.output_limits[0],
        inf if control.output_limits[1] is None else control.output_limits[1],
    )
    c = float(control.derivative_on == "error")
    y, integral, entered = start, 0.0, 0.0
    z = -start
    commands, inside, ys = np.zeros(n), np.zeros(n), np.zeros(n)
    rest = np.clip(control.gain * -start, low, high)  # what the controller gave before the start
    for k in range(n):
        error = reference - y
        wanted = control.gain * (control.setpoint_weight * reference - y) + integral
        if control.has_derivative_action:
            d = c * reference - y
            wanted += control.gain * control.derivative_filter * (d - z)
            z += (1.0 - exp(-h / control.filter_time)) * (d - z)
        given = min(high, max(low, wanted))
        commands[k], ys[k] = given, y
        if control.has_integral_action:
            integral += h * control.gain / float(control.integral_time or inf) * error
            if control.active_tracking_time is not None:
                integral += h / control.active_tracking_time * (given - wanted)
        if late is not None:
            drive = element.gain * (commands[k - late] if k >= late else rest)
        else:
            inside[k] = entered
            old = k - round(element.delay / h)
            before = commands[old] if old >= 0 else rest
            entered += h * (element.gain * before - entered) / element.time_constant
            old = k - round(VALUES["L"] / h)
            drive = inside[old] if old >= 0 else 0.0
        disturbed = load if k >= round(4.0 / h) else 0.0
        y += h * (VALUES["K"] * (drive + disturbed) - y) / VALUES["T"]
    return ys[::fine], commands[::fine]


PI = PidControl("u", "y", 1.2, integral_time=0.7)
PID = replace(PI, derivative_time=0.08, derivative_filter=8.0)
LIMITED = replace(PID, lower=-0.1, upper=0.72)


@pytest.mark.parametrize(
    "control",
    [
        PI,
        PID,
        replace(PID, derivative_on="error", setpoint_weight=0.4),
        replace(PI, setpoint_weight=0.0),
        replace(PID, integral_time=None),
        LIMITED,
        replace(LIMITED, tracking_time=0.1),
        replace(LIMITED, anti_windup="none"),
        replace(PI, upper=0.7),
        replace(PI, limit=0.7, gain=2.0),
        replace(PI, gain=0.6, transport=Transport(0.9, 0.0, 0.13)),
        replace(PID, gain=0.6, transport=Transport(1.1, 0.25, 0.1)),
    ],
    ids=str,
)
def test_a_continuous_loop_equals_the_same_loop_in_fine_steps_by_hand(control: PidControl) -> None:
    loop, found = simulate_loop(build_lag(), control, load=0.3)
    output, command = by_hand(control, load=0.3)
    # At the step itself the two may stand on either side of it; where its jump enters the plant, a
    # sample is off by a part of a step (decision 13).
    kept = np.arange(TIMES.size) != round(VALUES["L"] / STEP)
    kept[:2] = False
    np.testing.assert_allclose(found.channel("y").values[kept], output[kept], atol=5e-3)
    given = found.channel(loop.command).values
    np.testing.assert_allclose(given[kept], command[kept], atol=0.03)


def test_a_loop_that_starts_away_from_zero_has_no_kick_of_the_derivative() -> None:
    control = replace(PID, setpoint_weight=0.5)
    loop, found = simulate_loop(build_lag(), control, VALUES | {"y(0)": 0.8}, reference=1.0)
    output, command = by_hand(control, start=0.8)
    np.testing.assert_allclose(found.channel("y").values, output, atol=4e-3)
    np.testing.assert_allclose(found.channel(loop.command).values[2:], command[2:], atol=0.02)


@dataclass
class Textbook:
    """The sampled controller of Åström and Hägglund, section 13.3, as it is printed there."""

    control: PidControl
    period: float
    integral: float = 0.0
    action: float = 0.0
    before: float = 0.0

    def __call__(self, r: float, y: float) -> float:
        c, h = self.control, self.period
        td, n = c.derivative_time, c.derivative_filter
        d = (r if c.derivative_on == "error" else 0.0) - y
        if td:
            self.action = td / (td + n * h) * self.action
            self.action += c.gain * td * n / (td + n * h) * (d - self.before)
        self.before = d
        wanted = c.gain * (c.setpoint_weight * r - y) + self.integral + self.action
        low, high = c.output_limits
        given = wanted if high is None else min(high, wanted)
        given = given if low is None else max(low, given)
        if c.integral_time:
            self.integral += c.gain * h / c.integral_time * (r - y)
            if c.active_tracking_time is not None:
                self.integral += min(1.0, h / c.active_tracking_time) * (given - wanted)
        return given


@pytest.mark.parametrize(
    "control",
    [
        PI,
        PID,
        replace(PID, derivative_on="error"),
        replace(LIMITED, derivative_on="error", setpoint_weight=0.3),
        replace(PI, integral_time=0.004, gain=0.05, limit=0.5),
    ],
    ids=str,
)
def test_a_recursion_has_the_sampled_controller_of_the_textbook(control: PidControl) -> None:
    values = {"a": 0.97, "b": 0.05, "x(0)": 0.3}
    loop, found = simulate_loop(RECURSION, control, values, load=0.2)
    law, x = Textbook(control, STEP, before=-0.3), 0.3
    outputs, commands = [], []
    for t in TIMES:
        u = law(1.0, x)
        outputs.append(x)
        commands.append(u)
        x = 0.97 * x + 0.05 * (u + (0.2 if t >= 4.0 - STEP / 9 else 0.0))
    np.testing.assert_allclose(found.channel("y").values, outputs, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.channel(loop.command).values, commands, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.03])
def test_where_the_output_answers_at_once_the_textbooks_controller_is_late(delay: float) -> None:
    """By one step where nothing else is between them, by the transport's steps where it is."""
    direct = parse_model(
        {
            "name": "d",
            "form": "difference",
            "inputs": {"u": "V", "d": "V"},
            "states": {"x": "m"},
            "outputs": {"y": "x"},
            "initial": {"x": 0.0},
            "equations": {"x": "0.95*x(k-1) + 0.06*(u + d)"},
        }
    )
    control = replace(PID, gain=0.8, upper=0.9, transport=Transport(1.0, 0.0, delay))
    loop, found = simulate_loop(direct, control, {}, load=0.2)
    late = max(round(delay / STEP), 1)
    law, x, commands, outputs = Textbook(control, STEP), 0.0, [0.0] * late, []
    for k, t in enumerate(TIMES):
        if k:
            load = 0.2 if t >= 4.0 - STEP / 9 else 0.0
            x = 0.95 * x + 0.06 * (commands[-late] + load)
        commands.append(law(1.0, x))
        outputs.append(x)
    assert loop.controller_delay_steps == (delay == 0.0)
    np.testing.assert_allclose(found.channel("y").values, outputs, atol=1e-9)


def test_a_polynomial_is_controlled_without_a_steady_error() -> None:
    narx = parse_model(
        {
            "name": "n",
            "form": "polynomial",
            "output": "y",
            "inputs": {"u": "V"},
            "degree": 2,
            "lags": {"y": [1, 2], "u": [1]},
            "coefficients": {"lower": -2, "upper": 2},
            "terms": ["y(k-1)", "y(k-2)", "u(k-1)", "u(k-1)*y(k-1)"],
            "initial": {"y": 0},
        }
    )
    values = dict(zip([p.name for p in narx.parameters], (1.1, -0.3, 0.1, 0.05), strict=True))
    control = PidControl("u", "y", 0.5, integral_time=0.04, derivative_time=0.01, limit=3.0)
    loop = close_loop(narx, control, STEP)
    found = loop.simulate([make_step(loop.reference, 0.5)], values, times=TIMES)
    assert found.channel("y").values[-1] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("plant", [build_lag(), RECURSION], ids=["differential", "difference"])
@pytest.mark.parametrize("limit", [None, 0.5])
def test_without_integral_and_derivative_the_loop_is_the_proportional_one_bit_for_bit(
    plant: Model, limit: float | None
) -> None:
    values = {"a": 0.9, "b": 0.1, "x(0)": 0.2} if plant is RECURSION else VALUES
    plain = PidControl("u", "y", 1.3, limit, Transport(0.9, 0.1, 0.05))
    _, expected = simulate_loop(plant, plain, values)
    same = replace(
        plain,
        integral_time=inf,
        derivative_time=0.0,
        derivative_filter=3.0,
        derivative_on="error",
        setpoint_weight=1.0,
        tracking_time=2.0,
    )
    _, found = simulate_loop(plant, same, values)
    for one, other in zip(expected.channels, found.channels, strict=True):
        np.testing.assert_array_equal(one.values, other.values)


@pytest.mark.parametrize("plant", [build_lag(), RECURSION], ids=["differential", "difference"])
def test_integral_action_leaves_no_steady_error_under_a_load_and_proportional_does(
    plant: Model,
) -> None:
    values = {"a": 0.98, "b": 0.03, "x(0)": 0.0} if plant is RECURSION else VALUES
    for control, is_zero in ((PI, True), (PID, True), (replace(PI, integral_time=None), False)):
        _, found = simulate_loop(plant, control, values, load=0.3)
        error = 1.0 - found.channel("y").values[-1]
        assert (abs(error) < 1e-3) == is_zero


@pytest.mark.parametrize("plant", [build_lag(), RECURSION], ids=["differential", "difference"])
def test_the_command_keeps_its_limits_and_reaches_them(plant: Model) -> None:
    values = {"a": 0.98, "b": 0.03, "x(0)": 0.0} if plant is RECURSION else VALUES
    control = replace(PID, gain=30.0, lower=-0.05, upper=0.9)
    loop, found = simulate_loop(plant, control, values)
    command = found.channel(loop.command).values
    assert np.max(command) == 0.9
    assert np.min(command) == -0.05


def test_back_calculation_bounds_the_overshoot_after_a_long_saturation() -> None:
    """The limit holds the output just above the reference: it takes seconds to get there."""
    wound_up = PidControl(
        "u", "y", 2.0, integral_time=0.3, upper=0.66, lower=0.0, anti_windup="none"
    )
    overshoots = []
    led_back = replace(wound_up, anti_windup="back-calculation")
    for control in (wound_up, led_back, replace(led_back, tracking_time=0.05)):
        values = {**VALUES, "L": 0.0}
        _, found = simulate_loop(build_lag(), control, values, reference=1.0)
        metrics = measure_step_response(
            TIMES, found.channel("y").values, at=0.0, before=0.0, after=1.0
        )
        overshoots.append(metrics.overshoot_percent)
    assert overshoots[0] > 5.0
    assert overshoots[1] < 1.0
    assert overshoots[2] < 1.0


def test_other_numbers_of_a_controller_need_no_other_kernel() -> None:
    variant = KernelVariant(one_step=False, soft=False, on_grid=True, weighted=False)
    for plant in (build_lag(), RECURSION):
        keys = set()
        for size in (1.0, 1.3, 0.8):
            control = replace(
                LIMITED,
                gain=size,
                integral_time=size,
                derivative_time=0.2 * size,
                derivative_filter=5.0 * size,
                upper=size,
                lower=-size,
                tracking_time=size,
                setpoint_weight=0.5 * size,
                transport=Transport(size, 0.1 * size, 0.1 * size),
            )
            keys.add(compute_kernel_key(close_loop(plant, control, STEP).model, variant))
        assert len(keys) == 1


def test_steps_are_divided_where_the_filter_is_faster_than_they_are() -> None:
    fast = replace(PID, derivative_filter=100.0)  # its lag is 0.8 ms, a step 10 ms
    loop, found = simulate_loop(build_lag(), fast)
    assert loop.model.solver.substeps == 32
    output, _ = by_hand(fast, fine=320)
    np.testing.assert_allclose(found.channel("y").values, output, atol=4e-3)
    assert close_loop(build_lag(), PID, STEP).model.solver.substeps == 2
    assert close_loop(build_lag(), PI, STEP).model.solver.substeps == 1
    with pytest.raises(InvalidSettings, match="a smaller N, or a shorter") as caught:
        close_loop(build_lag(), replace(PID, derivative_filter=1e6), STEP)
    assert caught.value.pointer == "/derivative_filter"


@pytest.mark.parametrize(
    ("fields", "pointer", "part"),
    [
        ({"integral_time": -1.0}, "/integral_time", "above 0 s"),
        ({"integral_time": 0.0}, "/integral_time", "above 0 s"),
        ({"integral_time": nan}, "/integral_time", "above 0 s"),
        ({"derivative_time": -0.1}, "/derivative_time", "0 s or more"),
        ({"derivative_time": inf}, "/derivative_time", "0 s or more"),
        ({"derivative_filter": 0.0}, "/derivative_filter", "above 0"),
        ({"setpoint_weight": nan}, "/setpoint_weight", "finite"),
        ({"tracking_time": 0.0}, "/tracking_time", "above 0"),
        ({"lower": 2.0, "upper": 1.0}, "/upper", "found 1, and 2 as lower limit"),
        ({"lower": 1.0, "upper": 1.0}, "/upper", "need more"),
        ({"limit": 1.0, "upper": 2.0}, "/upper", "the limit ± is given too"),
        ({"lower": -inf}, "/lower", "finite"),
        ({"upper": 1e300}, "/upper", r"1e\+300 is not a finite number between ±1e\+300"),
    ],
)
def test_numbers_that_make_no_controller_are_told(
    fields: dict[str, Any], pointer: str, part: str
) -> None:
    with pytest.raises(InvalidSettings, match=part) as caught:
        PidControl("u", "y", 1.0, **fields)
    assert caught.value.pointer == pointer
