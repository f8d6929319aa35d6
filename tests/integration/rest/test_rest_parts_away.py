"""What the web process answers while its database or its disk is away: 503, never 500."""

import errno
import sqlite3
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError
from starlette.testclient import TestClient

from service.api import content
from tests.rest import CSV, parts_of, recording, refused


def away(*_args: Any, **_options: Any) -> Any:
    raise OperationalError("SELECT 1", {}, Exception("connection refused"))


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/datasets", "/v1/runs/run_1", "/metrics"])
def test_a_database_that_is_away_is_a_part_that_is_down(
    server: TestClient, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    monkeypatch.setattr(parts_of(server).database, "read_session", away)
    answer = server.get(path)
    assert refused(answer, 503, "unavailable") == []
    assert answer.headers["retry-after"] == "1"


def test_a_full_disk_is_a_part_that_is_down(
    server: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_args: Any, **_options: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(content, "_save_body", full)
    answer = server.post("/v1/datasets", content=recording(), headers=CSV)
    refused(answer, 503, "unavailable")
    assert "a disk of the server is full" in answer.json()["detail"]


def test_another_fault_of_a_disk_is_not_told_as_a_full_one_and_its_words_stay_inside(
    server: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_args: Any, **_options: Any) -> None:
        raise OSError(errno.EIO, "Input/output error", "/somewhere/inside")

    monkeypatch.setattr(content, "_save_body", broken)
    answer = server.post("/v1/datasets", content=recording(), headers=CSV)
    refused(answer, 500, "internal")
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
    refused(server.get("/v1/jobs"), 500, "internal")
