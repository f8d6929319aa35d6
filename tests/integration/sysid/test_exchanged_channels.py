"""Channels that are exchanged: the output drives the input, and the verdict says so."""

import numpy as np
import pandas as pd
import pytest

from sysid.core.settings import GeneticAlgorithm
from sysid.identification.identify import identify
from sysid.results.identification import Identification
from tests.support.library.judged_records import (
    FAST,
    FINE,
    NOISE,
    SLOW,
    TIMES,
    Process,
    draw_levels,
    draw_noise,
    hold,
)


def identify_columns(u: np.ndarray, y: np.ndarray) -> Identification:
    table = pd.DataFrame({"u": u, "y": y}, index=pd.Index(TIMES, name="t"))
    return identify("fopdt", table, GeneticAlgorithm(generations=60))


@pytest.mark.parametrize("plant", [FAST, SLOW], ids=["fast", "slow"])
def test_exchanged_channels_are_the_first_reason(plant: Process) -> None:
    u = draw_levels(3)
    y = plant.respond(hold(u))[::FINE] + NOISE * draw_noise(3)
    found = identify_columns(y, u)
    assert found.findings[0].explanation == "exchanged channels"
    assert found.verdict.text.startswith("not trustworthy: y drives u: their channels are exch")
    assert "Give u the channel of y, and y that of u" in found.findings[0].advice
    assert all(one.status != "identified" for one in found.parameters if one.is_free)


def test_a_model_that_fails_for_another_reason_is_not_of_exchanged_channels() -> None:
    """The output is even in the input: no linear model of either explains the other."""
    u = draw_levels(3)
    y = FAST.respond(hold(np.square(u - np.mean(u))))[::FINE] + NOISE * draw_noise(3)
    found = identify_columns(u, y)
    assert all(one.explanation != "exchanged channels" for one in found.findings)


def test_noise_alone_is_not_of_exchanged_channels() -> None:
    found = identify_columns(draw_levels(3), draw_noise(4, 0.8))
    assert all(one.explanation != "exchanged channels" for one in found.findings)
