"""What the driver sends to workers arrives whole."""

import pickle
from dataclasses import fields, replace
from typing import Any

import pytest

from sysid.data.noise import Noise
from tests.support.cluster.small_runs import spec
from workers.protocol import AdvanceRun


@pytest.mark.parametrize(
    "sent",
    [Noise(0.1, 2), spec(7), AdvanceRun("r", spec(7), None, 2.0, 3.0, True)],
    ids=lambda sent: type(sent).__name__,
)
def test_every_field_is_pickled(sent: Any) -> None:
    """A field that `__reduce__` forgets would have its default on a cluster, and nowhere else."""
    kind, values = sent.__reduce__()
    assert values == tuple(getattr(sent, field.name) for field in fields(kind))
    assert pickle.loads(pickle.dumps(sent)) == sent


def test_the_order_of_the_names_of_a_warm_start_makes_no_other_run() -> None:
    """PostgreSQL returns stored estimates in an order of its own."""
    starts = ({"K": 2.0, "L": 0.5}, {"L": 0.5, "K": 2.0}, {"K": 0.5, "L": 2.0})
    keys = [replace(spec(7), warm_starts=(values,)).reuse_key for values in starts]
    assert keys[0] == keys[1] != keys[2]
