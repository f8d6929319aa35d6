"""What a service shows of itself: request ids, access log, metrics, and what it waits for."""

import json
import logging
import re
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy.exc import OperationalError
from starlette.testclient import TestClient

from service.core.process.logs import ACCESS_LOGGER, JsonFormatter, TextFormatter
from service.queue.dispatchers import LEASE_SECONDS_KEY, STARTING_KEY, DispatcherRepository
from service.repositories.job_rows import JobRepository
from service.storage.storage_errors import ObjectStoreFailed
from tests.support.service.web_app import parts_of, read_faults

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def read_samples(server: TestClient) -> Samples:
    """The metrics as Prometheus reads them."""
    answer = server.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def find_value(samples: Samples, name: str, **labels: str) -> float:
    return samples.get((name, frozenset(labels.items())), 0.0)


def test_every_answer_has_a_request_id_of_its_own(server: TestClient) -> None:
    ids = {server.get(path).headers["x-request-id"] for path in ("/healthz", "/", "/none", "/v1")}
    assert len(ids) == 4
    assert all(re.fullmatch("[0-9a-f]{32}", one) for one in ids)


def test_a_sane_id_of_the_sender_is_kept_and_is_in_the_problem_document(
    server: TestClient,
) -> None:
    answer = server.get("/v1/jobs/none", headers={"X-Request-ID": "proxy-7.a:1"})
    read_faults(answer, 404, "not-found")
    assert answer.headers["x-request-id"] == answer.json()["request_id"] == "proxy-7.a:1"


@pytest.mark.parametrize("sent", ["", "a b", "x" * 129, '"><script>', "ü"])
def test_an_id_that_is_not_sane_is_replaced(server: TestClient, sent: str) -> None:
    answer = server.get("/healthz", headers={"X-Request-ID": sent.encode()})
    assert re.fullmatch("[0-9a-f]{32}", answer.headers["x-request-id"])


def test_requests_refused_by_the_middleware_have_their_id_too(server: TestClient) -> None:
    answer = server.get("/v1/jobs", headers={"Host": "evil.example", "X-Request-ID": "r1"})
    assert (answer.status_code, answer.json()["request_id"]) == (421, "r1")


def test_an_unexpected_error_is_counted_logged_and_has_its_id(
    server: TestClient, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_args: Any, **_options: Any) -> None:
        raise ZeroDivisionError

    labels = {"method": "GET", "route": "/v1/jobs/{job_id}", "status": "500"}
    before = find_value(read_samples(server), "lagid_http_requests_total", **labels)
    monkeypatch.setattr(JobRepository, "get", fail)
    quiet = TestClient(server.app, raise_server_exceptions=False)
    answer = quiet.get("/v1/jobs/job_1", headers={"X-Request-ID": "r1"})
    read_faults(answer, 500, "internal")
    assert answer.headers["x-request-id"] == answer.json()["request_id"] == "r1"
    after = find_value(read_samples(server), "lagid_http_requests_total", **labels)
    assert after == before + 1
    (record,) = [one for one in caplog.records if one.name == "service.api.requests.problems"]
    assert "ZeroDivisionError" in record.getMessage()


