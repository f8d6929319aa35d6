"""A good result warns of nothing, and of a doubtful one no sentence is superfluous."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.judgement.determination import find_undetermined
from sysid.models.catalogue.load import load_model
from sysid.results.identification import Identification
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate
from tests.support.library.search_problems import DUFFING as TRUTH
from tests.support.library.search_problems import noisy, record

DUFFING, FOPDT = load_model("duffing-eq16"), load_model("fopdt")
TIMES = 0.02 * np.arange(300)


def driven(name: str, u: FloatArray, y: FloatArray) -> Record:
    return Record((Channel(name, TIMES, u, hold="zero"),), (Channel("y", TIMES, y),))


def draw_noise(sd: float = 0.01) -> FloatArray:
    return sd * np.random.default_rng(0).standard_normal(300)


def is_warned(found: Identification, words: str) -> bool:
    return any(words in warning for warning in found.warnings)


@pytest.mark.parametrize("model", ["duffing-eq16", "coulomb-eq16"])
@pytest.mark.parametrize("seed", range(4))
def test_the_papers_examples_are_warned_of_nothing(model: str, seed: int) -> None:
    assert identify(load_model(model), record(noisy(model, seed=seed)), seed=seed).warnings == ()


def test_residuals_of_an_estimate_that_is_no_optimum_say_nothing_of_the_model() -> None:
    found = identify(DUFFING, record(noisy()), GeneticAlgorithm(method="simple"))
    assert is_warned(found, "not a local optimum")
    assert not is_warned(found, "not white")


def respond_without_noise(period: float, lag: int, time_constant: float, u: FloatArray) -> Record:
    """Respond to a held input with a gain of 2, after a lag of whole samples."""
    read = np.concatenate([np.full(lag, u[0]), u[:-lag]])
    y, decay = np.full(u.size, 2.0 * u[0]), np.exp(-period / time_constant)
    for i in range(u.size - 1):
        y[i + 1] = decay * y[i] + (1 - decay) * 2.0 * read[i]
    t = period * np.arange(u.size)
    return Record((Channel("u", t, u),), (Channel("y", t, y),))


def test_residuals_of_the_solver_are_no_doubt_about_the_minimum() -> None:
    """Where held input and time lag meet, the integration error has kinks: no optimum, no noise."""
    t = 0.1 * np.arange(600)
    command = np.sign(np.sin(0.3 * t) + np.sin(0.17 * t))
    found = identify(FOPDT, respond_without_noise(0.1, 5, 3.0, command))
    values = {estimate.name: estimate.value for estimate in found.parameters}
    assert values["L"] == pytest.approx(0.5, abs=1e-4)
    assert not is_warned(found, "not a local optimum")
    assert not is_warned(found, "white")


def test_residuals_of_the_solver_are_no_defect_even_at_the_finest_step() -> None:
    """They are larger than a share of the output, and smaller than what finer steps leave."""
    command = np.repeat(np.where(np.random.default_rng(1).random(40) < 0.5, -1.0, 1.0), 10)
    found = identify(FOPDT, respond_without_noise(0.42, 13, 5.29, command))
    assert found["L"].value == pytest.approx(13 * 0.42, abs=1e-4)
    assert found.verdict.text == "trustworthy"


def test_an_input_that_is_constant_in_one_record_only_is_not_told() -> None:
    at_rest = Record(
        (Channel("q", TIMES, 0.0 * TIMES, "N", hold="zero"),),
        (Channel("y", TIMES, draw_noise(), "m"),),
    )
    assert not is_warned(identify(DUFFING, [record(noisy()), at_rest]), "excites nothing")


def test_of_parameters_without_a_standard_error_only_their_groups_are_told() -> None:
    found = identify(FOPDT, driven("u", 0.0 * TIMES + 2.0, 3.0 + draw_noise()))
    assert is_warned(found, "input 'u' is constant, so it excites nothing")
    assert not is_warned(found, "correlation")


@pytest.mark.parametrize(("sd", "vague"), [(0.01, False), (2.0, True)])
def test_only_a_quantity_of_one_sign_is_told_to_be_no_more_than_its_error(
    sd: float, vague: bool
) -> None:
    fixed = {name: {"fixed": TRUTH[name]} for name in ("a", "b", "L")}
    positive = identify(DUFFING, record(noisy(sd=sd, seed=3)), parameters=fixed)
    assert is_warned(positive, "the standard error of c") is vague
    either = fixed | {"c": {"lower": -2.0, "upper": 5.0}}
    found = identify(DUFFING, record(noisy(sd=sd, seed=3)), parameters=either)
    assert not is_warned(found, "the standard error of c")


def test_a_lag_that_may_as_well_be_zero_is_not_separable_from_what_it_is_on_a_ridge_with() -> None:
    """On a slow ramp a lag and a time constant do the same to the output."""
    known = {"K": {"fixed": 1.0}, "y0": {"fixed": 0.0}, "x(0)": {"fixed": 0.0}}
    sought = known | {"T": {"lower": 0.01, "upper": 2.0}, "L": {"lower": 0.0, "upper": 0.4}}
    problem = Problem.build(FOPDT, [driven("u", TIMES / 6, 0.0 * TIMES)], parameters=sought)
    y = problem.predict(np.array([[0.2, 0.05]]))[0] + draw_noise(0.02)
    found = identify(FOPDT, driven("u", TIMES / 6, y), parameters=sought)
    assert is_warned(found, "T and L are not separable")
    # Coloured residuals may turn the ellipsoid; what one sensitivity makes up for in another stays.
    problem = Problem.build(FOPDT, [driven("u", TIMES / 6, y)], parameters=sought)
    theta = np.array([found[name].value for name in problem.free_names])
    analysis = replace(analyse_estimate(problem, theta), estimates=found.parameters)
    uncertainty = analysis.uncertainty
    assert uncertainty is not None

    def list_ridges(r: float, alike: float) -> list[str]:
        turned = replace(
            uncertainty,
            correlation=np.array([[1.0, r], [r, 1.0]]),
            sensitivity_correlation=np.array([[1.0, alike], [alike, 1.0]]),
        )
        turned_analysis = replace(analysis, uncertainty=turned)
        listed = find_undetermined(problem, turned_analysis, {"L"}, are_residuals_noise=True)
        return [one.text for one in listed if one.explanation == "ridge"]

    alike = float(uncertainty.sensitivity_correlation[0, 1])
    [ridge] = list_ridges(0.5, alike)
    assert "T and L are not separable (correlation 0.500)" in ridge
    assert list_ridges(0.5, 0.5) == []
