"""Runs simulated on new inputs and in closed loops, over REST, the client and the command line."""

import json
from math import degrees, pi
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from service.cli import common, run_commands
from service.client.client import Client
from service.datasets import data_child, large_simulation
from service.formats.mcap.mcap_files import read_mcap
from sysid.core.child_processes import run_child
from tests.support.library.catalogue_cases import ACTUATOR
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import Through, parts_of, read_faults, recording, store_csv

SMALL = {"population": 16, "generations": 25, "islands": 1}
NEAR = {name: {"lower": 0.9 * value, "upper": 1.1 * value} for name, value in ACTUATOR.items()}
STEP = {"kind": "step", "amplitude": pi / 2}
TUBE = {"time_constant": 0.35, "delay": 0.127}
CONTROL = {
    "input": "P_a",
    "output": "theta",
    "gain": 10e3,
    "limit": 0.25e6,
    "transport": TUBE,
    "reference": STEP,
}
LOOP = {"control": CONTROL, "samples": 601}


class SimulatedPlants(NamedTuple):
    """An application with an identified actuator, an identified lag and a run without result."""

    server: TestClient
    arm: str
    lag: str
    queued: str
    dataset: str


@pytest.fixture(scope="module")
def plants(server: TestClient) -> SimulatedPlants:
    parts = parts_of(server)
    pressure = "12e3*(0.55*sin(2.2*t) + 0.6*sin(5.65*t + 1) + 0.5*sin(14.5*t + 2))"
    made = server.post(
        "/v1/datasets:simulate",
        json={
            "model": "actuator",
            "parameters": ACTUATOR,
            "samples": 600,
            "sample_time": 0.01,
            "inputs": {"P_a": {"kind": "expression", "expression": pressure}},
        },
    )
    assert made.status_code == 201, made.text
    arm = {
        "model": "actuator",
        "datasets": [made.json()["id"]],
        "algorithm": SMALL,
        "parameters": {**NEAR, "theta(0)": {"fixed": 0}},
    }
    steps = store_csv(server, recording())
    lag = {
        "model": "fopdt",
        "datasets": [steps],
        "algorithm": SMALL,
        "parameters": {"K": {"lower": 0, "upper": 10}, "L": {"upper": 5}, "T": {"upper": 10}},
    }
    _, [first] = identify_job(parts, arm)
    _, [second] = identify_job(parts, lag)
    job = server.post("/v1/jobs", json=lag).json()["id"]
    [waiting] = Client("http://testserver", transport=Through(server)).runs(job)
    return SimulatedPlants(server, first, second, waiting["id"], steps)


def simulate_run(
    plants: SimulatedPlants, run: str, body: dict[str, Any], **query: Any
) -> dict[str, Any]:
    answer = plants.server.post(f"/v1/runs/{run}:simulate", json=body, params=query)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_the_identified_arm_under_control_behaves_as_in_figure_21(plants: SimulatedPlants) -> None:
    found = simulate_run(plants, plants.arm, LOOP)
    metrics = found["metrics"]
    assert (metrics["output"], metrics["unit"]) == ("theta", "rad")
    assert metrics["overshoot_percent"] == pytest.approx(1.0, abs=0.6)
    assert metrics["settling_time"] == pytest.approx(1.6, abs=0.2)
    assert [one["name"] for one in found["outputs"]] == ["theta"]
    assert [one["name"] for one in found["inputs"]] == ["P_a"]
    assert max(found["command"]["values"]) == pytest.approx(10e3 * pi / 2, rel=1e-3)
    assert found["reference"]["values"][0] == pytest.approx(pi / 2)
    assert found["dataset"] is None


def test_without_transport_the_controller_is_a_step_late_and_friction_leaves_an_error(
    plants: SimulatedPlants,
) -> None:
    control = {key: value for key, value in CONTROL.items() if key != "transport"}
    found = simulate_run(plants, plants.arm, {**LOOP, "control": control})
    expected = found["parameters"]["F_c"] / (found["parameters"]["A_m"] * 10e3)
    assert found["metrics"]["steady_error"] == pytest.approx(expected, abs=1e-3)
    assert degrees(expected) == pytest.approx(14.1, abs=0.5)
    assert found["metrics"]["overshoot_percent"] == 0.0
    assert found["metrics"]["rise_time"] > 0.0  # to the final value, as stepinfo tells it
    [note] = found["notes"]
    assert "0.00125 s late" in note


