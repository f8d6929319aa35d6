"""Keys, scopes and sessions of browsers at the door, on both databases."""

import logging
import re
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from sqlalchemy import update

from service.access.tokens import hash_secret, parse_token
from service.api.requests import failure_delay
from service.api.requests.access_check import COOKIE
from service.api.routes import event_routes
from service.repositories.key_rows import note_use
from service.storage.tables import ApiKey, WebSession
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.keyed_service import Guarded, guard
from tests.support.service.web_app import CSV, read_faults, recording
from tests.support.storage.databases import record_statements
from tests.support.storage.job_rows import submit

PAGE = {"Accept": "text/html"}
MODEL = {"name": "tank"}


def key_id(token: str) -> str:
    parts = parse_token(token)
    assert parts is not None
    return parts.key_id


def change_key(keyed_service: Guarded, token: str, **values: object) -> None:
    with keyed_service.parts.database.write_session() as session:
        session.execute(update(ApiKey).where(ApiKey.id == key_id(token)).values(**values))


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/nothing", "/metrics", "/v1/jobs/job_0/events"])
def test_a_request_without_a_key_is_told_how_to_send_one(keyed_service: Guarded, path: str) -> None:
    answer = keyed_service.ask("GET", path)
    read_faults(answer, 401, "unauthorized")
    assert answer.headers["www-authenticate"] == 'Bearer realm="lagid"'
    assert "Authorization: Bearer" in answer.json()["detail"]


@pytest.mark.parametrize(
    "path",
    ["/healthz", "/docs", "/guides/", "/openapi.json", "/sign-in", "/static/lagid.css"],
)
def test_what_belongs_to_no_project_needs_no_key(keyed_service: Guarded, path: str) -> None:
    assert keyed_service.ask("GET", path).status_code == 200


def test_a_wrong_key_is_refused_whatever_is_wrong_with_it(keyed_service: Guarded) -> None:
    token = keyed_service.add_key()
    lagid, name, secret = token.split("_")
    wrong = (
        "x",
        "lagid_" + "0" * 5000,
        f"{lagid}_{name}",
        f"{lagid}_{name}_{secret[:-1]}0{secret[-1]}",
        f"{lagid}_{name[:-1]}_{secret}",
        f"{lagid}_{name}_{hash_secret(secret)}",
        f"{lagid}_{name}_\x00",
    )
    for text in wrong:
        answer = keyed_service.ask("GET", "/v1/jobs", text)
        read_faults(answer, 401, "unauthorized")
        assert 'error="invalid_token"' in answer.headers["www-authenticate"]
        assert secret not in answer.text
    basic = keyed_service.ask("GET", "/v1/jobs", headers={"Authorization": f"Basic {token}"})
    read_faults(basic, 401, "unauthorized")
    assert keyed_service.ask("GET", "/v1/jobs", token).status_code == 200


def test_a_key_ends_when_it_expires_or_is_revoked(keyed_service: Guarded) -> None:
    ending, revoked = keyed_service.add_key(days=1), keyed_service.add_key()
    assert keyed_service.ask("GET", "/v1/jobs", ending).status_code == 200
    change_key(keyed_service, ending, expires_at=datetime.now(UTC))
    change_key(keyed_service, revoked, revoked_at=datetime.now(UTC))
    for token in (ending, revoked):
        read_faults(keyed_service.ask("GET", "/v1/jobs", token), 401, "unauthorized")


