"""How an input is held between its samples: said by the user, asked about by a warning."""

import numpy as np
import pytest

from sysid.core.errors import InvalidRecord
from sysid.core.settings import GeneticAlgorithm
from sysid.data.records import Channel, Recording
from sysid.identification.identify import identify
from sysid.identification.result import Identification
from sysid.models.catalogue.load import load_model

PERIOD, LAG = 0.5, 3.2


def step_test() -> Recording:
    """A step test of K = 1.5, T = 8 s, L = 3.2 s whose input is held between samples."""
    times = PERIOD * np.arange(200)
    response = np.where(times > 10 + LAG, 1.5 * (1 - np.exp(-(times - 10 - LAG) / 8)), 0.0)
    return Recording(
        (
            Channel("u", times, np.where(times >= 10, 1.0, 0.0), "V"),
            Channel("y", times, response, "bar"),
        )
    )


def fitted(recording: Recording) -> Identification:
    record = recording.to_record({"u": "u"}, {"y": "y"})
    return identify(load_model("fopdt"), record, GeneticAlgorithm(generations=100))


def lag(found: Identification) -> float:
    return next(one.value for one in found.estimates if one.name == "L")


def test_a_held_input_gives_the_true_lag_of_a_step_test() -> None:
    assert lag(fitted(step_test().replace_holds({"u": "zero"}))) == pytest.approx(LAG, abs=0.02)


def test_a_step_that_is_read_as_a_ramp_is_asked_about() -> None:
    found = fitted(step_test())
    assert abs(lag(found) - LAG) > 0.1
    assert any("use hold: {u: zero}" in one for one in found.warnings)


def test_a_held_input_is_not_asked_about() -> None:
    found = fitted(step_test().replace_holds({"u": "zero"}))
    assert not any("hold" in one for one in found.warnings)


def test_the_hold_of_a_channel_that_is_not_there_is_refused() -> None:
    with pytest.raises(InvalidRecord, match="no channel 'v'"):
        step_test().replace_holds({"v": "zero"})
