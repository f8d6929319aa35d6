"""Bounds that are too narrow for the data are told as such, with which of them to widen."""

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.results.identification import Identification
from sysid.simulation.simulate import simulate

QUICK = GeneticAlgorithm(population=60, generations=40, islands=2)
TRUTH = {"K": 2.0, "T": 0.6, "L": 0.3, "y0": 0.0, "x(0)": 0.0}


def identify_response(offset: float, y0: dict[str, float] | None = None) -> Identification:
    """A first-order response on top of an offset that given bounds may not foresee."""
    times = 0.05 * np.arange(400.0)
    u = Channel("u", times, np.where((times // 3) % 2 < 1, 0.0, 1.0), hold="zero")
    clean = simulate(load_model("fopdt"), [u], TRUTH, times=times).channels[0]
    noise = np.random.default_rng(1).normal(0, 0.02, times.size)
    y = Channel("y", times, clean.values + offset + noise)
    ten = {"lower": -10.0, "upper": 10.0}
    changes = {
        "K": ten,
        "T": {"lower": 0.01, "upper": 100.0},
        "L": {"upper": 5.0},
        "y0": y0 or ten,
        "x(0)": ten,
    }
    return identify(load_model("fopdt"), Record((u,), (y,)), QUICK, parameters=changes)


@pytest.mark.parametrize("offset", [40.0, 101_325.0, -3e6])
def test_an_offset_outside_its_bounds_is_at_bound_and_is_the_one_to_widen(offset: float) -> None:
    found = identify_response(offset)
    y0 = next(one for one in found.parameters if one.name == "y0")
    assert y0.status == "at bound"
    side, cure, bound = ("upper", "raise", 10) if offset > 0 else ("lower", "lower", -10)
    (told,) = [
        one for one in found.warnings if one.startswith(f"y0 is at its {side} bound {bound}")
    ]
    assert f"{cure} the bound of y0" in told


def test_the_verdict_names_the_bound_that_is_too_narrow() -> None:
    assert "y0 lies at its bound" in identify_response(40.0).verdict.text


def test_with_bounds_that_are_wide_enough_nothing_is_said_of_them() -> None:
    found = identify_response(40.0, {"lower": 0, "upper": 100})
    assert not any("To widen" in one for one in found.warnings)
    values = {one.name: one.value for one in found.parameters}
    assert values["y0"] == pytest.approx(40.0, abs=0.05)
