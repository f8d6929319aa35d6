"""Compile, or load from the cache, every loop that a run needs, before the first run."""

from pathlib import Path

import numpy as np

from sysid.core.settings import SEARCH_METHODS, GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.conclude import conclude_run
from sysid.identification.fingerprint import compute_fingerprint
from sysid.identification.run import advance_run, begin_run
from sysid.models.catalogue.load import load_model
from sysid.simulation.problem import Problem


def warm_up_worker() -> str:
    """Run a few generations of each method on a record of a few samples.

    Returns
    -------
    str
        Fingerprint of the program of this process (`sysid.identification.fingerprint`).
    """
    times: FloatArray = np.arange(40, dtype=np.float64) * 0.5
    values = 1.0 - np.exp(-times)
    record = Record((Channel("u", times, np.ones_like(times)),), (Channel("y", times, values),))
    problem = Problem.build(load_model("fopdt"), (record,))
    for method in SEARCH_METHODS:
        algorithm = GeneticAlgorithm(method=method, population=16, generations=4)
        state = advance_run(problem, algorithm, begin_run(problem, algorithm, 1))
        conclude_run(problem, algorithm, state)
    return compute_fingerprint(Path(__file__).parent)
