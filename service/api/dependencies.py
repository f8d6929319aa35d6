"""Dependencies of routes: the parts of the service, sessions, and page cursors."""

import asyncio
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from threading import Event
from typing import Annotated

from fastapi import Depends, Query, Request
from sqlalchemy.orm import Session

from service.api.event_feed import EventFeed
from service.core.settings import Settings
from service.storage.objects import ObjectStore
from service.storage.sessions import Database


@dataclass(frozen=True)
class Parts:
    """The service's parts, one of each per process.

    `stopping` is set as soon as the process is asked to end. Open event streams then close.
    """

    settings: Settings
    database: Database
    store: ObjectStore
    stopping: Event = field(default_factory=Event)

    @cached_property
    def upload_places(self) -> asyncio.Semaphore:
        """Places of the uploads that are received and read at once."""
        return asyncio.Semaphore(self.settings.max_uploads)

    @cached_property
    def feed(self) -> EventFeed:
        """The events of all jobs that have a stream."""
        settings = self.settings
        return EventFeed(self.database, self.stopping, settings.poll_seconds, settings.max_streams)


def get_parts(request: Request) -> Parts:
    """Return the parts of this process."""
    parts: Parts = request.app.state.parts
    return parts


PartsDep = Annotated[Parts, Depends(get_parts)]


def _open_read_session(parts: PartsDep) -> Iterator[Session]:
    with parts.database.read_session() as session:
        yield session


def _open_write_session(parts: PartsDep) -> Iterator[Session]:
    """Open a session with one transaction: commit if the route returns, else roll back."""
    with parts.database.write_session() as session:
        yield session


# With this scope the commit happens before the answer is sent: a confirmed change is stored.
ReadSession = Annotated[Session, Depends(_open_read_session, scope="function")]
WriteSession = Annotated[Session, Depends(_open_write_session, scope="function")]

Cursor = Annotated[str | None, Query(max_length=100, description="`next` of the previous page")]
Limit = Annotated[int, Query(ge=1, le=1000, description="items per page")]
MaxPoints = Annotated[int, Query(ge=2, le=1_000_000, description="most points per line")]