def test_the_access_log_has_route_status_time_and_id(
    server: TestClient, caplog: pytest.LogCaptureFixture
) -> None:
    lines: list[dict[str, Any]] = []

    class Collect(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(json.loads(JsonFormatter().format(record)))

    access, handler = logging.getLogger(ACCESS_LOGGER), Collect()
    caplog.set_level(logging.INFO, ACCESS_LOGGER)
    access.addHandler(handler)
    try:
        server.get("/v1/jobs/none%0Aforged", headers={"X-Request-ID": "r1"})
    finally:
        access.removeHandler(handler)
    (line,) = lines
    assert (line["method"], line["route"], line["status"]) == ("GET", "/v1/jobs/{job_id}", 404)
    assert (line["path"], line["request_id"]) == ("/v1/jobs/none\nforged", "r1")
    assert line["seconds"] >= 0
    assert line["message"].startswith("GET /v1/jobs/none\nforged 404 in ")
    (record,) = (r for r in caplog.records if r.name == ACCESS_LOGGER)
    assert "GET /v1/jobs/none\\u000aforged 404 in " in TextFormatter().format(record)


def test_requests_are_counted_by_template_and_status_never_by_path(server: TestClient) -> None:
    labels = {"method": "GET", "route": "/v1/jobs/{job_id}"}
    before = read_samples(server)
    for k in range(3):
        server.get(f"/v1/jobs/unknown-{k}")
    server.get("/not/a/route-1")
    server.request("BREW", "/v1/jobs")
    after = read_samples(server)
    counted = {**labels, "status": "404"}
    name = "lagid_http_requests_total"
    assert find_value(after, name, **counted) == find_value(before, name, **counted) + 3
    count = "lagid_http_request_seconds_count"
    assert find_value(after, count, **labels) == find_value(before, count, **labels) + 3
    values = {value for _, labels in after for key, value in labels if key in ("route", "method")}
    assert not [value for value in values if "unknown" in value or "not/a/route" in value]
    assert "BREW" not in values
    assert "other" in values


def test_metrics_have_the_queue_and_its_age(server: TestClient) -> None:
    samples = read_samples(server)
    assert find_value(samples, "lagid_jobs", state="queued") >= 0
    assert ("lagid_jobs", frozenset({("state", "failed")})) in samples
    assert ("lagid_queue_age_seconds", frozenset()) in samples
    assert find_value(samples, "lagid_database_up") == 1


def test_without_a_database_the_numbers_of_the_process_remain(
    server: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_args: Any, **_options: Any) -> Any:
        raise OperationalError("SELECT 1", {}, Exception("connection refused"))

    monkeypatch.setattr(parts_of(server).database, "read_session", away)
    samples = read_samples(server)
    assert ("lagid_database_up", frozenset()) in samples
    assert find_value(samples, "lagid_database_up") == 0
    assert ("lagid_jobs", frozenset({("state", "queued")})) not in samples
    assert ("lagid_store_errors_total", frozenset({("store", "objects")})) in samples


def test_a_failure_of_the_store_is_counted(server: TestClient) -> None:
    name = "lagid_store_errors_total"
    before = find_value(read_samples(server), name, store="objects")
    store = parts_of(server).store
    folder = store._temporary
    away = folder.rename(folder.with_name("away"))
    try:
        with pytest.raises(ObjectStoreFailed):
            store.put_stream([b"x"])
    finally:
        away.rename(folder)
    assert find_value(read_samples(server), name, store="objects") == before + 1


def test_readiness_says_what_a_dispatcher_waits_for(server: TestClient, dataset: str) -> None:
    parts = parts_of(server)

    def tell(owner: str, **details: Any) -> None:
        with parts.database.write_session() as session:
            known = {LEASE_SECONDS_KEY: 3600.0, **details}
            DispatcherRepository(session).add_dispatcher(owner, known)

    def count(state: str) -> float:
        return find_value(read_samples(server), "lagid_dispatchers", state=state)

    tell("d1", **{STARTING_KEY: ["ray", "search"]})
    answer = server.get("/readyz")
    (fault,) = read_faults(answer, 503, "unavailable")
    assert re.search(r"starting \(\d+ s\): Ray is starting and the search is comp", fault["detail"])
    assert (count("starting"), count("ready")) == (1, 0)
    job = server.post("/v1/jobs", json={"model": "fopdt", "datasets": [dataset]}).json()["id"]
    page = server.get(f"/jobs/{job}").text
    assert re.search(r"This job waits: a dispatcher is starting \(\d+ s\): Ray is starting", page)
    tell("d2")
    assert "This job waits" not in server.get(f"/jobs/{job}").text
    assert server.get("/readyz").status_code == 200
    assert (count("starting"), count("ready")) == (1, 1)
    tell("d1")
    assert (count("starting"), count("ready")) == (0, 2)
