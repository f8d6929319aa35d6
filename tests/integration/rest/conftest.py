"""The web application on a fresh data folder, with a recording and a model in it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from tests.support.service.tube_batch import ServedBatch, serve_batch
from tests.support.service.web_app import recording, settings_of, store_csv


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """One application for the tests of a module, without a dispatcher."""
    app = create_app(settings_of(tmp_path_factory.mktemp("data"), max_upload_bytes=200_000))
    with TestClient(app, raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="module")
def dataset(server: TestClient) -> str:
    """Identifier of a stored recording of 30 s with channels u and y."""
    return store_csv(server, recording())


@pytest.fixture
def own(tmp_path: Path) -> Iterator[TestClient]:
    """An application of the test's own."""
    with TestClient(create_app(settings_of(tmp_path)), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="module")
def served_batch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedBatch]:
    """An application that has the batch of tubes."""
    with serve_batch(tmp_path_factory.mktemp("batch")) as batch:
        yield batch
