"""Residual tests, onset delays and comparisons of runs that were identified, over REST."""

import html
import json
import re
from contextlib import nullcontext
from typing import Any, NamedTuple

import httpx
import numpy as np
import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from service.api.dependencies import Parts
from service.cli import common
from service.cli.runs import app as runs_app
from service.client.async_client import AsyncClient
from service.client.client import Client
from service.datasets import recordings
from service.storage.errors import ObjectMissing
from service.storage.objects import ObjectStore
from sysid.data.records import Recording
from tests.identified import identified
from tests.integration.rest.test_client import Through
from tests.rest import awaited, parts_of, refused, store_csv

N, STEP, NOISE = 500, 0.05, 0.02
SMALL = {"population": 20, "generations": 40, "islands": 1}
BOUNDS = {"K": {"lower": 0, "upper": 5}, "L": {"upper": 2}}


TWO_OUTPUTS = {
    "name": "both",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {
        "K": {"lower": 0, "upper": 5},
        "T": {"lower": 0.05, "upper": 5, "unit": "s"},
        "L": {"lower": 0, "upper": 2, "unit": "s"},
        "b": {"lower": -1, "upper": 1},
    },
    "equations": {"x": "(K*u(t - L) - x)/T"},
    "outputs": {"y": "x", "z": "x + b"},
    "initial": {"x": 0},
}


class Served(NamedTuple):
    """An application with a job of two models on the same data, and one on other data."""

    server: TestClient
    parts: Parts
    dataset: str
    runs: list[str]
    other: str