def test_a_scope_includes_the_lower_ones_and_no_higher_one(keyed_service: Guarded) -> None:
    tokens = [keyed_service.add_key(scope=scope) for scope in ("read", "write", "admin")]
    requests = (
        ("GET", "/v1/jobs", {}, 0),
        ("HEAD", "/v1/datasets/ds_0/content", {}, 0),
        ("POST", "/v1/models:check", {"json": MODEL}, 0),
        ("POST", "/v1/runs:compare", {"json": {"runs": ["a", "b"]}}, 0),
        ("POST", "/v1/jobs", {"json": {}}, 1),
        ("POST", "/v1/runs/run_0:simulate", {"json": {}}, 1),
        ("PUT", "/v1/references/a", {"json": {"run": "run_0"}}, 1),
        ("DELETE", "/v1/jobs/job_0", {}, 1),
        ("GET", "/v1/audit", {}, 2),
        ("GET", "/keys", {}, 2),
        ("GET", "/health", {}, 0),
        ("GET", "/settings", {}, 2),
        ("POST", "/keys", {"data": {"name": "a", "scope": "read"}}, 2),
    )
    for method, path, body, needed in requests:
        for rank, token in enumerate(tokens):
            answer = keyed_service.ask(method, path, token, **body)
            if rank >= needed:
                assert answer.status_code not in (401, 403), (method, path, answer.text)
            elif method != "HEAD":
                read_faults(answer, 403, "out-of-scope")
                assert "scope" in answer.json()["detail"]


def test_a_body_without_a_key_is_not_read(keyed_service: Guarded) -> None:
    def content():
        raise AssertionError("the body was read")
        yield b""

    answer = keyed_service.ask("POST", "/v1/datasets", content=content(), headers=CSV)
    read_faults(answer, 401, "unauthorized")


def test_no_cache_gives_an_answer_to_another_caller(keyed_service: Guarded) -> None:
    token = keyed_service.add_key()
    answer = keyed_service.ask("GET", "/v1/jobs", token)
    assert answer.headers["cache-control"] == "private, no-cache"
    assert keyed_service.ask("GET", "/", token, headers=PAGE).headers["cache-control"] == "no-store"
    stored = keyed_service.ask("POST", "/v1/datasets", token, content=recording(n=30), headers=CSV)
    content = f"/v1/datasets/{stored.json()['id']}/content"
    read = keyed_service.ask("GET", content, token)
    assert read.headers["cache-control"] == "private, no-cache"  # asked again with each use
    again = {"If-None-Match": read.headers["etag"]}
    unchanged = keyed_service.ask("GET", content, token, headers=again)
    assert (unchanged.status_code, unchanged.content) == (304, b"")
    assert unchanged.headers["cache-control"] == "private, no-cache"
    change_key(keyed_service, token, revoked_at=datetime.now(UTC))
    read_faults(keyed_service.ask("GET", content, token, headers=again), 401, "unauthorized")


def test_access_says_who_asks(keyed_service: Guarded) -> None:
    project = keyed_service.add_project("asking", max_open_jobs=3)
    token = keyed_service.add_key(project, "write")
    answer = keyed_service.ask("GET", "/v1/access", token).json()
    assert answer["actor"] == key_id(token)
    assert (answer["project"], answer["project_name"]) == (project, "asking")
    assert answer["scopes"] == ["read", "write"]
    assert answer["limits"]["max_open_jobs"] == 3
    assert answer["limits"]["max_stored_bytes"] is None
    assert answer["used"] == dict.fromkeys(answer["used"], 0)


def test_the_last_use_of_a_key_is_written_once_a_minute(keyed_service: Guarded) -> None:
    token = keyed_service.add_key()

    def count_writes() -> int:
        with record_statements(keyed_service.parts.database) as statements:
            assert keyed_service.ask("GET", "/v1/jobs", token).status_code == 200
        return sum(statement.startswith("UPDATE api_keys") for statement, _ in statements)

    assert [count_writes() for _ in range(3)] == [1, 0, 0]
    change_key(keyed_service, token, last_used_at=datetime.now(UTC) - timedelta(seconds=61))
    assert [count_writes() for _ in range(2)] == [1, 0]


def test_requests_at_once_write_the_use_of_a_key_once(keyed_service: Guarded) -> None:
    token = keyed_service.add_key()
    uses = []
    for _ in range(2):  # both have read that the key was never used
        with keyed_service.parts.database.write_session() as session:
            note_use(session, key_id(token))
        with keyed_service.parts.database.read_session() as session:
            uses.append(session.get_one(ApiKey, key_id(token)).last_used_at)
    assert uses[0] is not None
    assert uses[0] == uses[1]


