"""Estimated disturbances of a run with a load: as a document, in figure, page and report."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from service.core.computed import ComputedValues
from service.runs import disturbances
from tests.support.library.exported_programs import observe_python
from tests.support.service.local_runs import ServedRun, identify_job, serve_run
from tests.support.service.web_app import parts_of, read_faults, store_csv

pytestmark = pytest.mark.slow
PERIOD, SAMPLES = 0.25, 600


def make_load() -> np.ndarray:
    random, load = np.random.default_rng(5), np.zeros(SAMPLES)
    for k in range(1, SAMPLES):
        load[k] = 0.99 * load[k - 1] + 0.02 * random.normal()
    return load


def write_recording() -> bytes:
    """CSV of a first-order plant with the load at its input."""
    random, load = np.random.default_rng(6), make_load()
    u = np.repeat(random.integers(0, 2, SAMPLES // 40), 40) * 1.0
    x, rows = 0.0, ["t [s],u [%],y [K]"]
    for k in range(SAMPLES):
        rows.append(f"{PERIOD * k:.2f},{u[k]:g},{x + 0.02 * random.normal():.6f}")
        x = 0.95 * x + 0.1 * (u[max(k - 8, 0)] + load[k])
    return ("\n".join(rows) + "\n").encode()


@pytest.fixture(scope="module")
def served_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedRun]:
    with serve_run(tmp_path_factory.mktemp("disturbances"), seed=1) as white:
        body = {
            **white.body,
            "datasets": [store_csv(white.server, write_recording(), "loaded")],
            "noise": {"sigma": 0.0},
            "loss": {"noise_model": "load"},
            "parameters": {"y0": {"fixed": 0.0}},
            "validation": {"fraction": 0.2},
        }
        job, (run,) = identify_job(parts_of(white.server), body)
        yield ServedRun(white.server, {**body, "white": white.run}, job, run)


def read_load(served_run: ServedRun, **query: Any) -> dict[str, Any]:
    path = f"/v1/runs/{served_run.run}/disturbances"
    answer = served_run.server.get(path, params=query)
    assert answer.status_code == 200, answer.text
    [experiment] = answer.json()["experiments"]
    [load] = experiment["disturbances"]
    return dict(load)


def test_the_load_is_estimated_over_the_whole_record(served_run: ServedRun) -> None:
    load, true = read_load(served_run), make_load()
    assert (load["place"], load["kind"], load["unit"], load["samples"]) == (
        "u",
        "load",
        "%",
        SAMPLES,
    )
    assert load["times"] == pytest.approx(PERIOD * np.arange(SAMPLES))
    assert np.corrcoef(load["values"], true)[0, 1] > 0.9
    inside = (np.array(load["lower"]) <= true) & (true <= np.array(load["upper"]))
    assert np.mean(inside) > 0.8
    assert 2 <= len(read_load(served_run, max_points=10)["times"]) <= 10


def test_page_figure_and_report_show_it(served_run: ServedRun) -> None:
    server, run = served_run.server, served_run.run
    figure = server.get(f"/v1/runs/{run}/figures/disturbances").json()
    assert [trace["name"] for trace in figure["data"]] == [
        "95 % band, lower end",
        "95 % band",
        "estimate",
    ]
    assert figure["layout"]["yaxis"]["title"]["text"] == "load at u [%]"
    page = server.get(f"/runs/{run}").text
    assert 'data-figure="disturbances"' in page
    assert f"height: {figure['layout']['height']}px" in page
    for text in (page, server.get(f"/v1/jobs/{served_run.job}/report").text):
        assert "Noise inside the plant" in text
        assert '<tr><th scope="row">slow load</th><td data-label="place">u</td>' in text
    assert "Estimated disturbances" in server.get(f"/v1/jobs/{served_run.job}/report").text
    read_faults(server.get(f"/v1/runs/{run}/figures/disturbances?experiment=1"), 404, "not-found")


def test_errors_of_predictions_lie_between_one_sample_and_the_free_run(
    served_run: ServedRun,
) -> None:
    server, run = served_run.server, served_run.run
    noise = server.get(f"/v1/runs/{run}").json()["plant_noise"]
    errors = noise["prediction_errors"]
    assert [one["samples"] for one in errors] == [1, 2, 5, 10, 20]
    assert [one["time"] for one in errors] == pytest.approx([0.25, 0.5, 1.25, 2.5, 5.0])
    assert errors[0]["rms"] < errors[-1]["rms"] < noise["rms_free"]
    page = server.get(f"/runs/{run}").text
    assert '<tr><th scope="row">20 samples ahead</th>' in page
    assert '<tr><th scope="row">free run</th>' in page


def test_the_exported_observer_predicts_what_the_run_does(served_run: ServedRun) -> None:
    server, run = served_run.server, served_run.run
    text = server.get(f"/v1/runs/{run}/export", params={"format": "python"}).text
    table = np.genfromtxt(write_recording().decode().splitlines(), delimiter=",", skip_header=1)
    (predicted,) = observe_python(text, [table[:, 1]], [table[:, 2]])
    response = server.get(f"/v1/runs/{run}/response").json()["experiments"]
    shown = [value for part in response for value in part["simulated"][0]["values"]]
    # Validation data begin anew, from what was estimated for them.
    np.testing.assert_allclose(predicted[:480], shown[:480], rtol=1e-9, atol=1e-9)
    values = server.get(f"/v1/runs/{run}/export").json()["values"]
    assert [one["name"] for one in values][:4] == ["K", "T", "L", "y0"]
    assert not any("[" in one["name"] for one in values)


def test_a_run_without_a_load_has_none(
    served_run: ServedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, white = served_run.server, served_run.body["white"]
    assert server.get(f"/v1/runs/{white}/disturbances").json() == {"id": white, "experiments": []}
    assert server.get(f"/v1/runs/{white}/figures/disturbances").json()["data"] == []
    assert 'data-figure="disturbances"' not in server.get(f"/runs/{white}").text
    read_faults(server.get("/v1/runs/run_none/disturbances"), 404, "not-found")
    monkeypatch.setattr(disturbances, "MAX_VALUES", 10)
    monkeypatch.setattr(disturbances, "_computed_disturbances", ComputedValues(1))
    answer = server.get(f"/v1/runs/{served_run.run}/disturbances")
    read_faults(answer, 409, "conflict")
    assert "need at most 10. Use `compute_disturbances`" in answer.text
