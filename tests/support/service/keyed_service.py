"""A service that asks for keys, with several projects, on SQLite and on PostgreSQL."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from starlette.testclient import TestClient

from service.access.keys import create_key
from service.access.scopes import Scope
from service.api.app import create_app
from service.api.requests.dependencies import Parts
from service.repositories.project_rows import ProjectRepository
from service.storage.migrate import upgrade_database
from service.storage.sessions import SessionOwner
from service.storage.tables import DEFAULT_PROJECT
from tests.support.service.web_app import parts_of, settings_of
from tests.support.storage.databases import empty_postgres


class Guarded:
    """The service, asked without a key unless a test names one."""

    def __init__(self, client: TestClient) -> None:
        self.client = client

    @property
    def parts(self) -> Parts:
        return parts_of(self.client)

    def parts_for(self, project: str) -> Parts:
        """The parts as a request of a project has them."""
        return self.parts.open_for(SessionOwner(project, "test"))

    def add_project(self, name: str, **limits: int) -> str:
        with self.parts.database.write_session() as session:
            repository = ProjectRepository(session)
            project = repository.add(name).id
            if limits:
                repository.change_limits(project, limits)
            return project

    def add_key(
        self, project: str = DEFAULT_PROJECT, scope: Scope = "admin", days: int | None = None
    ) -> str:
        with self.parts.database.write_session() as session:
            return create_key(session, project, f"{scope} of {project}", scope, days).token

    def ask(self, method: str, path: str, key: str | None = None, **arguments: Any) -> Any:
        headers: Mapping[str, str] = arguments.pop("headers", {})
        return self.client.request(
            method,
            path,
            headers={**make_header(key), **headers},
            follow_redirects=False,
            **arguments,
        )


def make_header(key: str | None) -> dict[str, str]:
    return {} if key is None else {"Authorization": f"Bearer {key}"}


@contextmanager
def guard(kind: str, folder: Path, **changes: Any) -> Iterator[Guarded]:
    """A service of its own that asks for keys; answers to wrong ones do not wait."""
    changes = {"auth": "keys", **changes}
    if kind == "sqlite":
        with _open(folder, **changes) as guarded:
            yield guarded
        return
    with empty_postgres() as database:
        upgrade_database(database)
        url = database.engine.url.render_as_string(hide_password=False)
        with _open(folder, database_url=url, **changes) as guarded:
            yield guarded


@contextmanager
def _open(folder: Path, **changes: Any) -> Iterator[Guarded]:
    app = create_app(settings_of(folder, **changes))
    with TestClient(app, raise_server_exceptions=False) as client:
        app.state.parts.failures._seconds = 0.0
        yield Guarded(client)
