"""A service that a proxy publishes below a path: every address that it gives has that path."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import ValidationError
from starlette.testclient import TestClient

from service.api.app import create_app
from service.core.settings import Settings
from service.pages.render import STATIC_FOLDER
from tests.support.service.filled_folder import FilledFolder
from tests.support.service.web_app import CSV, recording, settings_of

ROOT_PATH = "/tools/lagid"
ADDRESSES = re.compile(r'(?:href|src|action|data-url|data-profile)="(/[^"]*)"')


@pytest.fixture(scope="module")
def server(folder: Path, filled_folder: FilledFolder) -> Iterator[TestClient]:
    """The application with LAGID_ROOT_PATH; the path of a request is that behind the proxy."""
    assert filled_folder.finished
    with TestClient(create_app(settings_of(folder, root_path=ROOT_PATH))) as client:
        yield client


def list_addresses(text: str) -> set[str]:
    return {address.replace("&amp;", "&") for address in ADDRESSES.findall(text)}


def test_every_address_of_every_page_has_the_root_path_and_answers(
    server: TestClient, filled_folder: FilledFolder
) -> None:
    ways = [f"{ROOT_PATH}/", f"{ROOT_PATH}/jobs/{filled_folder.finished}", f"{ROOT_PATH}/nothing"]
    seen: set[str] = set()
    while ways and len(seen) < 60:
        way = ways.pop(0)
        answer = server.get(way, headers={"accept": "text/html"})
        assert answer.is_success == (not way.endswith("/nothing")), (way, answer.text[:300])
        if not answer.headers["content-type"].startswith("text/html"):
            continue
        addresses = list_addresses(answer.text)
        assert all(address.startswith(f"{ROOT_PATH}/") for address in addresses), (way, addresses)
        fresh = {address for address in addresses if ":profile" not in address} - seen
        seen |= fresh
        ways += sorted(address.partition("#")[0] for address in fresh)
    assert {f"{ROOT_PATH}/datasets", f"{ROOT_PATH}/docs", f"{ROOT_PATH}/static/lagid.css"} <= seen
    assert len(seen) >= 40


@pytest.mark.parametrize("prefix", [ROOT_PATH, ""], ids=["kept", "stripped by the proxy"])
def test_rest_answers_with_the_root_path_whether_or_not_a_proxy_strips_it(
    server: TestClient, prefix: str
) -> None:
    stored = server.post(f"{prefix}/v1/datasets", content=recording(40), headers=CSV)
    address = stored.headers["location"]
    assert address == f"{ROOT_PATH}/v1/datasets/{stored.json()['id']}"
    assert server.get(address).json() == server.get(address.removeprefix(ROOT_PATH)).json()
    problem = server.get(f"{prefix}/v1/jobs/none").json()
    assert problem["type"] == f"{ROOT_PATH}/problems/not-found"
    assert problem["instance"] == f"{ROOT_PATH}/v1/jobs/none"
    assert "does not exist" in server.get(problem["type"]).text
    assert server.get(f"{prefix}/openapi.json").json()["servers"] == [{"url": ROOT_PATH}]


def test_reports_and_commands_name_the_whole_address(
    server: TestClient, filled_folder: FilledFolder
) -> None:
    page = server.get(f"{ROOT_PATH}/jobs/{filled_folder.finished}").text
    assert f"http://testserver{ROOT_PATH}/v1/jobs" in page
    report = server.get(f"{ROOT_PATH}/v1/jobs/{filled_folder.finished}/report").text
    assert list_addresses(report) == set()  # it needs no server


def test_events_are_streamed_below_the_root_path(
    server: TestClient, filled_folder: FilledFolder
) -> None:
    text = server.get(f"{ROOT_PATH}/v1/jobs/{filled_folder.finished}/events").text
    assert "event: end" in text


def test_scripts_ask_for_paths_of_the_service_only_by_its_address() -> None:
    for script in STATIC_FOLDER.glob("*.js"):
        for line in script.read_text(encoding="utf-8").splitlines():
            for place in re.finditer(r"['`]/(v1|jobs|pages|datasets|runs|static)\b", line):
                assert line[: place.start()].endswith("address("), (script.name, line)


def test_the_root_path_without_a_slash_is_the_first_page(server: TestClient) -> None:
    assert server.get(ROOT_PATH, follow_redirects=False).status_code == 200


@pytest.mark.parametrize("path", ["lagid", "/a b", "//x", "/a?b", "http://x/"])
def test_a_root_path_that_is_none_is_refused(path: str) -> None:
    with pytest.raises(ValidationError, match="root_path"):
        Settings(root_path=path)


def test_a_slash_at_the_end_of_the_root_path_is_left_out() -> None:
    assert Settings(root_path="/lagid/").root_path == "/lagid"
    assert Settings(root_path="/").root_path == ""
