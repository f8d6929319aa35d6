"""Short records whose outputs walk at random, for the likelihoods of filters."""

from collections.abc import Sequence

import numpy as np

from sysid.data.records import Channel, Record

PERIOD, SAMPLES = 0.25, 60


def make_walk(outputs: Sequence[str] = ("y",), missing: Sequence[int] = ()) -> Record:
    """Make a record of a white, held input; each output lacks the samples of these numbers."""
    random = np.random.default_rng(5)
    times = PERIOD * np.arange(SAMPLES)
    u = random.normal(size=SAMPLES)
    channels = []
    for name in outputs:
        y = np.cumsum(0.3 * random.normal(size=SAMPLES))
        y[list(missing)] = np.nan
        channels.append(Channel(name, times, y))
    return Record((Channel("u", times, u, hold="zero"),), tuple(channels))