def test_only_digests_are_stored_and_nothing_is_logged(
    keyed_service: Guarded, caplog: pytest.LogCaptureFixture
) -> None:
    token = keyed_service.add_key()
    secret = token.rpartition("_")[2]
    with caplog.at_level(logging.DEBUG):
        keyed_service.ask("GET", "/v1/jobs", token)
        keyed_service.ask("GET", "/v1/jobs", token + "0")
        signed_in = keyed_service.ask("POST", "/sign-in", data={"key": token})
    cookie = signed_in.cookies[COOKIE]
    keyed_service.client.cookies.clear()
    with keyed_service.parts.database.engine.connect() as connection:
        stored = [
            str(row)
            for kind in (ApiKey, WebSession)
            for row in connection.execute(kind.__table__.select())
        ]
    assert any(hash_secret(secret) in row for row in stored)
    assert any(hash_secret(cookie) in row for row in stored)
    for hidden in (secret, cookie):
        assert not any(hidden in row for row in stored)
        assert hidden not in caplog.text


def sign_in(keyed_service: Guarded, token: str, **arguments: Any) -> str:
    answer = keyed_service.ask("POST", "/sign-in", data={"key": token}, **arguments)
    assert answer.status_code == 303, answer.text
    keyed_service.client.cookies.clear()
    return str(answer.cookies[COOKIE])


def test_a_browser_signs_in_and_out(keyed_service: Guarded) -> None:
    token = keyed_service.add_key()
    asked = keyed_service.ask("GET", "/datasets?cursor=ds_1", headers=PAGE)
    assert asked.status_code == 303
    assert asked.headers["location"] == "/sign-in?next=/datasets%3Fcursor%3Dds_1"
    form = keyed_service.ask("GET", asked.headers["location"]).text
    assert 'name="next" value="/datasets?cursor=ds_1"' in form
    answer = keyed_service.ask(
        "POST", "/sign-in", data={"key": token, "next": "/datasets?cursor=ds_1"}
    )
    assert (answer.status_code, answer.headers["location"]) == (303, "/datasets?cursor=ds_1")
    attributes = answer.headers["set-cookie"]
    for needed in ("HttpOnly", "SameSite=strict", "Path=/", "Max-Age=43"):
        assert needed in attributes
    assert "Secure" not in attributes  # this test does not come over https
    cookie = {"Cookie": f"{COOKIE}={answer.cookies[COOKIE]}"}
    keyed_service.client.cookies.clear()
    page = keyed_service.ask("GET", "/datasets", headers={**PAGE, **cookie})
    assert "Sign out" in page.text
    assert 'href="/keys"' in page.text
    assert keyed_service.ask("GET", "/v1/jobs", headers=cookie).status_code == 200
    assert keyed_service.ask("POST", "/sign-out", headers=cookie).status_code == 303
    read_faults(keyed_service.ask("GET", "/v1/jobs", headers=cookie), 401, "unauthorized")


def test_a_session_ends_with_its_key_and_its_time(keyed_service: Guarded) -> None:
    revoked, ended, short = (keyed_service.add_key(days=days) for days in (None, None, 1))
    cookies = [
        {"Cookie": f"{COOKIE}={sign_in(keyed_service, token)}"} for token in (revoked, ended, short)
    ]
    for cookie in cookies:
        assert keyed_service.ask("GET", "/v1/jobs", headers=cookie).status_code == 200
    admin = keyed_service.add_key()
    answer = keyed_service.ask("POST", f"/keys/{key_id(revoked)}/revoke", admin)
    assert (answer.status_code, answer.headers["location"]) == (303, "/keys")
    change_key(keyed_service, short, expires_at=datetime.now(UTC))
    with keyed_service.parts.database.write_session() as session:
        session.execute(update(WebSession).values(expires_at=datetime.now(UTC)))
    for cookie in cookies:
        read_faults(keyed_service.ask("GET", "/v1/jobs", headers=cookie), 401, "unauthorized")


