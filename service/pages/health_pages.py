"""Pages of the operator: health of all parts, and settings in effect."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.core.settings import Settings
from service.core.shown_settings import list_settings
from service.pages.render import render_template
from service.queue.dispatchers import DispatcherRepository, describe_start
from service.queue.leases import count_held_parcels
from service.queue.queue_state import QueueState, read_queue_state
from service.storage import migrate
from service.storage.sessions import Database
from service.storage.tables import DispatcherHeartbeat

PARTS = {
    "/store": "objects can be written",
    "/database": "its tables are of this version",
    "/dispatcher": "at least one claims jobs",
}
"""Parts of the service, and what a good one does."""
PACKAGES = ("lagid", "ray", "numba", "numpy", "sqlalchemy")


@dataclass(frozen=True, slots=True)
class PartView:
    """A part of the service, whether it works, and why not."""

    name: str
    works: bool
    text: str


@dataclass(frozen=True, slots=True)
class DispatcherView:
    """A dispatcher as its last heartbeat told; ages in s."""

    owner: str
    state: str
    is_alive: bool
    version: str
    cpus: int | None
    wanted: int
    parcels: int
    started_at: datetime
    seen_at: datetime


def health_page(
    database: Database,
    settings: Settings,
    failures: Mapping[str, str],
    objects: str,
    *,
    is_admin: bool,
) -> str:
    """Render what works and what does not.

    Parameters
    ----------
    failures : mapping
        Those of ``/readyz``, by their part.
    objects : str
        What was found when stored objects were read.
    """
    queue: QueueState | None = None
    dispatchers: Sequence[DispatcherView] = ()
    try:
        with database.read_session() as session:
            queue, dispatchers = read_queue_state(session), _list_dispatchers(session)
    except SQLAlchemyError:
        pass  # `failures` says so
    return render_template(
        "health.html",
        parts=[
            PartView(part.removeprefix("/"), part not in failures, failures.get(part, text))
            for part, text in PARTS.items()
        ],
        queue=queue,
        dispatchers=dispatchers,
        facts=[*_list_versions(database, settings), ("stored objects", objects)],
        is_admin=is_admin,
    )


def settings_page(settings: Settings) -> str:
    """Render the settings in effect in this web process."""
    return render_template("settings.html", settings=list_settings(settings))


def _list_dispatchers(session: Session) -> list[DispatcherView]:
    repository = DispatcherRepository(session)
    alive = {one.owner for one in repository.list_alive()}
    parcels = count_held_parcels(session)
    return [
        DispatcherView(
            owner=one.owner,
            state=_describe_state(one, is_alive=one.owner in alive),
            is_alive=one.owner in alive,
            version=one.details["version"],
            cpus=one.details.get("cpus"),
            wanted=one.wanted_cores,
            parcels=parcels.get(one.owner, 0),
            started_at=one.started_at,
            seen_at=one.seen_at,
        )
        for one in repository.list_all()
    ]


def _describe_state(dispatcher: DispatcherHeartbeat, *, is_alive: bool) -> str:
    if not is_alive:
        return "silent"
    return describe_start(dispatcher) or "ready"


def _list_versions(database: Database, settings: Settings) -> list[tuple[str, str]]:
    kind = "SQLite" if database.is_sqlite else "PostgreSQL"
    number = ".".join(map(str, database.engine.dialect.server_version_info or ()))
    try:
        revision = migrate.read_current_revision(database) or "none"
    except SQLAlchemyError:
        revision = "unknown"
    packages = [(name, _find_version(name)) for name in PACKAGES]
    return [
        *packages,
        ("Python", platform.python_version()),
        (kind, f"{number}, tables {revision}"),
        ("object store", settings.store_location.partition("://")[0]),
        ("keys", settings.auth_mode),
        ("time of the server", datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")),
    ]


def _find_version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
