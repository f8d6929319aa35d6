"""Units: which are the same, by what they differ, and that a record in another one is told."""

from ast import literal_eval

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.settings import GeneticAlgorithm
from sysid.core.units import (
    describe_difference,
    find_conversion_factor,
    is_readable_unit,
    suggest_unit,
)
from sysid.data.derivations import derive_recording
from sysid.data.records import Channel, Record, Recording
from sysid.identification.identify import identify
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.models.unit_checks import list_mixed_unit_warnings, list_unknown_unit_warnings

TINY = GeneticAlgorithm(population=8, generations=2, islands=1)


@pytest.mark.parametrize(
    ("unit", "other", "times"),
    [
        ("kPa", "Pa", 1e3),
        ("Pa", "kPa", 1e-3),
        ("bar", "mbar", 1e3),
        ("psi", "Pa", 6894.757293168361),
        ("deg", "rad", np.pi / 180),
        ("rpm", "rad/s", np.pi / 30),
        ("m/s^2", "m/s²", 1.0),
        ("N/kg", "m/s**2", 1.0),
        ("kg·m²", "kg m^2", 1.0),
        ("1/(V·s)", "1/V/s", 1.0),
        ("s⁻¹", "Hz", 1.0),
        ("µm", "mm", 1e-3),
        ("min", "s", 60.0),
        ("m", "min", None),
        ("V", "N", None),
        ("°C", "K", None),
        ("counts", "counts", 1.0),
        ("counts", "V", None),
        ("(m", "m", None),
        ("rpm", "Hz", 1 / 60),
        ("rev/s", "Hz", 1.0),
        ("rpm", "1/min", 1.0),
        ("rpm", "deg/s", 6.0),
        ("rps", "1/s", 1.0),
        ("rev", "rad", 2 * np.pi),
        ("N·m/rad", "N·m/rev", 2 * np.pi),
        ("N·m/rad", "N·m", 1.0),
        ("V/Hz", "V·s", 1.0),
        ("Hz", "rad/s", None),
        ("deg/s", "kHz", None),
        ("N·m/rev", "N·m", None),
        ("°C", "C", None),
        ("°C", "degC", 1.0),
        ("° C", "℃", 1.0),
        ("deg C", "C", None),
        ("°F", "°C", None),
        ("°/s", "rad/s", np.pi / 180),
        ("°", "deg", 1.0),
        ("Nm", "N·m", 1.0),
        ("kNm", "N*m", 1e3),
        ("sec", "s", 1.0),
        ("RPM", "rpm", 1.0),
        ("m/s2", "m/s^2", 1.0),
        ("m s-2", "m/s²", 1.0),
        ("m3/hr", "m^3/h", 1.0),
        ("kWh", "J", 3.6e6),
        ("mAh", "C", 3.6),
        ("S", "1/ohm", 1.0),
        ("t", "kg", 1e3),
        ("inch", "mm", 25.4),
        ("volt", "V", None),
        ("H2O", "m", None),
        ("°C/s", "K/s", None),
        ("km^99 km^99 km^99 km^99", "m^396", None),
        ("m/", "m", None),
        ("2 m", "m", None),
    ],
)
def test_units_differ_by_a_factor_or_by_their_kind(
    unit: str, other: str, times: float | None
) -> None:
    assert find_conversion_factor(unit, other) == (
        None if times is None else pytest.approx(times, rel=1e-12)
    )


@given(st.text(max_size=90), st.text(max_size=90))
def test_no_text_breaks_the_comparison_and_a_factor_turns_round(unit: str, other: str) -> None:
    there, back = find_conversion_factor(unit, other), find_conversion_factor(other, unit)
    assert (there is None) == (back is None)
    if there is not None and back is not None:
        assert there * back == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("unit", "other"),
    [
        ("counts", "V"),
        ("V", "counts"),
        ("volt", "V"),
        ("Bar", "bar"),
        ("dB", "%"),
        ("A", "a"),
        ("°C/s", "K/s"),
        ("2 m", "m"),
    ],
)
def test_of_a_unit_that_cannot_be_read_nothing_is_asserted(unit: str, other: str) -> None:
    assert not describe_difference(unit, other)


