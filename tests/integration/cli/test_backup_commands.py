"""`lagid backup`, `restore` and `db keep`, beside a service that runs."""

import json
import sqlite3
import zipfile
from pathlib import Path

import httpx
import pytest

from service.api.app import create_app
from service.client.client import Client
from service.core.process.folder_lock import lock_folder, use_folder
from service.datasets import stored_recordings
from tests.support.service.commands import CommandResult, check_refusal, run_lagid
from tests.support.service.web_app import recording, settings_of
from tests.support.service.web_server import serve_in_thread


def run(folder: Path, *words: str) -> CommandResult:
    return run_lagid(*words, cwd=folder.parent, LAGID_DATA_DIR=str(folder))


def test_a_running_service_is_backed_up_and_restored_elsewhere(tmp_path: Path) -> None:
    folder, other = tmp_path / "data", tmp_path / "other"
    with serve_in_thread(create_app(settings_of(folder))) as url, Client(url) as client:
        data = client.add_dataset(recording(), "steps")
        job = client.submit({"model": "fopdt", "datasets": ["steps"], "name": "waits"})
        content = client.content(data["id"])
        done = run(folder, "backup", "lagid.zip")
        assert done.code == 0, done.stderr
        assert "1 objects" in done.stdout
        assert "exists" in check_refusal(run(folder, "backup", "lagid.zip"))
        assert run(folder, "backup", "lagid.zip", "--force").code == 0
    restored = run(other, "restore", "lagid.zip", "--json")
    assert json.loads(restored.stdout)["rows"]["jobs"] == 1
    assert run(other, "db", "check").code == 0
    with serve_in_thread(create_app(settings_of(other))) as url, Client(url) as client:
        assert client.job(job["id"])["name"] == "waits"
        assert client.content(data["id"]) == content


def test_a_damaged_object_is_told_everywhere_and_healed_by_its_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Another test may have read the same recording, and the process keeps the latest.
    monkeypatch.setattr(stored_recordings, "_recording_cache", stored_recordings._RecordingCache())
    folder, other = tmp_path / "data", tmp_path / "other"
    with serve_in_thread(create_app(settings_of(folder))) as url, Client(url) as client:
        data = client.add_dataset(recording(), "steps")
        kept = client.add_dataset(recording(200), "kept")
        sha256 = data["sha256"]
        (file,) = (folder / "objects").rglob(f"{sha256}.mcap")
        whole = file.read_bytes()
        file.write_bytes(whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:])
        for path in ("content", "signals", "content.csv"):
            answer = httpx.get(f"{url}/v1/datasets/{data['id']}/{path}")
            assert (answer.status_code, answer.json()["type"]) == (500, "/problems/damaged-object")
        checked = run(folder, "db", "check")
        assert (checked.code, checked.stderr) == (1, f"damaged: {sha256}\n")
        assert "2 objects read, 1 damaged; 0 lost" in checked.stdout
        assert run(folder, "db", "check", "--sample", "0").code == 0
        backed = run(folder, "backup", "b.zip", "--json")
        assert (backed.code, json.loads(backed.stdout)["damaged"]) == (1, [sha256])
        restored = run(other, "restore", "b.zip")
        assert (restored.code, sha256 in restored.stderr) == (1, True)
        assert client.add_dataset(recording(), "steps")["sha256"] == sha256
        assert file.read_bytes() == whole
        file.unlink()
        client.add_dataset(whole, "another name")  # the object itself, from where it was saved
        assert file.read_bytes() == whole
        assert run(folder, "db", "check").code == 0
    with serve_in_thread(create_app(settings_of(other))) as url, Client(url) as client:
        assert client.content(kept["id"])
        assert [one["name"] for one in client.datasets()] == ["kept", "steps"]


def test_a_damaged_database_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    settings_of(folder)
    assert run(folder, "db", "upgrade").code == 0
    file = folder / "lagid.db"
    with sqlite3.connect(file) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'jobs'"
        (page,) = connection.execute(query).fetchone()
        (size,) = connection.execute("PRAGMA page_size").fetchone()
    connection.close()
    content = bytearray(file.read_bytes())
    content[(page - 1) * size : (page - 1) * size + 64] = bytes(range(1, 65))
    file.write_bytes(content)
    checked = run(folder, "db", "check")
    assert checked.code == 1
    assert "the database is damaged: " in checked.stderr


def test_mistakes_in_backup_and_restore_are_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    settings_of(folder)
    assert "no database" in check_refusal(run(tmp_path / "none", "backup", "b.zip"))
    assert "no folder" in check_refusal(run(folder, "backup", "no/b.zip"), 2)
    assert "no file" in check_refusal(run(folder, "restore", "b.zip"))
    (tmp_path / "b.zip").write_text("text")
    assert "no complete ZIP" in check_refusal(run(folder, "restore", "b.zip"))
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        archive.writestr("a", "b")
    assert "`lagid backup` did not write" in check_refusal(run(folder, "restore", "b.zip"))
    with use_folder(folder):  # as a web process without a dispatcher
        assert "a process of lagid uses" in check_refusal(run(folder, "restore", "b.zip"))
    folder.chmod(0o700)  # else that is told too
    with use_folder(folder, alone=True):
        told = check_refusal(run(folder, "serve", "--no-dispatcher", "--port", "0"))
        assert "`lagid restore` writes" in told
    with lock_folder(folder, "advice") as lock:
        lock.describe_holder("a service")
        assert "a service" in check_refusal(run(folder, "restore", "b.zip"))


def test_a_project_is_told_how_long_to_keep_jobs(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    settings_of(folder)
    line = "proj_default keeps ended jobs"
    assert run(folder, "db", "keep").stdout == f"{line} for ever (default)\n"
    assert run(folder, "db", "keep", "365").stdout == f"{line} for 365 days\n"
    assert run(folder, "db", "keep", "forever").stdout == f"{line} for ever\n"
    shown = json.loads(run(folder, "db", "keep", "default", "--json").stdout)
    assert shown == {"project": "proj_default", "keep_days": None, "is_default": True}
    assert "need more than 0" in check_refusal(run(folder, "db", "keep", "0"), 2)
    assert "need a number" in check_refusal(run(folder, "db", "keep", "long"), 2)
    assert "project 'x'" in check_refusal(run(folder, "db", "keep", "--project", "x"))
    run(folder, "project", "create", "tubes")
    told = run(folder, "db", "keep", "9", "--project", "tubes").stdout
    assert told.endswith(" keeps ended jobs for 9 days\n")
    log = run(folder, "audit", "--project", "tubes", "--json").stdout
    assert [entry["action"] for entry in json.loads(log)] == ["project.keep", "project.create"]
