"""Places for heavy requests, which projects share: some run, some wait, all others get 503.

A simulation of a million samples takes seconds of a core and hundreds of megabytes. Every request
that waits in a thread holds one of the threads that all others need.

A free place goes to the project that has the fewest, and among those to the one that was served
least recently. That is max-min fairness (Bertsekas and Gallager, Data Networks, 1992, 6.5.2). One
project cannot have all places, so that another one need not wait for the end of long requests.
"""

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import Future
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from threading import Lock

from service.core.errors import ServiceBusy

MAX_RUNNING = 3
MAX_OF_PROJECT = 2
MAX_WAITING = 8
"""Requests of one project that wait."""
MAX_WAIT_SECONDS = 20.0


class FairPlaces:
    """Places for requests of several projects.

    Parameters
    ----------
    at_once : int
        All places.
    of_project : int
        Places of one project at most.
    waiting : int
        Requests of one project that may wait.
    what : str
        What is done there, for the answer to a request that gets no place.
    seconds : float
        How long a request waits.
    """

    def __init__(
        self,
        at_once: int,
        of_project: int,
        *,
        waiting: int = MAX_WAITING,
        what: str = "simulations",
        seconds: float = MAX_WAIT_SECONDS,
    ) -> None:
        self._free, self._of_project = at_once, of_project
        self._most_waiting, self._what, self._seconds = waiting, what, seconds
        self._held: Counter[str] = Counter()
        self._waiting: dict[str, deque[Future[None]]] = {}  # the one served longest ago first
        self._lock = Lock()

    @contextmanager
    def hold(self, project: str) -> Iterator[None]:
        """Hold a place for the length of the block.

        Raises
        ------
        ServiceBusy
            If too many requests of the project wait already, or no place became free in time.
        """
        place = self._ask(project)
        try:
            place.result(self._seconds)
        except TimeoutError:
            self._give_back(project, place)
            raise self._build_refusal() from None
        try:
            yield
        finally:
            self._give_back(project, place)

    @asynccontextmanager
    async def hold_awaiting(self, project: str) -> AsyncIterator[None]:
        """Do the same without a thread.

        Raises
        ------
        ServiceBusy
            As `hold`.
        """
        place = self._ask(project)
        try:
            try:
                async with asyncio.timeout(self._seconds):
                    await asyncio.wrap_future(place)
            except TimeoutError:
                raise self._build_refusal() from None
            yield
        finally:
            self._give_back(project, place)

    def _ask(self, project: str) -> "Future[None]":
        place: Future[None] = Future()
        with self._lock:
            queue = self._waiting.setdefault(project, deque())
            queue.append(place)
            self._serve()
            if len(queue) > self._most_waiting and not place.done():
                self._withdraw(project, place)
                raise ServiceBusy(
                    f"too many {self._what} of your project are waiting; ask again in a few seconds"
                )
        return place

    def _give_back(self, project: str, place: "Future[None]") -> None:
        """Take back a place, or the wish for one."""
        with self._lock:
            if place in self._waiting.get(project, ()):
                self._withdraw(project, place)
                return
            self._free += 1
            self._held[project] -= 1
            self._serve()

    def _withdraw(self, project: str, place: "Future[None]") -> None:
        self._waiting[project].remove(place)
        if not self._waiting[project]:
            del self._waiting[project]

    def _serve(self) -> None:
        """Give the free places away."""
        while self._free:
            able = [one for one in self._waiting if self._held[one] < self._of_project]
            if not able:
                return
            project = min(able, key=lambda one: self._held[one])
            queue = self._waiting.pop(project)
            place = queue.popleft()
            if queue:
                self._waiting[project] = queue  # now the one served last
            self._free -= 1
            self._held[project] += 1
            if place.set_running_or_notify_cancel():
                place.set_result(None)

    def _build_refusal(self) -> ServiceBusy:
        return ServiceBusy(
            f"no place for {self._what} became free within {self._seconds:g} s; ask again"
        )


@dataclass(frozen=True, slots=True)
class ReaderPlaces:
    """Places of child processes that read uploads or do long simulations.

    Attributes
    ----------
    memory_bytes : int
        Memory of each child.
    """

    places: FairPlaces
    memory_bytes: int


simulation_places = FairPlaces(MAX_RUNNING, MAX_OF_PROJECT)
"""Places of this process for simulations and for what compiles models."""