@pytest.mark.parametrize(
    ("unit", "other", "said"),
    [
        ("V", "N", "V is not N"),
        ("°C", "C", "°C is not C"),
        ("°C", "K", "°C is not K"),
        ("Hz", "rad/s", "between Hz and rad/s it is open"),
        ("deg/s", "kHz", "between deg/s and kHz it is open"),
    ],
)
def test_units_that_are_known_to_differ_are_told_with_both_names_and_no_number(
    unit: str, other: str, said: str
) -> None:
    assert said in describe_difference(unit, other)
    assert not any(char.isdigit() for char in describe_difference(unit, other))


@given(st.sampled_from(["", " ", "1", "-", None]), st.text(max_size=10))
def test_a_blank_unit_goes_with_every_unit(blank: str | None, unit: str) -> None:
    assert describe_difference(blank, unit) == describe_difference(unit, blank) == ""


def build_model(u: str = "Pa", y: str = "1") -> Model:
    return parse_model(
        {
            "name": "gauge",
            "form": "differential",
            "inputs": {"u": u},
            "states": {"x": y},
            "parameters": {"T": {"lower": 0.1, "upper": 2, "unit": "s"}},
            "equations": {"x": "(u - x)/T"},
            "outputs": {"y": "x"},
            "initial": {"x": 0},
        }
    )


def make_record(u: str, y: str, name: str = "") -> Record:
    times = 0.1 * np.arange(30.0)
    return Record(
        (Channel("u", times, np.sin(times), u),), (Channel("y", times, np.cos(times), y),), name
    )


def test_a_record_in_another_unit_than_the_model_is_refused_with_both_units() -> None:
    with pytest.raises(
        InvalidRecord,
        match=r"'u' is in kPa in record 'old', but in model 'gauge' "
        r"it is in Pa: 1 kPa is 1000 Pa; .*unit.*\"u\": \"Pa\"",
    ):
        identify(build_model(), make_record("kPa", "1", "old"), TINY)


@pytest.mark.parametrize(("u", "y"), [("Hz", "C"), ("rad/s", "°C")])
def test_cycles_for_radians_and_degrees_for_coulombs_are_refused(u: str, y: str) -> None:
    with pytest.raises(InvalidRecord, match=r"correct the wrong unit"):
        identify(build_model("rad/s", "C"), make_record(u, y), TINY)


def test_a_unit_that_cannot_be_read_is_accepted_with_a_warning() -> None:
    found = identify(build_model("Pa"), make_record("counts", "1"), TINY)
    told = "'u' is in counts, but in Pa in the model. The units were not compared, because counts"
    assert any(told in one for one in found.warnings)
    assert "read as a unit" not in "".join(
        identify(build_model(), make_record("Pa", "1"), TINY).warnings
    )


def test_a_record_after_one_whose_unit_cannot_be_read_is_compared_with_the_next() -> None:
    with pytest.raises(InvalidRecord, match=r"'y' is in V in record 3, but in record 2 it is in m"):
        identify(
            build_model(),
            [make_record("Pa", "counts"), make_record("Pa", "m"), make_record("Pa", "V")],
            TINY,
        )


def test_records_fitted_together_are_in_one_unit_where_the_model_has_none() -> None:
    with pytest.raises(
        InvalidRecord, match=r"'y' is in mm in record 2, but in record 1 it is in m"
    ):
        identify(build_model(), [make_record("Pa", "m"), make_record("Pa", "mm")], TINY)


def test_validation_records_are_in_the_unit_of_those_that_are_fitted() -> None:
    with pytest.raises(InvalidRecord, match=r"'y' is in V in record 2, but .* it is in m"):
        identify(build_model(), make_record("Pa", "m"), TINY, validation=make_record("", "V"))


def test_one_unit_written_in_two_ways_or_left_out_is_accepted() -> None:
    records = [make_record("Pa", "m/s^2"), make_record("N/m²", "m/s²"), make_record("", "1")]
    assert identify(build_model(), records, TINY).evaluations > 0


