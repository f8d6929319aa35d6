"""Documents made beside the dispatcher's turns: whole, in turn, errors where they belong."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from service.dispatch.background import BackgroundJobs
from service.storage.columns import Document
from tests.support.limits import LIMIT_SECONDS


def until(holds: Callable[[], bool]) -> None:
    limit = time.monotonic() + LIMIT_SECONDS
    while not holds():
        assert time.monotonic() < limit
        time.sleep(0.001)


@pytest.fixture
def jobs() -> Iterator[BackgroundJobs[str]]:
    made: BackgroundJobs[str] = BackgroundJobs()
    yield made
    made.stop()


def test_the_last_step_gives_the_document(jobs: BackgroundJobs[str]) -> None:
    def steps() -> Iterator[Document | None]:
        yield None
        yield {"a": 1}

    jobs.start_job("a", steps)
    assert "a" in jobs
    until(lambda: jobs.list_done() == ("a",))
    assert jobs.take_result("a") == {"a": 1}
    assert jobs.pending_keys == ()


def test_a_short_document_does_not_wait_for_a_long_one(jobs: BackgroundJobs[str]) -> None:
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

    jobs.start_job("long", long)
    jobs.start_job("short", short)
    may_go_on.set()
    until(lambda: set(jobs.list_done()) == {"long", "short"})
    assert told == ["long", "short", *["long"] * 4]


def test_an_error_is_raised_where_the_document_is_taken_and_ends_nothing_else(
    jobs: BackgroundJobs[str],
) -> None:
    def broken() -> Iterator[Document | None]:
        yield None
        raise ZeroDivisionError

    def sound() -> Iterator[Document | None]:
        yield {"b": 2}

    jobs.start_job("a", broken)
    jobs.start_job("b", sound)
    until(lambda: set(jobs.list_done()) == {"a", "b"})
    with pytest.raises(ZeroDivisionError):
        jobs.take_result("a")
    assert jobs.take_result("b") == {"b": 2}


def test_what_is_dropped_or_stopped_is_made_no_further(jobs: BackgroundJobs[str]) -> None:
    steps_taken: Counter[str] = Counter()

    def endless(key: str) -> Iterator[Document | None]:
        while True:
            steps_taken[key] += 1
            yield None

    jobs.start_job("a", partial(endless, "a"))
    until(lambda: steps_taken["a"] > 3)
    jobs.cancel_job("a")
    before = steps_taken["a"]
    jobs.cancel_job("a")
    assert jobs.pending_keys == ()
    jobs.start_job("b", partial(endless, "b"))
    until(lambda: steps_taken["b"] > 3)
    assert steps_taken["a"] <= before + 1  # the step that was begun
    jobs.stop()
    count = steps_taken.total()
    time.sleep(0.02)
    assert steps_taken.total() == count
