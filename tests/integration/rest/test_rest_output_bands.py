"""Bands of a run's outputs, and the order of its process: as documents, in figure and page."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from service.pages import figure_data
from service.runs import bands
from tests.support.service.local_runs import ServedRun, identify_job, serve_run
from tests.support.service.web_app import parts_of, read_faults, recording, store_csv

pytestmark = pytest.mark.slow
NAMES = [
    "95 % prediction band, lower end",
    "95 % prediction band",
    "95 % confidence band, lower end",
    "95 % confidence band",
]


@pytest.fixture(scope="module")
def served_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedRun]:
    with serve_run(tmp_path_factory.mktemp("bands"), validation={"fraction": 0.2}) as run:
        yield run


def read_bands(served_run: ServedRun) -> dict[str, Any]:
    answer = served_run.server.get(f"/v1/runs/{served_run.run}/bands")
    assert answer.status_code == 200, answer.text
    document: dict[str, Any] = answer.json()
    return document


def test_bands_surround_the_simulated_output_over_the_whole_record(served_run: ServedRun) -> None:
    document = read_bands(served_run)
    [experiment] = document["experiments"]
    [output] = experiment["outputs"]
    assert (document["id"], document["source"], output["name"]) == (
        served_run.run,
        "covariance",
        "y",
    )
    response = served_run.server.get(f"/v1/runs/{served_run.run}/response").json()["experiments"]
    times = [time for part in response for time in part["simulated"][0]["times"]]
    values = [value for part in response for value in part["simulated"][0]["values"]]
    assert output["times"] == times
    assert output["simulated"] == pytest.approx(values, abs=1e-9)
    simulated = np.array(output["simulated"])
    inner = np.array([output["confidence_lower"], output["confidence_upper"]]) - simulated
    outer = np.array([output["prediction_lower"], output["prediction_upper"]]) - simulated
    assert inner[0] == pytest.approx(-inner[1])
    result = served_run.server.get(f"/v1/runs/{served_run.run}").json()
    n, d = result["criteria"]["samples"], result["criteria"]["parameters"]
    noise = result["rms"] * np.sqrt(n / (n - d))
    assert outer[1] == pytest.approx(np.hypot(inner[1], 1.98 * noise), rel=0.02)


@pytest.mark.parametrize("most", [2, 3, 4, 10])
def test_fewer_points_are_read_on_request(served_run: ServedRun, most: int) -> None:
    path, query = f"/v1/runs/{served_run.run}/bands", {"max_points": most}
    [output] = served_run.server.get(path, params=query).json()["experiments"][0]["outputs"]
    assert 2 <= len(output["times"]) <= most < output["samples"]
    assert len(output["prediction_upper"]) == len(output["times"])


def test_the_figure_of_the_response_shows_the_bands_below_the_lines(served_run: ServedRun) -> None:
    figure = served_run.server.get(f"/v1/runs/{served_run.run}/figures/response").json()
    assert [trace["name"] for trace in figure["data"][:6]] == [*NAMES, "measured", "identified"]
    [output] = read_bands(served_run)["experiments"][0]["outputs"]
    assert figure["data"][3]["y"] == pytest.approx(output["confidence_upper"])
    assert [trace.get("fill") for trace in figure["data"][:4]] == [None, "tonexty"] * 2


def test_a_run_says_which_order_of_the_process_the_data_prefer(served_run: ServedRun) -> None:
    document = served_run.server.get(f"/v1/runs/{served_run.run}").json()
    compared = document["order_comparison"]
    assert (compared["model"], compared["preferred_model"], compared["delay"]) == (
        "fopdt",
        "fopdt",
        "L",
    )
    assert [fit["model"] for fit in compared["fits"]] == ["fopdt", "sopdt"]
    assert [fit["is_open"] for fit in compared["fits"]] == [True, False]
    assert compared["delay_range"] == [compared["fits"][0]["delay"]] * 2
    page = served_run.server.get(f"/runs/{served_run.run}").text
    is_doubted = any(one["severity"] != "note" for one in document["findings"])
    assert ('<table class="orders ' in page) is not is_doubted  # it would reassure beside a doubt


def test_a_sweep_compares_orders_on_request_only(served_run: ServedRun) -> None:
    sweep = {"axes": [{"path": "/noise/seed", "values": [1, 2]}]}
    for changes, is_compared in (({}, False), ({"compare_orders": True}, True)):
        _, runs = identify_job(
            parts_of(served_run.server), {**served_run.body, "sweep": sweep, **changes}
        )
        for run in runs:
            document = served_run.server.get(f"/v1/runs/{run}").json()
            assert (document["order_comparison"] is not None) == is_compared
    _, (run,) = identify_job(
        parts_of(served_run.server), {**served_run.body, "compare_orders": False}
    )
    assert served_run.server.get(f"/v1/runs/{run}").json()["order_comparison"] is None


def test_bands_that_cannot_be_computed_say_why_and_the_figure_does_without(
    served_run: ServedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bands, "MAX_WORK", 10)
    _, (run,) = identify_job(parts_of(served_run.server), {**served_run.body, "seed": 7})
    answer = served_run.server.get(f"/v1/runs/{run}/bands")
    read_faults(answer, 409, "conflict")
    [told] = re.findall(r"too much work. Steps × parameters is (\S+); need at most 10", answer.text)
    result = served_run.server.get(f"/v1/runs/{run}").json()
    samples, free = result["criteria"]["samples"], result["criteria"]["parameters"]
    assert result["substeps"] > 1  # each of which is simulated
    assert float(told) == pytest.approx(samples * result["substeps"] * free, rel=0.02)
    figure = served_run.server.get(f"/v1/runs/{run}/figures/response").json()
    assert [trace["name"] for trace in figure["data"][:2]] == ["measured", "identified"]
    read_faults(served_run.server.get("/v1/runs/run_none/bands"), 404, "not-found")
    computed: list[object] = []  # several runs over each other are drawn without bands
    monkeypatch.setattr(figure_data, "load_bands", lambda *given: computed.append(given))
    query = f"run={served_run.run}&run={run}"
    compared = served_run.server.get(f"/pages/compare/response?{query}").json()
    assert len([trace for trace in compared["data"] if trace.get("mode") == "lines"]) > 2
    assert computed == []


def test_records_count_by_their_noise_when_a_run_is_opened_again(served_run: ServedRun) -> None:
    """Else the estimate would not be the place of the largest likelihood."""
    header, *lines = recording(n=200).decode().splitlines()
    rows = np.array([line.split(",") for line in lines], dtype=np.float64)
    rows[:, 2] += np.random.default_rng(5).normal(0.0, 0.3, len(rows))
    noisy = "\n".join([header, *(",".join(f"{value:.6g}" for value in row) for row in rows)])
    datasets = [*served_run.body["datasets"], store_csv(served_run.server, noisy.encode())]
    kept = {name: served_run.body[name] for name in ("model", "algorithm", "hold")}
    body = {**kept, "datasets": datasets}
    _, (run,) = identify_job(parts_of(served_run.server), body)
    result = served_run.server.get(f"/v1/runs/{run}").json()
    (quiet,), (loud,) = result["noise_deviations"]
    assert loud > 20 * quiet
    asked = {"parameters": ["L"], "points": 9}
    [profile] = served_run.server.post(f"/v1/runs/{run}:profile", json=asked).json()["profiles"]
    assert min(profile["ratio"]) > -0.05
    document = served_run.server.get(f"/v1/runs/{run}/bands").json()
    [first], [second] = (experiment["outputs"] for experiment in document["experiments"])
    widths = [
        np.mean(np.subtract(one["prediction_upper"], one["prediction_lower"]))
        for one in (first, second)
    ]
    assert widths[1] > 20 * widths[0]