def test_an_open_event_stream_ends_after_its_key(
    keyed_service: Guarded, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_routes, "KEEP_ALIVE_S", 0.05)
    token, parts = keyed_service.add_key(), keyed_service.parts
    job, has_waited, wait_for_news = submit(parts.database), Event(), parts.feed.wait_for_news

    async def wait(*asked: Any) -> bool:
        is_news = await wait_for_news(*asked)
        has_waited.set()
        return is_news

    monkeypatch.setattr(parts.feed, "wait_for_news", wait)
    with ThreadPoolExecutor(1) as pool:
        stream = pool.submit(keyed_service.ask, "GET", f"/v1/jobs/{job}/events", token)
        assert has_waited.wait(LIMIT_SECONDS)
        assert not stream.done()
        change_key(keyed_service, token, revoked_at=datetime.now(UTC))
        answer = stream.result(timeout=LIMIT_SECONDS)
    assert answer.status_code == 200
    assert "still here" in answer.text
    read_faults(keyed_service.ask("GET", f"/v1/jobs/{job}/events", token), 401, "unauthorized")


def test_a_wrong_key_at_the_form_is_told_there(keyed_service: Guarded) -> None:
    answer = keyed_service.ask("POST", "/sign-in", data={"key": "lagid_1_2"})
    assert answer.status_code == 401
    assert "is unknown, has expired, or was revoked" in answer.text
    assert "set-cookie" not in answer.headers


def read_actions(keyed_service: Guarded, token: str, *names: str) -> list[dict[str, Any]]:
    """Entries of the audit log with these actions, the latest first."""
    entries = keyed_service.ask("GET", "/v1/audit", token).json()["items"]
    return [entry for entry in entries if entry["action"] in names]


@pytest.mark.parametrize("way", ["header", "form"])
def test_a_refused_key_is_in_the_log_and_in_the_audit_log_of_its_project(
    keyed_service: Guarded, caplog: pytest.LogCaptureFixture, way: str
) -> None:
    def try_key(token: str, request_id: str) -> None:
        headers = {"X-Request-ID": request_id}
        if way == "header":
            read_faults(
                keyed_service.ask("GET", "/v1/jobs", token, headers=headers), 401, "unauthorized"
            )
        else:
            form = keyed_service.ask("POST", "/sign-in", data={"key": token}, headers=headers)
            assert form.status_code == 401

    project = keyed_service.add_project(f"guessed by {way}")
    token, failures = keyed_service.add_key(project), keyed_service.parts.failures
    failures._recorded_at, failures._n_unrecorded = -failure_delay.RECORD_SECONDS, 0
    try_key(f"{token}0", "guess-1")
    for number in range(3):
        try_key(f"{token}0", f"flood-{number}")
    (entry,) = read_actions(keyed_service, token, "key.refuse")
    assert (entry["object_id"], entry["request_id"]) == (key_id(token), "guess-1")
    assert entry["actor"] == "address:testclient"
    assert f"refused a wrong key, the last from testclient; it names {key_id(token)}" in caplog.text
    failures._recorded_at = -failure_delay.RECORD_SECONDS
    try_key("no\tkey", "guess-2")
    assert "refused 4 wrong keys, the last from testclient; it has not the form" in caplog.text
    assert caplog.text.count("refused") == 2


def test_a_sign_in_has_a_new_secret_and_ends_the_session_of_the_browser(
    keyed_service: Guarded,
) -> None:
    token = keyed_service.add_key(keyed_service.add_project("again"))
    chosen = {"Cookie": f"{COOKIE}=chosen-by-another"}
    first = sign_in(keyed_service, token, headers={**chosen, "X-Request-ID": "in-1"})
    assert first != "chosen-by-another"
    read_faults(keyed_service.ask("GET", "/v1/jobs", headers=chosen), 401, "unauthorized")
    old = {"Cookie": f"{COOKIE}={first}"}
    second = sign_in(keyed_service, token, headers={**old, "X-Request-ID": "in-2"})
    read_faults(keyed_service.ask("GET", "/v1/jobs", headers=old), 401, "unauthorized")
    headers = {"Cookie": f"{COOKIE}={second}", "X-Request-ID": "out-1"}
    left = keyed_service.ask("POST", "/sign-out", headers=headers)
    assert "Max-Age=0" in left.headers["set-cookie"]
    entries = read_actions(keyed_service, token, "session.sign-in", "session.sign-out")
    assert [(entry["action"], entry["request_id"]) for entry in entries] == [
        ("session.sign-out", "out-1"),
        ("session.sign-in", "in-2"),
        ("session.sign-out", "in-2"),
        ("session.sign-in", "in-1"),
    ]


