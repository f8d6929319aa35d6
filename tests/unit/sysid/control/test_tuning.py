"""Tuning rules against what their papers print, and margins against those of known loops."""

from dataclasses import replace
from math import degrees, inf, isnan, log, pi, sqrt
from typing import Any

import numpy as np
import pytest

from sysid.control.closed_loop import close_loop
from sysid.control.controllers import PidControl, Transport
from sysid.control.linear_form import IdentifiedModel, NotLinear
from sysid.control.margins import Margins, compute_margins
from sysid.control.step_response import measure_step_response
from sysid.control.tuning import Tuning, factor_transfer_function, tune_controller
from sysid.core.errors import InvalidSettings
from sysid.data.records import Channel
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model


def give_values(model: Model, **values: float) -> IdentifiedModel:
    """A model with its values."""
    return IdentifiedModel.from_numbers(model, values)


def build_linear(equations: dict[str, str], output: str = "x1") -> IdentifiedModel:
    """A model in the differential form without parameters."""
    return give_values(
        parse_model(
            {
                "name": "plant",
                "form": "differential",
                "inputs": {"u": "V", "w": "V"},
                "states": dict.fromkeys(equations, "m"),
                "equations": equations,
                "outputs": {"y": output},
            }
        )
    )


def build_chain(*times: float, delay: float = 0.0, gain: float = 1.0) -> IdentifiedModel:
    """Lags in a row behind a dead time."""
    states = [f"x{i}" for i in range(1, len(times) + 1)]
    reads = [*states[1:], f"{gain}*u(t - {delay})"]
    return build_linear(
        {s: f"({r} - {s})/{t}" for s, r, t in zip(states, reads, times, strict=True)}
    )


FOPDT = give_values(load_model("fopdt"), K=2.0, T=3.0, L=1.0, y0=5.0)


def build_controller(found: Tuning, **fields: Any) -> PidControl:
    """The controller that a rule gives."""
    return PidControl(
        "u",
        "y",
        found.gain,
        integral_time=found.integral_time,
        derivative_time=found.derivative_time,
        **fields,
    )


def test_simc_of_a_first_order_process_is_that_of_the_formula() -> None:
    found = tune_controller(FOPDT, "u", "y")
    assert (found.gain, found.integral_time, found.derivative_time) == pytest.approx((0.75, 3, 0))
    assert found.closed_loop_time_constant == 1.0
    tight = tune_controller(FOPDT, "u", "y", closed_loop_time_constant=0.2)
    assert tight.gain == pytest.approx(3 / (2 * 1.2))
    lag_dominated = tune_controller(
        give_values(load_model("fopdt"), K=2, T=30, L=1, y0=0), "u", "y"
    )
    assert lag_dominated.integral_time == pytest.approx(8.0)


def test_margins_of_simc_are_those_that_its_paper_prints() -> None:
    """Skogestad 2003, Table 1, for τ_c = θ: T_i = T1, and T_i = 8 θ of an integrating process."""
    found = compute_margins(FOPDT, build_controller(tune_controller(FOPDT, "u", "y")))
    assert found.gain_margin == pytest.approx(3.14, abs=0.005)
    assert found.phase_margin == pytest.approx(61.4, abs=0.05)
    assert found.delay_margin == pytest.approx(2.14, abs=0.005)
    assert found.sensitivity_peak == pytest.approx(1.59, abs=0.005)
    assert found.crossover_frequency == pytest.approx(0.5)
    integrator = build_linear({"x1": "0.7*u(t - 1)"})
    found = compute_margins(integrator, build_controller(tune_controller(integrator, "u", "y")))
    assert found.gain_margin == pytest.approx(2.96, abs=0.01)
    assert found.phase_margin == pytest.approx(46.9, abs=0.05)
    assert found.delay_margin == pytest.approx(1.59, abs=0.005)
    assert found.sensitivity_peak == pytest.approx(1.70, abs=0.005)


