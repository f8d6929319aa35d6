"""The identified model of a run as JSON, Python, C and python-control: REST, clients, commands."""

import csv
import io
import json
import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import numpy as np
import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from service.cli import common
from service.cli.main import build_program
from service.client.async_client import AsyncClient
from service.client.calls import ProblemError
from service.client.client import Client
from tests.support.library.exported_programs import run_control, run_python
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import (
    Through,
    await_in_thread,
    parts_of,
    read_faults,
    recording,
    store_csv,
)

SMALL = {"population": 16, "generations": 20, "islands": 1}
POLYNOMIAL = {
    "name": "chosen",
    "form": "polynomial",
    "output": "y",
    "inputs": {"u": "1"},
    "degree": 2,
    "lags": {"y": [1], "u": [6]},
    "coefficients": {"lower": -1, "upper": 1},
    "terms": {"select": "frols", "keep": 3},
}
FORMATS = {
    "json": ("application/json", "fopdt.json"),
    "python": ("text/x-python; charset=utf-8", "fopdt_model.py"),
    "c": ("text/x-c; charset=utf-8", "fopdt.c"),
    "control": ("text/x-python; charset=utf-8", "fopdt_control.py"),
}


class ExportableRuns(NamedTuple):
    """An application with a finished run of a linear model, one of a polynomial, one that waits."""

    server: TestClient
    dataset: str
    run: str
    polynomial: str
    waiting: str


@pytest.fixture(scope="module")
def exports(server: TestClient) -> ExportableRuns:
    data = store_csv(server, recording(columns=("u [V]", "y [degC]")))
    parts = parts_of(server)
    body = {
        "model": "fopdt",
        "datasets": [data],
        "algorithm": SMALL,
        "hold": {"u": "zero"},
        "parameters": {"K": {"lower": 0, "upper": 5}, "L": {"upper": 2}, "x(0)": {"fixed": 0}},
    }
    _, (run,) = identify_job(parts, body)
    _, (polynomial,) = identify_job(parts, {**body, "model": POLYNOMIAL, "parameters": {}})
    waiting = server.post("/v1/jobs", json=body).json()["id"]
    (queued,) = server.get(f"/v1/jobs/{waiting}/runs").json()["items"]
    return ExportableRuns(server, data, run, polynomial, queued["id"])


def export(exports: ExportableRuns, run: str, **given: Any) -> httpx.Response:
    return exports.server.get(f"/v1/runs/{run}/export", params=given)


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_is_a_file_with_its_type_and_name(
    exports: ExportableRuns, format: str
) -> None:
    answer = export(exports, exports.run, format=format)
    assert answer.status_code == 200, answer.text
    media_type, name = FORMATS[format]
    assert answer.headers["content-type"] == media_type
    assert answer.headers["content-disposition"] == f'attachment; filename="{name}"'
    assert exports.run in answer.text


def test_the_document_tells_estimates_and_where_they_come_from(exports: ExportableRuns) -> None:
    document = export(exports, exports.run).json()
    result = exports.server.get(f"/v1/runs/{exports.run}").json()
    for told, known in zip(document["values"], result["parameters"], strict=True):
        assert told == {name: known[name] for name in told}
    correlation = result["correlation"]
    assert document["covariance"]["names"] == correlation["names"]
    errors = {one["name"]: one["stderr"] for one in result["parameters"]}
    deviations = np.array([errors[name] for name in correlation["names"]])
    expected = np.array(correlation["matrix"]) * np.outer(deviations, deviations)
    np.testing.assert_allclose(document["covariance"]["matrix"], expected)
    assert document["model"]["name"] == "fopdt"
    assert document["data"] == {
        "sample_time": pytest.approx(0.1),
        "hold": {"u": "zero"},
        "units": {"u": "V", "y": "degC"},
    }
    origin = document["provenance"]
    stored = exports.server.get(f"/v1/datasets/{exports.dataset}").json()
    assert origin["run"] == exports.run
    assert origin["job"] == result["job"]
    assert origin["datasets"] == [
        {"id": exports.dataset, "name": "steps", "sha256": stored["sha256"]}
    ]


@pytest.mark.parametrize("format", ["python", "c"])
def test_a_program_tells_the_units_of_the_recording_and_its_origin_in_words(
    exports: ExportableRuns, format: str
) -> None:
    text = export(exports, exports.run, format=format).text
    assert re.search(r"\bu, V\.$", text, re.M)
    assert re.search(r"\by, degC\.$", text, re.M)
    words = re.sub(r"\s(\* )?", " ", text)
    assert f"datasets: id {exports.dataset}, name steps, sha256 " in words
    assert '\\"' not in text


