"""Laws of cutting and grouping work; no Ray."""

from hypothesis import given
from hypothesis import strategies as st

from workers.packing import (
    FIRST_SLICE_SECONDS,
    PACK_SECONDS,
    PACK_TOLERANCE,
    MeanCost,
    balance_packs,
    choose_pack_size,
    choose_slice_seconds,
    is_worth_spreading,
)

costs = st.floats(1e-6, 100.0)


@given(costs, st.integers(1, 10_000), st.integers(1, 500))
def test_a_pack_holds_between_one_and_all_of_what_waits(
    seconds: float, waiting: int, slots: int
) -> None:
    assert 1 <= choose_pack_size(MeanCost(seconds), waiting, slots) <= waiting


@given(costs, st.integers(1, 10_000), st.integers(1, 500))
def test_a_pack_of_several_items_takes_no_longer_than_it_should(
    seconds: float, waiting: int, slots: int
) -> None:
    size = choose_pack_size(MeanCost(seconds), waiting, slots)
    assert size == 1 or size * max(seconds, 1e-4) <= PACK_SECONDS * (1 + 1e-9)


@given(costs, st.integers(2, 10_000), st.integers(2, 500))
def test_no_pack_takes_more_than_an_even_share_of_what_waits(
    seconds: float, waiting: int, slots: int
) -> None:
    assert choose_pack_size(MeanCost(seconds), waiting, slots) <= -(-waiting // slots)


def test_an_item_of_unknown_cost_goes_alone() -> None:
    assert choose_pack_size(MeanCost(), 100, 2) == 1
    assert choose_pack_size(MeanCost(), 0, 2) == 0


@given(costs, costs)
def test_the_mean_cost_lies_between_what_was_known_and_what_was_measured(
    known: float, measured: float
) -> None:
    mean = MeanCost().add_measurement(known).add_measurement(measured).seconds
    assert mean is not None
    slack = 1e-9 * (known + measured)
    assert min(known, measured) - slack <= mean <= max(known, measured) + slack


@given(st.lists(costs, min_size=1, max_size=40), st.integers(1, 10))
def test_dealing_gives_every_item_to_exactly_one_pack(loads: list[float], bins: int) -> None:
    packs = balance_packs(loads, bins)
    assert sorted(index for pack in packs for index in pack) == list(range(len(loads)))
    assert len(packs) == min(bins, len(loads))
    assert all(packs)


@given(st.lists(costs, min_size=1, max_size=40), st.integers(1, 10))
def test_no_pack_exceeds_the_even_share_by_more_than_one_item(
    loads: list[float], bins: int
) -> None:
    packs = balance_packs(loads, bins)
    share = sum(loads) / len(packs)
    heaviest = max(sum(loads[index] for index in pack) for pack in packs)
    assert heaviest <= share + max(loads) + 1e-9


def test_slices_grow_from_the_first_to_that_of_a_pack() -> None:
    lengths = [choose_slice_seconds(number) for number in range(8)]
    assert lengths[0] == FIRST_SLICE_SECONDS
    assert lengths == sorted(lengths)
    assert lengths[-1] == PACK_SECONDS


def test_islands_are_spread_only_over_idle_cores_and_when_an_epoch_is_long_enough() -> None:
    assert is_worth_spreading(1.0, islands=4, idle=1)
    assert not is_worth_spreading(1.0, islands=4, idle=0)
    assert not is_worth_spreading(1.0, islands=1, idle=1)
    assert not is_worth_spreading(0.01, islands=4, idle=1)


@given(costs, st.integers(0, 12))
def test_only_a_run_that_is_known_to_fit_into_a_pack_is_not_cut(mean: float, slices: int) -> None:
    known = choose_slice_seconds(slices, MeanCost(mean))
    assert known == (
        PACK_SECONDS if mean * PACK_TOLERANCE <= PACK_SECONDS else choose_slice_seconds(slices)
    )
    assert choose_slice_seconds(slices, MeanCost()) == choose_slice_seconds(slices)
