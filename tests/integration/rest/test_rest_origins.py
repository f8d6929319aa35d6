"""Web pages that are not the service's own: no reading by a rebound name, no writing at all."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from service.core.settings import Settings
from tests.support.service.web_app import CSV, read_faults, recording, settings_of

HERE = "127.0.0.1:8000"
MODEL = b'{"name": "tank"}'


@pytest.fixture(scope="module")
def door(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """An application with a further name, asked as a browser on the same machine asks."""
    settings = settings_of(tmp_path_factory.mktemp("door"), allowed_hosts="Lagid.Example, other")
    app = create_app(settings)
    with TestClient(app, f"http://{HERE}", raise_server_exceptions=False) as client:
        yield client


@pytest.mark.parametrize("path", ["/", "/v1/jobs", "/v1/datasets", "/healthz", "/static/lagid.css"])
@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8000", "user@localhost"])
def test_a_name_that_was_rebound_to_loopback_is_not_answered(
    door: TestClient, path: str, host: str
) -> None:
    read_faults(door.get(path, headers={"Host": host}), 421, "misdirected")


def test_a_browser_is_told_by_a_page_which_names_are_served(door: TestClient) -> None:
    answer = door.get("/", headers={"Host": "evil.example", "Accept": "text/html"})
    assert (answer.status_code, answer.headers["content-type"][:9]) == (421, "text/html")
    assert "LAGID_ALLOWED_HOSTS" in answer.text


@pytest.mark.parametrize(
    "host",
    [
        "localhost:8000",
        "LOCALHOST",
        "localhost.",
        "a.localhost",
        "127.0.0.1",
        "127.1.2.3:1",
        "[::1]:8000",
        "other",
        "lagid.example:443",
    ],
)
def test_names_of_loopback_and_allowed_names_are_answered(door: TestClient, host: str) -> None:
    assert door.get("/v1/jobs", headers={"Host": host}).status_code == 200


def test_one_foreign_name_among_several_is_refused(door: TestClient) -> None:
    both = [("Host", HERE), ("Host", "evil.example")]
    read_faults(door.get("/v1/jobs", headers=both), 421, "misdirected")


@pytest.mark.parametrize(
    ("listens_on", "served", "not_served"),
    [
        ("127.0.0.1", "127.0.0.1", "10.0.0.1"),
        ("lagid-host", "lagid-host", "evil.example"),
        ("0.0.0.0", "10.0.0.1", "evil.example"),
        ("::", "fe80::1", ""),
    ],
)
def test_the_host_that_the_service_listens_on_is_served(
    listens_on: str, served: str, not_served: str
) -> None:
    settings = Settings(host=listens_on)
    assert settings.is_served_host(served)
    assert settings.is_served_host("localhost")
    assert not settings.is_served_host(not_served)


FOREIGN = [
    {"Origin": "http://evil.example"},
    {"Origin": "http://localhost:3000"},
    {"Origin": "http://127.0.0.1:8001"},
    {"Origin": "null"},
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site"},
]


@pytest.mark.parametrize("headers", FOREIGN, ids=lambda headers: next(iter(headers.values())))
def test_a_page_of_another_origin_changes_nothing(
    door: TestClient, headers: dict[str, str]
) -> None:
    json = {"Content-Type": "application/json"}
    for path, kind, content in (
        ("/v1/models", json, MODEL),
        ("/v1/datasets", CSV, recording()),
        ("/v1/datasets", {"Content-Type": "text/plain"}, recording()),
        ("/v1/jobs/job_0:clone", {}, b""),
        ("/v1/jobs/job_0:cancel", {}, b""),
        ("/v1/jobs", json, b"{}"),
    ):
        answer = door.post(path, content=content, headers={**kind, **headers})
        read_faults(answer, 403, "foreign-origin")
    form = door.post("/v1/datasets", files={"file": ("a.csv", recording())}, headers=headers)
    read_faults(form, 403, "foreign-origin")
    read_faults(
        door.put("/v1/references/a", json={"run": "r"}, headers=headers), 403, "foreign-origin"
    )
    assert door.get("/v1/datasets").json()["items"] == []
    assert door.get("/v1/datasets", headers=headers).status_code == 200


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Origin": f"http://{HERE}", "Sec-Fetch-Site": "same-origin"},
        {"Origin": "https://lagid.example"},
        {"Sec-Fetch-Site": "none"},
    ],
)
def test_own_pages_and_programs_are_asked_for_nothing_more(
    door: TestClient, headers: dict[str, str]
) -> None:
    answer = door.post("/v1/models:check", json={"name": "tank"}, headers=headers)
    assert answer.status_code == 200


@pytest.mark.parametrize(
    ("host", "origin", "is_own"),
    [
        ("lagid.example", "https://lagid.example", True),
        ("lagid.example:443", "https://lagid.example", True),
        ("lagid.example:8443", "https://lagid.example:8443", True),
        ("127.0.0.1:8000", "https://lagid.example", True),  # a proxy wrote its own name
        ("lagid.example", "http://lagid.example:9999", False),
        ("lagid.example:8443", "https://lagid.example", False),
        ("127.0.0.1:8000", "http://lagid.example:9999", False),
    ],
)
def test_a_page_of_another_port_of_the_same_host_is_foreign(
    door: TestClient, host: str, origin: str, is_own: bool
) -> None:
    answer = door.post(
        "/v1/models:check", json={"name": "tank"}, headers={"Host": host, "Origin": origin}
    )
    assert answer.status_code == (200 if is_own else 403)


@pytest.mark.parametrize("path", ["/v1/models", "/v1/models:check", "/v1/jobs", "/v1/runs:compare"])
@pytest.mark.parametrize("kind", [None, "text/plain", "application/x-www-form-urlencoded"])
def test_a_body_without_its_media_type_is_refused(
    door: TestClient, path: str, kind: str | None
) -> None:
    headers = {} if kind is None else {"Content-Type": kind}
    answer = door.post(path, content=MODEL, headers=headers)
    read_faults(answer, 415, "unsupported-media-type")
    assert (kind or "") in answer.json()["detail"]


def test_an_upload_needs_its_media_type(door: TestClient) -> None:
    read_faults(door.post("/v1/datasets", content=recording()), 415, "unsupported-media-type")


def test_every_answer_forbids_guessed_types_and_use_by_other_origins(
    door: TestClient, tmp_path: Path
) -> None:
    paths = ("/", "/v1/jobs", "/v1/jobs/none", "/healthz", "/static/lagid.css", "/openapi.json")
    answers = [door.get(path) for path in paths]
    answers.append(door.get("/", headers={"Host": "evil.example"}))
    app = create_app(settings_of(tmp_path, allowed_hosts=["testserver"]))
    answers.append(TestClient(app, raise_server_exceptions=False).get("/v1/jobs"))  # not started
    assert [answer.status_code for answer in answers] == [200, 200, 404, 200, 200, 200, 421, 500]
    for answer in answers:
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"
