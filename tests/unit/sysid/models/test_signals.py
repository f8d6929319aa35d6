"""Channels become signals of a model: as given, by name, else by their order."""

import numpy as np
import pytest

from sysid.core.errors import InvalidRecord, InvalidSettings, UnknownModel
from sysid.data.records import Channel, Record, Recording
from sysid.models.catalogue.load import load_model, resolve_model
from sysid.models.channel_assignment import assign_channels, assign_record, assign_recording

MODEL = load_model("fopdt")
T = np.arange(3.0)


def make_record(inputs: list[str], outputs: list[str]) -> Record:
    return Record(
        tuple(Channel(name, T, T) for name in inputs),
        tuple(Channel(name, T, T) for name in outputs),
    )


def list_names(one: Record) -> tuple[list[str], list[str]]:
    return [channel.name for channel in one.inputs], [channel.name for channel in one.outputs]


@pytest.mark.parametrize(
    ("channels", "given", "assigned"),
    [
        (["u", "y"], {}, {"u": "u", "y": "y"}),
        (["y", "u", "T3"], {}, {"u": "u", "y": "y"}),
        (["P1", "P2", "P3"], {"u": "P3", "y": "P1"}, {"u": "P3", "y": "P1"}),
        (["y", "u"], {"u": "y", "y": "u"}, {"u": "y", "y": "u"}),
    ],
)
def test_what_is_given_or_has_the_name_needs_no_note(channels, given, assigned) -> None:
    assert assign_channels(MODEL, channels, given) == (assigned, "", False)


@pytest.mark.parametrize(
    ("channels", "given", "assigned"),
    [
        (["P1", "P2"], {}, {"u": "P1", "y": "P2"}),
        (["P1", "u"], {}, {"u": "u", "y": "P1"}),
        (["P1", "P2"], {"u": "P2"}, {"u": "P2", "y": "P1"}),
        (["u", "P2"], {"y": "u"}, {"u": "P2", "y": "u"}),
    ],
)
def test_the_order_decides_where_as_many_are_left_and_is_told(channels, given, assigned) -> None:
    found, note, may_be_swapped = assign_channels(MODEL, channels, given)
    assert found == assigned
    assert may_be_swapped == (len(given) == 0 and "u" not in channels)
    told = [signal for signal in assigned if f"{signal!r}: {assigned[signal]!r}" in note]
    assert told == [s for s in assigned if s not in given and assigned[s] != s]


@pytest.mark.parametrize(
    ("channels", "u", "y"),
    [
        (["Y", "U"], "U", "Y"),
        (["output", "input"], "input", "output"),
        (["Out", "In"], "In", "Out"),
        (["PV", "OP"], "OP", "PV"),
        (["PV", "CO"], "CO", "PV"),
        (["pv", "mv"], "mv", "pv"),
        (["y1", "u1"], "u1", "y1"),
        (["SP", "PV", "OP"], "OP", "PV"),
        (["y", "P1", "U"], "U", "y"),
    ],
)
def test_usual_names_decide_before_the_order(channels: list[str], u: str, y: str) -> None:
    found, note, may_be_swapped = assign_channels(MODEL, channels)
    assert found == {"u": u, "y": y}
    assert "usual names of inputs and outputs" in note
    assert f"'u': {u!r}" in note
    assert not may_be_swapped


@pytest.mark.parametrize(
    ("channels", "u", "basis"),
    [
        (["fuel", "CO"], "fuel", "by their order"),
        (["valve", "CO2"], "valve", "by their order"),
        (["PV1", "PV2"], "PV1", "by their order"),
        (["PV", "heater"], "heater", "usual names of inputs and outputs and their order"),
        (["oven", "input"], "input", "usual names of inputs and outputs and their order"),
    ],
)
def test_the_order_decides_about_other_names(channels: list[str], u: str, basis: str) -> None:
    found, note, _ = assign_channels(MODEL, channels)
    assert found["u"] == u
    assert f"{basis}. To choose" in note


def test_usual_names_of_too_many_channels_do_not_decide() -> None:
    with pytest.raises(InvalidRecord, match="Say which channel is which"):
        assign_channels(MODEL, ["PV1", "PV2", "OP"])


@pytest.mark.parametrize("text", ["Heater", "Heater [%]", "Heater (%)"])
def test_a_channel_may_be_given_as_its_heading(text: str) -> None:
    recording = Recording((Channel("Oven", T, T, "°C"), Channel("Heater", T, T, "%")))
    given = {"u": text, "y": "Oven"}
    assert assign_recording(MODEL, recording, given).by_signal == {"u": "Heater", "y": "Oven"}
    with pytest.raises(InvalidSettings, match=r"no channel 'Heater \[K\]'"):
        assign_recording(MODEL, recording, {"u": "Heater [K]"})


