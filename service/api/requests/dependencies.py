"""Dependencies of routes: the parts of the service, sessions, and page cursors."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from threading import Event
from typing import Annotated

from fastapi import Depends, Query, Request
from sqlalchemy.orm import Session

from service.access.callers import Caller
from service.api.event_feed import EventFeed
from service.api.requests.failure_delay import FailureDelay
from service.api.requests.request_log import get_request_id
from service.api.store_probe import StoreProbe
from service.core.process.concurrency import FairPlaces, ReaderPlaces
from service.core.settings import Settings
from service.storage.objects import ObjectStore
from service.storage.sessions import Database, SessionOwner
from service.upkeep.scrubber import Scrubber

MAX_WAITING_UPLOADS = 200
"""Uploads of one project that wait for a place; they need neither thread nor disk."""


@dataclass(frozen=True)
class Parts:
    """The service's parts, one of each per process.

    Attributes
    ----------
    database : Database
        For a request, that of its caller: it shows the caller's project alone.
    stopping : Event
        Set as soon as the process is asked to end. Open event streams then close.
    upload_places : FairPlaces
        Places of the uploads that are received.
    readers : ReaderPlaces
        Places of the child processes that read uploads or do long simulations.
    feed : EventFeed
        The events of all jobs that have a stream.
    probe : StoreProbe
        Tells whether objects can be written.
    scrubber : Scrubber
        Reads the stored objects now and then.
    failures : FailureDelay
        Delays the answers to wrong keys.
    """

    settings: Settings
    database: Database
    store: ObjectStore
    stopping: Event
    upload_places: FairPlaces
    readers: ReaderPlaces
    feed: EventFeed
    probe: StoreProbe
    scrubber: Scrubber
    failures: FailureDelay = field(default_factory=FailureDelay)

    @classmethod
    def build(cls, settings: Settings, database: Database, store: ObjectStore) -> "Parts":
        """Build the parts of a process."""
        stopping = Event()
        feed = EventFeed(database, stopping, settings.poll_seconds, settings.max_streams)
        most = settings.max_uploads
        build = partial(FairPlaces, waiting=MAX_WAITING_UPLOADS, what="uploads (LAGID_MAX_UPLOADS)")
        return cls(
            settings,
            database,
            store,
            stopping,
            # A body that arrives slowly takes a place of its own project alone.
            upload_places=build(settings.max_connections, most),
            readers=ReaderPlaces(
                build(most, max(1, most - 1), what="uploads and simulations (LAGID_MAX_UPLOADS)"),
                settings.reader_memory_bytes,
            ),
            feed=feed,
            probe=StoreProbe(store),
            scrubber=Scrubber(store, settings.scrub_days),
        )

    def open_for(self, owner: SessionOwner) -> "Parts":
        """Return the same parts for requests of an owner."""
        return replace(self, database=self.database.open_for(owner))


def get_caller(request: Request) -> Caller:
    """Return who sends the request; `service.api.requests.access_check` has found it."""
    caller: Caller = request.state.caller
    return caller


CallerDep = Annotated[Caller, Depends(get_caller)]


def get_parts(request: Request, caller: CallerDep) -> Parts:
    """Return the parts of this process for the caller."""
    parts: Parts = request.app.state.parts
    return parts.open_for(caller.to_owner(get_request_id(request)))


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
