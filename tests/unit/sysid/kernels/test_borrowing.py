"""Borrowed arrays: no reference counts inside, none lost outside."""

import sys
from typing import NamedTuple

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.kernels.borrowing import compile_borrowing


class Pair(NamedTuple):
    """Two arrays and a number."""

    first: FloatArray
    second: FloatArray
    factor: float


class Nested(NamedTuple):
    """A named tuple inside another."""

    pair: Pair
    third: FloatArray


@compile_borrowing
def _add_up(pair: Pair, scratch: FloatArray) -> float:
    total = 0.0
    for i in range(pair.first.size):
        scratch[i] = pair.factor * pair.first[i] + pair.second[i]
        total += scratch[i]
    return total


@compile_borrowing
def add_up_repeatedly(nested: Nested, turns: int) -> float:
    total = 0.0
    for _ in range(turns):
        total += _add_up(nested.pair, nested.third)
    return total


def make_nested() -> Nested:
    draw = np.random.default_rng(1).random
    return Nested(Pair(draw(7), draw(7), 2.5), draw(7))


def test_borrowed_arguments_are_read_and_written_in_place() -> None:
    nested = make_nested()
    first, second, factor = nested.pair
    total = add_up_repeatedly(nested, 3)
    np.testing.assert_array_equal(nested.third, factor * first + second)
    assert total == pytest.approx(3.0 * np.sum(factor * first + second), rel=1e-14)


def test_references_to_borrowed_arrays_are_neither_lost_nor_added() -> None:
    nested = make_nested()
    arrays = [nested.pair.first, nested.pair.second, nested.third]
    add_up_repeatedly(nested, 1)
    before = [sys.getrefcount(array) for array in arrays]
    for _ in range(50):
        add_up_repeatedly(nested, 20)
    assert [sys.getrefcount(array) for array in arrays] == before


@compile_borrowing
def return_borrowed(values: FloatArray) -> FloatArray:
    """Only a test may do this: nothing holds the memory of the result."""
    return np.asarray(values)


def test_a_borrowed_array_has_no_count_of_its_own() -> None:
    values = np.arange(5.0)
    borrowed = return_borrowed(values)
    assert np.shares_memory(borrowed, values)
    assert borrowed.base is None
    assert not borrowed.flags.owndata
