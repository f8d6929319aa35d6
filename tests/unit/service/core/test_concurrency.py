"""Turns at what is heavy: so many at once, some wait, the others are refused at once."""

from concurrent.futures import ThreadPoolExecutor
from threading import BoundedSemaphore, Event, Semaphore

import pytest

from service.core.errors import ServiceBusy
from service.core.process import concurrency
from service.core.process.concurrency import ConcurrencyLimit
from tests.support.limits import LIMIT_SECONDS


def test_so_many_go_on_at_once_some_wait_and_the_others_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = Semaphore(0)

    class Told(BoundedSemaphore):
        """Tells of everyone who has a place and asks for a turn."""

        def acquire(self, blocking: bool = True, timeout: float | None = None) -> bool:
            if timeout is not None:
                asked.release()
            return super().acquire(blocking, timeout)

    monkeypatch.setattr(concurrency, "BoundedSemaphore", Told)
    turns, begun, ended = (
        ConcurrencyLimit(at_once=2, waiting=1),
        [Event(), Event(), Event()],
        Event(),
    )

    def work(number: int) -> int:
        with turns.acquire():
            begun[number].set()
            assert ended.wait(LIMIT_SECONDS)
        return number

    with ThreadPoolExecutor(3) as pool:
        first = [pool.submit(work, number) for number in range(2)]
        assert all(one.wait(LIMIT_SECONDS) for one in begun[:2])
        third = pool.submit(work, 2)
        assert all(asked.acquire(timeout=LIMIT_SECONDS) for _ in range(3))
        assert not begun[2].is_set()
        with pytest.raises(ServiceBusy, match="too many"), turns.acquire():
            pass
        ended.set()
        assert [one.result() for one in (*first, third)] == [0, 1, 2]
    with turns.acquire():
        pass


def test_who_waits_too_long_is_told_and_leaves_its_place() -> None:
    turns = ConcurrencyLimit(at_once=1, waiting=1, seconds=0.01)
    with turns.acquire():
        for _ in range(3):
            with pytest.raises(ServiceBusy, match=r"0\.01 s"), turns.acquire():
                pass
    with turns.acquire():
        pass


def test_a_fault_gives_the_turn_back() -> None:
    turns = ConcurrencyLimit(at_once=1, waiting=0)

    @turns.acquire()
    def fails() -> None:
        raise KeyError

    for _ in range(3):
        with pytest.raises(KeyError):
            fails()
