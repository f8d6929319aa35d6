"""Units: which are the same, by what they differ, and that a record in another one is told."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid.derivations import derive
from sysid.errors import InvalidRecord, InvalidSettings
from sysid.identify import identify
from sysid.models.model import Model
from sysid.models.spec import parse_model
from sysid.records import Channel, Record, Recording
from sysid.settings import GeneticAlgorithm
from sysid.units import difference, factor

TINY = GeneticAlgorithm(population=8, generations=2, islands=1)


@pytest.mark.parametrize(
    ("unit", "other", "times"),
    [("kPa", "Pa", 1e3), ("Pa", "kPa", 1e-3), ("bar", "mbar", 1e3),
     ("psi", "Pa", 6894.757293168361), ("deg", "rad", np.pi / 180), ("rpm", "rad/s", np.pi / 30),
     ("m/s^2", "m/s²", 1.0), ("N/kg", "m/s**2", 1.0), ("kg·m²", "kg m^2", 1.0),
     ("1/(V·s)", "1/V/s", 1.0), ("s⁻¹", "Hz", 1.0), ("µm", "mm", 1e-3), ("min", "s", 60.0),
     ("m", "min", None), ("V", "N", None), ("°C", "K", None), ("counts", "counts", 1.0),
     ("counts", "V", None), ("(m", "m", None),
     ("km^99 km^99 km^99 km^99", "m^396", None), ("m/", "m", None), ("2 m", "m", None)],
)  # fmt: skip
def test_units_differ_by_a_factor_or_by_their_kind(
    unit: str, other: str, times: float | None
) -> None:
    assert factor(unit, other) == (None if times is None else pytest.approx(times, rel=1e-12))


@given(st.text(max_size=90), st.text(max_size=90))
def test_no_text_breaks_the_comparison_and_a_factor_turns_round(unit: str, other: str) -> None:
    there, back = factor(unit, other), factor(other, unit)
    assert (there is None) == (back is None)
    if there is not None and back is not None:
        assert there * back == pytest.approx(1.0)


@given(st.sampled_from(["", " ", "1", "-", None]), st.text(max_size=10))
def test_a_blank_unit_goes_with_every_unit(blank: str | None, unit: str) -> None:
    assert difference(blank, unit) == difference(unit, blank) == ""


def model(u: str = "Pa", y: str = "1") -> Model:
    return parse_model({
        "name": "gauge", "form": "differential", "inputs": {"u": u}, "states": {"x": y},
        "parameters": {"T": {"lower": 0.1, "upper": 2, "unit": "s"}},
        "equations": {"x": "(u - x)/T"}, "outputs": {"y": "x"}, "initial": {"x": 0},
    })  # fmt: skip


def record(u: str, y: str, name: str = "") -> Record:
    times = 0.1 * np.arange(30.0)
    return Record(
        (Channel("u", times, np.sin(times), u),), (Channel("y", times, np.cos(times), y),), name
    )


def test_a_record_in_another_unit_than_the_model_is_refused_with_both_units() -> None:
    with pytest.raises(InvalidRecord, match=r"'u' is in kPa in record 'old', but in model 'gauge' "
                       r"it is in Pa: 1 kPa is 1000 Pa; .*unit.*\"u\": \"Pa\""):  # fmt: skip
        identify(model(), record("kPa", "1", "old"), TINY)


def test_records_fitted_together_are_in_one_unit_where_the_model_has_none() -> None:
    with pytest.raises(
        InvalidRecord, match=r"'y' is in mm in record 2, but in record 1 it is in m"
    ):
        identify(model(), [record("Pa", "m"), record("Pa", "mm")], TINY)


def test_validation_records_are_in_the_unit_of_those_that_are_fitted() -> None:
    with pytest.raises(InvalidRecord, match=r"'y' is in V in record 2, but .* it is in m"):
        identify(model(), record("Pa", "m"), TINY, validation=record("", "V"))


def test_one_unit_written_in_two_ways_or_left_out_is_accepted() -> None:
    records = [record("Pa", "m/s^2"), record("N/m²", "m/s²"), record("", "1")]
    assert identify(model(), records, TINY).evaluations > 0


def test_a_derivation_converts_exactly_and_writes_down_a_unit_that_is_missing() -> None:
    times = np.arange(4.0)
    made = Recording((Channel("p", times, times, "kPa"), Channel("q", times, times)))
    found = derive(made, [{"unit": {"p": "Pa", "q": "V"}}])
    assert [one.unit for one in found.channels] == ["Pa", "V"]
    np.testing.assert_array_equal(found.channel("p").values, 1000.0 * times)
    np.testing.assert_array_equal(found.channel("q").values, times)
    with pytest.raises(InvalidSettings, match=r"/steps/0/unit/p: kPa is not V"):
        derive(made, [{"unit": {"p": "V"}}])
    with pytest.raises(InvalidSettings, match="no channel 'z'"):
        derive(made, [{"unit": {"z": "V"}}])
