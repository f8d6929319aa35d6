"""Documents made beside the dispatcher's turns: whole, in turn, errors where they belong."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from service.dispatch.background import BackgroundJobs
from service.storage.columns import Document

LIMIT_SECONDS = 30.0


def until(holds: Callable[[], bool]) -> None:
    limit = time.monotonic() + LIMIT_SECONDS
    while not holds():
        assert time.monotonic() < limit
        time.sleep(0.001)


@pytest.fixture
def aside() -> Iterator[BackgroundJobs[str]]:
    made: BackgroundJobs[str] = BackgroundJobs()
    yield made
    made.stop()


def test_the_last_step_gives_the_document(aside: BackgroundJobs[str]) -> None:
    def steps() -> Iterator[Document | None]:
        yield None
        yield {"a": 1}

    aside.start_job("a", steps)
    assert "a" in aside
    until(lambda: aside.list_done() == ("a",))
    assert aside.take_result("a") == {"a": 1}
    assert aside.pending_keys == ()


def test_a_short_document_does_not_wait_for_a_long_one(aside: BackgroundJobs[str]) -> None:
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

    aside.start_job("long", long)
    aside.start_job("short", short)
    may_go_on.set()
    until(lambda: set(aside.list_done()) == {"long", "short"})
    assert told == ["long", "short", *["long"] * 4]


def test_an_error_is_raised_where_the_document_is_taken_and_ends_nothing_else(
    aside: BackgroundJobs[str],
) -> None:
    def broken() -> Iterator[Document | None]:
        yield None
        raise ZeroDivisionError

    def sound() -> Iterator[Document | None]:
        yield {"b": 2}

    aside.start_job("a", broken)
    aside.start_job("b", sound)
    until(lambda: set(aside.list_done()) == {"a", "b"})
    with pytest.raises(ZeroDivisionError):
        aside.take_result("a")
    assert aside.take_result("b") == {"b": 2}


def test_what_is_dropped_or_stopped_is_made_no_further(aside: BackgroundJobs[str]) -> None:
    steps_taken: Counter[str] = Counter()

    def endless(key: str) -> Iterator[Document | None]:
        while True:
            steps_taken[key] += 1
            yield None

    aside.start_job("a", partial(endless, "a"))
    until(lambda: steps_taken["a"] > 3)
    aside.cancel_job("a")
    before = steps_taken["a"]
    aside.cancel_job("a")
    assert aside.pending_keys == ()
    aside.start_job("b", partial(endless, "b"))
    until(lambda: steps_taken["b"] > 3)
    assert steps_taken["a"] <= before + 1  # the step that was begun
    aside.stop()
    count = steps_taken.total()
    time.sleep(0.02)
    assert steps_taken.total() == count
