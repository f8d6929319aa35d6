"""What the web process answers while its database or its disk is away: 503, never 500."""

import errno
import sqlite3
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError
from sqlalchemy.exc import TimeoutError as NoConnection
from starlette.testclient import TestClient

from service.api import content
from service.api.app import create_app
from service.api.store_probe import PROBE_SECONDS
from service.core.process import service_metrics
from service.datasets import datasets
from service.formats import sandbox
from service.storage.storage_errors import ObjectStoreFailed
from tests.support.service.web_app import CSV, parts_of, read_faults, recording, settings_of


def away(*_args: Any, **_options: Any) -> Any:
    raise OperationalError("SELECT 1", {}, Exception("connection refused"))


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/datasets", "/v1/runs/run_1"])
def test_a_database_that_is_away_is_a_part_that_is_down(
    server: TestClient, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    monkeypatch.setattr(parts_of(server).database, "read_session", away)
    answer = server.get(path)
    assert read_faults(answer, 503, "unavailable") == []
    assert answer.headers["retry-after"] == "1"


def test_a_pool_whose_connections_are_all_in_use_is_told(
    server: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_args: Any, **_options: Any) -> Any:
        raise NoConnection("QueuePool limit of size 5 overflow 10 reached")

    count = service_metrics.store_errors.labels("database")._value.get
    before = count()
    monkeypatch.setattr(parts_of(server).database, "read_session", refuse)
    answer = server.get("/v1/jobs")
    read_faults(answer, 503, "unavailable")
    assert "all connections to the database are in use" in answer.json()["detail"]
    assert count() > before


def test_readiness_tells_a_stranger_no_address_and_writes_seldom(
    server: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        writes.append(1)
        raise ObjectStoreFailed("the object store cannot write: bucket-7 at 10.0.0.9")

    writes: list[int] = []
    parts = parts_of(server)
    monkeypatch.setattr(parts.database, "read_session", away)
    monkeypatch.setattr(parts.store, "check_writable", refuse)
    monkeypatch.setattr(parts.probe, "_tried_at", -PROBE_SECONDS)
    answers = [server.get("/readyz") for _ in range(3)]
    for answer in answers:
        read_faults(answer, 503, "unavailable")
        assert answer.json()["detail"] == "store: objects cannot be written; database: unreachable"
    assert writes == [1]
    monkeypatch.undo()
    parts.probe._tried_at = -PROBE_SECONDS
    faults = read_faults(server.get("/readyz"), 503, "unavailable")
    assert [fault["pointer"] for fault in faults] == ["/dispatcher"]


def test_a_full_disk_is_a_part_that_is_down(
    server: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_args: Any, **_options: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(content, "_save_body", full)
    answer = server.post("/v1/datasets", content=recording(), headers=CSV)
    read_faults(answer, 503, "unavailable")
    assert "a disk of the server is full" in answer.json()["detail"]
    assert answer.headers["retry-after"] == "1"


class FullFolder(TemporaryDirectory[str]):
    """A folder where the reader of an upload finds no space."""

    def __enter__(self) -> str:
        folder = super().__enter__()
        (Path(folder) / "clean.mcap").symlink_to("/dev/full")
        return folder


def test_a_full_folder_of_the_reading_process_is_no_fault_of_the_file(
    server: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sandbox, "TemporaryDirectory", FullFolder)
    answer = server.post("/v1/datasets", content=recording(period=0.07), headers=CSV)
    read_faults(answer, 503, "unavailable")
    assert "a disk of the server is full" in answer.json()["detail"]
    assert answer.headers["retry-after"] == "1"


def test_an_object_store_that_is_full_says_when_to_come_back(
    server: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_args: Any) -> None:
        raise ObjectStoreFailed("the object store cannot write an object: no space")

    monkeypatch.setattr(parts_of(server).store, "put_file", full)
    answer = server.post("/v1/datasets", content=recording(period=0.06), headers=CSV)
    read_faults(answer, 503, "unavailable")
    assert answer.headers["retry-after"] == "1"


def test_uploads_at_once_are_bounded_and_each_gives_its_place_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def post(text: bytes) -> Any:
        return client.post("/v1/datasets", content=text, headers=CSV)

    app = create_app(settings_of(tmp_path, max_uploads=1))
    with TestClient(app, raise_server_exceptions=False) as client:
        places = parts_of(client).readers.places
        assert post(recording()).status_code == 201
        read_faults(post(b"no recording"), 422, "invalid-upload")
        monkeypatch.setattr(places, "_seconds", 0.1)
        with places.hold("another"):  # as an upload that is read
            answer = post(recording(period=0.2))
        read_faults(answer, 503, "unavailable")
        assert "LAGID_MAX_UPLOADS" in answer.json()["detail"]
        assert int(answer.headers["retry-after"]) > 0
        held = []
        add_upload = datasets.add_upload

        def add(*args: Any, **options: Any) -> Any:
            held.append(places._free)
            return add_upload(*args, **options)

        monkeypatch.setattr(datasets, "add_upload", add)
        assert post(recording(period=0.2)).status_code == 201
        assert held == [0]


def test_another_fault_of_a_disk_is_not_told_as_a_full_one_and_its_words_stay_inside(
    server: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_args: Any, **_options: Any) -> None:
        raise OSError(errno.EIO, "Input/output error", "/somewhere/inside")

    monkeypatch.setattr(content, "_save_body", broken)
    answer = server.post("/v1/datasets", content=recording(), headers=CSV)
    read_faults(answer, 500, "internal")
    assert "inside" not in answer.text


def test_a_mistake_in_a_statement_is_not_told_as_a_database_that_is_away(
    server: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mistaken(*_args: Any, **_options: Any) -> None:
        try:
            sqlite3.connect(":memory:").execute("SELECT nothing FROM nowhere")
        except sqlite3.OperationalError as error:
            raise OperationalError("SELECT", {}, error) from error

    monkeypatch.setattr(parts_of(server).database, "read_session", mistaken)
    read_faults(server.get("/v1/jobs"), 500, "internal")