def test_the_half_rule_gives_what_its_paper_prints() -> None:
    first = tune_controller(build_chain(1.0, 0.2), "u", "y", closed_loop_time_constant=0.1)
    assert first.process.time_constant == pytest.approx(1.1)
    assert first.process.delay == pytest.approx(0.1)
    assert (first.gain, first.integral_time) == pytest.approx((5.5, 0.8))
    second = factor_transfer_function(build_chain(1.0, 0.2), "u", "y", None).reduce_order(2)
    assert (second.time_constant, second.second_time_constant) == pytest.approx((1.0, 0.2))
    assert second.delay == 0.0
    fourfold = build_chain(1.0, 1.0, 1.0, 1.0)
    for kind, process in (("PI", (1.5, 2.5, 0.0)), ("PID", (1.0, 1.5, 1.5))):
        one = tune_controller(fourfold, "u", "y", controller=kind).process  # type: ignore[arg-type]
        found = (one.time_constant, one.delay, one.second_time_constant)
        assert found == pytest.approx(process, rel=1e-3)


def test_simc_of_two_lags_cancels_both_in_the_standard_form() -> None:
    """K (1 + 1/(T_i s) + T_d s) has its zeros at -1/T1 and -1/T2, so that L = e^(-θs)/(2 θ s)."""
    plant = build_chain(2.0, 0.5, delay=0.4, gain=-3.0)
    found = tune_controller(plant, "u", "y", controller="PID")
    zeros = np.roots([found.integral_time * found.derivative_time, found.integral_time, 1.0])
    np.testing.assert_allclose(np.sort(zeros), [-2.0, -0.5], rtol=1e-6)
    assert found.gain < 0
    told = compute_margins(plant, build_controller(found, derivative_filter=1e5))
    assert told.gain_margin == pytest.approx(pi, rel=1e-3)
    assert told.phase_margin == pytest.approx(90 - degrees(0.5), abs=0.05)


def test_a_very_slow_process_is_tuned_as_an_integrating_one() -> None:
    slow = give_values(load_model("fopdt"), K=7e5, T=1e6, L=1.0, y0=0.0)
    for kind, rule in (("PI", "simc"), ("PI", "amigo"), ("PID", "amigo")):
        one, other = (
            tune_controller(plant, "u", "y", controller=kind, rule=rule)  # type: ignore[arg-type]
            for plant in (slow, build_linear({"x1": "0.7*u(t - 1)"}))
        )
        assert (one.gain, one.integral_time, one.derivative_time) == pytest.approx(
            (other.gain, other.integral_time, other.derivative_time), rel=1e-4
        )
    assert other.process.time_constant == inf


def test_amigo_is_that_of_its_formulas() -> None:
    """Åström and Hägglund 2004, equations 11 and 17, written out once more with K, T and L."""
    k, t, lag = 2.0, 3.0, 1.0
    pi_ = tune_controller(FOPDT, "u", "y", rule="amigo")
    assert pi_.gain == pytest.approx(0.15 / k + (0.35 - lag * t / (lag + t) ** 2) * t / (k * lag))
    assert pi_.integral_time == pytest.approx(
        0.35 * lag + 13 * lag * t**2 / (t**2 + 12 * lag * t + 7 * lag**2)
    )
    pid = tune_controller(FOPDT, "u", "y", rule="amigo", controller="PID")
    assert pid.gain == pytest.approx((0.2 + 0.45 * t / lag) / k)
    assert pid.integral_time == pytest.approx((0.4 * lag + 0.8 * t) / (lag + 0.1 * t) * lag)
    assert pid.derivative_time == pytest.approx(0.5 * lag * t / (0.3 * lag + t))
    # The rule was made for a largest sensitivity of about 1.4.
    for found in (pi_, pid):
        assert compute_margins(FOPDT, build_controller(found)).sensitivity_peak == pytest.approx(
            1.4, abs=0.2
        )


def test_a_transport_is_a_part_of_what_is_controlled() -> None:
    tube = Transport(0.8, 0.5, 0.3)
    found = tune_controller(FOPDT, "u", "y", transport=tube)
    assert found.process.time_constant == pytest.approx(3.25)
    assert found.process.delay == pytest.approx(1.55)
    assert found.process.gain == pytest.approx(1.6)
    whole = build_chain(3.0, 0.5, delay=1.3, gain=1.6)
    control = build_controller(found)
    assert _numbers(compute_margins(FOPDT, replace(control, transport=tube))) == pytest.approx(
        _numbers(compute_margins(whole, control)), rel=1e-4
    )


def test_states_without_effect_and_constants_are_no_part_of_the_transfer_function() -> None:
    plant = build_linear({"x1": "(u(t - 1) - x1)/3", "x2": "(u + 0.5*x1 - x2)/0.2"}, "x1 + 4")
    found = factor_transfer_function(plant, "u", "y", None)
    assert found.time_constants == pytest.approx((3.0,))
    assert (found.gain, found.delay) == pytest.approx((1.0, 1.0))