@pytest.mark.parametrize(
    "target", ["//evil.example", "https://evil.example", "/\\evil.example", ""]
)
def test_a_sign_in_leads_to_pages_of_this_service_only(keyed_service: Guarded, target: str) -> None:
    token = keyed_service.add_key()
    answer = keyed_service.ask("POST", "/sign-in", data={"key": token, "next": target})
    keyed_service.client.cookies.clear()
    assert answer.headers["location"] == "/"


def test_a_foreign_page_cannot_use_the_session_or_sign_in(keyed_service: Guarded) -> None:
    token = keyed_service.add_key()
    cookie = {"Cookie": f"{COOKIE}={sign_in(keyed_service, token)}"}
    foreign = {"Origin": "http://evil.example", "Sec-Fetch-Site": "cross-site"}
    headers = {**cookie, **foreign}
    read_faults(
        keyed_service.ask("POST", "/v1/models", json=MODEL, headers=headers), 403, "foreign-origin"
    )
    form = keyed_service.ask("POST", "/sign-in", data={"key": token}, headers=foreign)
    read_faults(form, 403, "foreign-origin")


def test_keys_are_made_shown_once_and_revoked_on_their_page(keyed_service: Guarded) -> None:
    project = keyed_service.add_project("paged")
    admin = keyed_service.add_key(project)
    made = keyed_service.ask(
        "POST", "/keys", admin, data={"name": "laptop", "scope": "read", "days": "3"}
    )
    assert made.status_code == 201
    (token,) = set(re.findall(r"lagid_\w+_[0-9a-f]{64}", made.text))
    assert keyed_service.ask("GET", "/v1/access", token).json()["scopes"] == ["read"]
    page = keyed_service.ask("GET", "/keys", admin).text
    assert token not in page
    assert "laptop" in page
    assert keyed_service.ask("POST", f"/keys/{key_id(token)}/revoke", admin).status_code == 303
    read_faults(keyed_service.ask("GET", "/v1/jobs", token), 401, "unauthorized")
    others = keyed_service.add_key()
    read_faults(
        keyed_service.ask("POST", f"/keys/{key_id(others)}/revoke", admin), 404, "not-found"
    )
    for form in ({"name": " "}, {"name": "a", "days": "0"}, {"name": "a", "days": "x"}):
        answer = keyed_service.ask("POST", "/keys", admin, data=form)
        assert answer.status_code == 422
        assert 'role="alert"' in answer.text
        assert "found" in answer.text
    read_faults(
        keyed_service.ask("POST", "/keys", admin, data={"name": "a", "scope": "all"}),
        422,
        "invalid",
    )