def recording(seed: int) -> bytes:
    """CSV of two equal lags behind a dead time of 0.4 s, with white noise."""
    draw = np.random.default_rng(seed)
    u = np.repeat(draw.choice([0.0, 1.0], N // 50), 50)
    u[:50], u[50:100] = 0.0, 1.0
    x, y = 0.0, np.zeros(N)
    for k in range(1, N):
        delayed = u[k - 9] if k >= 9 else 0.0
        before = y[k - 1]
        y[k] = before + STEP * (x - before) / 0.3
        x += STEP * (2 * delayed - x) / 0.3
    y += draw.normal(0, NOISE, N)
    rows = ["t,u,y", *(f"{k * STEP:.6g},{a:.6g},{b:.6g}" for k, (a, b) in enumerate(zip(u, y)))]  # noqa: B905
    return "\n".join(rows).encode()


@pytest.fixture(scope="module")
def served(server: TestClient) -> Served:
    data = [store_csv(server, recording(k), f"d{k}") for k in (1, 2)]
    parts = parts_of(server)
    body = {
        "model": "fopdt",
        "datasets": data[:1],
        "hold": {"u": "zero"},
        "algorithm": SMALL,
        "parameters": BOUNDS,
        "validation": {"fraction": 0.3},
    }
    models = {"axes": [{"path": "/model", "values": ["fopdt", "sopdt"]}]}
    _, runs = identified(parts, {**body, "sweep": models})
    _, other = identified(parts, {**body, "datasets": data[1:]})
    return Served(server, parts, data[0], runs, other[0])


def result(served: Served, run: str) -> dict[str, Any]:
    document: dict[str, Any] = served.server.get(f"/v1/runs/{run}").json()
    assert document["state"] == "succeeded", document["error"]
    return document


def assert_as_stored(served: Served, run: str, data: str) -> None:
    """The functions of a run are those of the verdicts that were stored with it."""
    stored = result(served, run)["residual_tests"]
    asked = served.server.get(f"/v1/runs/{run}/residuals").json()
    assert asked["passed"] == stored["passed"]
    assert asked["data"] == stored["data"] == data
    assert asked["note"] == ""
    for one, kept in zip(asked["tests"], stored["tests"], strict=True):
        for name, value in kept.items():
            # The two processes may add up in another order: the last bits differ.
            close = isinstance(value, float)
            assert one[name] == (pytest.approx(value, rel=1e-6, abs=1e-9) if close else value)
        assert len(one["lags"]) == len(one["values"]) == len(one["band99"])


@pytest.mark.parametrize("number", [0, 1])
def test_functions_that_are_asked_for_have_the_verdicts_that_were_stored(
    served: Served, number: int
) -> None:
    assert_as_stored(served, served.runs[number], "validation")


def test_under_a_noise_model_they_are_of_the_whitened_residuals(served: Served) -> None:
    body = {
        "model": "fopdt",
        "datasets": [served.dataset],
        "hold": {"u": "zero"},
        "algorithm": SMALL,
        "parameters": BOUNDS,
        "loss": {"noise_model": "ar1"},
    }
    _, (run,) = identified(served.parts, body)
    assert result(served, run)["correlation_times"]["y"] > STEP
    assert_as_stored(served, run, "estimation")
    faults = refused(
        served.server.post(f"/v1/runs/{run}:profile", json={"parameters": ["L"]}), 422, "invalid"
    )
    assert faults[0]["pointer"] == "/loss/noise_model"
    assert "plain squares" in faults[0]["detail"]
    refusals = [{"prediction": "one-step"}, {"loss": {"kind": "soft-l1", "noise_model": "ar1"}}]
    for change in refusals:
        (fault,) = refused(served.server.post("/v1/jobs", json={**body, **change}), 422, "invalid")
        assert fault["pointer"] == "/loss/noise_model"


def test_the_true_structure_passes_and_a_simpler_one_fails(served: Served) -> None:
    fopdt, sopdt = (result(served, run)["residual_tests"] for run in served.runs)
    assert fopdt["passed"] is False
    assert sopdt["passed"] is True


def test_the_onset_delay_is_that_of_the_measurement_whatever_the_model(served: Served) -> None:
    first, second = (result(served, run)["onset_delays"] for run in served.runs)
    assert first == second
    assert first[0]["output"] == "y"
    assert first[0]["unit"] == "s"
    assert 0.4 < first[0]["delay"] < 0.6  # behind the dead time two lags hesitate


def test_a_run_without_signals_has_no_residuals(served: Served) -> None:
    body = {"model": "fopdt", "datasets": [served.dataset]}
    job = served.server.post("/v1/jobs", json=body).json()["id"]
    run = served.server.get(f"/v1/jobs/{job}/runs").json()["items"][0]["id"]
    refused(served.server.get(f"/v1/runs/{run}/residuals"), 404, "not-found")
    faults = refused(
        served.server.post("/v1/runs:compare", json={"runs": [run, served.runs[0]]}), 422, "invalid"
    )
    assert faults[0]["pointer"] == "/runs/0"
    assert "queued" in faults[0]["detail"]


def test_a_comparison_has_the_better_model_first_and_flags_what_depends_on_it(
    served: Served,
) -> None:
    client = Client("http://testserver", transport=Through(served.server))
    found = client.compare(*served.runs)
    assert [one["model"] for one in found["runs"]] == ["sopdt", "fopdt"]
    better, worse = found["runs"]
    assert better["rms"] < worse["rms"]
    assert better["bic"] < worse["bic"]
    assert better["samples"] == worse["samples"] == 350
    assert better["residuals_passed"] is True
    lag = next(one for one in found["parameters"] if one["name"] == "L")
    assert lag["differs"]
    assert any(note.startswith("L depends on the model: ") for note in found["notes"])
    assert client.residuals(served.runs[0])["id"] == served.runs[0]


def test_runs_on_other_data_do_not_compare(served: Served) -> None:
    answer = served.server.post("/v1/runs:compare", json={"runs": [served.runs[0], served.other]})
    faults = refused(answer, 422, "invalid")
    assert faults[0]["pointer"] == "/runs/1"
    assert "other datasets" in faults[0]["detail"]


@pytest.mark.parametrize(
    ("runs", "expected"),
    [(["run_x", "run_y"], "run_x"), (["a"], "at least 2"), ([], "at least 2")],
)
def test_a_comparison_of_nothing_is_refused(served: Served, runs: list[str], expected: str) -> None:
    faults = refused(served.server.post("/v1/runs:compare", json={"runs": runs}), 422, "invalid")
    assert expected in faults[0]["detail"]


def test_a_run_is_not_compared_with_itself(served: Served) -> None:
    twice = [served.runs[0], served.runs[0]]
    faults = refused(served.server.post("/v1/runs:compare", json={"runs": twice}), 422, "invalid")
    assert "named twice" in faults[0]["detail"]


def test_where_the_inputs_are_lost_whiteness_is_told_all_the_same(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(store: ObjectStore, sha256: str) -> Recording:
        raise ObjectMissing(sha256)

    monkeypatch.setattr(recordings, "load_recording", lost)
    asked = served.server.get(f"/v1/runs/{served.runs[0]}/residuals").json()
    assert [one["test"] for one in asked["tests"]] == ["whiteness"]
    assert "cannot be read any more" in asked["note"]


def command(served: Served, monkeypatch: pytest.MonkeyPatch, *words: str, ends: int = 0) -> str:
    """What a command under ``lagid runs`` prints."""
    client = Client("http://testserver", transport=Through(served.server))
    monkeypatch.setattr(common, "connect_client", lambda url, key: nullcontext(client))
    done = CliRunner().invoke(runs_app, list(words))
    assert done.exit_code == ends, done.output
    return done.output


def test_the_command_line_tells_the_verdicts(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = command(served, monkeypatch, "residuals", served.runs[0])
    assert "residuals on validation data: failed" in text
    assert "independence" in text
    asked = json.loads(command(served, monkeypatch, "residuals", served.runs[1], "--json"))
    assert asked["passed"] is True


def test_the_command_line_compares_and_says_what_depends_on_the_model(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = command(served, monkeypatch, "compare", *served.runs)
    assert text.index("sopdt") < text.index("fopdt")
    assert "note: L depends on the model" in text


def test_the_command_line_says_what_of_its_own_words_does_not_compare(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = command(served, monkeypatch, "compare", served.runs[0], ends=1)
    assert alone.startswith("lagid: RUN: found")
    unknown = command(served, monkeypatch, "compare", served.runs[0], "run_x", ends=1)
    assert "--set" not in unknown


def test_the_asynchronous_client_asks_the_same(served: Served) -> None:
    async def asked() -> tuple[dict[str, Any], dict[str, Any]]:
        transport = httpx.ASGITransport(served.server.app)
        async with AsyncClient("http://testserver", transport=transport) as client:
            return await client.residuals(served.runs[0]), await client.compare(*served.runs)

    residuals, compared = awaited(asked)
    assert residuals["id"] == served.runs[0]
    assert len(compared["runs"]) == 2


def test_the_page_of_a_sweep_over_models_leads_to_their_comparison(served: Served) -> None:
    page = served.server.get(f"/runs/{served.runs[0]}").text
    link = re.search(r'href="(/compare[^"]+)"', page)
    assert link is not None
    compared = served.server.get(html.unescape(link[1]))
    assert compared.status_code == 200
    assert "L depends on the model" in compared.text
    alone = served.server.get(f"/runs/{served.other}").text
    assert "/compare" not in alone


def test_figures_of_residuals_have_a_function_for_each_test(served: Served) -> None:
    figure = served.server.get(f"/v1/runs/{served.runs[0]}/figures/residuals").json()
    assert sum(one["type"] == "bar" for one in figure["data"]) == 2
    beyond = served.server.get(f"/v1/runs/{served.runs[0]}/figures/residuals?experiment=1")
    refused(beyond, 404, "not-found")


def test_the_report_holds_tests_and_figures(served: Served) -> None:
    job = served.server.get(f"/v1/runs/{served.runs[0]}").json()["job"]
    text = served.server.get(f"/v1/jobs/{job}/report").text
    assert "Correlation of the residuals: validation 1" in text
    assert "Onset delay, y behind u" in text
    assert "A dead time should not be longer." in text
    assert text.index("<dt>BIC</dt>") < text.index("<dt>Onset delay")
    assert re.search(r"<dt>BIC</dt><dd>−?\d+\.\d</dd>", text)


@pytest.mark.parametrize(
    "changes",
    [
        {"loss": {"kind": "soft-l1", "scale": 0.02}, "skip": 30, "validation": None},
        {"loss": {"kind": "soft-l1", "scale": 0.05}, "skip": 7, "validation": {"fraction": 0.4}},
        {"noise": {"sigma": 0.1, "seed": 4}, "validation": {"datasets": ["d2"]}, "skip": 11},
        {"datasets": ["d1", "d2"], "validation": None},
        {"datasets": ["d1", "d2"], "validation": {"fraction": 0.25}, "prediction": "one-step"},
        {"datasets": ["d1", "d2"], "validation": None, "prediction": "one-step", "skip": 9},
        {
            "model": TWO_OUTPUTS,
            "channels": {"z": "y"},
            "weights": {"y": 2.0},
            "skip": 3,
            "loss": {"kind": "soft-l1", "scale": 0.1},
            "parameters": {},
        },
    ],
    ids=[
        "robust",
        "robust part",
        "noise, other data",
        "two records",
        "two parts",
        "one step ahead",
        "two outputs",
    ],
)
def test_what_is_computed_again_is_what_was_stored_whatever_the_job(
    served: Served, changes: dict[str, Any]
) -> None:
    body = {
        "model": "fopdt",
        "datasets": ["d1"],
        "hold": {"u": "zero"},
        "algorithm": SMALL,
        "parameters": BOUNDS,
        "validation": {"fraction": 0.3},
    }
    _, runs = identified(served.parts, {**body, **changes})
    stored = result(served, runs[0])["residual_tests"]
    asked = served.server.get(f"/v1/runs/{runs[0]}/residuals").json()
    assert asked["data"] == stored["data"]
    assert len(asked["tests"]) == len(stored["tests"]) >= 2
    for one, kept in zip(asked["tests"], stored["tests"], strict=True):
        assert one["outcome"] == kept["outcome"] != "not tested"
        assert one["samples"] == kept["samples"]
        assert one["statistic"] == pytest.approx(kept["statistic"], rel=1e-6)
        assert one["degrees"] == pytest.approx(kept["degrees"], rel=1e-6)


def input_shapes(figure: dict[str, Any]) -> set[str]:
    inputs = (one for one in figure["data"] if one.get("name") == "u")
    return {one["line"].get("shape", "linear") for one in inputs}


def test_figures_draw_an_input_as_the_job_holds_it(served: Served) -> None:
    figure = served.server.get(f"/v1/runs/{served.runs[0]}/figures/response").json()
    assert input_shapes(figure) == {"hv"}


def test_a_report_draws_an_input_as_the_job_holds_it(served: Served) -> None:
    job = served.server.get(f"/v1/runs/{served.other}").json()["job"]
    page = served.server.get(f"/v1/jobs/{job}/report").text
    texts = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.DOTALL)
    figures = [json.loads(html.unescape(one)) for one in texts]
    shapes = [input_shapes(one) for one in figures if isinstance(one, dict) and "data" in one]
    assert {"hv"} in shapes
    assert {"linear"} not in shapes
