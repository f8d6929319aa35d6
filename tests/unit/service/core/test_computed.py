"""Values that take long are computed once, and those that may change not too often."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import islice
from threading import Event
from types import SimpleNamespace

import pytest

from service.core import computed
from service.core.computed import FRESH_SECONDS, MAX_WAITING, REUSE_FACTOR, ComputedValues
from service.core.errors import ServiceBusy
from tests.support.clocks import SecondsClock
from tests.support.limits import LIMIT_SECONDS


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SecondsClock:
    made = SecondsClock()
    monkeypatch.setattr(computed, "FRESH_SECONDS", FRESH_SECONDS)
    monkeypatch.setattr(computed, "time", SimpleNamespace(monotonic=made))
    return made


def counting(clock: SecondsClock, seconds: float) -> tuple[list[int], Callable[[], int]]:
    """The results so far, and a computation that takes some time."""
    made: list[int] = []

    def compute() -> int:
        clock.now += seconds
        made.append(len(made))
        return made[-1]

    return made, compute


def test_what_is_final_is_computed_once(clock: SecondsClock) -> None:
    made, compute = counting(clock, 0.0)
    values = ComputedValues(2)
    for _ in range(3):
        assert values.get("a", compute, is_final=True) == 0
        clock.now += 1e9
    assert made == [0]


def test_what_may_change_and_takes_little_is_computed_each_time(clock: SecondsClock) -> None:
    _, compute = counting(clock, FRESH_SECONDS / 2)
    values = ComputedValues(2)
    assert [values.get("a", compute, is_final=False) for _ in range(3)] == [0, 1, 2]


def test_what_may_change_and_takes_long_is_used_for_many_times_its_time(
    clock: SecondsClock,
) -> None:
    _, compute = counting(clock, 1.0)
    values = ComputedValues(2)
    assert values.get("a", compute, is_final=False) == 0
    clock.now += REUSE_FACTOR - 0.1
    assert values.get("a", compute, is_final=False) == 0
    clock.now += 0.2
    assert values.get("a", compute, is_final=False) == 1


def test_the_values_that_were_asked_for_last_are_remembered(clock: SecondsClock) -> None:
    made, compute = counting(clock, 0.0)
    values = ComputedValues(2)
    for key in "abac":  # c takes the place of b
        values.get(key, compute, is_final=True)
    assert values.get("a", compute, is_final=True) == 0
    assert values.get("b", compute, is_final=True) == len(made) - 1 == 3


def test_what_failed_is_tried_again(clock: SecondsClock) -> None:
    values = ComputedValues(2)

    def fail() -> int:
        raise OSError

    with pytest.raises(OSError):  # noqa: PT011 - any
        values.get("a", fail, is_final=True)
    assert values.get("a", lambda: 7, is_final=True) == 7


def test_few_requests_wait_for_a_value_and_others_are_told_to_come_again() -> None:
    """A thread that waits is one that no other request has."""
    values, may_end = ComputedValues(2), Event()

    def compute() -> int:
        may_end.wait(LIMIT_SECONDS)
        return 7

    def ask() -> int | str:
        try:
            return values.get("a", compute, is_final=True)
        except ServiceBusy as error:
            return str(error)

    with ThreadPoolExecutor(MAX_WAITING + 4) as pool:
        answers = [pool.submit(ask) for _ in range(MAX_WAITING + 4)]
        refused = [one.result() for one in islice(as_completed(answers), 3)]
        may_end.set()
    assert {str(one).partition(";")[0] for one in refused} == {
        "too many requests wait for the same result"
    }
    assert [one.result() for one in answers].count(7) == MAX_WAITING + 1
    assert ask() == 7
