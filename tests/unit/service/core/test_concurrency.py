"""Places for what is heavy: projects share them, some wait, the others are refused."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from threading import Event

import pytest

from service.core.errors import ServiceBusy
from service.core.process.concurrency import FairPlaces
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.web_app import await_in_thread


class Guests:
    """Requests that hold their places until they are told to leave."""

    def __init__(self, places: FairPlaces) -> None:
        self.places, self.pool = places, ThreadPoolExecutor(8)
        self.served: list[str] = []
        self.leave: dict[str, Event] = {}

    def send(self, name: str) -> "Future[None]":
        """Send a request; the first letter of its name is its project."""
        self.leave[name] = Event()
        asked = len(self._queue(name[0])) + len(self.served)
        sent = self.pool.submit(self._work, name)
        wait_until(lambda: len(self._queue(name[0])) + len(self.served) > asked or sent.done())
        return sent

    def end(self, name: str, then: int) -> None:
        """Let a request leave, until `then` of them were served."""
        self.leave[name].set()
        wait_until(lambda: len(self.served) == then)

    def _queue(self, project: str) -> list[object]:
        return list(self.places._waiting.get(project, ()))

    def _work(self, name: str) -> None:
        with self.places.hold(name[0]):
            self.served.append(name)
            assert self.leave[name].wait(LIMIT_SECONDS)


def wait_until(happens: Callable[[], bool]) -> None:
    pause = Event()
    for _ in range(int(LIMIT_SECONDS / 0.01)):
        if happens():
            return
        pause.wait(0.01)
    raise AssertionError("it did not happen")


def test_a_free_place_goes_to_the_project_that_has_the_fewest() -> None:
    guests = Guests(FairPlaces(3, 2))
    sent = [guests.send(name) for name in ("a1", "a2", "a3", "a4")]
    assert guests.served == ["a1", "a2"]  # one place is left for others
    sent += [guests.send(name) for name in ("b1", "b2", "c1")]
    assert guests.served == ["a1", "a2", "b1"]
    guests.end("a1", then=4)
    assert guests.served[3] == "c1"  # which has none, though a and b came before
    guests.end("b1", then=5)
    assert guests.served[4] == "b2"
    guests.end("c1", then=6)
    assert guests.served[5] == "a3"
    guests.end("a2", then=7)
    assert guests.served[6] == "a4"
    for leave in guests.leave.values():
        leave.set()
    for one in sent:
        one.result()


def test_projects_with_as_many_places_take_turns() -> None:
    guests = Guests(FairPlaces(1, 1))
    sent = [guests.send(name) for name in ("a1", "a2", "a3", "b1", "b2")]
    for n, name in enumerate(("a1", "a2", "b1", "a3", "b2"), 1):
        wait_until(lambda n=n: len(guests.served) == n)  # type: ignore[misc]
        guests.leave[guests.served[-1]].set()
        assert name in guests.leave
    for one in sent:
        one.result()
    assert [name[0] for name in guests.served] == ["a", "a", "b", "a", "b"]


def test_some_requests_of_a_project_wait_and_its_others_are_refused() -> None:
    guests = Guests(FairPlaces(2, 1, waiting=1))
    sent = [guests.send("a1"), guests.send("a2")]
    with pytest.raises(ServiceBusy, match="too many simulations of your project"):
        guests.send("a3").result(LIMIT_SECONDS)
    sent.append(guests.send("b1"))
    assert guests.served == ["a1", "b1"]
    for leave in guests.leave.values():
        leave.set()
    for one in sent:
        one.result()


def test_who_waits_too_long_is_told_and_leaves_its_place() -> None:
    places = FairPlaces(1, 1, waiting=1, seconds=0.01)
    with places.hold("a"):
        for project in ("a", "b", "a"):
            with pytest.raises(ServiceBusy, match=r"0\.01 s"), places.hold(project):
                pass
    with places.hold("a"):
        pass


def test_a_fault_gives_the_place_back() -> None:
    places = FairPlaces(1, 1, waiting=0)
    for _ in range(3):
        with pytest.raises(KeyError), places.hold("a"):
            raise KeyError


def test_a_request_that_waits_without_a_thread_leaves_its_place_too() -> None:
    places = FairPlaces(1, 1, seconds=0.01)

    async def use() -> None:
        async with places.hold_awaiting("b"):
            pass

    async def play() -> None:
        with ExitStack() as held:
            held.enter_context(places.hold("a"))
            with pytest.raises(ServiceBusy):
                await use()
            gone = asyncio.create_task(use())
            await asyncio.sleep(0)
            gone.cancel()
            with pytest.raises(asyncio.CancelledError):
                await gone
            waiting = asyncio.create_task(use())
            await asyncio.sleep(0)
        await waiting
        await use()

    await_in_thread(play)
    assert places._free == 1
    assert not places._waiting
