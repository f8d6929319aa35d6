"""A warm start: the same result for at most half of the simulations, wherever it begins."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import pytest

from sysid import Identification, identify, load_model
from sysid.core.settings import GeneticAlgorithm, Loss
from sysid.data.records import Record
from sysid.identification.run import advance_run, begin_run, exchange_migrants, find_next_border
from tests.support.cluster.small_runs import step_record
from tests.support.library.search_problems import DUFFING, bits, example, noisy, record

Given = Mapping[str, float] | Sequence[Mapping[str, float]]

BOUNDS = {
    "K": {"lower": -10.0, "upper": 10.0},
    "T": {"lower": 0.01, "upper": 10.0},
    "L": {"upper": 2.0},
    "y0": {"lower": -10.0, "upper": 10.0},
    "x(0)": {"lower": -10.0, "upper": 10.0},
}


@cache
def make_records() -> tuple[Record, Record]:
    """The tube before, and after a change: another lag, other noise."""
    return step_record(400, delay=0.7, seed=3), step_record(400, delay=1.1, seed=8)


def identify_lag(
    record: Record, warm: dict[str, float] | None = None, seed: int = 1
) -> Identification:
    """Identify without other orders and noise models: the simulations are counted."""
    return identify(
        load_model("fopdt"),
        record,
        seed=seed,
        parameters=BOUNDS,
        warm=warm,
        loss=Loss(noise_model="white"),
        compare_orders=False,
    )


def read_values(one: Identification) -> dict[str, float]:
    return {estimate.name: estimate.value for estimate in one.parameters}


def test_a_warm_start_halves_the_simulations_and_ends_at_the_same_result() -> None:
    before, after = make_records()
    spent = {"cold": 0, "warm": 0}
    for seed in range(1, 5):
        cold = identify_lag(after, seed=seed)
        warm = identify_lag(after, read_values(identify_lag(before, seed=seed)), seed=seed)
        spent["cold"] += cold.evaluations
        spent["warm"] += warm.evaluations
        for one, other in zip(cold.parameters, warm.parameters, strict=True):
            if one.stderr is not None:
                assert abs(one.value - other.value) <= 0.01 * one.stderr
    assert 2 * spent["warm"] <= spent["cold"]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_warm_start_from_a_false_place_ends_at_the_same_result(seed: int) -> None:
    after = make_records()[1]
    cold = identify_lag(after, seed=seed)
    warm = identify_lag(after, {"K": -3.0, "T": 9.0, "L": 0.0}, seed=seed)
    assert warm.rms == pytest.approx(cold.rms, rel=1e-6)


def test_a_warm_start_repeats_bit_for_bit() -> None:
    before, after = make_records()
    start = read_values(identify_lag(before))
    assert read_values(identify_lag(after, start)) == read_values(identify_lag(after, start))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 25, 34])
def test_beside_a_false_start_of_a_rough_loss_the_result_is_the_same(seed: int) -> None:
    seen = record(noisy("coulomb-eq16", seed=100 + seed))
    false = {"c": 0.192, "L": 0.895, "b": 5.0, "mu": 0.1}
    model = load_model("coulomb-eq16")
    cold, warm = identify(model, seen, seed=seed), identify(model, seen, seed=seed, warm=false)
    assert warm.rms <= cold.rms * (1.0 + 2e-5)


@pytest.mark.parametrize("given", [{}, [{}], {"c": 0.2}, [{}, {"c": 0.2, "L": 0.5}]])
def test_less_than_all_free_parameters_is_no_earlier_result(given: Given) -> None:
    assert not begin_run(example(), GeneticAlgorithm(), 1, given).is_warm
    full = [given] if isinstance(given, Mapping) else list(given)
    assert begin_run(example(), GeneticAlgorithm(), 1, [*full, DUFFING]).is_warm


def test_an_empty_warm_start_is_a_cold_one() -> None:
    cold = begin_run(example(), GeneticAlgorithm(), 1)
    assert bits(begin_run(example(), GeneticAlgorithm(), 1, {})) == bits(cold)


@pytest.mark.parametrize(
    ("random", "beside", "ends"), [(6, 1, True), (5, 9, False), (0, 30, False), (6, 0, False)]
)
def test_searches_from_beside_a_warm_start_alone_do_not_end_it(
    random: int, beside: int, ends: bool
) -> None:
    algorithm = GeneticAlgorithm(islands=1)
    state = advance_run(
        example(), replace(algorithm, generations=5), begin_run(example(), algorithm, 1)
    )
    (island,) = state.islands
    search, first = island.search.copy(), island.history[-1]._replace(generation=1)
    search["random_starts"], search["confirmed_starts"] = random, 0
    search["hop_count"] = search["returned_hops"] = beside
    search["generation"] = find_next_border(algorithm, state)
    there = replace(island, search=search, history=(first,))
    state = replace(state, islands=(there,), is_warm=True, has_ended=False)
    assert exchange_migrants(algorithm, state, state.islands).has_ended is ends