def test_that_states_start_where_an_earlier_input_does_is_told(plants: SimulatedPlants) -> None:
    def simulate_since(since: float) -> dict[str, Any]:
        u = {"kind": "series", "times": [since, 20.0], "values": [0.0, 0.0], "hold": "zero"}
        return simulate_run(
            plants,
            plants.lag,
            {
                "inputs": {"u": u},
                "samples": 100,
                "sample_time": 0.05,
                "parameters": {"y0": 5.0, "x(0)": 1.0},
            },
        )

    early, at_zero = simulate_since(-2.0), simulate_since(0.0)
    assert at_zero["notes"] == []
    assert at_zero["outputs"][0]["values"][0] == pytest.approx(6.0)
    [note] = early["notes"]
    assert note.startswith("u begins at -2 s. The initial states apply there")
    gone = np.exp(-2.0 / early["parameters"]["T"])
    assert early["outputs"][0]["values"][0] == pytest.approx(5.0 + gone, rel=1e-4)


def test_a_loop_that_is_not_at_rest_when_its_reference_steps_is_told(
    plants: SimulatedPlants,
) -> None:
    def read_notes(**step: float) -> list[str]:
        control = {"input": "u", "output": "y", "gain": 0.2, "reference": {"kind": "step", **step}}
        body = {
            "control": control,
            "samples": 4000,
            "sample_time": 0.05,
            "parameters": {"y0": 5.0, "x(0)": 0.0},
        }
        return list(simulate_run(plants, plants.lag, body)["notes"])

    [note] = read_notes(offset=1.0, amplitude=2.0)
    assert note.startswith("y starts at 5 with a reference of 1 before the step")
    assert read_notes(offset=5.0, amplitude=2.0) == []  # there the controller asks for nothing
    assert read_notes(offset=1.0, amplitude=2.0, time=150.0) == []
    [note] = read_notes(offset=1.0, amplitude=2.0, time=1.0)
    assert note.startswith("y still moves when the reference steps")


@pytest.mark.parametrize("time", [0.0, 1.0])
@pytest.mark.parametrize("is_closed", [True, False])
def test_starts_are_those_at_the_first_sample_also_where_a_step_comes(
    plants: SimulatedPlants, time: float, is_closed: bool
) -> None:
    step = {"kind": "step", "offset": 1.0, "amplitude": 2.0, "time": time}
    loop = {"control": {"input": "u", "output": "y", "gain": 0.2, "reference": step}}
    body = {"samples": 100, "sample_time": 0.05, "parameters": {"y0": 5.0, "x(0)": 1.0}}
    found = simulate_run(
        plants, plants.lag, {**body, **(loop if is_closed else {"inputs": {"u": step}})}
    )
    values, p = np.array(found["outputs"][0]["values"]), found["parameters"]
    # Until the lag is over the plant is driven by what stood before the start.
    driven = p["K"] * (0.2 * (1.0 - 6.0) if is_closed else 1.0)
    times = 0.05 * np.arange(int(p["L"] / 0.05))
    expected = 5.0 + driven + (1.0 - driven) * np.exp(-times / p["T"])
    assert values[0] == pytest.approx(6.0)
    np.testing.assert_allclose(values[: times.size], expected, rtol=1e-4)


def test_overridden_parameters_are_used_and_ties_follow_them(plants: SimulatedPlants) -> None:
    found = simulate_run(plants, plants.arm, {**LOOP, "parameters": {"F_c": 0.0, "k_a": 50.0}})
    assert found["parameters"]["F_c"] == 0.0
    alone = simulate_run(
        plants, plants.arm, {**LOOP, "parameters": {"k_a": 50.0, "F_c": 0.0, "k_b": 50.0}}
    )
    assert found["outputs"] == alone["outputs"]


def test_an_open_loop_follows_given_samples_a_dataset_or_a_formula(plants: SimulatedPlants) -> None:
    found = simulate_run(
        plants,
        plants.lag,
        {"inputs": {"u": {"kind": "step", "time": 1.0}}, "samples": 201, "sample_time": 0.05},
    )
    values = np.array(found["outputs"][0]["values"])
    times = np.array(found["outputs"][0]["times"])
    p = found["parameters"]
    late = np.maximum(times - 1.0 - p["L"], 0.0)
    expected = p["y0"] + p["K"] * (1 - np.exp(-late / p["T"]))
    # At the sample nearest to the jump a held input is off by K h/(8 T s) at most (decision 13).
    near = int(np.argmin(np.abs(times - 1.0 - p["L"])))
    assert abs(values[near] - expected[near]) <= p["K"] * 0.05 / (8 * p["T"] * 2) + 1e-3
    others = np.arange(values.size) != near
    np.testing.assert_allclose(values[others], expected[others], rtol=1e-3)
    assert found["metrics"] is found["reference"] is None
    inputs = (
        {"kind": "series", "times": [0.0, 1.0], "values": [0.0, 1.0], "hold": "zero"},
        {"kind": "dataset", "dataset": plants.dataset, "channel": "u"},
        {"kind": "cosine", "frequency": 0.1},
    )
    for one in inputs:
        again = simulate_run(plants, plants.lag, {"inputs": {"u": one}, "samples": 101})
        assert again["outputs"][0]["samples"] == 101
        if one["kind"] == "series":
            coarse = np.array(again["outputs"][0]["times"])
            others = np.abs(coarse - 1.0 - p["L"]) > 0.05
            expected = np.interp(coarse, times, values)
            np.testing.assert_allclose(
                np.array(again["outputs"][0]["values"])[others],
                expected[others],
                rtol=1e-2,
                atol=1e-4,
            )


