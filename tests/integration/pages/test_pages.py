"""Pages, figures and files over HTTP, without a browser."""

import gzip
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from service.api.app import create_app
from service.datasets.datasets import add_recording
from service.pages import render
from service.storage.tables import Job
from sysid.data.records import Channel, Recording
from tests.support.service.filled_folder import FilledFolder
from tests.support.service.web_app import parts_of, settings_of


@pytest.fixture(scope="module")
def client(folder: Path, filled_folder: FilledFolder) -> Iterator[TestClient]:
    with TestClient(create_app(settings_of(folder))) as opened:
        yield opened


def test_an_empty_service_has_a_page_that_says_how_to_begin(tmp_path: Path) -> None:
    with TestClient(create_app(settings_of(tmp_path))) as client:
        answer = client.get("/")
    assert answer.status_code == 200
    assert "No identification yet" in answer.text


def test_pages_run_no_script_but_those_of_the_service(client: TestClient) -> None:
    policy = client.get("/").headers["content-security-policy"]
    assert "script-src 'self';" in policy
    assert "default-src 'none'" in policy


def test_no_page_names_another_host(client: TestClient, filled_folder: FilledFolder) -> None:
    for path in ("/", f"/jobs/{filled_folder.finished}", f"/datasets/{filled_folder.dataset}"):
        text = client.get(path).text
        assert 'src="http' not in text
        assert 'href="http' not in text


def test_what_a_user_writes_is_escaped(client: TestClient, filled_folder: FilledFolder) -> None:
    for path in ("/", f"/jobs/{filled_folder.running}", f"/v1/jobs/{filled_folder.running}/report"):
        text = client.get(path).text
        assert "tube 80 m &lt;b&gt;live&lt;/b&gt;" in text
        assert "<b>live" not in text


