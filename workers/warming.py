"""Compile, or load from the cache, every loop that a run needs, before the first run comes."""

from pathlib import Path

import numpy as np

from sysid.models.library import load_model
from sysid.problem import Problem
from sysid.program import program
from sysid.records import Channel, Record
from sysid.run import advance, begin, conclude
from sysid.settings import METHODS, GeneticAlgorithm
from sysid.types import FloatArray


def warm() -> str:
    """A run of a few generations by each method, on a record of a few samples.

    Returns
    -------
    str
        Names the program that this process runs, as `sysid.program` does.
    """
    times: FloatArray = np.arange(40, dtype=np.float64) * 0.5
    values = 1.0 - np.exp(-times)
    record = Record((Channel("u", times, np.ones_like(times)),), (Channel("y", times, values),))
    problem = Problem.build(load_model("fopdt"), (record,))
    for method in METHODS:
        algorithm = GeneticAlgorithm(method=method, population=16, generations=4)
        state = advance(problem, algorithm, begin(problem, algorithm, 1))
        conclude(problem, algorithm, state)
    return program(Path(__file__).parent)
