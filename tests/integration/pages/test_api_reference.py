"""The page of the REST interface: complete, and nothing on it comes from elsewhere."""

import re

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from tests.rest import settings_of


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> TestClient:
    return TestClient(create_app(settings_of(tmp_path_factory.mktemp("reference"))))


def test_every_operation_of_the_openapi_document_is_on_the_page(client: TestClient) -> None:
    page = client.get("/docs").text
    document = client.get("/openapi.json").json()
    for path, item in document["paths"].items():
        for method in item:
            assert f"{method.upper()} {path}" in page


def test_the_page_shows_the_fields_of_a_job_with_their_defaults(client: TestClient) -> None:
    page = client.get("/docs").text
    job = page[page.index("POST /v1/jobs<") :]
    assert re.search(r"<code>prediction</code></td><td>simulation \| one-step</td>", job)
    assert re.search(r"<code>datasets</code> \(required\)</td><td>list of string", job)
    assert "<summary>Example</summary><pre>{" in job
    assert "&#34;model&#34;: &#34;fopdt&#34;" in job


def test_the_page_loads_nothing_from_elsewhere(client: TestClient) -> None:
    loaded = re.findall(r'(?:src|href)="([^"]+)"', client.get("/docs").text)
    assert loaded
    assert [one for one in loaded if not one.startswith(("/", "#"))] == []
