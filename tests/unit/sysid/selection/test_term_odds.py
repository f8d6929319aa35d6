"""How likely a selected term belongs to the model, against all sets of a few candidates."""

from itertools import combinations
from math import comb, log

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.models.model import TermRule
from sysid.selection.frols import select_terms
from sysid.selection.term_odds import CERTAIN, LEAST_COVERAGE, TermOdds, weigh_terms

LABELS = tuple("abcdef")
SAMPLES = 200


def make_triangle(columns: FloatArray, target: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.qr(np.column_stack([columns, target]), mode="r"))


def draw(seed: int, noise: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Six candidates, of which the first two make the output."""
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((SAMPLES, 6))
    return columns, columns[:, 0] - 0.5 * columns[:, 1] + noise * rng.standard_normal(SAMPLES)


def weigh_all(columns: FloatArray, target: FloatArray) -> dict[tuple[int, ...], float]:
    """The weight of every set with at least one term."""
    values = {}
    for size in range(1, 7):
        for terms in combinations(range(6), size):
            left = np.linalg.lstsq(columns[:, terms], target, rcond=None)[1][0]
            criterion = SAMPLES * log(left) + size * log(SAMPLES) + 2 * log(comb(6, size))
            values[terms] = criterion
    least = min(values.values())
    weights = {terms: np.exp(-0.5 * (value - least)) for terms, value in values.items()}
    whole = sum(weights.values())
    return {terms: weight / whole for terms, weight in weights.items()}


def weigh(columns: FloatArray, target: FloatArray, chosen: list[int]) -> list[TermOdds]:
    return weigh_terms(make_triangle(columns, target), chosen, SAMPLES, LABELS)


@pytest.mark.parametrize("seed", range(4))
def test_the_probability_is_the_weight_of_all_sets_with_the_term(seed: int) -> None:
    columns, target = draw(seed)
    weights = weigh_all(columns, target)
    for term, one in zip((0, 1, 3), weigh(columns, target, [0, 1, 3]), strict=True):
        expected = sum(weight for terms, weight in weights.items() if term in terms)
        assert one.probability == pytest.approx(expected, abs=0.03)  # sets three steps away


@pytest.mark.parametrize("seed", range(6))
def test_true_terms_are_certain_and_one_of_noise_is_not(seed: int) -> None:
    columns, target = draw(seed, noise=0.3)
    first, second, spurious = weigh(columns, target, [0, 1, 4])
    for one in (first, second):
        assert one.probability > CERTAIN
        assert one.coverage > LEAST_COVERAGE
        assert one.rival == ""
    assert spurious.probability < CERTAIN
    assert spurious.rival


def test_of_two_terms_that_are_nearly_alike_neither_is_certain() -> None:
    columns, target = draw(1)
    columns[:, 2] = columns[:, 0] + 0.05 * columns[:, 2]
    first, _ = weigh(columns, target, [0, 1])
    assert 0.1 < first.probability < 0.9
    assert first.rival == "with c instead of it"


def test_a_coefficient_that_another_term_would_move_is_not_certain() -> None:
    """The other term takes a part, and what is left has another coefficient and a wide interval."""
    rng = np.random.default_rng(3)
    columns, _ = draw(3)
    columns[:, 2] = columns[:, 0] + 0.2 * columns[:, 2]
    noise = rng.standard_normal(SAMPLES)
    target = 3.0 * columns[:, 0] + 0.7 * columns[:, 2] - columns[:, 1] + noise
    first, second = weigh(columns, target, [0, 1])
    assert first.probability > CERTAIN
    assert first.coverage < LEAST_COVERAGE
    assert first.rival == "with c besides"
    assert second.coverage > LEAST_COVERAGE


def test_terms_of_a_wrong_set_are_told_to_be_wrong() -> None:
    columns, target = draw(2, noise=0.1)
    assert all(one.probability < 0.5 for one in weigh(columns, target, [4, 5]))


def test_without_noise_the_true_terms_are_certain() -> None:
    columns, target = draw(1, noise=0.0)
    assert [one.probability for one in weigh(columns, target, [0, 1])] == pytest.approx([1.0, 1.0])


def test_a_number_of_terms_takes_first_what_the_data_demand() -> None:
    """The four that leave least need not have the true ones: here pairs imitate the first."""
    for seed in range(20):
        columns, target = draw(seed, noise=0.3)
        demanded = select_terms(
            make_triangle(columns, target), TermRule(6, criterion="bic"), SAMPLES
        )
        chosen = select_terms(make_triangle(columns, target), TermRule(4), SAMPLES)
        assert len(chosen.order) == 4
        assert {0, 1} <= set(demanded.order) <= set(chosen.order)