def test_a_derivation_converts_exactly_and_writes_down_a_unit_that_is_missing() -> None:
    times = np.arange(4.0)
    made = Recording((Channel("p", times, times, "kPa"), Channel("q", times, times)))
    found = derive_recording(made, [{"unit": {"p": "Pa", "q": "V"}}])
    assert [one.unit for one in found.channels] == ["Pa", "V"]
    np.testing.assert_array_equal(found.channel("p").values, 1000.0 * times)
    np.testing.assert_array_equal(found.channel("q").values, times)
    with pytest.raises(InvalidSettings, match=r"/steps/0/unit/p: kPa is not V"):
        derive_recording(made, [{"unit": {"p": "V"}}])
    spinning = Recording((Channel("f", times, times, "rpm"), Channel("c", times, times, "counts")))
    turned = derive_recording(spinning, [{"unit": {"f": "Hz"}}])
    np.testing.assert_allclose(turned.channel("f").values, times / 60)
    with pytest.raises(InvalidSettings, match=r"between Hz and rad/s it is open"):
        derive_recording(turned, [{"unit": {"f": "rad/s"}}])
    with pytest.raises(InvalidSettings, match=r"/steps/0/unit/c: 'counts' cannot be read"):
        derive_recording(spinning, [{"unit": {"c": "V"}}])
    with pytest.raises(InvalidSettings, match="no channel 'z'"):
        derive_recording(made, [{"unit": {"z": "V"}}])


@pytest.mark.parametrize(
    ("unit", "meant"),
    [
        ("bat", "bar"),
        ("m/sx", "m/s"),
        ("Kpa", "kPa"),
        ("Mpa", "MPa"),
        ("PA", "Pa"),
        ("seconds", "s"),
        ("volt", "V"),
        ("N*meters", "N*m"),
        ("Hertz", "Hz"),
        ("mbat", "mbar"),
        ("pct", "%"),
        ("pct/s", "%/s"),
    ],
)
def test_for_a_unit_that_nobody_knows_the_one_written_most_alike_is_suggested(
    unit: str, meant: str
) -> None:
    assert suggest_unit(unit) == f"; did you mean {meant!r}?"
    assert not suggest_unit(meant)


@given(st.text(max_size=90))
@example("1\rM")
def test_what_is_suggested_can_be_read_and_nothing_is_for_what_can_be(unit: str) -> None:
    told = suggest_unit(unit)
    if told:
        assert not is_readable_unit(unit)
        assert is_readable_unit(
            literal_eval(told.removeprefix("; did you mean ").removesuffix("?"))
        )


def test_channels_in_units_that_nobody_knows_are_told_and_others_are_not() -> None:
    times = np.arange(3.0)
    known = [Channel("k", times, times, unit) for unit in ("kPa", "1", "", "dB", "m/s²", "°C")]
    assert list_unknown_unit_warnings(known) == []
    (told,) = list_unknown_unit_warnings([*known, Channel("p", times, times, "bat")])
    assert told.startswith("channel 'p': 'bat' is no known unit")
    assert told.endswith("did you mean 'bar'?")
    (long,) = list_unknown_unit_warnings([Channel("p", times, times, "x" * 1000)])
    assert len(long) < 200


def test_two_units_of_one_quantity_are_told_where_the_model_does_not_give_both() -> None:
    assert list_mixed_unit_warnings(build_model("Pa", "1"), [make_record("Pa", "kPa")])
    (told,) = list_mixed_unit_warnings(build_model("1", "1"), [make_record("kPa", "Pa")])
    assert "'u' is in kPa and 'y' in Pa" in told
    assert "1 kPa is 1000 Pa" in told
    assert '{"unit": {"u": "Pa"}}' in told
    assert told in identify(build_model("1", "1"), make_record("kPa", "Pa"), TINY).warnings


@pytest.mark.parametrize(("u", "y"), [("Pa", "Pa"), ("Pa", "m"), ("1", "Pa"), ("bat", "Pa")])
def test_of_one_unit_two_quantities_or_a_plain_number_nothing_is_told(u: str, y: str) -> None:
    assert list_mixed_unit_warnings(build_model("1", "1"), [make_record(u, y)]) == []


def test_units_that_the_model_gives_are_not_told_of_its_channels() -> None:
    assert list_mixed_unit_warnings(build_model("kPa", "Pa"), [make_record("kPa", "Pa")]) == []
