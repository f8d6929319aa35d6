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

from service.api.requests.dependencies import Parts
from service.cli import common
from service.cli.run_commands import app as runs_app
from service.client.async_client import AsyncClient
from service.client.client import Client
from service.datasets import stored_recordings
from service.storage.objects import ObjectStore
from service.storage.storage_errors import ObjectMissing
from sysid.data.records import Recording
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import Through, await_in_thread, parts_of, read_faults, store_csv

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


class ResidualFits(NamedTuple):
    """An application with a job of two models on the same data, and one on other data."""

    server: TestClient
    parts: Parts
    dataset: str
    runs: list[str]
    other: str


def make_recording(seed: int) -> bytes:
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
def fits(server: TestClient) -> ResidualFits:
    data = [store_csv(server, make_recording(k), f"d{k}") for k in (1, 2)]
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
    _, runs = identify_job(parts, {**body, "sweep": models})
    _, other = identify_job(parts, {**body, "datasets": data[1:]})
    return ResidualFits(server, parts, data[0], runs, other[0])


def read_result(fits: ResidualFits, run: str) -> dict[str, Any]:
    document: dict[str, Any] = fits.server.get(f"/v1/runs/{run}").json()
    assert document["state"] == "succeeded", document["error"]
    return document


def assert_as_stored(fits: ResidualFits, run: str, data: str) -> None:
    """The functions of a run are those of the verdicts that were stored with it."""
    stored = read_result(fits, run)["residual_tests"]
    asked = fits.server.get(f"/v1/runs/{run}/residuals").json()
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
    fits: ResidualFits, number: int
) -> None:
    assert_as_stored(fits, fits.runs[number], "validation")


def test_under_a_noise_model_they_are_of_the_whitened_residuals(fits: ResidualFits) -> None:
    body = {
        "model": "fopdt",
        "datasets": [fits.dataset],
        "hold": {"u": "zero"},
        "algorithm": SMALL,
        "parameters": BOUNDS,
        "loss": {"noise_model": "ar1"},
    }
    _, (run,) = identify_job(fits.parts, body)
    assert read_result(fits, run)["correlation_times"]["y"] > STEP
    assert_as_stored(fits, run, "estimation")
    faults = read_faults(
        fits.server.post(f"/v1/runs/{run}:profile", json={"parameters": ["L"]}), 422, "invalid"
    )
    assert faults[0]["pointer"] == "/loss/noise_model"
    assert "plain squares" in faults[0]["detail"]
    refusals = [{"prediction": "one-step"}, {"loss": {"kind": "soft-l1", "noise_model": "ar1"}}]
    for change in refusals:
        (fault,) = read_faults(
            fits.server.post("/v1/jobs", json={**body, **change}), 422, "invalid"
        )
        assert fault["pointer"] == "/loss/noise_model"


def test_the_true_structure_passes_and_a_simpler_one_fails(fits: ResidualFits) -> None:
    fopdt, sopdt = (read_result(fits, run)["residual_tests"] for run in fits.runs)
    assert fopdt["passed"] is False
    assert sopdt["passed"] is True


def test_the_onset_delay_is_that_of_the_measurement_whatever_the_model(fits: ResidualFits) -> None:
    first, second = (read_result(fits, run)["onset_delays"] for run in fits.runs)
    assert first == second
    assert first[0]["output"] == "y"
    assert first[0]["unit"] == "s"
    assert 0.4 < first[0]["delay"] < 0.6  # behind the dead time two lags hesitate


def test_a_run_without_signals_has_no_residuals(fits: ResidualFits) -> None:
    body = {"model": "fopdt", "datasets": [fits.dataset]}
    job = fits.server.post("/v1/jobs", json=body).json()["id"]
    run = fits.server.get(f"/v1/jobs/{job}/runs").json()["items"][0]["id"]
    read_faults(fits.server.get(f"/v1/runs/{run}/residuals"), 404, "not-found")
    faults = read_faults(
        fits.server.post("/v1/runs:compare", json={"runs": [run, fits.runs[0]]}), 422, "invalid"
    )
    assert faults[0]["pointer"] == "/runs/0"
    assert "queued" in faults[0]["detail"]


def test_a_comparison_has_the_better_model_first_and_flags_what_depends_on_it(
    fits: ResidualFits,
) -> None:
    client = Client("http://testserver", transport=Through(fits.server))
    found = client.compare(*fits.runs)
    assert [one["model"] for one in found["runs"]] == ["sopdt", "fopdt"]
    better, worse = found["runs"]
    assert better["rms"] < worse["rms"]
    assert better["bic"] < worse["bic"]
    assert better["samples"] == worse["samples"] == 350
    assert better["residuals_passed"] is True
    lag = next(one for one in found["parameters"] if one["name"] == "L")
    assert lag["differs"]
    assert any(note.startswith("L depends on the model: ") for note in found["notes"])
    assert client.residuals(fits.runs[0])["id"] == fits.runs[0]


def test_runs_on_other_data_do_not_compare(fits: ResidualFits) -> None:
    answer = fits.server.post("/v1/runs:compare", json={"runs": [fits.runs[0], fits.other]})
    faults = read_faults(answer, 422, "invalid")
    assert faults[0]["pointer"] == "/runs/1"
    assert "other datasets" in faults[0]["detail"]


