"""A bound that is a limit of the quantity itself is no doubt, and one of the search is."""

from typing import Any

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.results.identification import Identification
from sysid.simulation.simulate import simulate

MODEL = load_model("sopdt")
QUICK = GeneticAlgorithm(population=60, generations=40, islands=2)
TRUTH = {"K": 2.0, "T1": 8.0, "L": 3.0, "y0": 1.0, "w(0)": 0.0, "x(0)": 0.0}


def draw_record(r: float, seed: int) -> Record:
    """A second-order process under steps, whose faster time constant is r times the slower one."""
    generator = np.random.default_rng(seed)
    times = np.arange(400.0)
    u = Channel("u", times, np.repeat(generator.normal(size=16), 25), hold="zero")
    clean = simulate(MODEL, [u], TRUTH | {"r": r}, times=times).channels[0].values
    noise = 0.02 * float(np.std(clean)) * generator.normal(size=times.size)
    return Record((u,), (Channel("y", times, clean + noise),))


def identify_process(r: float, seed: int = 1, **changes: Any) -> Identification:
    return identify(
        MODEL, draw_record(r, seed), QUICK, parameters={"r": changes} if changes else {}
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("r", [0.9, 1.0])
def test_time_constants_that_are_nearly_or_quite_equal_are_determined(r: float, seed: int) -> None:
    found = identify_process(r, seed)
    assert found.verdict.text == "trustworthy"
    for name, truth in {"r": r, "T1": TRUTH["T1"], "L": TRUTH["L"]}.items():
        assert found[name].status == "identified"
        assert found[name].open_ends == ()
        low, high = found[name].interval95 or (0.0, 0.0)
        assert low <= truth <= high
    assert (found["r"].interval95 or (0.0, 0.0))[1] == 1.0


def test_an_estimate_at_its_limit_is_a_note() -> None:
    found = next(
        one for seed in range(1, 20) if (one := identify_process(1.0, seed))["r"].value == 1.0
    )
    assert found.verdict.text == "trustworthy"
    assert found["r"].reason == "it lies at its bound, a limit of the quantity"
    (told,) = [one for one in found.findings if one.explanation == "bound"]
    assert (told.severity, told.parameters) == ("note", ("r",))
    assert told.text == "r lies at its upper bound 1, a limit of the quantity"
    assert told.advice == ""


def test_a_job_that_narrows_the_range_has_a_bound_of_the_search() -> None:
    found = identify_process(0.9, upper=0.6)
    assert found["r"].status == "at bound"
    (told,) = [one for one in found.findings if one.explanation == "bound"]
    assert told.severity != "note"
    expected = (
        "Widen the range, or set parameters: {r: {physical: upper}} if it is a physical limit."
    )
    assert told.advice == expected
    (warning,) = [one for one in found.warnings if "r lies at its upper bound 0.6" in one]
    assert "set parameters={'r': {'physical': 'upper'}} if" in warning


def test_data_that_pull_a_parameter_over_its_limit_are_told_as_such() -> None:
    change = {"K": {"upper": 0.5 * TRUTH["K"], "physical": "upper"}}
    found = identify(MODEL, draw_record(0.9, 1), QUICK, parameters=change)
    assert found["K"].status == "at bound"
    (told,) = [one for one in found.findings if one.explanation == "bound"]
    assert told.brief == "the data pull K over its physical limit"
    assert told.severity == "serious"
    assert "widen" not in told.sentences
    assert "raise the bound" not in told.sentences
