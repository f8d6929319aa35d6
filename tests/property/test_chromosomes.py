"""Laws of the code and of the operators on it, and of the derived random numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid.search import operators
from sysid.search.operators import (
    cross_over,
    decode,
    draw_pair,
    encode,
    flip_bit,
    get_mutation_rate,
    mutate_by_step,
    reflect_at_bounds,
    sort_population,
)
from sysid.simulation.scaling import from_unit, to_unit
from tests.support.library.search_problems import example

BITS = st.integers(1, 32)
WORD = st.integers(0, 2**32 - 1)


@given(BITS, st.lists(WORD, min_size=1, max_size=8))
def test_coding_is_the_inverse_of_decoding(bits: int, values: list[int]) -> None:
    words = np.array([[v % 2**bits for v in values]], dtype=np.uint32)
    assert np.array_equal(encode(decode(words, bits), bits), words)


def test_a_place_is_coded_by_the_nearest_word() -> None:
    places = np.array([[0.0, 0.16, 0.17, 0.6, 0.9, 1.0]])
    assert encode(places, 2).tolist() == [[0, 0, 1, 2, 3, 3]]


@given(st.booleans(), st.lists(st.floats(0, 1), min_size=4, max_size=4))
def test_placing_is_the_inverse_of_locating(log: bool, values: list[float]) -> None:
    evaluator = example(n=80).evaluator
    if log:
        evaluator = evaluator._replace(
            is_log=np.ones(4, dtype=np.int64), lower=evaluator.upper / 1e4
        )
    places = np.array([values])
    theta = from_unit(evaluator, places)
    assert np.all((theta >= evaluator.lower) & (theta <= evaluator.upper))
    assert np.allclose(to_unit(evaluator, theta), places, atol=1e-12)


def test_the_code_reaches_both_bounds() -> None:
    evaluator = example(n=80).evaluator
    ends = np.array([[0, 0, 0, 0], [2**24 - 1] * 4], dtype=np.uint32)
    theta = from_unit(evaluator, decode(ends, 24))
    assert np.array_equal(theta, np.vstack([evaluator.lower, evaluator.upper]))


def string(word: np.ndarray, bits: int) -> str:
    return "".join(format(int(w), f"0{bits}b") for w in word)


@given(BITS, WORD, WORD, WORD, WORD, st.data())
def test_a_child_has_the_first_parents_bits_up_to_the_cut(
    bits: int, a: int, b: int, c: int, d: int, data: st.DataObject
) -> None:
    mask = 2**bits - 1
    first, second = (
        np.array(pair, dtype=np.uint32) for pair in ([a & mask, b & mask], [c & mask, d & mask])
    )
    cut = data.draw(st.integers(0, 2 * bits))
    child = np.empty(2, dtype=np.uint32)
    cross_over(child, first, second, cut, bits)
    assert string(child, bits) == string(first, bits)[:cut] + string(second, bits)[cut:]


@given(BITS, WORD, WORD, st.data())
def test_a_mutation_changes_exactly_the_chosen_bit(
    bits: int, a: int, b: int, data: st.DataObject
) -> None:
    before = np.array([a % 2**bits, b % 2**bits], dtype=np.uint32)
    position = data.draw(st.integers(0, 2 * bits - 1))
    after = before.copy()
    flip_bit(after, position, bits)
    changed = [i for i in range(2 * bits) if string(before, bits)[i] != string(after, bits)[i]]
    assert changed == [position]


@given(st.lists(st.sampled_from([0.0, 1.0, 2.0, np.inf]), min_size=1, max_size=12))
def test_ranking_is_stable_and_ascends(values: list[float]) -> None:
    words = np.arange(len(values), dtype=np.uint32)[:, None]
    fitness = np.array(values)
    order = np.argsort(fitness, kind="stable")
    sort_population(words, fitness)
    assert np.array_equal(words[:, 0], order)
    assert np.array_equal(fitness, np.sort(values))


@given(st.floats(0, 1), WORD, WORD, BITS)
def test_a_scale_free_step_stays_in_the_box_and_moves(
    place: float, size: int, sign: int, bits: int
) -> None:
    assert 0 <= mutate_by_step(place, size, sign, bits) <= 1
    assert 0 <= reflect_at_bounds(2 * place - 0.5) <= 1


def test_a_scale_free_step_has_every_size_of_the_code_in_both_directions() -> None:
    bits, words = 10, range(0, 2**32, 2**20)
    for sign in (0, 1):
        sizes = np.array([mutate_by_step(0.5, word, sign, bits) - 0.5 for word in words])
        assert np.all(sizes * (1 if sign else -1) > 0)
        # 0.5 is half the range away from its bounds, where a longer step turns round
        steps = np.abs([mutate_by_step(0.0 if sign else 1.0, word, sign, bits) for word in words])
        logs = np.log2(steps if sign else 1.0 - steps)
        assert np.histogram(logs, bins=bits, range=(-bits, 0))[0].tolist() == pytest.approx(
            [4096 / bits] * bits, abs=2
        )


@pytest.mark.parametrize(
    ("place", "reflected"), [(-0.25, 0.25), (0.0, 0.0), (0.3, 0.3), (1.0, 1.0), (1.25, 0.75)]
)
def test_what_passes_a_bound_comes_back_as_far(place: float, reflected: float) -> None:
    assert reflect_at_bounds(place) == reflected


@given(WORD, WORD, st.integers(2, 1000))
def test_two_parents_differ(a: int, b: int, n: int) -> None:
    first, second = draw_pair(a, b, n)
    assert first != second
    assert 0 <= first < n
    assert 0 <= second < n


def test_the_mutation_rate_follows_its_schedule() -> None:
    starts, rates = np.array([0, 50]), np.array([0.2, 0.8])
    assert [get_mutation_rate(starts, rates, g) for g in (0, 49, 50, 399)] == [0.2, 0.2, 0.8, 0.8]


def test_philox_gives_its_published_values() -> None:
    def words(counter: tuple[int, ...], key: tuple[int, int]) -> tuple[int, ...]:
        draw, generation, island, use = counter
        return tuple(operators.draw_words(key[0] | key[1] << 32, use, island, generation, draw))

    zero = (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)
    pi = (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1)
    assert words((0, 0, 0, 0), (0, 0)) == zero
    counter = (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344)
    assert words(counter, (0xA4093822, 0x299F31D0)) == pi


def test_no_two_places_of_a_run_share_draws() -> None:
    seen = [
        tuple(operators.draw_words(seed, use, island, generation, draw))
        for seed in (0, 1, 2**40)
        for use in range(1, 7)
        for island in range(4)
        for generation in range(5)
        for draw in range(10)
    ]
    assert len(set(seen)) == len(seen)


def test_draws_are_uniform() -> None:
    values = np.array(
        [operators.to_uniform(operators.draw_words(7, 1, 0, 0, i)[0]) for i in range(20_000)]
    )
    counts = np.histogram(values, bins=20, range=(0, 1))[0]
    assert np.sum((counts - 1000) ** 2 / 1000) < 60  # chi-squared, 19 degrees: P < 1e-5
    assert {
        operators.to_integer(operators.draw_words(7, 2, 0, 0, i)[1], 7) for i in range(500)
    } == set(range(7))