def _numbers(found: Margins) -> tuple[float, ...]:
    return (found.gain_margin, found.phase_margin, found.delay_margin, found.sensitivity_peak)


@pytest.mark.parametrize(("gain", "is_stable"), [(0.9, True), (1.1, False)])
def test_the_loop_swings_where_the_gain_margin_says(gain: float, is_stable: bool) -> None:
    """The simulation, which knows nothing of margins, at 10 % on either side."""
    control = build_controller(tune_controller(FOPDT, "u", "y"))
    factor = compute_margins(FOPDT, control).gain_margin
    edge = replace(control, gain=control.gain * factor * gain)
    assert compute_margins(FOPDT, edge).is_stable == is_stable
    assert (compute_margins(FOPDT, edge).gain_margin > 1) == is_stable
    assert (compute_margins(FOPDT, edge).phase_margin > 0) == is_stable
    times = 0.02 * np.arange(10001.0)
    loop = close_loop(FOPDT.model, edge, 0.02)
    step = Channel(
        loop.reference, np.array([-1e-9, 0.0, times[-1]]), np.array([5.0, 6.0, 6.0]), hold="zero"
    )
    values = {**FOPDT.parameter_values, "x(0)": 0.0}
    found = loop.simulate([step], values, times=times).channel("y").values
    metrics = measure_step_response(times, found, at=0.0, before=5.0, after=6.0)
    assert metrics.is_settled == is_stable
    assert metrics.runs_away != is_stable


def test_of_a_double_integrator_under_pd_the_margins_are_known() -> None:
    """L = K (1 + T_d s)/s² with a filter far away: at crossover the phase margin is atan(T_d ω)."""
    plant = build_linear({"x1": "x2", "x2": "u"})
    control = PidControl("u", "y", 1.0, derivative_time=1.0, derivative_filter=1e6)
    found = compute_margins(plant, control)
    omega = sqrt((1 + sqrt(5)) / 2)
    assert found.crossover_frequency == pytest.approx(omega, rel=1e-4)
    assert found.phase_margin == pytest.approx(degrees(np.arctan(omega)), abs=1e-2)
    assert found.gain_margin == inf
    weak = compute_margins(build_chain(1.0), PidControl("u", "y", 0.5))
    assert (weak.phase_margin, weak.delay_margin, weak.gain_margin) == (inf, inf, inf)
    assert isnan(weak.crossover_frequency)


def test_the_wrong_sign_of_the_gain_has_no_margin() -> None:
    found = compute_margins(FOPDT, PidControl("u", "y", -1.0, integral_time=3.0))
    assert not found.is_stable
    assert found.phase_margin < 0
    assert found.delay_margin == 0


@pytest.mark.parametrize("gain", [0.5, 1.5, 4.0, 40.0])
def test_stability_is_that_of_the_roots_where_there_is_no_dead_time(gain: float) -> None:
    """Of an unstable plant, of one that integrates behind lags, and of one that swings."""
    polynomials = {
        ("(u + x1)/2",): [2.0, -1.0],
        ("(x2 - x1)/0.5", "x3", "(u - x3)/0.2"): [0.1, 0.7, 1.0, 0.0],
        ("x2", "u - x1 - 0.1*x2"): [1.0, 0.1, 1.0],
    }
    for equations, below in polynomials.items():
        plant = build_linear({f"x{i}": one for i, one in enumerate(equations, 1)})
        for integral, derivative in ((None, 0.0), (1.5, 0.0), (1.5, 0.4), (0.1, 0.0)):
            control = PidControl("u", "y", gain, integral_time=integral, derivative_time=derivative)
            filtered = [control.filter_time, 1.0]
            above = np.polyadd(filtered, [derivative, 0.0])
            whole = np.polymul(filtered, below)
            if integral is not None:
                above = np.polyadd(np.polymul(above, [1.0, 0.0]), np.array(filtered) / integral)
                whole = np.polymul(whole, [1.0, 0.0])
            roots = np.roots(np.polyadd(whole, gain * above))
            assert compute_margins(plant, control).is_stable == bool(np.all(roots.real < 0))


