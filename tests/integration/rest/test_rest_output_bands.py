"""Bands of a run's outputs, and the order of its process: as documents, in figure and page."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from service.pages import figure_data
from service.runs import bands
from tests.identified import ServedRun, identified, serve_run
from tests.rest import parts_of, recording, refused, store_csv

pytestmark = pytest.mark.slow
NAMES = [
    "95 % prediction band, lower end",
    "95 % prediction band",
    "95 % confidence band, lower end",
    "95 % confidence band",
]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedRun]:
    with serve_run(tmp_path_factory.mktemp("bands"), validation={"fraction": 0.2}) as run:
        yield run


def read_bands(served: ServedRun) -> dict[str, Any]:
    answer = served.server.get(f"/v1/runs/{served.run}/bands")
    assert answer.status_code == 200, answer.text
    document: dict[str, Any] = answer.json()
    return document


def test_bands_surround_the_simulated_output_over_the_whole_record(served: ServedRun) -> None:
    document = read_bands(served)
    [experiment] = document["experiments"]
    [output] = experiment["outputs"]
    assert (document["id"], document["source"], output["name"]) == (served.run, "covariance", "y")
    response = served.server.get(f"/v1/runs/{served.run}/response").json()["experiments"]
    times = [time for part in response for time in part["simulated"][0]["times"]]
    values = [value for part in response for value in part["simulated"][0]["values"]]
    assert output["times"] == times
    assert output["simulated"] == pytest.approx(values, abs=1e-9)
    simulated = np.array(output["simulated"])
    inner = np.array([output["confidence_lower"], output["confidence_upper"]]) - simulated
    outer = np.array([output["prediction_lower"], output["prediction_upper"]]) - simulated
    assert inner[0] == pytest.approx(-inner[1])
    result = served.server.get(f"/v1/runs/{served.run}").json()
    n, d = result["criteria"]["samples"], result["criteria"]["parameters"]
    noise = result["rms"] * np.sqrt(n / (n - d))
    assert outer[1] == pytest.approx(np.hypot(inner[1], 1.98 * noise), rel=0.02)


@pytest.mark.parametrize("most", [2, 3, 4, 10])
def test_fewer_points_are_read_on_request(served: ServedRun, most: int) -> None:
    path, query = f"/v1/runs/{served.run}/bands", {"max_points": most}
    [output] = served.server.get(path, params=query).json()["experiments"][0]["outputs"]
    assert 2 <= len(output["times"]) <= most < output["samples"]
    assert len(output["prediction_upper"]) == len(output["times"])


def test_the_figure_of_the_response_shows_the_bands_below_the_lines(served: ServedRun) -> None:
    figure = served.server.get(f"/v1/runs/{served.run}/figures/response").json()
    assert [trace["name"] for trace in figure["data"][:6]] == [*NAMES, "measured", "identified"]
    [output] = read_bands(served)["experiments"][0]["outputs"]
    assert figure["data"][3]["y"] == pytest.approx(output["confidence_upper"])
    assert [trace.get("fill") for trace in figure["data"][:4]] == [None, "tonexty"] * 2


def test_a_run_says_which_order_of_the_process_the_data_prefer(served: ServedRun) -> None:
    compared = served.server.get(f"/v1/runs/{served.run}").json()["order_comparison"]
    assert (compared["model"], compared["preferred_model"], compared["delay"]) == (
        "fopdt",
        "fopdt",
        "L",
    )
    assert [fit["model"] for fit in compared["fits"]] == ["fopdt", "sopdt"]
    assert [fit["is_open"] for fit in compared["fits"]] == [True, False]
    assert compared["delay_range"] == [compared["fits"][0]["delay"]] * 2
    page = served.server.get(f"/runs/{served.run}").text
    assert '<table class="orders ' in page
    assert "strong evidence against" in page
    lowest, other = sorted(fit["bic"] for fit in compared["fits"])
    assert f'data-label="BIC − lowest BIC">{other - lowest:.1f}</td>' in page


def test_a_sweep_compares_orders_on_request_only(served: ServedRun) -> None:
    sweep = {"axes": [{"path": "/noise/seed", "values": [1, 2]}]}
    for changes, is_compared in (({}, False), ({"compare_orders": True}, True)):
        _, runs = identified(parts_of(served.server), {**served.body, "sweep": sweep, **changes})
        for run in runs:
            document = served.server.get(f"/v1/runs/{run}").json()
            assert (document["order_comparison"] is not None) == is_compared
    _, (run,) = identified(parts_of(served.server), {**served.body, "compare_orders": False})
    assert served.server.get(f"/v1/runs/{run}").json()["order_comparison"] is None


def test_bands_that_cannot_be_computed_say_why_and_the_figure_does_without(
    served: ServedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bands, "MAX_WORK", 10)
    _, (run,) = identified(parts_of(served.server), {**served.body, "seed": 7})
    answer = served.server.get(f"/v1/runs/{run}/bands")
    refused(answer, 409, "conflict")
    [told] = re.findall(r"too much work. Steps × parameters is (\S+); need at most 10", answer.text)
    result = served.server.get(f"/v1/runs/{run}").json()
    samples, free = result["criteria"]["samples"], result["criteria"]["parameters"]
    assert result["substeps"] > 1  # each of which is simulated
    assert float(told) == pytest.approx(samples * result["substeps"] * free, rel=0.02)
    figure = served.server.get(f"/v1/runs/{run}/figures/response").json()
    assert [trace["name"] for trace in figure["data"][:2]] == ["measured", "identified"]
    refused(served.server.get("/v1/runs/run_none/bands"), 404, "not-found")
    computed: list[object] = []  # several runs over each other are drawn without bands
    monkeypatch.setattr(figure_data, "load_bands", lambda *given: computed.append(given))
    query = f"run={served.run}&run={run}"
    compared = served.server.get(f"/pages/compare/response?{query}").json()
    assert len([trace for trace in compared["data"] if trace.get("mode") == "lines"]) > 2
    assert computed == []


def test_records_count_by_their_noise_when_a_run_is_opened_again(served: ServedRun) -> None:
    """Else the estimate would not be the place of the largest likelihood."""
    header, *lines = recording(n=200).decode().splitlines()
    rows = np.array([line.split(",") for line in lines], dtype=np.float64)
    rows[:, 2] += np.random.default_rng(5).normal(0.0, 0.3, len(rows))
    noisy = "\n".join([header, *(",".join(f"{value:.6g}" for value in row) for row in rows)])
    datasets = [*served.body["datasets"], store_csv(served.server, noisy.encode())]
    kept = {name: served.body[name] for name in ("model", "algorithm", "hold")}
    body = {**kept, "datasets": datasets}
    _, (run,) = identified(parts_of(served.server), body)
    result = served.server.get(f"/v1/runs/{run}").json()
    (quiet,), (loud,) = result["noise_deviations"]
    assert loud > 20 * quiet
    asked = {"parameters": ["L"], "points": 9}
    [profile] = served.server.post(f"/v1/runs/{run}:profile", json=asked).json()["profiles"]
    assert min(profile["ratio"]) > -0.05
    document = served.server.get(f"/v1/runs/{run}/bands").json()
    [first], [second] = (experiment["outputs"] for experiment in document["experiments"])
    widths = [
        np.mean(np.subtract(one["prediction_upper"], one["prediction_lower"]))
        for one in (first, second)
    ]
    assert widths[1] > 20 * widths[0]
