"""Pages that find: lists, comparisons of other data, models, references, lineage, results."""

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from service.api.app import create_app
from service.core.settings import Settings
from service.core.shown_settings import list_settings
from service.datasets.datasets import add_recording
from service.jobs.job_schemas import ReferenceIn
from service.jobs.references import accept_reference
from service.models.models import add_model
from service.pages import job_pages
from service.pages.lineage_drawing import MAX_CHARACTERS, LineageDrawing, draw_lineage
from service.repositories.lineage_rows import LineageRepository
from service.storage.tables import Job, Run
from sysid.data.holds import HOLD_TEXTS, HOLDS, HoldSetting
from sysid.data.records import Channel, Recording
from sysid.figures.data import ExperimentTraces, OutputTraces, SignalTrace
from sysid.figures.signal_figures import plot_comparison
from sysid.models.catalogue.load import copy_catalogue_document
from tests.support.service.filled_folder import FilledFolder
from tests.support.service.web_app import parts_of, settings_of


@pytest.fixture(scope="module")
def client(folder: Path, filled_folder: FilledFolder) -> Iterator[TestClient]:
    with TestClient(create_app(settings_of(folder))) as opened:
        with parts_of(opened).database.write_session() as session:
            accept_reference(session, "tube", ReferenceIn(run=filled_folder.finished_run, by="Ada"))
        yield opened


def list_jobs(client: TestClient, query: str) -> list[str]:
    answer = client.get(f"/?{query}")
    assert answer.status_code == 200, answer.text
    return re.findall(r'<tr data-job="([^"]*)"', answer.text)


