"""Chains of a sweep side by side: each run once, behind those before it, and none held up."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.dispatch.run_warm_starts import MAX_OPEN_CHAINS, OpenChains
from service.jobs.warm_start_order import ChainLayout

SHAPES = st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 6))
"""Values of the axes slower than the chain's, of its own, and of those faster."""


def always(_number: int) -> bool:
    return True


@given(SHAPES)
def test_chains_share_out_the_runs_and_each_follows_the_order_of_its_axis(
    shape: tuple[int, int, int],
) -> None:
    slower, length, stride = shape
    chain = ChainLayout(stride, length)
    chains = [list(chain.list_runs(key)) for key in range(slower * stride)]
    assert sorted(number for numbers in chains for number in numbers) == list(
        range(slower * length * stride)
    )
    for key, numbers in enumerate(chains):
        assert [chain.find_chain(number) for number in numbers] == [key] * length
        assert {later - number for number, later in pairwise(numbers)} <= {stride}
    assert [numbers[0] for numbers in chains] == sorted(numbers[0] for numbers in chains)


@given(SHAPES, st.integers(1, 5), st.data())
def test_each_run_is_given_once_when_those_before_it_are_over_and_no_chain_is_held_up(
    shape: tuple[int, int, int], limit: int, data: st.DataObject
) -> None:
    slower, length, stride = shape
    chain, n_runs = ChainLayout(stride, length), slower * length * stride
    ended = data.draw(st.sets(st.integers(0, n_runs - 1)))
    waiting = data.draw(st.sets(st.integers(0, n_runs - 1)))
    chains = OpenChains(chain, n_runs, waiting.__contains__, ended)
    given_out: list[int] = []
    flying: set[int] = set()
    while not chains.is_exhausted or flying:
        while numbers := chains.take_ready(limit, n_runs):
            assert len(numbers) <= limit
            given_out += numbers
            flying |= set(numbers)
        for key in range(slower * stride):
            left = [n for n in chain.list_runs(key) if n not in ended and n not in given_out]
            out = flying.intersection(chain.list_runs(key))
            assert not left or (out and left[0] in waiting)
        if flying:
            number = data.draw(st.sampled_from(sorted(flying)))
            flying.remove(number)
            chains.end_run(number, {"a": float(number)})
            chains.end_run(number)
    assert sorted(given_out) == sorted(set(range(n_runs)) - ended)
    for key in range(slower * stride):
        own = [number for number in given_out if chain.find_chain(number) == key]
        assert own == sorted(own)


@pytest.mark.parametrize("chain", [ChainLayout(1, 3), ChainLayout(4, 3)])
def test_a_run_begins_with_the_last_before_it_that_succeeded_in_its_own_chain(
    chain: ChainLayout,
) -> None:
    chains = OpenChains(chain, 12, always)
    first = chains.take_ready(12, 12)
    assert first == [chain.list_runs(key)[0] for key in range(4)]
    for number in first[::-1]:
        chains.end_run(number, {"a": float(number)})
    second = chains.take_ready(12, 12)
    assert [chains.find_previous_values(number, nothing) for number in second] == [
        {"a": float(number - chain.stride)} for number in second
    ]
    chains.end_run(chain.list_runs(1)[1])
    (third,) = chains.take_ready(12, 12)
    assert third == chain.list_runs(1)[2]
    assert chains.find_previous_values(third, nothing) == {"a": float(chain.list_runs(1)[0])}


def test_an_earlier_run_that_ends_late_does_not_replace_the_values_of_a_later_one() -> None:
    chains = OpenChains(ChainLayout(1, 3), 3, {2}.__contains__)  # the second waits for nobody
    assert [chains.take_ready(9, 3), chains.take_ready(9, 3)] == [[0], [1]]
    chains.end_run(1, {"a": 1.0})
    chains.end_run(0, {"a": 0.0})
    assert chains.take_ready(9, 3) == [2]
    assert chains.find_previous_values(2, nothing) == {"a": 1.0}


def nothing(_numbers: range) -> None:
    raise AssertionError("every run that ended was told of")


def test_what_an_earlier_attempt_ended_is_looked_for_once_and_newer_values_count() -> None:
    looked: list[range] = []

    def find_stored(numbers: range) -> tuple[int, dict[str, float]]:
        looked.append(numbers)
        return 1, {"a": 1.0}

    chains = OpenChains(ChainLayout(1, 6), 6, always, {0, 1, 2})
    assert chains.take_ready(9, 6) == [3]
    assert chains.find_previous_values(3, find_stored) == {"a": 1.0}
    chains.end_run(3, {"a": 3.0})
    assert chains.take_ready(9, 6) == [4]
    assert chains.find_previous_values(4, find_stored) == {"a": 3.0}
    assert looked == [range(3)]


def test_runs_that_are_not_made_are_given_when_they_are() -> None:
    chains = OpenChains(ChainLayout(1, 10), 30, always)
    assert chains.take_ready(9, 5) == [0]
    assert chains.has_ready
    assert chains.take_ready(9, 5) == []
    assert chains.take_ready(9, 11) == [10]
    assert chains.take_ready(9, 30) == [20]
    assert not chains.has_ready


@pytest.mark.parametrize("chain", [ChainLayout(1, 2), ChainLayout(50_000, 2)])
def test_chains_are_opened_as_runs_are_wanted_and_never_all_at_once(chain: ChainLayout) -> None:
    chains = OpenChains(chain, 100_000, always)
    assert len(chains.take_ready(64, 100_000)) == 64
    out = 64
    while numbers := chains.take_ready(64, 100_000):
        out += len(numbers)
    assert out == MAX_OPEN_CHAINS
