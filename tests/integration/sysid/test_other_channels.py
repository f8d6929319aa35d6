"""Channels that a model does not use: they change no estimate, and one that acts is named."""

from typing import Any

import pandas as pd

from sysid.core.settings import GeneticAlgorithm
from sysid.identification.identify import identify
from sysid.results.identification import Identification
from tests.support.library.judged_records import (
    FAST,
    FINE,
    NOISE,
    TIMES,
    N,
    draw_levels,
    draw_noise,
)
from tests.support.library.judged_records import hold as hold_samples


def make_table(acts: float) -> pd.DataFrame:
    """A valve acts beside the plant; a clock and an operator's name say nothing."""
    u, valve = draw_levels(1), draw_levels(12)
    y = FAST.respond(hold_samples(u + acts * (valve - valve[0])))[::FINE] + NOISE * draw_noise(1)
    columns = {
        "u": u,
        "y": y,
        "valve": valve,
        "seconds": 3.0 + TIMES,
        "who": ["Ann"] * N,
    }
    return pd.DataFrame(columns, index=pd.Index(TIMES, name="t"))


def identify_table(table: pd.DataFrame, **settings: Any) -> Identification:
    return identify(
        "fopdt", table, GeneticAlgorithm(generations=60), channels={"u": "u", "y": "y"}, **settings
    )


def test_channels_that_do_not_act_change_nothing() -> None:
    table = make_table(0.0)
    whole, bare = identify_table(table), identify_table(table[["u", "y"]])
    assert whole.parameters == bare.parameters
    assert whole.findings == bare.findings
    assert whole.verdict == bare.verdict


def test_a_channel_that_acts_is_the_reason() -> None:
    found = identify_table(make_table(0.4))
    first = found.findings[0]
    assert first.explanation == "another input"
    assert "valve acts as another input" in found.verdict.text
    assert "Add valve to the inputs of the model's document" in first.advice


def test_a_part_of_a_record_keeps_the_other_channels() -> None:
    found = identify_table(make_table(0.4), validation_fraction=0.3)
    assert any(one.explanation == "another input" for one in found.findings)
