"""Small problems and comparisons for the tests of the search."""

from dataclasses import replace
from functools import cache

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.islands.run_state import RunState
from sysid.models.catalogue.load import load_model
from sysid.search.island import Island
from sysid.simulation.problem import Problem

STEP = 0.02
DUFFING = {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0}
COULOMB = {"c": 0.2, "L": 0.5, "b": 5.0, "mu": 0.5}


def force(n: int) -> Channel:
    times = STEP * np.arange(n)
    return Channel("q", times, 10.0 * np.cos(5.0 * times), "N", hold="zero")


def record(y: FloatArray) -> Record:
    return Record((force(y.size),), (Channel("y", STEP * np.arange(y.size), y, "m"),))


@cache
def clean(model: str = "duffing-eq16", n: int = 300) -> FloatArray:
    """The free run of the true model."""
    truth = DUFFING if model == "duffing-eq16" else COULOMB
    problem = Problem.build(load_model(model), [record(np.zeros(n))])
    theta = np.array([[truth[p.name] for p in problem.free_parameters]])
    return problem.predict(theta)[0]


def noisy(model: str = "duffing-eq16", n: int = 300, sd: float = 0.01, seed: int = 0) -> FloatArray:
    return clean(model, n) + sd * np.random.default_rng(seed).standard_normal(n)


@cache
def example(model: str = "duffing-eq16", n: int = 300, sd: float = 0.01, seed: int = 0) -> Problem:
    """The paper's Example 1 or 2."""
    return Problem.build(load_model(model), [record(noisy(model, n, sd, seed))])


def with_search(island: Island, **fields: float) -> Island:
    """The same island with other values in its search record."""
    search = island.search.copy()
    for name, value in fields.items():
        search[name] = value
    return replace(island, search=search)


def bits(state: RunState | Island) -> tuple[object, ...]:
    """Everything of a run but its clock, so that two of them can be compared bit for bit."""
    if isinstance(state, RunState):
        islands = tuple(bits(island) for island in state.islands)
        return (state.generation, state.epoch, state.has_ended, state.migrations, islands)
    arrays = (state.chromosomes, state.fitness, state.search, state.point, state.archive)
    return (state.index, state.history, *(array.tobytes() for array in arrays))
