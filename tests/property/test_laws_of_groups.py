"""Laws of what is told of parameters that the data do not tell apart."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identifiability.combinations import (
    classify_directions,
    express_combinations,
    find_blocks,
    find_unidentified,
)
from sysid.models.catalogue.load import load_model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate

NAMES = "abcdef"


def directions(rng: np.random.Generator, d: int, m: int) -> FloatArray:
    """Orthonormal directions (m, D) whose entries are of very unlike sizes."""
    drawn = rng.standard_normal((m, d)) * 10.0 ** rng.uniform(-2.2, 0.0, (m, d))
    return np.linalg.svd(drawn, full_matrices=False)[2]


@given(st.integers(2, 6), st.integers(0, 2**32 - 1), st.data())
def test_a_group_has_two_members_and_does_not_change_along_any_direction(
    d: int, seed: int, data: st.DataObject
) -> None:
    rng = np.random.default_rng(seed)
    null = directions(rng, d, data.draw(st.integers(1, d - 1)))
    value = rng.choice([-1.0, 1.0], d) * 10.0 ** rng.uniform(-3, 4, d)
    unit = np.abs(value) * 10.0 ** rng.uniform(-0.5, 1.5, d)
    member = np.any(null**2 > 1e-5, axis=0)
    for block in find_blocks(null, member):
        for group in express_combinations(block, NAMES, value, unit, np.diag(unit**2)):
            assert len(group.members) >= 2
            assert group.members == tuple(sorted(set(group.members)))
            assert all(name in group.expression for name in group.members)
            parts = _parts(group.expression, value, unit)
            assert set(np.flatnonzero(parts)) == {NAMES.index(one) for one in group.members}
            change = np.abs(null @ parts) / np.linalg.norm(parts)
            assert np.max(change) < 0.01


def _parts(expression: str, value: FloatArray, unit: FloatArray) -> FloatArray:
    """By how much an expression changes with the places, by complex steps."""
    steps = value + 1e-30j * np.diag(unit)
    found = [eval(expression, dict(zip(NAMES, one, strict=False))) for one in steps]
    return np.array([one.imag * 1e30 for one in found])


@given(st.integers(2, 6), st.integers(0, 2**32 - 1))
def test_a_standard_error_of_half_the_range_is_never_said_to_be_told(d: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = directions(rng, d, d)
    singular = np.sort(10.0 ** rng.uniform(-3, 1, d))[::-1]
    null = np.arange(d) >= d - rng.integers(0, 2)
    root = rows[~null] / singular[~null, None]
    covariance = root.T @ np.diag(10.0 ** rng.uniform(-2, 2, len(root))) @ root
    found = classify_directions(singular, rows, null, np.zeros(d, dtype=np.bool_), covariance, 0.1)
    told_nothing = {d for block in find_unidentified(found) for d in block.members.tolist()}
    assert set(np.flatnonzero(np.diag(covariance) >= 0.25)) <= told_nothing


@pytest.mark.parametrize("seed", range(3))
def test_of_a_nearly_constant_output_no_group_has_one_member(seed: int) -> None:
    times = 0.1 * np.arange(200.0)
    y = 1e-3 * np.random.default_rng(0).standard_normal((2, 200))[1]
    u = Channel("u", times, 1.0 + 1e-6 * times / 20, hold="zero")
    posed = Problem.build(load_model("sopdt"), [Record((u,), (Channel("y", times, y),))])
    span = posed.evaluator.upper - posed.evaluator.lower
    place = np.random.default_rng(seed).uniform(size=len(posed.free_parameters))
    end = refine_candidates(posed, [posed.evaluator.lower + span * place])[0]
    assert end is not None
    found = analyse_estimate(posed, end.theta)
    assert found.uncertainty is not None
    groups = found.uncertainty.groups
    assert all(len(one.members) >= 2 for one in groups)
    told = {name for one in groups for name in one.members}
    assert {e.name for e in found.estimates if e.status == "group"} <= told