def test_a_stored_simulation_is_a_dataset_that_knows_its_run_and_is_made_once(
    plants: SimulatedPlants,
) -> None:
    body = {**LOOP, "store": True, "name": "ninety degrees"}
    first, again = (simulate_run(plants, plants.arm, body, max_points=10) for _ in range(2))
    assert first["dataset"]["id"] == again["dataset"]["id"]
    dataset = first["dataset"]
    assert (dataset["name"], dataset["kind"]) == ("ninety degrees", "simulate")
    assert [c["name"] for c in dataset["channels"]] == ["P_a", "theta", "reference"]
    assert len(first["outputs"][0]["values"]) <= 10
    lineage = plants.server.get(f"/v1/datasets/{dataset['id']}/lineage").json()["edges"]
    assert {"parent": plants.arm, "child": dataset["id"], "relation": "simulated"} in lineage
    content = plants.server.get(f"/v1/datasets/{dataset['id']}/content").content
    angle = read_mcap(content).channel("theta").values
    assert angle.size == 601
    whole = simulate_run(plants, plants.arm, LOOP)["outputs"][0]["values"]
    np.testing.assert_array_equal(angle, whole)


@pytest.mark.parametrize(
    ("change", "pointer", "part"),
    [
        ({"control": {**CONTROL, "input": "P"}}, "/control/input", "no input 'P'; known are P_a"),
        (
            {
                "control": {
                    **CONTROL,
                    "reference": {"kind": "expression", "expression": "unknown(t)"},
                }
            },
            "/control/reference/expression",
            "tanh, where",
        ),
        (
            {"control": {**CONTROL, "reference": {"kind": "expression", "expression": "q*t"}}},
            "/control/reference/expression",
            "known are h, k, pi, t",
        ),
        ({"control": {**CONTROL, "output": "theta_"}}, "/control/output", "did you mean 'theta'"),
        ({"control": {**CONTROL, "limit": 0}}, "/control/limit", "need a number above 0"),
        ({"control": {**CONTROL, "transport": {"delay": -1}}}, "/control/transport/delay", "0"),
        (
            {"control": {**CONTROL, "reference": {**STEP, "time": 9}}},
            "/control/reference/time",
            "outside the simulation, from 0 to 6 s",
        ),
        ({"inputs": {"P_a": STEP}}, "/inputs/P_a", "the controller computes this input"),
        ({"inputs": {"u": STEP}}, "/inputs/u", "no input 'u'"),
        ({"control": None}, "/inputs/P_a", "input 'P_a' is missing"),
        ({"parameters": {"Fc": 1.0}}, "/parameters/Fc", "did you mean 'F_c'"),
        ({"samples": 1}, "/samples", "2"),
        ({"samples": 2_000_000}, "/samples", "1000000"),
        (
            {"control": {**CONTROL, "transport": {"delay": 7}}},
            "/control/transport/delay",
            "found 7 s, but the simulation lasts 6 s",
        ),
    ],
)
def test_what_cannot_be_simulated_is_told_where_it_is(
    plants: SimulatedPlants, change: dict[str, Any], pointer: str, part: str
) -> None:
    answer = plants.server.post(f"/v1/runs/{plants.arm}:simulate", json={**LOOP, **change})
    faults = read_faults(answer, 422, "invalid")
    assert pointer in {fault["pointer"] for fault in faults}
    assert any(part in fault["detail"] for fault in faults), faults


def test_a_run_without_estimates_or_without_existence_is_told(plants: SimulatedPlants) -> None:
    path = f"/v1/runs/{plants.queued}:simulate"
    answer = plants.server.post(path, json={"inputs": {"u": STEP}, "samples": 10})
    read_faults(answer, 409, "conflict")
    read_faults(plants.server.post("/v1/runs/run_x:simulate", json=LOOP), 404, "not-found")


def test_a_simulation_that_diverges_is_told_with_its_time(plants: SimulatedPlants) -> None:
    control = {"input": "u", "output": "y", "gain": 1e30, "reference": STEP}
    body = {"control": control, "samples": 201, "parameters": {"L": 0.5}}
    faults = read_faults(
        plants.server.post(f"/v1/runs/{plants.lag}:simulate", json=body), 422, "invalid"
    )
    assert faults[0]["pointer"] == "/control/gain"
    assert "found 1e+30, with which the loop diverges" in faults[0]["detail"]
    assert "diverges at t =" in faults[0]["detail"]


