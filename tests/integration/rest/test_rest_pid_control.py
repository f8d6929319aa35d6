"""PI and PID control, tuning rules and margins in `:simulate`, over REST and the command line."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from service.cli import common, run_commands
from service.client.client import Client
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import Through, parts_of, read_faults

STEP = {"kind": "step", "amplitude": 1.0}
CONTROL = {"input": "u", "output": "y", "gain": 0.5, "integral_time": 1.0, "reference": STEP}
BODY = {"control": CONTROL, "samples": 751, "sample_time": 0.02}
PLANT = {"K": 2.0, "T": 1.0, "L": 0.5, "y0": 0.0, "x(0)": 0.0}
ARX = {
    "name": "arx",
    "form": "difference",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {"a": {"lower": 0, "upper": 1}, "b": {"lower": 0, "upper": 1}},
    "equations": {"x": "a*x(k-1) + b*u(k-1)"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}


class ControlledPlants(NamedTuple):
    """An application with an identified lag and an identified recursion."""

    server: TestClient
    lag: str
    arx: str


@pytest.fixture(scope="module")
def plants(server: TestClient) -> ControlledPlants:
    found = []
    for model, values in (("fopdt", {**PLANT}), (ARX, {"a": 0.9, "b": 0.1})):
        made = server.post(
            "/v1/datasets:simulate",
            json={
                "model": model,
                "parameters": values,
                "samples": 200,
                "sample_time": 0.1,
                "inputs": {"u": {"kind": "binary", "period": 2}},
            },
        )
        assert made.status_code == 201, made.text
        body = {
            "model": model,
            "datasets": [made.json()["id"]],
            "algorithm": {"population": 16, "generations": 25, "islands": 1},
        }
        _, [run] = identify_job(parts_of(server), body)
        found.append(run)
    return ControlledPlants(server, *found)


def simulate_control(
    plants: ControlledPlants, run: str | None = None, **control: Any
) -> dict[str, Any]:
    """The lag with its true parameters in a loop; other fields of the controller."""
    body: dict[str, Any] = {**BODY, "control": {**CONTROL, **control}}
    if run is None:
        body["parameters"] = PLANT
    answer = plants.server.post(f"/v1/runs/{run or plants.lag}:simulate", json=body)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_a_pi_controller_leaves_no_error_and_its_numbers_are_told(plants: ControlledPlants) -> None:
    found = simulate_control(plants, upper=0.62, setpoint_weight=0.9)
    assert found["metrics"]["steady_error"] == pytest.approx(0.0, abs=1e-4)
    assert found["controller"] == {
        "gain": 0.5,
        "integral_time": 1.0,
        "derivative_time": 0.0,
        "derivative_filter": 10.0,
        "derivative_on": "measurement",
        "setpoint_weight": 0.9,
        "lower": None,
        "upper": 0.62,
        "tracking_time": 1.0,
        "command_min": pytest.approx(0.45, abs=1e-6),
        "command_max": 0.62,
        "saturated_percent": found["controller"]["saturated_percent"],
    }
    assert 1.0 < found["controller"]["saturated_percent"] < 20.0
    at_limit = np.mean(np.array(found["command"]["values"]) >= 0.62)
    assert found["controller"]["saturated_percent"] == pytest.approx(100 * at_limit, abs=0.5)
    assert found["tuning"] is None
    proportional = simulate_control(plants, integral_time=None)
    # Of gain 0.5 and a plant of 2 half of the step is left.
    assert proportional["metrics"]["steady_error"] == pytest.approx(0.5, abs=1e-3)
    assert proportional["controller"]["integral_time"] is None


def test_integrals_of_the_error_are_those_of_the_series(plants: ControlledPlants) -> None:
    metrics = simulate_control(plants)["metrics"]
    whole = simulate_control(plants)
    times, values = (np.array(whole["outputs"][0][key]) for key in ("times", "values"))
    assert times.size == BODY["samples"]
    error = np.abs(1.0 - values)
    assert metrics["iae"] == pytest.approx(float(np.trapezoid(error, times)))
    assert metrics["itae"] == pytest.approx(float(np.trapezoid(times * error, times)))
    # ∫e dt = T_i/(K k) of integral action, and the error of this loop never changes its sign much.
    assert metrics["iae"] == pytest.approx(1.0 / (0.5 * 2.0), rel=0.1)


def test_margins_are_those_of_the_loop_and_a_recursion_has_none(plants: ControlledPlants) -> None:
    found = simulate_control(plants)["margins"]
    assert found["is_stable"]
    assert found["gain_margin"] == pytest.approx(3.14, abs=0.01)
    assert found["phase_margin"] == pytest.approx(61.4, abs=0.1)
    assert found["delay_margin"] == pytest.approx(2.14 * 0.5, abs=0.01)
    recursion = simulate_control(plants, plants.arx, gain=2.0)
    assert recursion["margins"] is None
    assert recursion["metrics"]["steady_error"] == pytest.approx(0.0, abs=1e-4)


def test_a_rule_chooses_the_numbers_and_says_whose_it_is(plants: ControlledPlants) -> None:
    found = simulate_control(plants, gain=None, integral_time=None, tuning={})
    assert found["controller"]["gain"] == pytest.approx(0.5)
    assert found["controller"]["integral_time"] == pytest.approx(1.0)
    told = found["tuning"]
    assert (told["rule"], told["controller"]) == ("simc", "PI")
    assert told["closed_loop_time_constant"] == pytest.approx(0.5)
    assert told["process_gain"] == pytest.approx(2.0)
    assert "Skogestad" in told["reference"]
    assert told["formulas"]
    by_hand = simulate_control(
        plants, gain=found["controller"]["gain"], integral_time=found["controller"]["integral_time"]
    )
    assert by_hand["outputs"] == found["outputs"]
    slower = simulate_control(
        plants, gain=None, integral_time=None, tuning={"closed_loop_time_constant": 2.0}
    )
    assert slower["controller"]["gain"] == pytest.approx(1.0 / (2.0 * 2.5))
    tube = {"time_constant": 0.4, "delay": 0.2}
    pid = simulate_control(
        plants, gain=None, integral_time=None, transport=tube, tuning={"controller": "PID"}
    )
    assert pid["tuning"]["process_second_time_constant"] == pytest.approx(0.4)
    assert pid["controller"]["derivative_time"] > 0
    assert pid["metrics"]["is_settled"]
    amigo = simulate_control(plants, gain=None, integral_time=None, tuning={"rule": "amigo"})
    assert "Åström" in amigo["tuning"]["reference"]
    assert amigo["tuning"]["closed_loop_time_constant"] is None


def test_a_pid_rule_that_gives_no_derivative_says_why(plants: ControlledPlants) -> None:
    found = simulate_control(plants, gain=None, integral_time=None, tuning={"controller": "PID"})
    assert found["controller"]["derivative_time"] == 0.0
    assert any("no second time constant" in note for note in found["notes"])


def test_an_unstable_loop_and_a_limit_cycle_are_told_plainly(plants: ControlledPlants) -> None:
    wild = simulate_control(plants, gain=3.0, integral_time=1.0)
    assert wild["metrics"]["runs_away"]
    assert wild["metrics"]["settling_time"] is wild["metrics"]["iae"] is None
    assert not wild["margins"]["is_stable"]
    assert any("the loop is unstable" in note for note in wild["notes"])
    bounded = simulate_control(plants, gain=3.0, integral_time=1.0, limit=1.5)
    metrics = bounded["metrics"]
    assert not metrics["runs_away"]
    assert metrics["settling_time"] is None
    assert metrics["swing"] > 1.0
    # A relay around a lag with dead time swings at about its ultimate period, 4 L and less.
    assert 1.2 < metrics["swing_period"] < 2.6
    assert any("oscillates and does not settle" in note for note in bounded["notes"])
    assert not any("it decays" in note for note in bounded["notes"])


def test_of_a_loop_that_is_hardly_stable_it_is_said_that_its_swing_decays(
    plants: ControlledPlants,
) -> None:
    border = simulate_control(plants, gain=1.0, integral_time=1.0)["margins"]["gain_margin"]
    hardly = simulate_control(plants, gain=0.999 * border, integral_time=1.0)
    assert hardly["margins"]["is_stable"]
    [note] = [one for one in hardly["notes"] if "oscillates and does not settle" in one]
    assert note.endswith(". By its transfer function it decays, but too slowly for this record")


@pytest.mark.parametrize(
    ("change", "pointer", "part"),
    [
        ({"integral_time": 0.0}, "/control/integral_time", "above 0"),
        ({"lower": 1.0, "upper": -1.0}, "/control/upper", "found -1, and 1 as lower limit"),
        ({"limit": 1.0, "lower": 0.0}, "/control/lower", "the limit ± is given too"),
        ({"gain": None}, "/control/gain", "is missing. Give it, or give a tuning rule as 'tuning'"),
        ({"tuning": {}}, "/control/gain", "Leave it out, or leave out 'tuning'"),
        ({"tuning": {}, "gain": 0.0, "integral_time": None}, "/control/gain", "Leave it out"),
        (
            {"tuning": {}, "gain": None},
            "/control/integral_time",
            "the tuning rule chooses this value",
        ),
        ({"tuning": {"rule": "ziegler"}}, "/control/tuning/rule", "simc"),
        (
            {
                "tuning": {"rule": "amigo", "closed_loop_time_constant": 1},
                "gain": None,
                "integral_time": None,
            },
            "/control/tuning/closed_loop_time_constant",
            "leave it out",
        ),
        ({"derivative_time": 1e-6}, "/control/derivative_filter", "too short for steps of 0.02"),
        ({"integraltime": 1.0}, "/control/integraltime", "integral_time"),
        ({"gain": 1e30}, "/control/gain", "with which the loop diverges"),
    ],
)
def test_what_cannot_control_is_told_where_it_is(
    plants: ControlledPlants, change: dict[str, Any], pointer: str, part: str
) -> None:
    body = {**BODY, "control": {**CONTROL, **change}, "parameters": PLANT}
    faults = read_faults(
        plants.server.post(f"/v1/runs/{plants.lag}:simulate", json=body), 422, "invalid"
    )
    assert pointer in {fault["pointer"] for fault in faults}, faults
    assert any(part in fault["detail"] for fault in faults), faults


def test_steps_that_are_too_long_for_a_stable_loop_are_not_blamed_on_its_gain(
    plants: ControlledPlants,
) -> None:
    assert simulate_control(plants)["margins"]["is_stable"]
    body = {**BODY, "sample_time": 20, "control": CONTROL, "parameters": PLANT}
    [fault] = read_faults(
        plants.server.post(f"/v1/runs/{plants.lag}:simulate", json=body), 422, "invalid"
    )
    assert fault["pointer"] == "/sample_time"
    assert "The loop is stable, but steps of 10 s are too long to simulate it" in fault["detail"]
    wild = {**body, "control": {**CONTROL, "gain": 1e30}}
    [fault] = read_faults(
        plants.server.post(f"/v1/runs/{plants.lag}:simulate", json=wild), 422, "invalid"
    )
    assert fault["pointer"] == "/control/gain"


@pytest.mark.parametrize("zero", [0, 0.0, -0.02])
def test_a_sampling_period_of_zero_is_refused(plants: ControlledPlants, zero: float) -> None:
    body = {**BODY, "sample_time": zero}
    faults = read_faults(
        plants.server.post(f"/v1/runs/{plants.lag}:simulate", json=body), 422, "invalid"
    )
    assert [fault["pointer"] for fault in faults] == ["/sample_time"]


def test_a_rule_for_a_recursion_or_without_dead_time_is_refused(plants: ControlledPlants) -> None:
    control = {key: value for key, value in CONTROL.items() if key not in ("gain", "integral_time")}
    control["tuning"] = {}
    path = f"/v1/runs/{plants.arx}:simulate"
    [fault] = read_faults(
        plants.server.post(path, json={**BODY, "control": control}), 422, "invalid"
    )
    assert fault["pointer"] == "/control/tuning"
    assert "this one is a recursion" in fault["detail"]
    body = {**BODY, "control": control, "parameters": {**PLANT, "L": 0.0}}
    path = f"/v1/runs/{plants.lag}:simulate"
    [fault] = read_faults(plants.server.post(path, json=body), 422, "invalid")
    assert fault["pointer"] == "/control/tuning/closed_loop_time_constant"
    assert "no dead time to use instead" in fault["detail"]


def test_the_command_line_tells_controller_rule_and_margins(
    plants: ControlledPlants, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def connect_in_process(url: str, key: str | None) -> Client:
        return Client("http://testserver", transport=Through(plants.server))

    monkeypatch.setattr(common, "connect_client", connect_in_process)
    file = tmp_path / "loop.json"

    def run_command(**control: Any) -> str:
        body = {**BODY, "parameters": PLANT, "control": {**CONTROL, **control}}
        file.write_text(json.dumps(body))
        done = CliRunner().invoke(run_commands.app, ["simulate", plants.lag, str(file)])
        assert done.exit_code == 0, done.output
        return done.output

    text = run_command(gain=None, integral_time=None, tuning={}, upper=0.62)
    for part in (
        "IAE: 1.",
        "ITAE: 0.",
        "controller by SIMC (S. Skogestad",
        "K = 0.5, T_i = 1",
        "to 0.62, ",
        "% of the time at a limit",
        "stable, gain margin 3.14",
        "phase margin 61.4°",
    ):
        assert part in text, text
    text = run_command(gain=3.0, limit=1.5)
    assert "oscillates and does not settle" in text
    assert "gain margin" not in text
