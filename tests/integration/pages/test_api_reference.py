"""The page of the REST interface: Swagger UI from this server, and nothing from elsewhere."""

import re

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from tests.support.service.web_app import settings_of


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> TestClient:
    return TestClient(create_app(settings_of(tmp_path_factory.mktemp("reference"))))


def find_addresses(page: str) -> list[str]:
    return re.findall(r'(?:src|href|data-document)="([^"]+)"', page)


def test_what_the_page_loads_is_on_this_server(client: TestClient) -> None:
    loaded = find_addresses(client.get("/docs").text)
    assert [one for one in loaded if not one.startswith(("/", "#"))] == []
    files = [one for one in loaded if one.startswith("/static/") or one == "/openapi.json"]
    assert [one for one in files if client.get(one).status_code != 200] == []
    assert len([one for one in files if "swagger-ui" in one]) == 2


def test_bundles_may_be_cached_for_ever_since_their_names_have_a_version(
    client: TestClient,
) -> None:
    [script] = re.findall(r"/static/swagger-ui-[\d.]+\.js", client.get("/docs").text)
    answer = client.get(script, headers={"Accept-Encoding": "gzip"})
    assert "immutable" in answer.headers["Cache-Control"]
    assert answer.headers["Content-Encoding"] == "gzip"
    plain = client.get(script, headers={"Accept-Encoding": "identity"})
    assert plain.text == answer.text
    assert plain.headers["Content-Type"].startswith("text/javascript")