def test_the_form_of_the_list_of_jobs_finds_and_sorts(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    assert list_jobs(client, "sort=fit")[:2] == [filled_folder.finished, filled_folder.sweep]
    assert list_jobs(client, "sort=worst-fit")[:2] == [filled_folder.sweep, filled_folder.finished]
    assert list_jobs(client, "state=failed&name=&model=lagged-tube&sort=") == [filled_folder.failed]
    assert list_jobs(client, "state=failed&name=tube") == []
    page = client.get("/?sort=fit").text
    assert 'aria-sort="descending"><a class="plain" href="/?sort=worst-fit">Fit</a>' in page
    assert '<option value="fit" selected>best fit first</option>' in page
    for query, told in (("sort=size", "need one of newest, oldest"), ("state=no", "?state")):
        answer = client.get(f"/?{query}")
        assert answer.status_code == 422
        assert told in answer.text
    following = client.get(f"/?sort=name&cursor={filled_folder.finished}").text
    assert 'href="/?sort=name"' in following  # back to the first page, in the same order


def traces(start: float, values: list[float], unit: str = "V") -> ExperimentTraces:
    times = start + np.arange(len(values))
    measured = SignalTrace("y", unit, times, np.array(values))
    driven = SignalTrace("u", "V", times, np.array(values) / 2)
    return ExperimentTraces("record 1", (OutputTraces(measured, np.array(values) + 1),), (driven,))


def test_runs_on_other_data_are_drawn_over_their_own_measured_output() -> None:
    first, other = traces(0.0, [1, 2, 3]), traces(50.0, [3, 2, 1])
    figure = plot_comparison([("a", first), ("b", other), ("c", first)])
    drawn = {(one["name"], one.get("yaxis")): one for one in figure["data"]}
    assert drawn["measured, a", "y"]["y"] == [1, 2, 3]
    assert drawn["measured, b", "y"]["x"] == [0, 1, 2]  # from the start of its record
    assert drawn["b", "y"]["y"] == [4, 3, 2]
    assert drawn["c", "y"]["y"] == [2, 3, 4]
    assert sum(name.startswith("measured") for name, _ in drawn) == 2  # a and c share theirs
    assert {axis for _, axis in drawn} == {"y", "y2", "y3"}
    assert drawn["u, b", "y3"]["y"] == [1.5, 1, 0.5]
    units = plot_comparison([("a", first), ("b", traces(0.0, [3, 2, 1], "kPa"))])
    names = [one["title"]["text"] for key, one in units["layout"].items() if "yaxis" in key]
    assert names[0::2][:2] == ["y [V]", "y [kPa]"]  # other units have plots of their own
    named = [one["name"] for one in units["data"] if one.get("showlegend")]
    assert named == ["measured", "a", "b"]  # each once
    late = replace(first, outputs=traces(1.0, [2, 3]).outputs)  # the first sample is not scored
    assert plot_comparison([("a", first), ("b", late)])["data"][3]["x"] == [1, 2]


def test_a_comparison_of_other_data_says_what_does_not_compare(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    parts = parts_of(client)
    with parts.database.write_session() as session:
        job = session.get_one(Job, filled_folder.sweep)
        before = job.spec
        job.spec = {**before, "skip": 7}
    try:
        page = client.get(
            f"/compare?run={filled_folder.sweep_run}&run={filled_folder.finished_run}"
        ).text
        assert "on different data" in page
        assert "tube 40 m, pattern 1 has another number of skipped samples" in page
        assert page.index(">three methods, four seeds<") < page.index(">tube 40 m, pattern 1<")
        refused = client.post(
            "/v1/runs:compare", json={"runs": [filled_folder.sweep_run, filled_folder.finished_run]}
        )
        assert refused.status_code == 422  # programs must say what they compare
    finally:
        with parts.database.write_session() as session:
            session.get_one(Job, filled_folder.sweep).spec = before


def test_models_are_shown_with_equations_parameters_and_the_jobs_that_used_them(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    gallery = client.get("/models").text
    assert gallery.count("<math") > 20
    assert 'href="/models/fopdt"' in gallery
    found = client.get("/models?name=OVEN").text  # by what it is used for
    assert 'href="/models/fopdt"' in found
    assert 'href="/models/narx"' not in found
    page = client.get("/models/fopdt").text
    assert '<th scope="row">T</th><td>time constant</td><td>s</td>' in page
    assert "follows the data: 0 … half the shortest record" in page
    assert "Typical systems:" in page
    assert f'<option value="{filled_folder.dataset}">' in page
    assert "None yet." in page
    document = {**copy_catalogue_document("fopdt"), "name": "lagged-tube", "title": "<i>mine</i>"}
    with parts_of(client).database.write_session() as session:
        add_model(session, document)
        add_model(session, {**document, "title": "changed"})
    assert 'href="/models/lagged-tube%402"' in client.get("/models").text
    own = client.get("/models/lagged-tube@1").text
    assert "&lt;i&gt;mine&lt;/i&gt;" in own
    assert "changed" not in own
    assert f'href="/jobs/{filled_folder.finished}"' in own
    assert client.get("/models/fopdd").status_code == 404
    assert "fopdt" in client.get("/models/fopdd").text


def test_every_built_in_model_has_a_page_and_a_typical_system(client: TestClient) -> None:
    for model in client.get("/v1/models").json()["items"]:
        if model["builtin"]:
            page = client.get(f"/models/{model['name']}")
            assert page.status_code == 200
            assert "Typical systems:" in page.text, model["name"]
            assert "<math" in page.text


def test_references_are_listed_with_units_and_what_is_compared_with_them(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    listed = client.get("/references?name=TUB").text
    assert 'href="/references/tube"' in listed
    assert "T = 0.34890 ± 0.00041\u202fs" in listed
    assert "No reference meets all conditions" in client.get("/references?name=pipe").text
    page = client.get("/references/tube").text
    assert "by Ada" in page
    assert f'href="/runs/{filled_folder.finished_run}"' in page
    assert "No job yet." in page
    with parts_of(client).database.write_session() as session:
        LineageRepository(session).add_links(
            filled_folder.queued, [filled_folder.finished_run], "reference"
        )
    page = client.get("/references/tube").text
    assert f'href="/jobs/{filled_folder.queued}"' in page
    assert "compared with it" in page
    assert client.get("/references/pipe").status_code == 404


def test_the_lineage_of_a_job_is_drawn_with_links(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    page = client.get(f"/jobs/{filled_folder.finished}").text
    drawn = page[page.index('<svg class="lineage"') :].partition("</svg>")[0]
    assert f'<a href="/datasets/{filled_folder.dataset}" aria-label="recording tube 40 m">' in drawn
    assert f'<a href="/runs/{filled_folder.finished_run}" aria-label="run 1 of tube' in drawn
    assert drawn.count('<g class="shown">') == 1
    assert 'aria-label="reference tube"' in drawn
    assert f'href="/jobs/{filled_folder.sweep}"' not in drawn  # it only used the same recording


def test_the_lineage_of_an_open_job_follows_when_it_has_ended(
    client: TestClient, filled_folder: FilledFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[str] = []

    def draw(session: Session, shown: Job) -> LineageDrawing:
        drawn.append(shown.id)
        return draw_lineage(session, shown)

    monkeypatch.setattr(job_pages, "draw_lineage", draw)
    shown = {
        job: client.get(f"/jobs/{job}").text
        for job in (filled_folder.running, filled_folder.finished)
    }
    assert drawn == [filled_folder.finished]
    region = '<div data-live="lineage">'
    assert (
        f'{region}<p class="muted">Drawn when the job has ended.</p>'
        in shown[filled_folder.running]
    )
    assert '<svg class="lineage"' in shown[filled_folder.finished].partition(region)[2]


def test_the_lineage_of_a_recording_is_drawn_with_links(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    parts = parts_of(client)
    channel = Channel("u", np.array([0.0, 1.0]), np.array([1.0, 2.0]), "V")
    long_name = "a part of it with a very long name & more"
    part = add_recording(
        parts.database,
        parts.store,
        Recording((channel,)),
        name=long_name,
        kind="derived",
        key="part",
        details={"warnings": []},
    ).dataset.id
    with parts.database.write_session() as session:
        LineageRepository(session).add_links(part, [filled_folder.dataset], "derived")
    drawing = client.get(f"/datasets/{filled_folder.dataset}").text.partition('class="lineage"')[2]
    for target in (
        f"/jobs/{filled_folder.sweep}",
        f"/runs/{filled_folder.finished_run}",
        "/references/tube",
        f"/datasets/{part}",
    ):
        assert f'<a href="{target}" aria-label=' in drawing
    assert long_name.replace("&", "&amp;")[: MAX_CHARACTERS - 1] + "…</text>" in drawing
    assert '<g class="shown"><title>tube 40 m</title>' in drawing
    upwards = client.get(f"/datasets/{part}").text.partition('class="lineage"')[2]
    assert f'<a href="/datasets/{filled_folder.dataset}"' in upwards
    assert f"/jobs/{filled_folder.sweep}" not in upwards  # made from its parent, not from it


@pytest.mark.parametrize("hold", HOLDS)
def test_a_recording_says_what_its_channels_do_between_samples(
    client: TestClient, hold: HoldSetting
) -> None:
    assert set(HOLD_TEXTS) == set(HOLDS)
    parts = parts_of(client)
    channel = Channel("u", np.array([0.0, 1.0]), np.array([1.0, 2.0]), "V", hold)
    stored = add_recording(
        parts.database,
        parts.store,
        Recording((channel,)),
        name=f"read as {hold}",
        kind="upload",
        key=f"hold {hold}",
        details={"warnings": []},
    ).dataset.id
    answer = client.get(f"/datasets/{stored}")
    assert answer.status_code == 200
    assert f"<td>{HOLD_TEXTS[hold]}</td>" in answer.text


def test_health_tells_what_works_and_settings_where_they_come_from(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = client.get("/health").text
    assert page.count("not ready") == 1
    assert "no dispatcher is alive" in page
    assert 'href="/settings"' in page
    assert "LAGID_DATA_DIR" in client.get("/settings").text
    secret = "postgresql+psycopg://lagid:pa/s:s@w@db:5432/lagid?sslpassword=x1y2"
    monkeypatch.setenv("LAGID_DATABASE_URL", secret)
    monkeypatch.setenv("LAGID_PORT", "9000")
    shown = {one.variable: one for one in list_settings(Settings(host="localhost"))}
    address = shown["LAGID_DATABASE_URL"]
    assert (address.value, address.source) == (
        "postgresql+psycopg://•••@db:5432/lagid?•••",
        "environment",
    )
    assert (shown["LAGID_PORT"].value, shown["LAGID_PORT"].source) == ("9000", "environment")
    assert (shown["LAGID_HOST"].value, shown["LAGID_HOST"].source) == ("localhost", "command line")
    assert shown["LAGID_CPUS"].source == "default"
    assert shown["LAGID_CPUS"].text.startswith("Workers of the local Ray")


def test_one_parameter_of_the_runs_of_all_jobs_is_a_table_a_figure_and_a_file(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    page = client.get("/results?parameter=L").text
    assert page.count('<input type="checkbox" name="run"') == 13
    assert "<b>0.11270</b>\u202fs</td>" in page
    assert '<td class="n wide">0.00023</td>' in page
    assert '<option value="/seed">seed</option>' in page
    assert (
        f'href="/v1/jobs/{filled_folder.sweep}/runs.csv"'
        in client.get(f"/jobs/{filled_folder.sweep}").text
    )
    best = client.get("/results?parameter=L&runs=best&name=four seeds").text
    assert re.findall(r'name="run" value="([^"]*)"', best) == [filled_folder.sweep_run]
    figure = client.get("/pages/results/figure?parameter=L&over=/seed&theme=dark").json()
    [points] = figure["data"]
    assert sorted(points["x"]) == sorted([1, 2, 3, 4] * 3)  # the run without a seed is left out
    assert set(points["error_y"]["array"]) == {0.00023}
    assert figure["layout"]["yaxis"]["title"]["text"] == "L [s]"
    [ordered] = client.get("/pages/results/figure?parameter=L&name=four seeds").json()["data"]
    assert ordered["x"] == list(range(1, len(ordered["x"]) + 1))
    numbers = [int(text.rpartition(" ")[2]) for text in ordered["text"]]
    assert numbers == list(range(1, 13))  # the runs of a sweep rise to the right
    unasked = client.get("/results?name=four seeds").text
    [parameter] = set(re.findall(r"results(?:/figure|\.csv)\?[^\"]*parameter=(\w+)", unasked))
    assert f"<h2>{parameter} of each run</h2>" in unasked
    file = client.get("/pages/results.csv?parameter=T&model=lagged-tube")
    rows = list(csv.DictReader(io.StringIO(file.text)))
    assert len(rows) == 13
    assert {(row["value"], row["stderr"], row["unit"]) for row in rows} == {
        ("0.3489", "0.00041", "s")
    }
    assert "No run with a result meets all conditions" in client.get("/results?model=none").text
    none = client.get("/pages/results/figure?model=none").json()
    assert none["data"] == []
    assert client.get("/results?cursor=x").status_code == 422
    assert "no such free parameter" in client.get("/results?parameter=other").text


def test_a_number_that_is_not_finite_is_an_empty_cell_and_a_dash(
    client: TestClient, filled_folder: FilledFolder
) -> None:
    with parts_of(client).database.write_session() as session:
        run = session.get_one(Run, filled_folder.finished_run)
        before = run.result
        assert before is not None
        first, *others = before["parameters"]
        damaged = {**first, "value": None, "interval95": [None, 3.053]}
        run.result = {**before, "parameters": [damaged, *others]}
    try:
        page = client.get(f"/runs/{filled_folder.finished_run}").text
        file = client.get(f"/pages/results.csv?parameter={first['name']}").text
    finally:
        with parts_of(client).database.write_session() as session:
            session.get_one(Run, filled_folder.finished_run).result = before
    assert "– … 3.053" in page
    assert not re.search(r"\bnan\b", page)
    rows = {row["run"]: row for row in csv.DictReader(io.StringIO(file))}
    cells = rows[filled_folder.finished_run]
    assert [cells[name] for name in ("value", "lower95", "upper95")] == ["", "", "3.053"]
