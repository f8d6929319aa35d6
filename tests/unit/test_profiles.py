"""How much tests repeat in each profile, and how far chance may go."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom, norm

from tests.support import profiles, random_bounds


@pytest.mark.parametrize(("profile", "found"), [("gate", 40), ("dev", 100), ("night", 500)])
def test_a_law_has_few_examples_at_the_gate_and_many_at_night(
    profile: str, found: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(profiles, "PROFILE", profile)
    assert profiles.scale_examples(100) == found
    assert profiles.scale_examples(10) == (50 if profile == "night" else 10)


def test_the_gate_has_the_first_seeds_and_each_night_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(profiles, "_NIGHT_SEED", 7000)
    monkeypatch.setattr(profiles, "PROFILE", "gate")
    assert profiles.draw_seeds(gate=3, night=5) == range(3)
    assert "7000" not in profiles.pytest_report_header()
    monkeypatch.setattr(profiles, "PROFILE", "night")
    assert profiles.draw_seeds(gate=3, night=5) == range(7000, 7005)
    assert "LAGID_NIGHT_SEED=7000" in profiles.pytest_report_header()


@pytest.mark.parametrize(
    ("profile", "marks", "is_left"),
    [("gate", "", True), ("gate", "not night", False), ("night", "", False)],
)
def test_what_is_marked_for_the_night_is_left_to_it(
    profile: str, marks: str, is_left: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def item(mark: str) -> Any:
        return SimpleNamespace(get_closest_marker=lambda name: name if name == mark else None)

    deselected: list[Any] = []
    hook = SimpleNamespace(pytest_deselected=lambda items: deselected.extend(items))
    config: Any = SimpleNamespace(getoption=lambda _: marks, hook=hook)
    both = [item("night"), item("slow")]
    items = list(both)
    monkeypatch.setattr(profiles, "PROFILE", profile)
    profiles.pytest_collection_modifyitems(config, items)
    assert (deselected, items) == ((both[:1], both[1:]) if is_left else ([], both))


@pytest.mark.parametrize("draws", [20, 300])
def test_a_count_is_as_rarely_out_of_bounds_as_a_false_alarm(draws: int) -> None:
    least, most = random_bounds.bound_count(draws, 0.9, 0.95)
    alarm = random_bounds.FALSE_ALARM / 2
    assert binom.cdf(least - 1, draws, 0.9) < alarm <= binom.cdf(least, draws, 0.9)
    assert binom.sf(most, draws, 0.95) <= alarm < binom.sf(most - 1, draws, 0.95)


def test_a_mean_may_lie_further_away_the_fewer_and_the_wider_its_values() -> None:
    values = np.random.default_rng(0).normal(size=400)
    wide = random_bounds.bound_mean(values)
    assert wide == pytest.approx(norm.isf(random_bounds.FALSE_ALARM / 2) / 20, rel=0.1)
    assert random_bounds.bound_mean(3.0 * values, 0.5) == pytest.approx(3.0 * wide + 0.5)
    assert random_bounds.bound_mean(values[:100]) == pytest.approx(2.0 * wide, rel=0.2)
