"""Polynomials whose terms are selected on the data: what REST says before there is a result."""

from typing import Any

import pytest
from starlette.testclient import TestClient

from service.core.states import JobState
from service.jobs.stored_run import StoredRun
from service.storage.tables import Job, Run
from sysid.models.parse import keep_terms, parse_model
from tests.support.library.polynomials import document, frols
from tests.support.service.web_app import read_faults, recording, store_csv


def job(server: TestClient, dataset: str, terms: Any, **changes: Any) -> Any:
    model = document(terms) | changes
    return server.post("/v1/jobs", json={"model": model, "datasets": [dataset]})


def test_a_job_may_ask_for_a_selection(server: TestClient, dataset: str) -> None:
    answer = job(server, dataset, frols(5))
    assert answer.status_code == 202, answer.text
    (run,) = server.get(f"/v1/jobs/{answer.json()['id']}/runs").json()["items"]
    history = server.get(f"/v1/runs/{run['id']}/history").json()
    assert history["names"] == []  # which of 14 candidates it will be is not known yet
    assert server.get(f"/v1/runs/{run['id']}").status_code == 200


@pytest.mark.parametrize(
    ("terms", "place", "part"),
    [
        (frols(0), "/model/terms/keep", "whole number from 1 to 14"),
        ({"select": "fro"}, "/model/terms/select", "frols"),
        (frols(3, error="both"), "/model/terms/error", "one-step"),
        (frols(3, exchange=1), "/model/terms/exchange", "true or false"),
        (frols(1, candidates=["y(k-1"]), "/model/terms/candidates/0", ""),
    ],
)
def test_a_rule_with_faults_is_refused_where_they_are(
    server: TestClient, dataset: str, terms: Any, place: str, part: str
) -> None:
    found = {
        one["pointer"]: one["detail"]
        for one in read_faults(job(server, dataset, terms), 422, "invalid")
    }
    assert part in found[place]


def test_more_candidates_than_samples_are_refused_when_the_job_is_sent(server: TestClient) -> None:
    few = store_csv(server, recording(n=12), "few")
    (fault,) = read_faults(job(server, few, frols(3)), 422, "invalid")
    assert fault["pointer"] == "/model/terms"
    assert "14 candidates cannot be distinguished with 12 samples" in fault["detail"]


def test_the_model_of_a_run_has_the_terms_that_were_selected_on_its_data() -> None:
    asked = document(frols(2))
    stored = Job(id="job", spec={"model": asked}, state=JobState.SUCCEEDED)
    run = Run(id="run", job_id="job", number=0, cell={}, state=JobState.SUCCEEDED)
    run.result = {"selection": [{"term": "u(k-1)"}, {"term": "y(k-1)"}]}
    assert StoredRun.from_rows(stored, run).model == keep_terms(
        parse_model(asked), ["u(k-1)", "y(k-1)"]
    )
    run.result = None
    assert StoredRun.from_rows(stored, run).model.rule is not None