def test_a_signal_without_a_channel_is_told_with_all_channels() -> None:
    choices = r"{'u': 'P1', 'y': 'P3'} or channels={'u': 'P2', 'y': 'P3'}$"
    with pytest.raises(InvalidRecord, match=rf"inputs u and outputs y.*P1, P2, P3.*{choices}"):
        assign_channels(MODEL, ["P1", "P2", "P3"])
    with pytest.raises(InvalidRecord, match=r"'y': 'P1', 'u': 'P2'} or .*'u': 'P3'}$"):
        assign_channels(MODEL, ["P1", "P2", "P3"], {"y": "P1"})
    with pytest.raises(InvalidRecord, match=r"which: channels={'u': 'P0', 'y': 'y1'}$"):
        assign_channels(MODEL, ["y1", *(f"P{n}" for n in range(9))])
    with pytest.raises(InvalidRecord, match=r"which: channels={'u': …, 'y': …}$"):
        assign_channels(MODEL, ["P1"])
    with pytest.raises(InvalidRecord, match="'y': …"):
        assign_channels(MODEL, ["u"])
    with pytest.raises(InvalidRecord, match="the recording has no channels"):
        assign_channels(MODEL, [])


def test_a_mapping_is_turned_only_if_both_names_exist() -> None:
    with pytest.raises(InvalidSettings, match="known are u, y"):
        assign_channels(MODEL, ["P1"], {"q": "u"})


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"q": "P1"}, "/channels/q: the model has no signal 'q'; known are u, y"),
        ({"P1": "u"}, "no signal 'P1'. Write {'u': 'P1'}"),
        ({"u": "P11"}, "/channels/u: there is no channel 'P11'; did you mean 'P1'?"),
    ],
)
def test_a_wrong_name_is_told(given: dict[str, str], told: str) -> None:
    for assign in (
        lambda: assign_channels(MODEL, ["P1", "P2"], given),
        lambda: assign_record(MODEL, make_record(["P1"], ["P2"]), given),
    ):
        with pytest.raises(InvalidSettings) as caught:
            assign()
        assert told in str(caught.value)


def test_a_record_of_the_models_names_is_the_same_object() -> None:
    one = make_record(["u", "more"], ["y"])
    assert assign_record(MODEL, one) == (one, "")


def test_the_sides_of_a_record_say_what_is_input_and_output() -> None:
    renamed, note = assign_record(MODEL, make_record(["P2"], ["P1"]))
    assert list_names(renamed) == (["u"], ["y"])
    assert "'u': 'P2', 'y': 'P1'" in note
    renamed, note = assign_record(MODEL, make_record(["P1", "P2"], ["P3"]), {"u": "P2"})
    assert list_names(renamed) == (["P1", "u"], ["y"])


def test_a_channel_of_the_other_side_is_refused() -> None:
    with pytest.raises(InvalidSettings, match="'P2' is not among the inputs of the record"):
        assign_record(MODEL, make_record(["P1"], ["P2"]), {"u": "P2"})
    with pytest.raises(InvalidSettings, match="'P1' is not among the outputs of the record"):
        assign_record(MODEL, make_record(["P1"], ["P2"]), {"y": "P1"})


def test_exchanged_sides_are_left_to_the_checks_of_the_problem() -> None:
    one = make_record(["y"], ["u"])
    assert assign_record(MODEL, one) == (one, "")


def test_a_text_that_ends_like_a_file_is_one(tmp_path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "name: mine\nform: differential\ninputs: {u: V}\nstates: {x: V}\n"
        "parameters: {T: {lower: 0.1, upper: 9, unit: s}}\n"
        "equations: {x: (u - x)/T}\noutputs: {y: x}\ninitial: {x: 0}\n"
    )
    assert resolve_model(str(path)).name == resolve_model(path).name == "mine"
    assert resolve_model(dict(MODEL.document)).name == "fopdt"
    assert resolve_model(MODEL) is MODEL
    assert resolve_model("fopdt") is MODEL


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("fopd", "did you mean 'fopdt'"),
        ("absent.yaml", "absent.yaml cannot be read: No such file"),
        (3, "found an object of type int; need a model, a name, a file or a document"),
        ({}, "form: is missing"),
    ],
)
def test_a_model_that_cannot_be_found_is_told(source: object, told: str) -> None:
    with pytest.raises((ValueError, UnknownModel), match=told):
        resolve_model(source)
