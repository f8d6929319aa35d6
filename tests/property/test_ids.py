"""Identifiers sort by time, also when the clock does not help."""

import re
import threading
import time

from hypothesis import given
from hypothesis import strategies as st

from service.storage import statements
from service.storage.statements import new_id, new_ids


def test_an_identifier_is_a_prefix_and_26_characters_without_lookalikes():
    assert re.fullmatch(r"job_[0-9a-hjkmnp-tv-z]{26}", new_id("job"))


@given(st.lists(st.integers(1, 50), max_size=20))
def test_each_identifier_is_greater_than_the_one_before(sizes):
    made = [one for n in sizes for one in (*new_ids("run", n), new_id("run"))]
    assert made == sorted(set(made))


@given(st.lists(st.integers(0, 2**47), min_size=2, max_size=30))
def test_a_clock_that_jumps_back_does_not_disturb_the_order(milliseconds):
    clock = iter(milliseconds)
    sequence = statements._IdSequence()
    true_time, time.time_ns = time.time_ns, lambda: next(clock) * 1_000_000
    try:
        made = [statements._encode_base32(sequence.take_numbers(1)[0]) for _ in milliseconds]
    finally:
        time.time_ns = true_time
    assert made == sorted(set(made))


def test_later_identifiers_of_another_process_are_greater():
    early, late = statements._IdSequence(), statements._IdSequence()
    before = early.take_numbers(1)[0]
    time.sleep(0.002)
    assert late.take_numbers(1)[0] > before


def test_threads_never_get_the_same_identifier():
    made = []
    threads = [threading.Thread(target=lambda: made.extend(new_ids("job", 500))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(made)) == 2000