@pytest.mark.parametrize("which", ["run", "polynomial"])
def test_the_exported_program_gives_the_response_that_the_run_has(
    exports: ExportableRuns, which: str
) -> None:
    run = getattr(exports, which)
    text = export(exports, run, format="python").text
    answer = exports.server.get(f"/v1/runs/{run}/response").json()
    told = answer["experiments"][0]["simulated"][0]["values"]
    rows = np.loadtxt(recording().decode().splitlines(), delimiter=",", skiprows=1)
    start = {} if which == "run" else {"y_0": rows[0, 2]}
    (y,) = run_python(text, rows[:, 0], [rows[:, 1]], **start)
    # The run starts from the noisy samples of its first second, the program from the first alone.
    equal = slice(0 if which == "run" else 100, None)
    np.testing.assert_allclose(y[equal], told[equal], rtol=1e-6, atol=1e-6)


def test_a_linear_model_has_a_transfer_function_and_the_order_is_chosen(
    exports: ExportableRuns,
) -> None:
    script = run_control(export(exports, exports.run, format="control", pade_order=5).text)
    assert len(script["systems"]["u", "y"].denominator) == 2 + 5
    values = {one["name"]: one["value"] for one in export(exports, exports.run).json()["values"]}
    (gain,) = script["response"](script["pairs"]["u", "y"], [0.0])
    assert gain == pytest.approx(values["K"])


def test_what_cannot_be_exported_says_why(exports: ExportableRuns) -> None:
    read_faults(export(exports, "run_0"), 404, "not-found")
    read_faults(export(exports, exports.waiting), 409, "conflict")
    read_faults(export(exports, exports.run, format="pascal"), 422, "invalid")
    read_faults(export(exports, exports.run, format="control", pade_order=0), 422, "invalid")
    (fault,) = read_faults(export(exports, exports.polynomial, format="control"), 422, "invalid")
    assert fault["pointer"] == "?format"
    assert "not linear" in fault["detail"]


def test_both_clients_give_the_text_that_rest_gives(exports: ExportableRuns) -> None:
    client = Client("http://testserver", transport=Through(exports.server))
    assert json.loads(client.export(exports.run)) == export(exports, exports.run).json()
    told = export(exports, exports.run, format="c").text
    assert client.export(exports.run, "c") == told
    with pytest.raises(ProblemError, match="not linear"):
        client.export(exports.polynomial, "control")

    async def work() -> str:
        transport = httpx.ASGITransport(exports.server.app)  # type: ignore[arg-type]
        async with AsyncClient("http://testserver", transport=transport) as opened:
            return await opened.export(exports.run, "c")

    assert await_in_thread(work) == told


def test_the_command_writes_a_file_or_to_stdout(
    exports: ExportableRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Client("http://testserver", transport=Through(exports.server))
    monkeypatch.setattr(common, "connect_client", lambda *_: nullcontext(client))
    told = export(exports, exports.run, format="python").text
    run = CliRunner().invoke
    shown = run(build_program(), ["export", exports.run, "--format", "python"])
    assert (shown.exit_code, shown.stdout) == (0, told)
    file = tmp_path / "model.py"
    done = run(
        build_program(), ["export", exports.run, "--format", "python", "--output", str(file)]
    )
    assert done.exit_code == 0, done.output
    assert file.read_text(encoding="utf-8") == told
    failed = run(
        build_program(), ["export", exports.run, "--output", str(tmp_path / "no" / "file")]
    )
    assert failed.exit_code == 2
    assert run(build_program(), ["export", exports.run, "--format", "pascal"]).exit_code == 2


def test_the_page_of_a_finished_run_links_to_every_format(exports: ExportableRuns) -> None:
    job = exports.server.get(f"/v1/runs/{exports.run}").json()["job"]
    page = exports.server.get(f"/jobs/{job}").text
    for format in FORMATS:
        assert f"/v1/runs/{exports.run}/export?format={format}" in page


def test_estimates_are_a_table_that_spreadsheets_read(exports: ExportableRuns) -> None:
    answer = exports.server.get(f"/v1/runs/{exports.run}/estimates.csv")
    assert answer.headers["content-type"] == "text/csv; charset=utf-8"
    rows = {row["parameter"]: row for row in csv.DictReader(io.StringIO(answer.text))}
    for one in exports.server.get(f"/v1/runs/{exports.run}").json()["parameters"]:
        row = rows.pop(one["name"])
        assert (float(row["value"]), row["unit"]) == (one["value"], one["unit"])
        assert (row["status"], float(row["upper_bound"])) == (one["status"], one["upper"])
        shown = one["stderr"] is not None and one["status"] != "at bound"
        assert row["stderr"] == (str(one["stderr"]) if shown else "")
        ends = one["interval95"] if shown else ["", ""]
        assert [row["interval95_low"], row["interval95_high"]] == list(map(str, ends))
    assert not rows
    assert f"{exports.run}/estimates.csv" in exports.server.get(f"/runs/{exports.run}").text
    waiting = exports.server.get(f"/v1/runs/{exports.waiting}/estimates.csv")
    assert waiting.status_code == 409
