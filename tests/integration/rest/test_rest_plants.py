"""Datasets of reference plants, over REST and the command line."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from service.cli import common, dataset_commands
from service.client.client import Client
from service.formats.mcap.mcap_files import read_mcap
from sysid.data.records import Recording
from tests.support.service.web_app import Through, read_faults

SUPPLY = {"P_a": {"kind": "binary", "amplitude": 12e3, "period": 0.2, "seed": 3}}
ARM = {"plant": "actuator", "inputs": SUPPLY, "samples": 200, "sample_time": 0.01}
TUBE = {"plant": "tube", "parameters": {"length_m": 20}, "samples": 400}


def simulate_dataset(server: TestClient, body: dict[str, Any]) -> dict[str, Any]:
    answer = server.post("/v1/datasets:simulate", json=body)
    assert answer.status_code in (200, 201), answer.text
    return dict(answer.json())


def read_content(server: TestClient, dataset: dict[str, Any]) -> Recording:
    return read_mcap(server.get(f"/v1/datasets/{dataset['id']}/content").content)


def test_the_actuator_is_made_once_and_tells_its_true_parameters(server: TestClient) -> None:
    body = {**ARM, "parameters": {"J": 4e-4, "k_a": 70.0}}
    first, again = (simulate_dataset(server, body) for _ in range(2))
    assert first["id"] == again["id"]
    assert [c["name"] for c in first["channels"]] == ["P_a", "theta", "P"]
    true = first["details"]["true_parameters"]
    assert (true["J"], true["k_a"], true["k_b"], true["F_c"]) == (4e-4, 70.0, 70.0, 1.2317e-2)


def test_noise_is_on_the_angle_alone(server: TestClient) -> None:
    clean = read_content(server, simulate_dataset(server, ARM))
    noisy = read_content(
        server, simulate_dataset(server, {**ARM, "noise": {"sigma": 1e-3, "seed": 2}})
    )
    for name in ("P_a", "P"):
        np.testing.assert_array_equal(clean.channel(name).values, noisy.channel(name).values)
    error = noisy.channel("theta").values - clean.channel("theta").values
    assert float(np.std(error)) == pytest.approx(1e-3, rel=0.2)


def test_the_tube_has_a_record_of_its_own_length_and_sampling(server: TestClient) -> None:
    short = simulate_dataset(server, {"plant": "tube", "parameters": {"length_m": 5, "pattern": 2}})
    assert (short["samples"], short["sample_time"]) == (15001, 0.002)
    some = simulate_dataset(server, TUBE)
    assert (some["samples"], some["sample_time"]) == (400, 0.01)
    assert [(c["name"], c["unit"]) for c in some["channels"]] == [("P1", "Pa"), ("P2", "Pa")]
    gauged = simulate_dataset(server, {**TUBE, "parameters": {"length_m": 20, "gauges": 1}})
    values = read_content(server, gauged).channel("P2").values / (1e6 / 4096)
    np.testing.assert_allclose(values, np.round(values), atol=1e-9)


@pytest.mark.parametrize(
    ("body", "pointer", "part"),
    [
        ({**ARM, "model": "tube"}, "", "either 'model' or 'plant'"),
        ({"samples": 5, "sample_time": 1}, "", "either 'model' or 'plant'"),
        ({**ARM, "plant": "robot"}, "/plant", "actuator"),
        ({**ARM, "inputs": {}}, "/inputs/P_a", "give input 'P_a' in Pa"),
        ({**ARM, "inputs": {**SUPPLY, "u": SUPPLY["P_a"]}}, "/inputs/u", "one input, P_a"),
        ({"plant": "actuator", "inputs": SUPPLY}, "/samples", "is missing"),
        ({**ARM, "samples": 300_000}, "/samples", "200000"),
        ({**ARM, "parameters": {"F_cc": 1}}, "/parameters/F_cc", "did you mean 'F_c'"),
        ({**ARM, "parameters": {"F_max": 1e-3}}, "/parameters/F_max", "Coulomb friction"),
        ({**TUBE, "inputs": SUPPLY}, "/inputs/P_a", "driven by its regulator"),
        ({**TUBE, "parameters": {"length": 3}}, "/parameters/length", "'length_m'"),
        ({**TUBE, "parameters": {"pattern": 1.5}}, "/parameters/pattern", "whole number"),
        ({**TUBE, "parameters": {"pattern": 3}}, "/parameters/pattern", "need 1 or 2"),
        ({**TUBE, "parameters": {"length_m": 1e5}}, "/parameters/length_m", "from 0.5 to 2000"),
        ({**TUBE, "samples": 9_000_000}, "/samples", "need at most 500000"),
        (
            {
                "plant": "tube",
                "parameters": {"cells": 1, "length_m": 5},
                "samples": 9_000_000,
                "sample_time": 0.005,
            },
            "/samples",
            "need at most 500000",
        ),
        (
            {**TUBE, "parameters": {"length_m": 20, "cells": 100}, "samples": 400_000},
            "/samples",
            "Request fewer samples",
        ),
        (
            {**TUBE, "parameters": {"length_m": 2000, "cells": 1}},
            "/parameters/cells",
            "need 400 or more",
        ),
        ({**TUBE, "sample_time": 1e308}, "/sample_time", "need 1000000000 or less"),
        ({**TUBE, "sample_time": 1e9}, "/samples", "Request fewer samples"),
        ({**ARM, "samples": 2, "sample_time": 1e6}, "/sample_time", "at most 300 s"),
        ({**ARM, "sample_time": 1e-12}, "/sample_time", "need 1e-09 or more"),
        ({**ARM, "parameters": {"k_a": 1e308}}, "/parameters", "not finite at t = "),
        (
            {**ARM, "inputs": {"P_a": {**SUPPLY["P_a"], "period": 1e-9}}},
            "/inputs/P_a/period",
            "Use a period of more than 1.99e-07 s",
        ),
        (
            {**ARM, "inputs": {"P_a": {**SUPPLY["P_a"], "period": 1e-300}}},
            "/inputs/P_a/period",
            "Use a period of more than 1.99e-07 s",
        ),
    ],
)
def test_a_plant_that_cannot_be_is_told_where_it_is(
    server: TestClient, body: dict[str, Any], pointer: str, part: str
) -> None:
    faults = read_faults(server.post("/v1/datasets:simulate", json=body), 422, "invalid")
    assert pointer in {fault["pointer"] for fault in faults}, faults
    assert any(part in fault["detail"] for fault in faults), faults


def test_the_command_line_makes_a_tube_from_its_length(
    server: TestClient, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    client = Client("http://testserver", transport=Through(server))
    monkeypatch.setattr(common, "connect_client", lambda url, key: client)
    run = CliRunner().invoke
    file = tmp_path / "short.yaml"
    file.write_text("{samples: 100, parameters: {length_m: 10}}")
    words = ["simulate", str(file), "--plant", "tube", "--set", "length_m=30", "--name", "long"]
    done = run(dataset_commands.app, words)
    assert done.exit_code == 0, done.output
    assert "long: 100 samples" in done.output
    assert run(dataset_commands.app, ["simulate"]).exit_code == 1
    assert (
        run(dataset_commands.app, ["simulate", "--plant", "tube", "--set", "length_m"]).exit_code
        == 2
    )