def test_the_audit_log_says_who_did_what(keyed_service: Guarded) -> None:
    project = keyed_service.add_project("audited")
    admin, writer = keyed_service.add_key(project), keyed_service.add_key(project, "write")
    stored = keyed_service.ask(
        "POST",
        "/v1/datasets?name=a",
        writer,
        content=recording(n=30),
        headers={**CSV, "X-Request-ID": "request-7"},
    ).json()["id"]
    again = keyed_service.ask(
        "POST", "/v1/datasets?name=a", writer, content=recording(n=30), headers=CSV
    )
    assert again.status_code == 200  # nothing was changed
    entries = keyed_service.ask("GET", "/v1/audit", admin).json()["items"]
    assert [entry["action"] for entry in entries[:3]] == ["dataset.add", "key.create", "key.create"]
    first = entries[0]
    assert (first["actor"], first["object_id"]) == (key_id(writer), stored)
    assert first["request_id"] == "request-7"
    page = keyed_service.ask("GET", "/v1/audit?limit=1", admin).json()
    following = keyed_service.ask("GET", f"/v1/audit?limit=1&cursor={page['next']}", admin).json()
    assert [page["items"][0], following["items"][0]] == entries[:2]
    read_faults(keyed_service.ask("GET", "/v1/audit?cursor=x", admin), 422, "invalid")
    equations = {
        "name": "tank",
        "form": "difference",
        "states": {"x": "1"},
        "parameters": {"a": {"lower": 0, "upper": 1}},
        "equations": {"x": "a*x(k-1)"},
        "outputs": {"y": "x"},
    }
    added = keyed_service.ask("POST", "/v1/models", writer, json=equations)
    entry = keyed_service.ask("GET", "/v1/audit?limit=1", admin).json()["items"][0]
    assert entry["request_id"] == added.headers["X-Request-ID"]
    other = keyed_service.ask("GET", "/v1/audit", keyed_service.add_key()).json()["items"]
    assert stored not in {entry["object_id"] for entry in other}


def test_nothing_is_recorded_of_what_was_refused(keyed_service: Guarded) -> None:
    project = keyed_service.add_project("full", max_stored_bytes=10)
    token = keyed_service.add_key(project)
    answer = keyed_service.ask("POST", "/v1/datasets", token, content=recording(n=30), headers=CSV)
    read_faults(answer, 429, "quota")
    actions = keyed_service.ask("GET", "/v1/audit", token).json()["items"]
    assert {entry["action"] for entry in actions} == {
        "key.create",
        "project.create",
        "project.limit",
    }
    assert keyed_service.ask("GET", "/v1/datasets", token).json()["items"] == []


def test_what_is_simulated_on_request_counts_for_the_day(keyed_service: Guarded) -> None:
    project = keyed_service.add_project("busy", max_daily_evaluations=2)
    token = keyed_service.add_key(project)
    body = {
        "model": "fopdt",
        "parameters": {"K": 2.0, "T": 1.5, "L": 0.7, "y0": 0.0},
        "samples": 50,
        "sample_time": 0.1,
        "inputs": {"u": {"kind": "step"}},
    }

    def simulate(gain: float) -> Any:
        changed = {**body, "parameters": {**body["parameters"], "K": gain}}  # type: ignore[dict-item]
        return keyed_service.ask("POST", "/v1/datasets:simulate", token, json=changed)

    assert [simulate(gain).status_code for gain in (1.0, 1.0, 2.0)] == [201, 200, 201]
    read_faults(simulate(3.0), 429, "quota")
    used = keyed_service.ask("GET", "/v1/access", token).json()["used"]
    assert used["daily_evaluations"] == 2


def test_failing_keys_wait_and_too_many_of_them_are_sent_away(tmp_path: Path) -> None:
    with guard("sqlite", tmp_path) as guarded:
        token, failures = guarded.add_key(), guarded.parts.failures
        failures._most = 0
        answer = guarded.ask("GET", "/v1/jobs", "lagid_1_2")
        read_faults(answer, 503, "unavailable")
        assert answer.headers["retry-after"] == "2"
        assert guarded.ask("GET", "/v1/jobs", token).status_code == 200
        read_faults(guarded.ask("GET", "/v1/jobs"), 401, "unauthorized")  # no key is no guess


def test_a_database_that_is_away_is_told_as_everywhere(tmp_path: Path) -> None:
    with guard("sqlite", tmp_path) as guarded:
        token = guarded.add_key()
        (tmp_path / "lagid.db").rename(tmp_path / "gone.db")
        guarded.parts.database.dispose()
        (tmp_path / "lagid.db").mkdir()
        read_faults(guarded.ask("GET", "/v1/jobs", token), 503, "unavailable")
        (tmp_path / "lagid.db").rmdir()
        (tmp_path / "gone.db").rename(tmp_path / "lagid.db")
        assert guarded.ask("GET", "/v1/jobs", token).status_code == 200
