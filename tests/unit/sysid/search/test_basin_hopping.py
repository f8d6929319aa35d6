"""Where hops lead to: along the covariance of the estimate, or off its valley."""

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Stop
from sysid.core.types import FloatArray
from sysid.islands.archipelago import create_islands, make_plans
from sysid.search.basin_hopping import hop_from_champion
from sysid.search.schedule import HOP_ALONG_COVARIANCE, HOP_IN_ONE_PARAMETER
from sysid.search.slopes import build_normal_equations
from sysid.simulation.evaluator import Evaluator
from sysid.simulation.scaling import to_unit
from tests.support.library.search_problems import COULOMB, example

ALONE = GeneticAlgorithm(population=12, islands=1, stop=Stop(evaluations=6_000))
PROBLEM = example("coulomb-eq16")
(PLAN,) = make_plans(PROBLEM, ALONE, 3)
BEGIN = to_unit(PROBLEM.evaluator, np.array([[COULOMB[p.name] for p in PROBLEM.free_parameters]]))[
    0
]
DRAWN = 400


def measure_hops(
    hop: int, is_evidence: bool = True, evaluator: Evaluator = PROBLEM.evaluator
) -> FloatArray:
    """How far hops of that kind lead (DRAWN, D), each by its own draw."""
    island = create_islands(PROBLEM, ALONE, 3)[0]
    search, ends = island.search, np.empty((DRAWN, BEGIN.size))
    search["hop"], search["hop_is_evidence"] = hop, is_evidence
    search["hop_count"] = 4  # four hops have looked for jumps
    for k in range(DRAWN):
        search["generation"], before = k, island.evaluations
        island.point[:] = BEGIN
        hop_from_champion(evaluator, PLAN, island.arrays)
        assert island.evaluations - before == BEGIN.size + 1
        ends[k] = island.point
    return ends - BEGIN


@pytest.mark.parametrize("is_evidence", [True, False])
def test_a_hop_of_one_parameter_moves_each_of_them_in_its_turn_and_no_other(
    is_evidence: bool,
) -> None:
    moves = measure_hops(HOP_IN_ONE_PARAMETER, is_evidence)
    assert np.all(np.sum(moves != 0.0, axis=1) == 1)
    assert np.all(np.abs(np.sum(moves != 0.0, axis=0) - DRAWN / 4) < 5 * np.sqrt(DRAWN * 3 / 16))
    others = measure_hops(HOP_ALONG_COVARIANCE, is_evidence)
    assert np.all(np.sum(others != 0.0, axis=1) == BEGIN.size)


def test_it_leads_3_to_500_standard_errors_of_a_parameter_whose_fellows_are_held() -> None:
    moves = measure_hops(HOP_IN_ONE_PARAMETER)
    search = create_islands(PROBLEM, ALONE, 3)[0].search
    assert search["wide_differences"] == 0  # hops take the same derivatives
    matrix, _, base = build_normal_equations(PROBLEM.evaluator, PLAN, BEGIN, 1.0, 1e-6)
    inside = np.all((moves + BEGIN > 0.0) & (moves + BEGIN < 1.0), axis=1)
    assert np.mean(inside) > 0.8
    errors = np.abs(moves[inside] * np.sqrt(np.diag(matrix)) / base).sum(axis=1)
    # The logarithm of a normal number's size has a mean of -0.635, and is spread by 1.11.
    wanted = 0.5 * (np.log(3.0) + np.log(500.0)) - 0.635
    assert abs(np.mean(np.log(errors)) - wanted) < 0.5
    assert np.max(errors) < 500.0 * 4.5
    assert np.median(errors) > 10.0


def test_a_parameter_that_changes_nothing_stays() -> None:
    blind = PROBLEM.evaluator._replace(weight=np.zeros_like(PROBLEM.evaluator.weight))
    assert np.all(measure_hops(HOP_IN_ONE_PARAMETER, evaluator=blind) == 0.0)


@pytest.mark.parametrize("is_evidence", [True, False])
def test_hops_that_are_evidence_look_for_jumps_whichever_way_they_lead(is_evidence: bool) -> None:
    """Whether the fitness jumps decides what settles a search: all of the first hops have to."""
    for hop in (HOP_ALONG_COVARIANCE, HOP_IN_ONE_PARAMETER):
        island = create_islands(PROBLEM, ALONE, 3)[0]
        island.search["hop"], island.search["hop_is_evidence"] = hop, is_evidence
        island.point[:] = BEGIN
        spent = island.evaluations + BEGIN.size + 1
        hop_from_champion(PROBLEM.evaluator, PLAN, island.arrays)
        assert (island.evaluations > spent) == is_evidence
        assert island.search["champion_discontinuities"] == 0 or is_evidence
