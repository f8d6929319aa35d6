"""Sums of parameters that move without any change of the output are told as groups."""

from typing import Any

import numpy as np
import pytest

from benchmarks.real_data.emps import asymmetric
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import copy_catalogue_document
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate

TRUTH = {"M": 95.0, "Fv": 200.0, "o": -3.0, "Fp": 24.0, "Fn": 19.0}
TIMES: FloatArray = 0.001 * np.arange(3000, dtype=np.float64)
FORCE = Channel("u", TIMES, 3.0 * np.sin(4.0 * TIMES) + np.sin(17.0 * TIMES), "V")


def drive(**changes: Any) -> tuple[Problem, FloatArray]:
    """A carriage with a friction level for either direction and an offset, at its truth."""
    model = parse_model(asymmetric(copy_catalogue_document("emps")))
    blank = Record((FORCE,), (Channel("y", TIMES, np.zeros(3000), "m"),))
    problem = Problem.build(model, [blank], **changes)
    theta = np.array([TRUTH[p.name] for p in problem.free_parameters])
    noise = 1e-5 * np.random.default_rng(2).standard_normal(3000)
    y = problem.predict(theta[None])[0] + noise
    y[0] = 0.0  # it starts measured
    return Problem.build(
        model, [Record((FORCE,), (Channel("y", TIMES, y, "m"),))], **changes
    ), theta


def test_an_offset_beside_a_friction_of_either_direction_is_a_group() -> None:
    found = analyse_estimate(*drive())
    statuses = {one.name: one.status for one in found.estimates}
    assert statuses == {
        "M": "identified",
        "Fv": "identified",
        "o": "group",
        "Fp": "group",
        "Fn": "group",
    }
    assert found.uncertainty is not None
    values = {group.expression: group.value for group in found.uncertainty.groups}
    assert values == pytest.approx({"o + Fp": 21.0, "o - Fn": -22.0})
    assert all(0 < (group.stderr or 9.0) < 0.1 for group in found.uncertainty.groups)
    assert found.uncertainty.condition == np.inf


def test_with_the_offset_known_both_levels_are_identified() -> None:
    found = analyse_estimate(*drive(parameters={"o": {"fixed": -3.0}}))
    assert {one.status for one in found.estimates if one.name != "o"} == {"identified"}


def test_a_strong_correlation_is_no_group_while_the_output_changes_along_it() -> None:
    model = parse_model(
        {
            "name": "sum",
            "form": "difference",
            "inputs": {"u": "V"},
            "states": {"y": "V"},
            "parameters": {"a": {"lower": 0, "upper": 5}, "b": {"lower": 0, "upper": 5}},
            "equations": {"y": "a*u + b*u*(1 + 0.001*u)"},
            "outputs": {"y": "y"},
            "initial": {"y": 0},
        }
    )
    theta = np.array([2.0, 1.0])
    noise = 1e-7 * np.random.default_rng(2).standard_normal(3000)
    y = 3.0 * FORCE.values + 0.001 * FORCE.values**2 + noise
    problem = Problem.build(model, [Record((FORCE,), (Channel("y", TIMES, y, "V"),))])
    found = analyse_estimate(problem, theta)
    assert [one.status for one in found.estimates] == ["identified"] * 2
    assert found.uncertainty is not None
    assert abs(found.uncertainty.correlation[0, 1]) > 0.99
