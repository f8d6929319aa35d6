"""`lagid key`, `lagid project` and `lagid audit`, and `lagid serve` that asks for keys."""

import json
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from tests.support.service.commands import check_refusal, run_lagid
from tests.support.service.web_app import recording, settings_of
from tests.support.service.web_server import serve_in_thread


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    settings_of(tmp_path)
    return tmp_path


def read_json(folder: Path, *words: object) -> Any:
    result = run_lagid(*words, "--data-dir", folder, "--json")
    assert result.code == 0, result.stderr
    return json.loads(result.stdout)


def test_a_key_is_printed_alone_and_opens_the_service_until_it_is_revoked(folder: Path) -> None:
    made = run_lagid("key", "create", "laptop", "--scope", "read", "--data-dir", folder)
    token = made.stdout.strip()
    assert token.startswith("lagid_")
    assert "\n" not in token
    assert "Copy it now" in made.stderr
    (listed,) = read_json(folder, "key", "list")
    assert (listed["name"], listed["scope"], listed["state"]) == ("laptop", "read", "valid")
    header = {"Authorization": f"Bearer {token}"}
    with TestClient(create_app(settings_of(folder, auth="keys"))) as client:
        assert client.get("/v1/jobs", headers=header).status_code == 200
        assert read_json(folder, "key", "revoke", listed["id"])["state"] == "revoked"
        assert client.get("/v1/jobs", headers=header).status_code == 401
    text = run_lagid("key", "list", "--data-dir", folder).stdout
    assert token not in text
    assert "revoked" in text


def test_a_key_belongs_to_a_project_and_ends(folder: Path) -> None:
    project = read_json(folder, "project", "create", "tubes")
    assert (project["name"], project["max_open_jobs"]) == ("tubes", None)
    key = read_json(folder, "key", "create", "a", "--project", "tubes", "--days", 2)
    assert key["project"] == "tubes"
    assert key["expires"]
    assert key["key"].startswith("lagid_")
    assert read_json(folder, "key", "list", "--project", "default") == []
    assert [row["id"] for row in read_json(folder, "key", "list")] == [key["id"]]


def test_limits_are_set_and_removed(folder: Path) -> None:
    words = ("project", "limit", "default")
    assert read_json(folder, *words, "--max-stored-bytes", 9)["max_stored_bytes"] == 9
    changed = read_json(folder, *words, "--max-open-runs", 7, "--max-stored-bytes", "none")
    assert (changed["max_open_runs"], changed["max_stored_bytes"]) == (7, None)
    (listed,) = read_json(folder, "project", "list")
    assert (listed["max_open_runs"], listed["stored_bytes"]) == (7, 0)
    text = run_lagid("project", "limit", "default", "--max-open-runs", "none", "--data-dir", folder)
    assert "max open runs none" in text.stdout


def test_commands_send_the_key_of_the_environment(folder: Path) -> None:
    key = read_json(folder, "key", "create", "a", "--scope", "write")["key"]
    record = folder / "steps.csv"
    record.write_bytes(recording())
    with serve_in_thread(create_app(settings_of(folder, auth="keys"))) as url:
        line = check_refusal(run_lagid("jobs", LAGID_URL=url))
        assert "LAGID_API_KEY" in line
        known = {"LAGID_URL": url, "LAGID_API_KEY": key}
        assert run_lagid("dataset", "add", record, **known).code == 0
        body = folder / "job.yaml"
        body.write_text("model: fopdt\ndatasets: [steps]\n")
        assert run_lagid("submit", body, **known).code == 0
        assert "fopdt" in run_lagid("jobs", "--url", url, "--key", key).stdout
        wrong = run_lagid("jobs", "--key", "lagid_1_2", LAGID_URL=url)
        logged, told = wrong.stderr.splitlines()  # the server writes to the same stream here
        assert "refused a wrong key, the last from 127.0.0.1; it names key_1" in logged
        assert (wrong.code, "the API key is unknown" in told) == (1, True)


def test_the_audit_log_is_listed(folder: Path) -> None:
    read_json(folder, "project", "create", "tubes")
    read_json(folder, "key", "create", "a", "--project", "tubes")
    read_json(folder, "key", "create", "b")
    entries = read_json(folder, "audit")
    assert [entry["action"] for entry in entries] == ["key.create", "key.create", "project.create"]
    assert {entry["actor"] for entry in entries} == {"command line"}
    assert len(read_json(folder, "audit", "--project", "tubes")) == 2
    assert "… and 2 more" in run_lagid("audit", "--limit", 1, "--data-dir", folder).stdout


@pytest.mark.parametrize(
    ("words", "code", "part"),
    [
        (("key", "create", "a", "--scope", "all"), 2, "need read, write, admin"),
        (("key", "create", " "), 2, "name: found"),
        (("key", "create", "a", "--days", 0), 2, "days: found 0"),
        (("key", "create", "a", "--project", "no"), 1, "there is no project 'no'"),
        (("key", "revoke", "key_0"), 1, "there is no key key_0"),
        (("project", "create", "default"), 1, "there is a project 'default' already"),
        (("project", "create", ""), 2, "is no name"),
        (("project", "limit", "default"), 2, "name a limit"),
        (("project", "limit", "default", "--max-open-jobs", "x"), 2, "need a whole number"),
    ],
)
def test_a_mistake_is_one_line(
    folder: Path, words: tuple[object, ...], code: int, part: str
) -> None:
    assert part in check_refusal(run_lagid(*words, "--data-dir", folder), code)


@pytest.mark.parametrize("changes", [{}, {"LAGID_AUTH": "keys"}])
def test_a_service_that_nobody_could_use_does_not_start(
    folder: Path, changes: dict[str, str]
) -> None:
    host = () if changes else ("--host", "0.0.0.0")
    line = check_refusal(run_lagid("serve", *host, "--data-dir", folder, **changes))
    assert "there is none" in line
    assert "lagid key create" in line


def test_an_open_service_without_keys_needs_two_settings(folder: Path) -> None:
    words = ("serve", "--host", "0.0.0.0", "--data-dir", folder)
    assert "LAGID_ALLOW_OPEN_HOST" in check_refusal(run_lagid(*words, LAGID_AUTH="off"))


def test_users_of_a_proxy_need_a_project(folder: Path) -> None:
    changes = {"LAGID_AUTH": "proxy", "LAGID_PROXY_PROJECT": "no"}
    line = check_refusal(run_lagid("serve", "--data-dir", folder, **changes))
    assert line == "lagid: LAGID_PROXY_PROJECT: there is no project 'no'"