def test_a_dead_time_inside_the_plant_is_kept_as_it_is() -> None:
    """x' = -a x(t - 1) + u: with proportional control -(a + K) x(t - 1), stable below π/2."""
    plant = build_linear({"x1": "-0.5*x1(t - 1) + u(t - 1)"})
    found = compute_margins(plant, PidControl("u", "y", 0.3))
    assert found.gain_margin == pytest.approx((pi / 2 - 0.5) / 0.3, rel=1e-5)
    with pytest.raises(InvalidSettings, match="inside a loop of its own"):
        tune_controller(plant, "u", "y")


@pytest.mark.parametrize(
    ("plant", "part"),
    [
        (build_linear({"x1": "(u(t-1) - x1**2)/2"}), "needs a linear model"),
        (build_linear({"x1": "(u(t-1) + x1)/2"}), "unstable by itself"),
        (build_linear({"x1": "x2", "x2": "u(t-1)"}), "integrates twice"),
        (build_linear({"x1": "x2", "x2": "u(t-1) - x1 - 0.4*x2"}), "oscillates by itself"),
        (build_linear({"x1": "(u(t-1) + u(t-2) - x1)/2"}), "more than one dead time"),
        (build_linear({"x1": "(u - x1)/2"}, "x1 + 0.3*u"), "has a zero at"),
        (build_linear({"x1": "(w - x1)/2"}), "has no effect on 'y'"),
        (build_linear({"x1": "-x1"}, "u(t-1)"), "no time constant"),
    ],
)
def test_a_plant_that_a_rule_is_not_for_is_told(plant: IdentifiedModel, part: str) -> None:
    with pytest.raises(InvalidSettings, match=part) as caught:
        tune_controller(plant, "u", "y")
    assert caught.value.pointer == "/tuning"


def test_what_a_rule_cannot_take_is_told() -> None:
    recursion = IdentifiedModel(
        parse_model(
            {
                "name": "r",
                "form": "difference",
                "inputs": {"u": "V"},
                "states": {"x": "m"},
                "equations": {"x": "0.9*x(k-1) + 0.1*u(k-1)"},
                "outputs": {"y": "x"},
            }
        ),
        (),
        sample_time=0.1,
    )
    with pytest.raises(InvalidSettings, match="this one is a recursion"):
        tune_controller(recursion, "u", "y")
    with pytest.raises(NotLinear, match="this one is a recursion"):
        compute_margins(recursion, PidControl("u", "y", 1.0))
    with pytest.raises(InvalidSettings, match="no dead time to use instead") as caught:
        tune_controller(build_chain(1.0), "u", "y")
    assert caught.value.pointer == "/tuning/closed_loop_time_constant"
    with pytest.raises(InvalidSettings, match="above 0 s"):
        tune_controller(FOPDT, "u", "y", closed_loop_time_constant=-1.0)
    with pytest.raises(InvalidSettings, match="leave it out"):
        tune_controller(FOPDT, "u", "y", rule="amigo", closed_loop_time_constant=1.0)
    with pytest.raises(InvalidSettings, match="use rule 'simc'"):
        tune_controller(build_chain(1.0), "u", "y", rule="amigo")
    with pytest.raises(InvalidSettings, match=r"^/tuning: 'u' has no effect on 'y'"):
        tune_controller(FOPDT, "u", "y", transport=Transport(gain=0.0))
    for gain, delay, slow in ((1e-310, 1.0, 1.0), (1e-300, 1e-30, 1e-30), (100.0, 1.0, 1e308)):
        weak = build_chain(1.0, delay=delay, gain=gain)
        with pytest.raises(InvalidSettings, match=r"^/tuning: the rule gives a gain of (inf|0)"):
            tune_controller(weak, "u", "y", closed_loop_time_constant=slow)


def test_the_gain_margin_is_found_beyond_many_turns_of_a_long_dead_time() -> None:
    """Of K e^(-θs)/s the margin is π/(2 K θ), whatever θ is against the other times."""
    for theta in (1e-3, 1.0, 1e3):
        plant = build_linear({"x1": f"u(t - {theta})"})
        found = compute_margins(plant, PidControl("u", "y", 0.1 / theta))
        assert found.gain_margin == pytest.approx(pi / 0.2, rel=1e-6)
        assert log(found.delay_margin) == pytest.approx(log((pi / 2 - 0.1) * theta / 0.1), rel=1e-6)
