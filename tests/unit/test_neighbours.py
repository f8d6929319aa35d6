"""Minima beside an estimate: looked for where the loss is rough, told by the intervals."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.models.library import load_model
from sysid.neighbours import Neighbourhood, neighbourhood, widened
from sysid.problem import Problem
from sysid.refinement import refine
from sysid.result import Estimate
from sysid.uncertainty import analyse
from tests.searching import COULOMB, example, noisy, record

FALSE = np.array([0.192, 0.495, 5.002, 0.485])


def rough(seed: int = 70_043) -> Problem:
    """Example 2 with dry friction: its loss jumps."""
    return Problem.build(load_model("coulomb-eq16"), [record(noisy("coulomb-eq16", seed=seed))])


def around(problem: Problem, start: np.ndarray, left: int | None = None) -> Neighbourhood:
    end = refine(problem, [start])[0]
    assert end is not None
    known = analyse(problem, end.theta).uncertainty
    assert known is not None
    return neighbourhood(problem, end.theta, end.rms, known.covariance, 1, left)


def test_beside_the_optimum_of_a_smooth_loss_nothing_more_than_a_look_is_spent() -> None:
    found = around(example(), np.array([0.2, 0.5, 5.0, 1.0]))
    assert found.best is None
    assert found.rms.size == 1
    assert found.evaluations == 24


def test_beside_a_minimum_of_a_rough_loss_others_are_found_inside_bounds_and_budget() -> None:
    problem = rough()
    found = around(problem, FALSE, 700)
    assert found.rms.size > 5
    assert np.unique(found.rms.round(6)).size > 1
    assert found.rms[-1] == found.rms.min()
    assert 24 < found.evaluations <= 700
    assert np.all(
        (found.values >= problem.evaluator.lower) & (found.values <= problem.evaluator.upper)
    )
    assert found.rms == pytest.approx(problem.fitness(found.values), rel=1e-12)
    if found.best is not None:
        assert found.best.rms == found.rms.min() < found.rms[0]


def test_one_of_several_minima_leads_to_a_better_one() -> None:
    truth = np.array([COULOMB[name] for name in ("c", "L", "b", "mu")])
    gains = [around(rough(seed), truth).best is not None for seed in range(6)]
    assert any(gains)


def test_the_same_seed_finds_the_same_bits() -> None:
    one, other = around(rough(), FALSE, 500), around(rough(), FALSE, 500)
    assert one.values.tobytes() == other.values.tobytes()
    assert one.rms.tobytes() == other.rms.tobytes()


def test_without_a_budget_nothing_is_simulated() -> None:
    assert around(rough(), FALSE, 0).evaluations == 0


ONE = Estimate("a", "1", 2.0, 0.0, 5.0, 0.1, (1.8, 2.2), "identified", "")


@pytest.mark.parametrize(("ratio", "low"), [(0.0, 1.4), (2.0, 1.6 - 0.1 * np.sqrt(2)), (4.1, 1.8)])
def test_an_interval_holds_the_values_of_minima_that_the_data_do_not_rule_out(
    ratio: float, low: float
) -> None:
    n = 50
    rms = np.array([1.0, np.exp(ratio / (2 * n))])
    found = Neighbourhood(None, np.array([[2.0], [1.6]]), rms, 0)
    wide = widened((ONE,), ("a",), n, found)[0]
    assert wide == replace(ONE, interval95=wide.interval95)
    assert wide.interval95 == pytest.approx((low, 2.2))


def test_an_estimate_without_a_standard_error_gets_none_by_its_neighbours() -> None:
    blind = replace(ONE, stderr=None, interval95=None)
    found = Neighbourhood(None, np.array([[2.0]]), np.array([1.0]), 0)
    assert widened((blind,), ("a",), 50, found) == (blind,)


def test_beside_a_perfect_fit_nothing_else_is_likely() -> None:
    found = Neighbourhood(None, np.array([[2.0], [1.6]]), np.array([0.0, 1e-9]), 0)
    assert widened((ONE,), ("a",), 50, found)[0].interval95 == pytest.approx((1.8, 2.2))
