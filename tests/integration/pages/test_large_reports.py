"""Reports and tables of jobs of many runs: small, and with those that stand out."""

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient

from service.api.app import create_app
from service.core.states import JobState
from service.jobs import submit
from service.jobs.job_schemas import JobIn
from service.queue.leases import Claim, LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.run_rows import RunRepository
from service.storage.sessions import Database
from tests.support.service.web_app import parts_of, recording, settings_of, store_csv
from tests.support.storage.run_results import write_result

N_SIGMA, N_SEEDS = 40, 105  # times the two methods: 8,400 asked for, the first 2,000 of them made
WHY = "the model diverged <everywhere>"


@dataclass(frozen=True)
class Large:
    """A job of many runs that has ended; the run numbered 7 is the worst, 11 and 12 have failed."""

    client: TestClient
    job: str


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Large]:
    settings = settings_of(tmp_path_factory.mktemp("large"))
    with TestClient(create_app(settings)) as client:
        parts = parts_of(client)
        stored = store_csv(client, recording())
        body = JobIn.model_validate(
            {
                "name": "large",
                "model": "fopdt",
                "datasets": [stored],
                "parameters": {"L": {"upper": 2}},
                "sweep": {
                    "axes": [
                        {"path": "/noise/sigma", "values": [0.01 * n for n in range(N_SIGMA)]},
                        {"path": "/algorithm/method", "values": ["simple", "improved"]},
                        {"path": "/seed", "range": [0, N_SEEDS]},
                    ]
                },
            }
        )
        job = submit.submit_job(parts.database, body, settings).id
        with parts.database.write_session() as session:
            claim = LeaseQueue(session).claim_job("test", timedelta(hours=1))
        assert claim is not None
        _end(parts.database, claim)
        yield Large(client, job)


def _end(database: Database, claim: Claim) -> None:
    with database.write_session() as session:
        found = RunRepository(session).list_page(claim.job.id, limit=3000).items
        RunWriter(session, claim.lease).record_outcomes(
            [_outcome(run.id, run.number) for run in found]
        )
        LeaseQueue(session).finish_job(claim.lease, JobState.FAILED, "stopped before its end")


def _outcome(run: str, number: int) -> RunOutcome:
    if number in (11, 12):
        return RunOutcome(run_id=run, state=JobState.FAILED, error=WHY)
    rms = 99.0 if number == 7 else 1.0 + number / 1000
    values: list[dict[str, Any]] = [
        {
            "name": name,
            "unit": "1",
            "value": 2.0 + number,
            "stderr": 0.1,
            "lower": 0.01,
            "upper": 9e3,
            "interval95": [1.8, 2.2],
            "status": "identified",
            "reason": "",
        }
        for name in ("K", "T")
    ]
    return RunOutcome(
        run_id=run,
        state=JobState.SUCCEEDED,
        valid=True,
        best_rms=rms,
        rms_noise_free=rms,
        fit_estimation=100 - rms,
        evaluations=100,
        generations=4,
        seconds=0.01,
        result=write_result(rms=rms, parameters=values),
    )


def test_the_report_of_thousands_of_runs_is_small(large: Large) -> None:
    answer = large.client.get(f"/v1/jobs/{large.job}/report")
    assert answer.status_code == 200
    assert len(answer.content) < 1_000_000
    assert "<script" not in answer.text
    assert "src=" not in answer.text


def test_it_tells_the_best_the_worst_and_the_failed_runs(large: Large) -> None:
    text = large.client.get(f"/v1/jobs/{large.job}/report").text
    worst = text[text.index("The worst runs that succeeded") :]
    assert re.search(r"<tbody>\s*<tr>\s*<td class=\"tight\">run 8</td>", worst)
    best = text[text.index("The best runs") :]
    assert re.search(r"<tbody>\s*<tr>\s*<td class=\"tight\">run 1</td>", best)
    failed = text[text.index("Failed runs") : text.index("The worst runs")]
    assert failed.count("the model diverged &lt;everywhere&gt;") == 2
    assert text.count("<tr>") < 400


def test_it_draws_the_errors_against_the_noise(large: Large) -> None:
    text = large.client.get(f"/v1/jobs/{large.job}/report").text
    assert 'class="drawn"' in text
    assert "RMS error</tspan> of the response" in text


def test_it_says_where_the_rest_is(large: Large) -> None:
    text = large.client.get(f"/v1/jobs/{large.job}/report").text
    for path in re.findall(r'href="http://testserver(/v1[^"]*)"', text):
        assert large.client.get(path).status_code == 200
    assert f"/v1/jobs/{large.job}/runs.csv" in text


def test_the_table_has_a_row_for_every_run_with_cell_and_estimates(large: Large) -> None:
    answer = large.client.get(f"/v1/jobs/{large.job}/runs.csv")
    assert answer.headers["content-type"].startswith("text/csv")
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [int(row["number"]) for row in rows] == list(range(2000))
    assert rows[320]["/noise/sigma"] == "0.01"
    assert rows[320]["/algorithm/method"] == "improved"
    assert (rows[320]["K"], rows[320]["stderr of K"]) == ("322.0", "0.1")
    assert (rows[11]["state"], rows[11]["error"], rows[11]["K"]) == ("failed", WHY, "")


def test_the_table_of_a_job_that_is_not_there_is_not_found(large: Large) -> None:
    answer: httpx.Response = large.client.get("/v1/jobs/job_x/runs.csv")
    assert answer.status_code == 404


def test_the_page_lists_a_part_of_the_runs_and_leads_to_the_next(large: Large) -> None:
    query = "?cell=/noise/sigma%3D0.0"
    text = large.client.get(f"/jobs/{large.job}{query}").text
    assert text.count('<td class="tight"><a href="/runs/') == 100
    assert len(text) < 200_000
    [following] = re.findall(r'rel="next" href="([^"]*)"', text)
    more = large.client.get(f"/jobs/{large.job}{following.replace('&amp;', '&')}").text
    assert more.count('<td class="tight"><a href="/runs/') == 100


def test_the_groups_of_a_job_that_is_resumed_are_made_anew(large: Large) -> None:
    path = f"/v1/jobs/{large.job}/summary?by=/algorithm/method"
    before = large.client.get(path).json()
    assert large.client.get(path).json() == before  # from memory
    assert sum(group["failed"] for group in before["groups"]) > 6000  # those never made, too
    assert large.client.post(f"/v1/jobs/{large.job}:resume").status_code == 202
    after = large.client.get(path).json()
    assert sum(group["failed"] for group in after["groups"]) <= 2
