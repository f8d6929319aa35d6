"""A warm start: the same result for at most half of the simulations, wherever it begins."""

from functools import cache

import pytest

from sysid import Identification, identify, load_model
from sysid.records import Record
from tests.runs import step_record

BOUNDS = {"T": {"upper": 10.0}, "L": {"upper": 2.0}}


@cache
def records() -> tuple[Record, Record]:
    """The tube before, and after a change: another lag, other noise."""
    return step_record(400, delay=0.7, seed=3), step_record(400, delay=1.1, seed=8)


def found(record: Record, warm: dict[str, float] | None = None, seed: int = 1) -> Identification:
    return identify(load_model("fopdt"), record, seed=seed, parameters=BOUNDS, warm=warm)


def values(one: Identification) -> dict[str, float]:
    return {estimate.name: estimate.value for estimate in one.estimates}


def test_a_warm_start_halves_the_simulations_and_ends_at_the_same_result() -> None:
    before, after = records()
    spent = {"cold": 0, "warm": 0}
    for seed in range(1, 5):
        cold = found(after, seed=seed)
        warm = found(after, values(found(before, seed=seed)), seed=seed)
        spent["cold"] += cold.evaluations
        spent["warm"] += warm.evaluations
        for one, other in zip(cold.estimates, warm.estimates, strict=True):
            if one.stderr is not None:
                assert abs(one.value - other.value) <= 0.01 * one.stderr
    assert 2 * spent["warm"] <= spent["cold"]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_warm_start_from_a_false_place_ends_at_the_same_result(seed: int) -> None:
    after = records()[1]
    cold = found(after, seed=seed)
    warm = found(after, {"K": -3.0, "T": 9.0, "L": 0.0}, seed=seed)
    assert warm.rms == pytest.approx(cold.rms, rel=1e-6)


def test_a_warm_start_repeats_bit_for_bit() -> None:
    before, after = records()
    start = values(found(before))
    assert values(found(after, start)) == values(found(after, start))
