"""Sources of noise that the data do not rule out: doubtful only if they move something."""

import numpy as np
import pytest

from sysid.core.findings import Finding, Move
from sysid.core.settings import Loss, NoiseModel
from sysid.data.records import Channel, Record
from sysid.judgement.conclusions import conclude_estimates, conclude_verdict
from sysid.judgement.noise_sources import (
    OpenSource,
    SourceComparison,
    find_no_response,
    find_open_sources,
    name_source,
    open_defect,
)
from sysid.models.catalogue.load import load_model
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import Estimate
from tests.support.library.search_problems import example

GAIN = Estimate("K", "1", 2.0, 0.0, 9.0, 0.1, (1.8, 2.2), "identified")
LAG = Estimate("L", "s", 4.0, 0.0, 9.0, 0.1, (3.8, 4.2), "identified")
SIZE = Estimate("load[u]", "1", 3.0, 0.01, 99.0, 0.1, (2.8, 3.2), "identified")
VALUES = {"K": 2.0, "L": 4.0, "load[u]": 3.0}


def compare(name: str, gain: float, **values: float) -> SourceComparison:
    stderrs = {"K": 0.1, "L": 0.1}
    other = OpenSource("a drift of y", "loss: {noise_model: drift}", gain, values, stderrs)
    return SourceComparison(name, VALUES, (other,))


def build(noise_model: NoiseModel) -> Problem:
    times = np.arange(100.0)
    u, y = (Channel(name, times, (times > 20) * 1.0, hold="zero") for name in "uy")
    loss = Loss(noise_model=noise_model)
    return Problem.build(load_model("fopdt"), [Record((u,), (y,))], loss=loss)


def test_a_source_makes_what_it_moves_doubtful() -> None:
    estimates, problem = (GAIN, LAG, SIZE), example()
    comparison = compare("a slow load at u", -2.0, K=2.3, L=4.02)
    (told,) = find_open_sources(comparison, problem, estimates)
    assert told.parameters == ("K",)
    assert [(one.parameter, one.value) for one in told.moves] == [("K", 2.3), ("L", 4.02)]
    concluded = conclude_estimates(estimates, [told])
    assert [one.status for one in concluded] == ["dependent", "identified", "identified"]
    low, high = concluded[0].interval95 or (0.0, 0.0)
    assert low < 1.85
    assert high > 2.35
    assert "2.30 ± 0.10 if the data do not tell a slow load at u from a drift of y" in (
        concluded[0].reason
    )
    verdict = conclude_verdict(concluded, [told], ["K", "L"])
    assert verdict.text.startswith("trustworthy but for K: the data do not tell a slow load at u")


def test_a_source_that_moves_nothing_is_a_note() -> None:
    comparison = compare("a slow load at u", -2.0, K=2.05, L=4.02)
    (told,) = find_open_sources(comparison, example(), (GAIN, LAG, SIZE))
    assert (told.severity, told.parameters, told.advice) == ("note", (), "")
    assert "the estimates are nearly the same" in told.text


def test_beside_a_free_run_it_explains_as_much_as_what_was_found() -> None:
    (told,) = find_open_sources(compare("", 40.0, K=2.3), example(), (GAIN, LAG))
    assert told.brief == "a drift of y explains as much"
    assert "With that (loss: {noise_model: drift}), K is 2.30 ± 0.10." in told.text
    assert "Move q there and back" in told.advice


def test_a_defect_is_a_source_too() -> None:
    moves = (Move("K", 1.5, 0.1, -5.0),)
    jump = Finding("step", "sensor", "caution", "y jumps at about 9 s", "", "", 30.0, moves, ("K",))
    other = open_defect(jump, {"K": 2.0, "L": 4.0}, -3.0)
    comparison = SourceComparison("a slow load at u", VALUES, (other,))
    (told,) = find_open_sources(comparison, example(), (GAIN, LAG, SIZE))
    assert told.parameters == ("K",)
    assert told.brief == "the data do not tell a slow load at u from a defect: y jumps at about 9 s"
    assert "With that (loss: {noise_model: white}), K is 1.50 ± 0.10." in told.text


@pytest.mark.parametrize(("gain", "is_told"), [(None, False), (50.0, False), (2.0, True)])
def test_a_plant_that_shows_no_response_has_no_estimate(gain: float | None, is_told: bool) -> None:
    told = list(find_no_response(build("load"), gain, (GAIN, LAG, SIZE)))
    assert bool(told) == is_told
    if told:
        assert told[0].brief == "nothing shows that u moves y"
        concluded = conclude_estimates((GAIN, LAG), told)
        assert {one.status for one in concluded} == {"dependent"}
        assert conclude_verdict(concluded, told, ["K", "L"]).trust == "not trustworthy"


def test_nothing_was_compared() -> None:
    assert not list(find_open_sources(None, example(), (GAIN, LAG)))


@pytest.mark.parametrize(
    ("noise_model", "name"),
    [
        ("load", "a slow load at u"),
        ("drift", "a drift of y"),
        ("plant", "noise in x and u"),
    ],
)
def test_sources_have_names(noise_model: NoiseModel, name: str) -> None:
    assert name_source(build(noise_model)) == name