def test_a_loop_that_runs_away_has_no_overshoot(plants: SimulatedPlants) -> None:
    control = {"input": "u", "output": "y", "gain": 6.0, "reference": STEP}
    body = {"samples": 201, "parameters": {"K": 2.0, "T": 1.0, "L": 0.5, "y0": 0.0}}
    metrics = simulate_run(plants, plants.lag, {**body, "control": control})["metrics"]
    assert metrics["runs_away"] is True
    assert metrics["overshoot_percent"] is metrics["settling_time"] is metrics["steady_error"]
    assert metrics["overshoot_percent"] is None
    calm = {**control, "gain": 0.2}
    metrics = simulate_run(plants, plants.lag, {**body, "control": calm})["metrics"]
    assert metrics["runs_away"] is False
    assert metrics["overshoot_percent"] is not None


def test_no_name_of_our_own_is_suggested_in_an_expression(plants: SimulatedPlants) -> None:
    wave = {"kind": "expression", "expression": "foo(t) + q"}
    body = {"inputs": {"u": wave}, "samples": 20}
    faults = read_faults(
        plants.server.post(f"/v1/runs/{plants.lag}:simulate", json=body), 422, "invalid"
    )
    assert [fault["column"] for fault in faults] == [1, 10]
    assert not any("unused" in fault["detail"] for fault in faults)


def test_the_client_simulates_a_run(plants: SimulatedPlants) -> None:
    client = Client("http://testserver", transport=Through(plants.server))
    found = client.simulate_run(plants.arm, LOOP, max_points=50)
    assert len(found["outputs"][0]["times"]) <= 50


def test_the_command_line_tells_the_measures_of_the_step(
    plants: SimulatedPlants, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def connect_in_process(url: str, key: str | None) -> Client:
        return Client("http://testserver", transport=Through(plants.server))

    monkeypatch.setattr(common, "connect_client", connect_in_process)
    file = tmp_path / "loop.json"
    file.write_text(json.dumps({**LOOP, "store": True}))
    done = CliRunner().invoke(run_commands.app, ["simulate", plants.arm, str(file)])
    assert done.exit_code == 0, done.output
    told = ("theta [rad]: 601 samples", "overshoot of the reference: ", "settling time (2 %): 1.")
    for part in (*told, "stored as"):
        assert part in done.output
    raw = CliRunner().invoke(run_commands.app, ["simulate", plants.arm, str(file), "--json"])
    assert json.loads(raw.output)["metrics"]["output"] == "theta"


def test_a_lag_that_would_look_ahead_is_refused(plants: SimulatedPlants) -> None:
    inputs = {"u": {"kind": "step", "amplitude": 1}}
    body = {"inputs": inputs, "samples": 20, "parameters": {"L": -1}}
    for path in (f"/v1/runs/{plants.lag}:simulate", "/v1/datasets:simulate"):
        given = body
        if path.startswith("/v1/datasets"):
            values = {"K": 2, "T": 0.5, "y0": 0, "L": -1}
            given = {**body, "model": "fopdt", "sample_time": 0.1, "parameters": values}
        [fault] = read_faults(plants.server.post(path, json=given), 422, "invalid")
        assert fault["pointer"] == "/parameters/L"
        assert "found -1; with it the delay of u(t - L) can be as small as -1 s" in fault["detail"]


def test_long_simulations_are_done_by_a_child_with_the_same_bits(
    plants: SimulatedPlants, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_loop = {"inputs": {"u": {"kind": "step", "time": 1.0}}, "samples": 101, "sample_time": 0.1}
    here = [
        simulate_run(plants, plants.arm, LOOP),
        simulate_run(plants, plants.lag, open_loop),
    ]
    children = []

    def count(*args: Any, **options: Any) -> Any:
        children.append(args[0])
        return run_child(*args, **options)

    monkeypatch.setattr(data_child, "run_child", count)
    monkeypatch.setattr(large_simulation, "LARGE_STEPS", 1)
    assert [
        simulate_run(plants, plants.arm, LOOP),
        simulate_run(plants, plants.lag, open_loop),
    ] == here
    body = {
        "model": "fopdt",
        "parameters": {"K": 2.0, "T": 1.0, "L": 0.5, "y0": 0.0},
        "inputs": {"u": {"kind": "step", "time": 1.0}},
        "samples": 77,
        "sample_time": 0.1,
    }
    assert plants.server.post("/v1/datasets:simulate", json=body).status_code == 201
    truth = {key: body[key] for key in ("parameters", "inputs", "sample_time")}
    sweep = {"model": "fopdt", "truth": {**truth, "samples": 78}, "sigma": [0.1], "relative": True}
    answer = plants.server.post("/v1/recipes/noise-sweep", json=sweep)
    assert answer.status_code == 202, answer.text
    assert children == ["service.datasets.simulation_child"] * 4