@pytest.mark.parametrize(
    "path",
    [
        "/jobs/job_x",
        "/runs/run_x",
        "/datasets/ds_x",
        "/static/x.js",
        "/static/..%2fpages.py",
        "/v1/runs/run_x/figures/history",
        "/pages/models/nothing.yaml",
    ],
)
def test_what_is_not_there_is_not_found(client: TestClient, path: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


def test_the_pages_of_jobs_follow_each_other(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    assert client.get("/").text.count('<tr data-job="') == 5
    assert (
        client.get("/", params={"cursor": filled_folder.failed}).text.count('<tr data-job="') == 2
    )


def test_plotly_is_served_compressed_and_kept_forever(client: TestClient) -> None:
    name = "/static/" + render.get_bundles()["plotly"].name
    answer = client.get(name, headers={"Accept-Encoding": "gzip"})
    assert answer.headers["content-encoding"] == "gzip"
    assert "immutable" in answer.headers["cache-control"]
    plain = client.get(name, headers={"Accept-Encoding": "identity"})
    assert plain.text == answer.text
    assert len(gzip.compress(plain.content, 1)) < len(plain.content) / 2


def test_an_unchanged_file_is_not_sent_again(client: TestClient) -> None:
    first = client.get("/static/lagid.css")
    again = client.get("/static/lagid.css", headers={"If-None-Match": first.headers["etag"]})
    assert (first.status_code, again.status_code, again.content) == (200, 304, b"")


@pytest.mark.parametrize(
    "name", ["history", "convergence", "response", "correlation", "waterfall", "posterior"]
)
def test_every_figure_comes_as_plotly_json_and_as_csv(
    client: TestClient, filled_folder: FilledFolder, name: str
) -> None:
    path = f"/v1/runs/{filled_folder.finished_run}/figures/{name}"
    figure = client.get(path).json()
    assert set(figure) == {"data", "layout"}
    assert figure["data"]
    table = client.get(path, params={"format": "csv"})
    assert table.headers["content-type"].startswith("text/csv")
    assert len(table.text.splitlines()) > 3


@pytest.mark.parametrize(
    ("name", "query"),
    [
        ("history", "abscissa=years"),
        ("response", "start=nan"),
        ("history", "theme=pink"),
        ("history", "nonsense=1"),
        ("spectrum", ""),
    ],
)
def test_a_figure_that_cannot_be_made_is_a_fault_of_the_request(
    client: TestClient, filled_folder: FilledFolder, name: str, query: str
) -> None:
    answer = client.get(f"/v1/runs/{filled_folder.finished_run}/figures/{name}?{query}")
    assert answer.status_code == 422
    assert answer.json()["errors"]


def test_an_experiment_beyond_the_last_is_not_found(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    path = f"/v1/runs/{filled_folder.finished_run}/figures/response?experiment=1"
    assert "the last is 0" in client.get(path).json()["detail"]


def test_the_response_joins_the_parts_of_one_record(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    path = f"/v1/runs/{filled_folder.finished_run}/figures/response"
    layout = client.get(path).json()["layout"]
    assert layout["meta"]["experiments"] == ["record 1"]
    assert layout["shapes"][0]["x0"] == 21.0


def test_a_run_that_has_not_ended_has_an_empty_response(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    path = f"/v1/runs/{filled_folder.running_run}/figures/response"
    assert client.get(path).json()["data"] == []


def test_the_report_of_a_job_names_no_other_file(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    answer = client.get(f"/v1/jobs/{filled_folder.sweep}/report")
    head = answer.text[: answer.text.index("<style>")]
    assert answer.status_code == 200
    assert "src=" not in head
    assert "<link" not in answer.text
    policy = answer.headers["content-security-policy"]
    assert "sha256-" in policy
    assert policy.endswith("; frame-ancestors 'none'")
    assert "frame-ancestors" not in head  # not known there: browsers would complain


def test_a_model_is_shown_as_yaml(client: TestClient) -> None:
    answer = client.get("/pages/models/tube.yaml")
    assert answer.status_code == 200
    assert "equations:" in answer.text


def test_the_list_tells_how_the_runs_of_a_sweep_ended(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    rows = client.get("/").text.split("<tr data-job=")
    (sweep,) = (row for row in rows if row.startswith(f'"{filled_folder.sweep}"'))
    (single,) = (row for row in rows if row.startswith(f'"{filled_folder.finished}"'))
    assert "best of 12 succeeded" in sweep
    assert "succeeded</small>" not in single


def test_the_list_tells_the_verdict_fit_and_warnings_of_each_result(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    rows = client.get("/").text.split("<tr data-job=")
    (single,) = (row for row in rows if row.startswith(f'"{filled_folder.finished}"'))
    assert '<span class="trust trustworthy">trustworthy</span>' in single
    assert "99.71 %" in single
    assert '<td class="n" data-label="findings">1</td>' in single
    (running,) = (row for row in rows if row.startswith(f'"{filled_folder.running}"'))
    assert 'class="trust' not in running


def test_results_of_two_jobs_are_compared_under_different_names(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    jobs = {job["id"]: job for job in client.get("/v1/jobs").json()["items"]}
    outcomes = [jobs[job]["outcome"] for job in (filled_folder.finished, filled_folder.sweep)]
    assert [outcome["trust"] for outcome in outcomes] == ["trustworthy", "trustworthy"]
    query = "&".join(f"run={outcome['run']}" for outcome in outcomes)
    page = client.get(f"/compare?{query}").text
    assert ">tube 40 m, pattern 1</a>" in page
    assert ">three methods, four seeds</a>" in page
    differing = page[page.index('<th scope="row">posterior</th>') :].partition("</tr>")[0]
    assert re.findall(r'data-label="([^"]*)">(\w+)<', differing) == [
        ("tube 40 m, pattern 1", "yes"),
        ("three methods, four seeds", "no"),
    ]
    figure = client.get(f"/pages/compare/response?{query}")
    assert figure.status_code == 200, figure.text
    names = [trace["name"] for trace in figure.json()["data"]]
    assert names.count("three methods, four seeds") in (0, 2)
    assert "measured" in names
    assert client.get(f"/pages/compare/response?{query}&experiment=7").status_code == 404
    assert client.get("/compare").status_code == 200


def test_starts_are_told_apart_from_dispatchers_that_were_lost(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    parts = parts_of(client)
    page = client.get(f"/jobs/{filled_folder.finished}").text
    assert "dispatchers lost" not in page
    with parts.database.write_session() as session:
        session.get(Job, filled_folder.finished).lost_leases = 1
    page = client.get(f"/jobs/{filled_folder.finished}").text
    assert "1 of at most 3 dispatchers lost" in page


def test_the_recordings_are_listed_page_by_page_with_what_can_be_done(tmp_path: Path) -> None:
    with TestClient(create_app(settings_of(tmp_path))) as client:
        assert "No recording is stored yet" in client.get("/datasets").text
        parts = parts_of(client)
        for number in range(52):
            channel = Channel("u", np.array([0.0, 1.0]), np.array([1.0, number]), "V")
            add_recording(
                parts.database,
                parts.store,
                Recording((channel,)),
                name=f"record {number}",
                kind="upload",
                key=f"record {number}",
                details={"warnings": []},
            )
        first = client.get("/datasets").text
        [following] = re.findall(r'rel="next" href="([^"]*)"', first)
        rest = client.get(following).text
    assert first.count("data-dataset=") == 50
    assert rest.count("data-dataset=") == 2
    assert "record 51" in first
    assert "record 0" in rest
    assert re.search(r'href="/new/noise-sweep\?dataset=ds_', rest)


@pytest.mark.parametrize(
    ("path", "status", "told"),
    [
        ("/jobs/job_x", 404, "there is no job"),
        ("/nothing", 404, "/nothing"),
        ("/compare?run=%3Cb%3E&run=x", 422, "run"),
    ],
)
def test_a_browser_is_told_an_error_on_a_page(
    client: TestClient, path: str, status: int, told: str
) -> None:
    answer = client.get(path, headers={"accept": "text/html,*/*;q=0.8"})
    assert answer.status_code == status
    assert answer.headers["content-type"].startswith("text/html")
    assert "script-src 'self'" in answer.headers["content-security-policy"]
    assert told in answer.text
    assert 'href="/datasets"' in answer.text
    assert "<b>" not in answer.text


@pytest.mark.parametrize("path", ["/v1/jobs/job_x", "/static/x.js", "/pages/models/x.yaml"])
def test_what_scripts_load_has_a_problem_document_also_in_a_browser(
    client: TestClient, path: str
) -> None:
    answer = client.get(path, headers={"accept": "text/html,*/*;q=0.8"})
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["vary"] == "Accept"


def test_every_column_of_a_page_has_a_heading() -> None:
    folder = Path(render.__file__).parent / "templates"
    for path in folder.glob("*.html"):
        assert "<th></th>" not in path.read_text(encoding="utf-8"), path.name


def test_why_the_one_run_of_a_job_failed_is_told_once_above_its_model(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    text = client.get(f"/jobs/{filled_folder.failed}").text
    assert text[: text.index("<h2>Model</h2>")].count('class="note bad"') == 1
    assert "The run failed:" in text