@pytest.mark.parametrize(
    ("runs", "expected"),
    [(["run_x", "run_y"], "run_x"), (["a"], "at least 2"), ([], "at least 2")],
)
def test_a_comparison_of_nothing_is_refused(
    fits: ResidualFits, runs: list[str], expected: str
) -> None:
    faults = read_faults(fits.server.post("/v1/runs:compare", json={"runs": runs}), 422, "invalid")
    assert expected in faults[0]["detail"]


def test_a_run_is_not_compared_with_itself(fits: ResidualFits) -> None:
    twice = [fits.runs[0], fits.runs[0]]
    faults = read_faults(fits.server.post("/v1/runs:compare", json={"runs": twice}), 422, "invalid")
    assert "named twice" in faults[0]["detail"]


def test_where_the_inputs_are_lost_whiteness_is_told_all_the_same(
    fits: ResidualFits, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(store: ObjectStore, sha256: str) -> Recording:
        raise ObjectMissing(sha256)

    monkeypatch.setattr(stored_recordings, "load_recording", lost)
    asked = fits.server.get(f"/v1/runs/{fits.runs[0]}/residuals").json()
    assert [one["test"] for one in asked["tests"]] == ["whiteness"]
    assert "cannot be read any more" in asked["note"]


def command(fits: ResidualFits, monkeypatch: pytest.MonkeyPatch, *words: str, ends: int = 0) -> str:
    """What a command under ``lagid runs`` prints."""
    client = Client("http://testserver", transport=Through(fits.server))
    monkeypatch.setattr(common, "connect_client", lambda url, key: nullcontext(client))
    done = CliRunner().invoke(runs_app, list(words))
    assert done.exit_code == ends, done.output
    return done.output


def test_the_command_line_tells_the_verdicts(
    fits: ResidualFits, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = command(fits, monkeypatch, "residuals", fits.runs[0])
    assert "residuals on validation data: failed" in text
    assert "independence" in text
    asked = json.loads(command(fits, monkeypatch, "residuals", fits.runs[1], "--json"))
    assert asked["passed"] is True


def test_the_command_line_compares_and_says_what_depends_on_the_model(
    fits: ResidualFits, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = command(fits, monkeypatch, "compare", *fits.runs)
    assert text.index("sopdt") < text.index("fopdt")
    assert "note: L depends on the model" in text


def test_the_command_line_says_what_of_its_own_words_does_not_compare(
    fits: ResidualFits, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = command(fits, monkeypatch, "compare", fits.runs[0], ends=1)
    assert alone.startswith("lagid: RUN: found")
    unknown = command(fits, monkeypatch, "compare", fits.runs[0], "run_x", ends=1)
    assert "--set" not in unknown


def test_the_asynchronous_client_asks_the_same(fits: ResidualFits) -> None:
    async def ask_asynchronously() -> tuple[dict[str, Any], dict[str, Any]]:
        transport = httpx.ASGITransport(fits.server.app)
        async with AsyncClient("http://testserver", transport=transport) as client:
            return await client.residuals(fits.runs[0]), await client.compare(*fits.runs)

    residuals, compared = await_in_thread(ask_asynchronously)
    assert residuals["id"] == fits.runs[0]
    assert len(compared["runs"]) == 2


def test_the_page_of_a_sweep_over_models_leads_to_their_comparison(fits: ResidualFits) -> None:
    page = fits.server.get(f"/runs/{fits.runs[0]}").text
    link = re.search(r'href="(/compare[^"]+)"', page)
    assert link is not None
    compared = fits.server.get(html.unescape(link[1]))
    assert compared.status_code == 200
    assert "L depends on the model" in compared.text
    alone = fits.server.get(f"/runs/{fits.other}").text
    assert "/compare" not in alone


def test_figures_of_residuals_have_a_function_for_each_test(fits: ResidualFits) -> None:
    figure = fits.server.get(f"/v1/runs/{fits.runs[0]}/figures/residuals").json()
    assert sum(one["type"] == "bar" for one in figure["data"]) == 2
    beyond = fits.server.get(f"/v1/runs/{fits.runs[0]}/figures/residuals?experiment=1")
    read_faults(beyond, 404, "not-found")


def test_the_report_holds_tests_and_figures(fits: ResidualFits) -> None:
    job = fits.server.get(f"/v1/runs/{fits.runs[0]}").json()["job"]
    text = fits.server.get(f"/v1/jobs/{job}/report").text
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
    fits: ResidualFits, changes: dict[str, Any]
) -> None:
    body = {
        "model": "fopdt",
        "datasets": ["d1"],
        "hold": {"u": "zero"},
        "algorithm": SMALL,
        "parameters": BOUNDS,
        "validation": {"fraction": 0.3},
    }
    _, runs = identify_job(fits.parts, {**body, **changes})
    stored = read_result(fits, runs[0])["residual_tests"]
    asked = fits.server.get(f"/v1/runs/{runs[0]}/residuals").json()
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


def test_figures_draw_an_input_as_the_job_holds_it(fits: ResidualFits) -> None:
    figure = fits.server.get(f"/v1/runs/{fits.runs[0]}/figures/response").json()
    assert input_shapes(figure) == {"hv"}


def test_a_report_draws_an_input_as_the_job_holds_it(fits: ResidualFits) -> None:
    job = fits.server.get(f"/v1/runs/{fits.other}").json()["job"]
    page = fits.server.get(f"/v1/jobs/{job}/report").text
    texts = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.DOTALL)
    figures = [json.loads(html.unescape(one)) for one in texts]
    shapes = [input_shapes(one) for one in figures if isinstance(one, dict) and "data" in one]
    assert {"hv"} in shapes
    assert {"linear"} not in shapes
