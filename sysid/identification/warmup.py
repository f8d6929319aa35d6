"""Compile the search once for an installation, before its first use."""

import numpy as np

from sysid.core.settings import GeneticAlgorithm
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model


def compile_search() -> None:
    """Run a minimal search.

    The search is one compiled function for all models, and its machine code is stored on disk.
    So this takes about a minute after an installation or update, and a moment otherwise. A line
    on stderr tells the former.
    """
    times = 0.1 * np.arange(40.0)
    step = np.where(times < 0.5, 0.0, 1.0)
    u = Channel("u", times, step, hold="first")
    response = 0.5 * (1.0 - np.exp(-np.maximum(times - 0.8, 0.0) / 0.5))  # inside all bounds
    record = Record((u,), (Channel("y", times, response),))
    changes = {"L": {"upper": 1.0}}
    settings = GeneticAlgorithm(population=8, islands=1, generations=2)
    identify(load_model("fopdt"), record, settings, parameters=changes)
