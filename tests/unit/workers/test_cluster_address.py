"""A wrong address of a cluster is refused in one line, before Ray waits for it."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from workers.cluster_address import check_address, explain_failure, has_token
from workers.errors import ClusterUnavailable


def refuse(address: str) -> str:
    with pytest.raises(ClusterUnavailable) as caught:
        check_address(address)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.fixture
def listening() -> Iterator[str]:
    """The address of a port where something listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"127.0.0.1:{server.getsockname()[1]}"


@pytest.fixture
def _no_token(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))


@pytest.mark.parametrize(
    ("address", "told"),
    [
        ("127.0.0.1:1", "no Ray cluster answers at 127.0.0.1:1 (Connection refused)"),
        ("nowhere.invalid:6379", "no Ray cluster answers at nowhere.invalid:6379"),
        ("10.0.0.5", "the Ray address '10.0.0.5' is invalid: write host:port"),
        ("10.0.0.5:", "the Ray address '10.0.0.5:' is invalid: write host:port"),
        (":6379", "the Ray address ':6379' is invalid: write host:port"),
        ("10.0.0.5:0", "the Ray address '10.0.0.5:0' is invalid: write host:port"),
        ("10.0.0.5:65536", "the Ray address '10.0.0.5:65536' is invalid: write host:port"),
        ("ray://10.0.0.5:10001", "is one of Ray Client, which is not supported"),
    ],
)
def test_an_address_that_is_wrong_is_refused_with_what_would_be_right(
    address: str, told: str
) -> None:
    assert told in refuse(address)


def test_the_cluster_of_this_machine_is_found_by_ray_itself() -> None:
    check_address("auto")


@pytest.mark.usefixtures("_no_token")
def test_a_cluster_without_a_token_for_it_is_refused(listening: str) -> None:
    told = refuse(listening)
    assert told.startswith(f"there is no token for the Ray cluster at {listening}: set")


@pytest.mark.usefixtures("_no_token")
def test_a_token_is_a_variable_or_a_file_or_not_needed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, listening: str
) -> None:
    assert not has_token()
    with monkeypatch.context() as there:
        there.setenv("RAY_AUTH_MODE", "disabled")
        check_address(listening)
    with monkeypatch.context() as there:
        there.setenv("RAY_AUTH_TOKEN", "0" * 64)
        check_address(listening)
    with monkeypatch.context() as there:
        there.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "token"))
        assert not has_token()
        (tmp_path / "token").touch()
        check_address(listening)
    (tmp_path / ".ray").mkdir()
    (tmp_path / ".ray" / "auth_token").touch()
    check_address(listening)


def test_a_refused_connection_and_a_failed_start_are_told_in_one_line() -> None:
    refused = explain_failure("10.0.0.5:6379", ConnectionError("Failed to connect\nto GCS"))
    assert refused.startswith("the Ray cluster at 10.0.0.5:6379 answers, but refuses")
    assert "Most likely its token is a different one" in refused
    joined = explain_failure("10.0.0.5:6379", RuntimeError("Version\n mismatch"))
    assert joined == "the Ray cluster at 10.0.0.5:6379 could not be joined: Version mismatch"
    started = explain_failure(None, OSError("no\nspace"))
    assert started == "Ray could not be started: no space"
