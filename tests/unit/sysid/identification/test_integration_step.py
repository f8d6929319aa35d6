"""Estimates that the step of the integration has moved by much of their standard error are told."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.data.records import Record
from sysid.identification.integration_step import warn_integration_step
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from tests.catalogue_cases import CASES, made

FINE = 16


def finer(model: Model, times: int) -> Model:
    return replace(model, solver=replace(model.solver, substeps=times * model.solver.substeps))


def noisy(name: str, times: int, share: float, seed: int = 0) -> Record:
    """A record of the true model with a finer step, with white noise of a share of the output."""
    clean = made(finer(load_model(name), times), replace(CASES[name], sigma=0.0))
    random = np.random.default_rng(seed)
    outputs = tuple(
        replace(
            y, values=y.values + share * np.std(y.values) * random.standard_normal(y.values.size)
        )
        for y in clean.outputs
    )
    return Record(clean.inputs, outputs)


def fitted(model: Model, name: str, record: Record) -> tuple[Analysis, list[str]]:
    """The estimate from the truth on, and what is told of its step."""
    problem, case = Problem.build(model, [record]), CASES[name]
    truth = {**case.truth, **case.initial}
    (end,) = refine_candidates(
        problem, [np.array([truth[one.name] for one in problem.free_parameters])]
    )
    assert end is not None
    found = analyse_estimate(problem, end.theta)
    simulated = problem.predict(end.theta[None])[0]
    return found, warn_integration_step(problem, end.theta, found.estimates, simulated)


def test_a_small_error_of_the_step_is_told_where_the_noise_is_smaller() -> None:
    """It moves the output by 5e-4 of its size, and the estimates by nine standard errors."""
    model, record = load_model("fopdt"), noisy("fopdt", FINE, 1e-3)
    coarse, (note,) = fitted(model, "fopdt", record)
    exact, nothing = fitted(finer(model, FINE), "fopdt", record)
    assert nothing == []
    assert note.startswith("the integration step is too long for these estimates: with half of it ")
    assert note.endswith("Give the model solver: {substeps: 8}")
    told = {}
    for part in note.split("with half of it ")[1].split(". Give")[0].split("away"):
        name, _, rest = part.strip(", ").partition(" = ")
        if " instead of " in rest:
            told[name] = float(rest.split()[0])
    values = {one.name: one.value for one in exact.estimates}
    by = {
        one.name: abs(one.value - values[one.name]) / (one.stderr or 1.0)
        for one in coarse.estimates
    }
    assert {name for name, far in by.items() if far > 2} <= set(told)
    assert max(by.values()) > 5
    for one in coarse.estimates:  # half of the step's error, or more, is gone with half the step
        if one.name in told:
            assert abs(told[one.name] - values[one.name]) < 0.7 * abs(one.value - values[one.name])


def test_of_a_record_that_was_simulated_with_the_step_nothing_is_told() -> None:
    for name in ("duffing-delay", "fopdt"):
        assert fitted(load_model(name), name, noisy(name, 1, 1e-5))[1] == []


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    "name",
    [
        "duffing-delay",
        "tube",
        "tube-second-order",
        "fopdt",
        "sopdt",
        "delayed-van-der-pol",
        "delayed-logistic",
    ],
)
def test_ordinary_noise_hides_the_errors_of_the_catalogues_steps(name: str, seed: int) -> None:
    for times in (1, FINE):
        assert fitted(load_model(name), name, noisy(name, times, 0.01, seed))[1] == []


def test_estimates_that_stand_still_are_not_told_though_the_output_moves() -> None:
    """What no parameter can make up for is no error of an estimate."""
    found, notes = fitted(load_model("tube"), "tube", noisy("tube", FINE, 1e-4))
    assert all(one.stderr is not None for one in found.estimates if one.status == "identified")
    assert notes == []
