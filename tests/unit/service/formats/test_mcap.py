"""Files of ours as other programs see them: the plain `mcap` reader and protobuf's own decoder."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader

from service.formats import mcap_writer
from service.formats.mcap import (
    FittedOutput,
    read_fitted_outputs,
    read_recording,
    write_fitted_outputs,
    write_recording,
)
from sysid.data.records import Channel, History, Recording, Segment
from tests.mcap_files import recorded

TIMES = np.arange(40) * 0.01


def two_bases() -> Recording:
    later = np.array([0.0, 0.005, 0.3])
    return Recording(
        (
            Channel("u [x]", TIMES, np.zeros(40), "V", "zero"),
            Channel("other/base", later, np.array([1.0, np.nan, -0.0]), "m"),
            Channel("t", TIMES, np.sin(TIMES), "1", "band-limited"),
        ),
        (Segment(0.0, 0.1, 2.0, {"length": 8.0, "phase": "fill"}), Segment(0.2, 0.5)),
    )


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_writer, "CHUNK_SAMPLES", 16)


@pytest.mark.usefixtures("small_chunks")
def test_the_plain_reader_finds_every_message_and_all_checksums_hold() -> None:
    content = recorded(two_bases(), source="abc")
    reader = make_reader(BytesIO(content), validate_crcs=True)
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 43
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) == 4
    topics: dict[str, list[int]] = {}
    for schema, channel, message in reader.iter_messages():
        assert schema is not None
        assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
        assert message.log_time == message.publish_time
        topics.setdefault(channel.topic, []).append(message.log_time)
    assert topics == {
        "/signals": [10_000_000 * k for k in range(40)],
        "/signals/other_base": [0, 5_000_000, 300_000_000],
    }
    assert [(one.name, one.metadata["source"]) for one in reader.iter_metadata()] == [
        ("lagid.dataset", "abc")
    ]


def test_protobuf_decodes_the_same_values_also_zero_and_nan() -> None:
    recording = two_bases()
    reader = make_reader(BytesIO(recorded(recording)))
    decoded: dict[str, list[float]] = {"u__x": [], "t": [], "other_base": []}
    for schema, _, message in reader.iter_messages():
        assert schema is not None
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file)
        found = GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(message.data)
        for field in found.DESCRIPTOR.fields:
            decoded[field.name].append(getattr(found, field.name))
    for name, field in (("u [x]", "u__x"), ("t", "t"), ("other/base", "other_base")):
        np.testing.assert_array_equal(decoded[field], recording.channel(name).values)


def test_a_part_of_the_time_can_be_read_through_the_index() -> None:
    reader = make_reader(BytesIO(recorded(two_bases())))
    found = list(
        reader.iter_messages(topics="/signals", starting_at=10**8, ending_before=2 * 10**8)
    )
    assert len(found) == 10


def test_names_units_holds_and_segments_come_back() -> None:
    back = read_recording(recorded(two_bases()))
    assert back.names == ("u [x]", "other/base", "t")
    assert [one.unit for one in back.channels] == ["V", "m", "1"]
    assert [one.hold for one in back.channels] == ["zero", "first", "band-limited"]
    assert back.segments == two_bases().segments


def test_a_history_stands_in_topics_of_its_own() -> None:
    known = replace(two_bases().channels[0], history=History(TIMES[:3] - 1, np.ones(3)))
    with_history = Recording((known, *two_bases().channels[1:]), two_bases().segments)
    reader = make_reader(BytesIO(recorded(with_history)))
    topics = [channel.topic for _, channel, _ in reader.iter_messages()]
    assert topics.count("/history") == 3
    assert len(topics) == 46
    back = read_recording(recorded(with_history)).channel("u [x]").history
    assert back is not None
    np.testing.assert_array_equal(back.times, TIMES[:3] - 1)


def test_the_same_recording_gives_the_same_bytes() -> None:
    assert recorded(two_bases(), a="b") == recorded(two_bases(), a="b")


def test_the_exact_sampling_period_is_kept_as_text() -> None:
    content = recorded(Recording((Channel("u", TIMES, TIMES),)), parent="ds_1")
    [record] = make_reader(BytesIO(content)).iter_metadata()
    metadata = record.metadata
    assert metadata["sample_time"] == "0.01"
    assert metadata["parent"] == "ds_1"


def test_a_reserved_metadata_key_is_refused() -> None:
    with pytest.raises(ValueError, match="channels"):
        recorded(two_bases(), channels="mine")


def test_times_beyond_the_files_clock_are_refused() -> None:
    with pytest.raises(ValueError, match="63 bits"):
        recorded(Recording((Channel("u", np.array([0.0, 1e10]), np.zeros(2)),)))


def test_paths_are_written(tmp_path) -> None:
    target = tmp_path / "a.mcap"
    write_recording(two_bases(), target)
    assert read_recording(target).names == two_bases().names


def test_fitted_signals_come_back_and_have_the_residual_as_a_field() -> None:
    rng = np.random.default_rng(1)
    later = np.array([0.0, 0.5, 0.5])
    fits = [
        FittedOutput("estimation", 1, "y", "m", TIMES, rng.normal(size=40), rng.normal(size=40)),
        FittedOutput("estimation", 1, "v", "m/s", TIMES, rng.normal(size=40), rng.normal(size=40)),
        FittedOutput("validation", 2, "y", "m", later, np.array([1, np.nan, 2.0]), np.zeros(3)),
    ]
    stream = BytesIO()
    write_fitted_outputs("run_1", fits, stream)
    for fit, back in zip(fits, read_fitted_outputs(stream.getvalue()), strict=True):
        assert (back.experiment, back.name, back.unit) == (fit.experiment, fit.name, fit.unit)
        for part in ("times", "measured", "simulated"):
            np.testing.assert_array_equal(getattr(back, part), getattr(fit, part))
    summary = make_reader(BytesIO(stream.getvalue())).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert topics == {"/fit/run_1", "/fit/run_1/2"}
    assert b"y_residual" in next(iter(summary.schemas.values())).data
