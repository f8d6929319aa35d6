"""Addresses and methods that are not there: a problem document as for all else."""

import pytest
from starlette.testclient import TestClient

from tests.support.service.web_app import read_faults


@pytest.mark.parametrize(
    "path",
    [
        "/v1/nothing",
        "/v1/jobs/job_0",
        "/v1/jobs/job_0/runs",
        "/v1/jobs/job_0/events",
        "/v1/runs/run_0",
        "/v1/runs/run_0/history",
        "/v1/runs/run_0/signals.mcap",
        "/v1/datasets/ds_0",
        "/v1/datasets/ds_0/content",
        "/v1/models/nothing",
        "/v1/jobs/",  # not led elsewhere: the address would have a scheme that may be wrong
        "/datasets/",
    ],
)
def test_what_is_not_there_is_not_found(server: TestClient, path: str) -> None:
    read_faults(server.get(path), 404, "not-found")


def test_an_action_on_a_job_that_is_not_there_is_not_found(server: TestClient) -> None:
    for verb in ("cancel", "resume", "clone"):
        read_faults(server.post(f"/v1/jobs/job_0:{verb}"), 404, "not-found")


def test_a_method_that_a_path_does_not_have_is_refused(server: TestClient) -> None:
    read_faults(server.delete("/v1/jobs"), 405, "method-not-allowed")
