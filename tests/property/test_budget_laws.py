"""Laws of the budget of simulations: what is counted never exceeds it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid.core.errors import InvalidSettings
from sysid.core.settings import SEARCH_METHODS, GeneticAlgorithm, SearchMethod, Stop
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from tests.support.profiles import scale_examples

TIMES = 0.05 * np.arange(120.0)
LAG = load_model("fopdt")
BOUNDS = {"L": {"upper": 2.0}}


def build_polynomial() -> Model:
    """A recursion whose starts are sought by least squares, which counts too."""
    return parse_model(
        {
            "name": "n",
            "form": "polynomial",
            "output": "y",
            "inputs": {"u": "1"},
            "degree": 2,
            "lags": {"y": [1], "u": ["1 + d"]},
            "coefficients": {"lower": -2, "upper": 2},
            "parameters": {"d": {"lower": 0, "upper": 6}},
        }
    )


def make_record() -> Record:
    rng = np.random.default_rng(1)
    u = Channel("u", TIMES, np.repeat(rng.uniform(-1, 1, 12), 10), hold="zero")
    y = np.convolve(u.values, 0.1 * 0.9 ** np.arange(60))[: TIMES.size]
    return Record((u,), (Channel("y", TIMES, y + rng.normal(0, 0.01, TIMES.size)),))


@pytest.mark.parametrize("model", [LAG, build_polynomial()], ids=["lag", "polynomial"])
@settings(max_examples=scale_examples(25))
@given(
    budget=st.integers(24, 900),
    method=st.sampled_from(SEARCH_METHODS),
    refine=st.booleans(),
    population=st.sampled_from([24, 50, 130]),
    islands=st.sampled_from([None, 1, 6]),
)
def test_a_budget_is_never_exceeded_or_refused_where_one_population_does(
    model: Model,
    budget: int,
    method: SearchMethod,
    refine: bool,
    population: int,
    islands: int | None,
) -> None:
    def algorithm() -> GeneticAlgorithm:
        return GeneticAlgorithm(
            method, population, islands=islands, refine=refine, stop=Stop(evaluations=budget)
        )

    if budget < population:
        with pytest.raises(InvalidSettings, match="one simulation for each of the") as caught:
            algorithm()
        assert caught.value.pointer == "/algorithm/stop/evaluations"
        return
    found = identify(model, make_record(), algorithm(), parameters=BOUNDS if model is LAG else None)
    assert population <= found.evaluations <= budget


def test_of_a_budget_that_leaves_none_for_standard_errors_it_is_said_why_there_are_none() -> None:
    algorithm = GeneticAlgorithm(stop=Stop(evaluations=50))
    found = identify(LAG, make_record(), algorithm, parameters=BOUNDS)
    assert found.evaluations <= 50
    assert all(one.stderr is None for one in found.parameters)
    assert all("the budget of simulations" in one.reason for one in found.parameters)
