"""Documents made beside the dispatcher's turns: whole, in turn, errors where they belong."""

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from service.dispatch.background import Aside
from service.storage.columns import Document

LIMIT_SECONDS = 30.0


def until(holds: Callable[[], bool]) -> None:
    limit = time.monotonic() + LIMIT_SECONDS
    while not holds():
        assert time.monotonic() < limit
        time.sleep(0.001)


@pytest.fixture
def aside() -> Iterator[Aside[str]]:
    made: Aside[str] = Aside()
    yield made
    made.stop()


def test_the_last_step_gives_the_document(aside: Aside[str]) -> None:
    def steps() -> Iterator[Document | None]:
        yield None
        yield {"a": 1}

    aside.begin("a", steps)
    assert "a" in aside
    until(lambda: aside.ended() == ("a",))
    assert aside.take("a") == {"a": 1}
    assert aside.keys == ()


def test_a_short_document_does_not_wait_for_a_long_one(aside: Aside[str]) -> None:
    may_go_on = threading.Event()
    told: list[str] = []

    def long() -> Iterator[Document | None]:
        may_go_on.wait(LIMIT_SECONDS)
        for _ in range(5):
            told.append("long")
            yield None
        yield {}

    def short() -> Iterator[Document | None]:
        told.append("short")
        yield {}

    aside.begin("long", long)
    aside.begin("short", short)
    may_go_on.set()
    until(lambda: set(aside.ended()) == {"long", "short"})
    assert told == ["long", "short", *["long"] * 4]


def test_an_error_is_raised_where_the_document_is_taken_and_ends_nothing_else(
    aside: Aside[str],
) -> None:
    def broken() -> Iterator[Document | None]:
        yield None
        raise ZeroDivisionError

    def sound() -> Iterator[Document | None]:
        yield {"b": 2}

    aside.begin("a", broken)
    aside.begin("b", sound)
    until(lambda: set(aside.ended()) == {"a", "b"})
    with pytest.raises(ZeroDivisionError):
        aside.take("a")
    assert aside.take("b") == {"b": 2}


def test_what_is_dropped_or_stopped_is_made_no_further(aside: Aside[str]) -> None:
    steps_taken: list[int] = []

    def endless() -> Iterator[Document | None]:
        while True:
            steps_taken.append(1)
            yield None

    aside.begin("a", endless)
    until(lambda: len(steps_taken) > 3)
    aside.drop("a")
    aside.drop("a")
    assert aside.keys == ()
    aside.begin("b", endless)
    aside.stop()
    count = len(steps_taken)
    time.sleep(0.02)
    assert len(steps_taken) == count
