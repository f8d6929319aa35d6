"""The start of a dispatcher as seen from outside: heartbeat, health command, metrics port."""

import json
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx
import pytest

from service.cli import health_command
from service.client.embedded import find_free_port
from service.core.process import service_metrics
from service.core.settings import Settings
from service.dispatch import start
from service.queue.dispatchers import DispatcherRepository, describe_start
from service.storage.sessions import Database
from tests.support.service.commands import check_refusal, run_lagid
from tests.support.service.web_app import settings_of
from tests.support.service.web_server import serve_in_thread


@pytest.fixture
def url(database: Database) -> str:
    return database.engine.url.render_as_string(hide_password=False)


@pytest.fixture
def starting(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[start.DispatcherStart]:
    """A dispatcher that has announced its start, with nothing to compile."""
    monkeypatch.setattr(start, "warm_up_worker", lambda: None)
    announced = start.DispatcherStart(Settings(data_dir=tmp_path / "data", database_url=url))
    announced.announce()
    yield announced
    announced.close()


def test_a_dispatcher_that_starts_says_what_it_waits_for_until_it_is_ready(
    database: Database, starting: start.DispatcherStart
) -> None:
    def describe() -> str | None:
        with database.read_session() as session:
            (row,) = DispatcherRepository(session).list_alive()
            return describe_start(row)

    starting.announce()  # once is enough
    assert re.fullmatch(
        r"a dispatcher is starting \(\d+ s\): Ray is starting and the search is compiling and "
        "Ray's workers are starting",
        describe() or "",
    )
    starting.compile_search()
    starting.compile_search()
    starting.finish("ray")
    assert str(describe()).endswith(": Ray's workers are starting")
    starting.finish("workers")
    starting.leases.start_heartbeat({"cpus": 2})  # as a dispatcher that is ready does
    assert describe() is None
    starting.close()
    with database.read_session() as session:
        assert DispatcherRepository(session).list_all() == []


def test_a_start_that_fails_leaves_no_dispatcher(
    database: Database, starting: start.DispatcherStart
) -> None:
    starting.close()
    with database.read_session() as session:
        assert DispatcherRepository(session).list_all() == []


def test_the_health_of_a_dispatcher_is_the_heartbeat_of_its_host(
    url: str, starting: start.DispatcherStart, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = {"LAGID_DATABASE_URL": url}
    assert "Ray is starting" in run_lagid("health", "dispatcher", **words).stdout
    starting.leases.start_heartbeat({})
    found = run_lagid("health", "dispatcher", **words)
    assert (found.code, found.stdout) == (0, f"{starting.leases.owner} is ready\n")
    monkeypatch.setattr(socket, "gethostname", lambda: "other")
    line = check_refusal(run_lagid("health", "dispatcher", **words))
    assert "no dispatcher of the host other" in line


def test_the_health_of_the_web_process_is_its_answer(tmp_path: Path) -> None:
    from service.api.app import create_app

    with serve_in_thread(create_app(settings_of(tmp_path))) as url:
        port = url.rpartition(":")[2]
        found = run_lagid("health", "web", "--host", "0.0.0.0", "--port", port)
        assert (found.code, found.stdout) == (0, f"{url}/healthz answers\n")
    line = check_refusal(run_lagid("health", "web", "--port", port))
    assert "does not answer as it should" in line


def test_the_health_of_ray_is_its_socket() -> None:
    with TemporaryDirectory() as folder:  # a path of a socket must be short
        words = {"RAY_TMPDIR": folder}
        assert "Ray does not answer at" in check_refusal(run_lagid("health", "ray", **words))
        path = Path(folder, health_command.RAY_SOCKET)
        path.parent.mkdir(parents=True)
        with socket.socket(socket.AF_UNIX) as raylet:
            raylet.bind(str(path))
            raylet.listen()
            found = run_lagid("health", "ray", "--json", **words)
            assert json.loads(found.stdout) == {"part": "ray", "detail": f"Ray answers at {path}"}


def test_a_dispatcher_answers_prometheus_at_its_port_and_works_on_without_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    port = find_free_port()
    service_metrics.serve_metrics("127.0.0.1", port)
    text = httpx.get(f"http://127.0.0.1:{port}/metrics").text
    assert "lagid_evaluations_total" in text
    service_metrics.serve_metrics("127.0.0.1", port)
    assert re.search(f"metrics are not served at 127.0.0.1:{port}: Address", caplog.text)
