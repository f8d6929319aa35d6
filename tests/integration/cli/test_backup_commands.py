"""`lagid backup`, `restore` and `db keep`, beside a service that runs."""

import json
import zipfile
from pathlib import Path

from service.api.app import create_app
from service.client.client import Client
from service.core.process.folder_lock import lock_folder
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
