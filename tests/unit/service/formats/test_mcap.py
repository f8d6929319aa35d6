"""Files of ours as other programs see them: the plain `mcap` reader and protobuf's own decoder."""

import struct
import zlib
from dataclasses import replace
from datetime import UTC, datetime
from io import BytesIO

import numpy as np
import pytest
import zstandard
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import DataEnd, Footer, McapRecord, Message, MessageIndex, SummaryOffset
from mcap.stream_reader import StreamReader

from service.formats.limits import DEFAULT_LIMITS
from service.formats.mcap import mcap_writer
from service.formats.mcap.mcap_files import (
    FittedInput,
    FittedOutput,
    read_fitted_outputs,
    read_mcap,
    write_fitted_outputs,
    write_recording,
)
from sysid.core.types import FloatArray
from sysid.data.records import Channel, History, Recording, Segment
from tests.support.files.mcap_files import read_run_record, write_mcap_bytes

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


def walk_records(content: bytes, start: int = 8) -> dict[int, tuple[int, bytes]]:
    """Opcode and content of every record by its offset, read without a library."""
    records = {}
    while start + 9 <= len(content):
        opcode, length = struct.unpack_from("<BQ", content, start)
        records[start] = (opcode, content[start + 9 : start + 9 + length])
        start += 9 + length
    return records


def read_record(content: bytes, offset: int) -> McapRecord:
    """Record at an offset, as the plain reader sees it."""
    return next(StreamReader(BytesIO(content[offset:]), skip_magic=True).records)


def unpack_chunk(chunk: bytes) -> tuple[int, bytes]:
    """Stored checksum and unpacked content of a chunk record."""
    _, _, size, crc, length = struct.unpack_from("<QQQII", chunk)
    assert chunk[32 : 32 + length] == b"zstd"
    return crc, zstandard.decompress(chunk[40 + length :], max_output_size=size)


def later_and_shorter() -> Recording:
    """Two topics: the second begins last and ends first."""
    return Recording(
        (
            Channel("u", TIMES + 1, np.sin(TIMES)),
            Channel("y", np.array([1.1, 1.15, 1.2]), np.array([1.0, 2.0, 3.0])),
        )
    )


@pytest.mark.usefixtures("small_chunks")
def test_every_checksum_is_stored_and_right() -> None:
    content = write_mcap_bytes(two_bases())
    records = walk_records(content)
    chunks = [unpack_chunk(body) for opcode, body in records.values() if opcode == Opcode.CHUNK]
    assert len(chunks) == 4
    assert all(crc == zlib.crc32(unpacked) != 0 for crc, unpacked in chunks)
    [data_end] = [at for at, (opcode, _) in records.items() if opcode == Opcode.DATA_END]
    stored = read_record(content, data_end)
    assert isinstance(stored, DataEnd)
    assert stored.data_section_crc == zlib.crc32(content[:data_end]) != 0
    [end] = [at for at, (opcode, _) in records.items() if opcode == Opcode.FOOTER]
    footer = read_record(content, end)
    assert isinstance(footer, Footer)
    assert footer.summary_start == data_end + 9 + 4
    assert footer.summary_crc == zlib.crc32(content[footer.summary_start : end + 9 + 16]) != 0


@pytest.mark.usefixtures("small_chunks")
def test_the_index_of_a_chunk_points_to_each_message_and_has_its_time() -> None:
    content = write_mcap_bytes(later_and_shorter())
    records = walk_records(content)
    summary = make_reader(BytesIO(content)).get_summary()
    assert summary is not None
    times: dict[int, list[int]] = {1: [], 2: []}
    sequences: dict[int, list[int]] = {1: [], 2: []}
    for entry in summary.chunk_indexes:
        opcode, chunk = records[entry.chunk_start_offset]
        assert opcode == Opcode.CHUNK
        assert entry.chunk_length == 9 + len(chunk)
        assert entry.compressed_size == len(chunk) - 40 - len("zstd")
        unpacked = unpack_chunk(chunk)[1]
        assert entry.uncompressed_size == len(unpacked)
        [(channel, offset)] = entry.message_index_offsets.items()
        assert records[offset][0] == Opcode.MESSAGE_INDEX
        assert offset == entry.chunk_start_offset + entry.chunk_length
        assert entry.message_index_length == 9 + len(records[offset][1])
        index = read_record(content, offset)
        assert isinstance(index, MessageIndex)
        assert index.channel_id == channel
        assert [place for _, place in index.records] == list(walk_records(unpacked, 0))
        for log_time, place in index.records:
            message = read_record(unpacked, place)
            assert isinstance(message, Message)
            assert (message.channel_id, message.log_time) == (channel, log_time)
            times[channel].append(log_time)
            sequences[channel].append(message.sequence)
        assert struct.unpack_from("<QQ", chunk) == (index.records[0][0], index.records[-1][0])
        assert entry.message_start_time == index.records[0][0]
        assert entry.message_end_time == index.records[-1][0]
    assert times[1] == [1_000_000_000 + 10_000_000 * k for k in range(40)]
    assert times[2] == [1_100_000_000, 1_150_000_000, 1_200_000_000]
    assert sequences == {1: list(range(40)), 2: [0, 1, 2]}


def test_the_statistics_span_all_topics() -> None:
    summary = make_reader(BytesIO(write_mcap_bytes(later_and_shorter()))).get_summary()
    assert summary is not None
    statistics = summary.statistics
    assert statistics is not None
    assert statistics.message_start_time == 1_000_000_000
    assert statistics.message_end_time == 1_390_000_000
    assert statistics.channel_message_counts == {1: 40, 2: 3}
    assert (statistics.schema_count, statistics.channel_count) == (2, 2)


def test_the_offsets_of_the_summary_enclose_records_of_one_kind_each() -> None:
    content = write_mcap_bytes(two_bases())
    records = walk_records(content)
    offsets = [
        record
        for at, (opcode, _) in records.items()
        if opcode == Opcode.SUMMARY_OFFSET
        and isinstance(record := read_record(content, at), SummaryOffset)
    ]
    assert len(offsets) == 5
    for group in offsets:
        inside = range(group.group_start, group.group_start + group.group_length)
        opcodes = {opcode for at, (opcode, _) in records.items() if at in inside}
        assert opcodes == {group.group_opcode}
        assert inside.stop in records
    ends = [group.group_start + group.group_length for group in offsets]
    assert [group.group_start for group in offsets[1:]] == ends[:-1]


def test_times_before_zero_come_back() -> None:
    before = Channel("u", np.array([-0.5, -0.25, 0.0, 2.0]), np.arange(4.0))
    np.testing.assert_array_equal(
        read_mcap(write_mcap_bytes(Recording((before,)))).channel("u").times, before.times
    )


@pytest.mark.usefixtures("small_chunks")
def test_the_plain_reader_finds_every_message_and_all_checksums_hold() -> None:
    content = write_mcap_bytes(two_bases(), source="abc")
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
    reader = make_reader(BytesIO(write_mcap_bytes(recording)))
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
    reader = make_reader(BytesIO(write_mcap_bytes(two_bases())))
    found = list(
        reader.iter_messages(topics="/signals", starting_at=10**8, ending_before=2 * 10**8)
    )
    assert len(found) == 10


def test_names_units_holds_and_segments_come_back() -> None:
    back = read_mcap(write_mcap_bytes(two_bases()))
    assert back.names == ("u [x]", "other/base", "t")
    assert [one.unit for one in back.channels] == ["V", "m", "1"]
    assert [one.hold for one in back.channels] == ["zero", "auto", "band-limited"]
    assert back.segments == two_bases().segments


def test_a_history_stands_in_topics_of_its_own() -> None:
    known = replace(two_bases().channels[0], history=History(TIMES[:3] - 1, np.ones(3)))
    with_history = Recording((known, *two_bases().channels[1:]), two_bases().segments)
    reader = make_reader(BytesIO(write_mcap_bytes(with_history)))
    topics = [channel.topic for _, channel, _ in reader.iter_messages()]
    assert topics.count("/history") == 3
    assert len(topics) == 46
    back = read_mcap(write_mcap_bytes(with_history)).channel("u [x]").history
    assert back is not None
    np.testing.assert_array_equal(back.times, TIMES[:3] - 1)


def test_the_repeats_of_pooled_samples_come_back() -> None:
    channel = Channel("y", [0.0, 0.1, 0.1], [1.0, 2.0, 3.0], repeats=np.array([1.0, 3.0, 2.0]))
    back = read_mcap(write_mcap_bytes(Recording((channel,)))).channel("y")
    np.testing.assert_array_equal(back.repeats, [1.0, 3.0, 2.0])
    np.testing.assert_array_equal(back.values, channel.values)


def test_the_same_recording_gives_the_same_bytes() -> None:
    assert write_mcap_bytes(two_bases(), a="b") == write_mcap_bytes(two_bases(), a="b")


def test_the_exact_sampling_period_is_kept_as_text() -> None:
    content = write_mcap_bytes(Recording((Channel("u", TIMES, TIMES),)), parent="ds_1")
    [record] = make_reader(BytesIO(content)).iter_metadata()
    metadata = record.metadata
    assert metadata["sample_time"] == "0.01"
    assert metadata["parent"] == "ds_1"


def test_a_reserved_metadata_key_is_refused() -> None:
    with pytest.raises(ValueError, match="channels"):
        write_mcap_bytes(two_bases(), channels="mine")


def test_times_beyond_the_files_clock_are_refused() -> None:
    with pytest.raises(ValueError, match="63 bits"):
        write_mcap_bytes(Recording((Channel("u", np.array([0.0, 1e10]), np.zeros(2)),)))


def test_paths_are_written(tmp_path) -> None:
    target = tmp_path / "a.mcap"
    write_recording(two_bases(), target)
    assert read_mcap(target).names == two_bases().names


def test_fitted_signals_come_back_and_have_the_residual_as_a_field() -> None:
    rng = np.random.default_rng(1)
    later = np.array([0.0, 0.5, 0.5])
    fits = [
        FittedOutput("estimation", 1, "y", "m", TIMES, rng.normal(size=40), rng.normal(size=40)),
        FittedOutput("estimation", 1, "v", "m/s", TIMES, rng.normal(size=40), rng.normal(size=40)),
        FittedOutput("validation", 2, "y", "m", later, np.array([1, np.nan, 2.0]), np.zeros(3)),
    ]
    stream = BytesIO()
    write_fitted_outputs(fits, stream)
    for fit, back in zip(fits, read_fitted_outputs(stream.getvalue()), strict=True):
        assert (back.experiment, back.name, back.unit) == (fit.experiment, fit.name, fit.unit)
        for part in ("times", "measured", "simulated"):
            np.testing.assert_array_equal(getattr(back, part), getattr(fit, part))
    summary = make_reader(BytesIO(stream.getvalue())).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert topics == {"/fit", "/fit/2"}
    assert b"y_residual" in next(iter(summary.schemas.values())).data


def test_inputs_and_origin_of_a_run_are_in_its_file_under_fixed_topics() -> None:
    slow, started = TIMES[::2], datetime(2026, 1, 31, 8, tzinfo=UTC)
    fits = [FittedOutput("estimation", 1, "y", "m", TIMES, TIMES + 1, TIMES)]
    inputs = [
        FittedInput("estimation", 1, Channel("u", TIMES, TIMES, "V", "zero")),
        FittedInput("estimation", 1, Channel("w", slow, slow)),
        FittedInput("validation", 1, Channel("u", TIMES, TIMES * 2, "V")),
    ]
    stream = BytesIO()
    write_fitted_outputs(fits, stream, inputs=inputs, run={"run": "run_1"}, started_at=started)
    content = stream.getvalue()
    summary = make_reader(BytesIO(content)).get_summary()
    assert summary is not None
    topics = [channel.topic for channel in summary.channels.values()]
    assert topics == ["/fit", "/inputs", "/inputs/2", "/inputs/3"]
    assert read_run_record(content) == {"run": "run_1"}
    assert len(read_fitted_outputs(content)) == 1
    back = read_mcap(content)
    assert back.started_at == started
    held = back.channel("estimation 1/u/input")
    assert (held.unit, held.hold) == ("V", "zero")
    np.testing.assert_array_equal(back.channel("validation 1/u/input").values, TIMES * 2)


def test_the_widest_recording_is_written_within_the_limits_of_the_reader() -> None:
    times = np.arange(7000) * 0.01
    zeros = np.zeros(times.size)
    names = [f"channel{number}" for number in range(DEFAULT_LIMITS.channels)]
    content = write_mcap_bytes(Recording(tuple(Channel(name, times, zeros) for name in names)))
    read = read_mcap(BytesIO(content), DEFAULT_LIMITS)
    assert [channel.name for channel in read.channels] == names
    np.testing.assert_array_equal(read.channels[-1].times, times)


def test_names_and_segments_that_the_reader_would_refuse_are_not_written(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    times = np.arange(3.0)
    long = [Channel(f"{'n' * 2000}{number}", times, times) for number in range(600)]
    with pytest.raises(ValueError, match="names of 600 channels are too long"):
        write_mcap_bytes(Recording(tuple(long)))
    monkeypatch.setattr(mcap_writer, "DEFAULT_LIMITS", replace(DEFAULT_LIMITS, record_bytes=500))
    spans = tuple(Segment(float(n), n + 0.5, float(n), {"run": float(n)}) for n in range(20))
    with pytest.raises(ValueError, match="too many segments"):
        write_mcap_bytes(Recording((Channel("u", np.arange(20.0), np.zeros(20)),), spans))


@pytest.mark.parametrize("clock", ["2026-03-14T08:00:00.250001+02:00", "2026-03-14T08:00:00.25"])
@pytest.mark.parametrize("times", [TIMES, np.arange(50) * 0.1, np.array([-2.5, 0.0, 1 / 3])])
def test_viewers_see_the_day_and_times_come_back(clock: str, times: FloatArray) -> None:
    start = datetime.fromisoformat(clock)
    history = History(np.array([-3.0, -2.75]), np.array([1.0, 2.0])) if times[0] >= 0 else None
    channel = Channel("u", times, np.sin(times), history=history)
    content = write_mcap_bytes(Recording((channel,), started_at=start))
    back = read_mcap(content)
    assert back.started_at == start
    assert back.channel("u").times.tobytes() == times.tobytes()
    moment = start if start.tzinfo else start.replace(tzinfo=UTC)
    messages = list(make_reader(BytesIO(content)).iter_messages())
    logged = {one.topic: message.log_time for _, one, message in reversed(messages)}
    first = round(moment.timestamp() * 1e6) * 1000 + round(times[0] * 1e9)
    assert abs(logged["/signals"] - first) <= 1000
    if history is not None:
        assert back.channel("u").history is not None
        assert logged["/history"] - logged["/signals"] == round((-3.0 - times[0]) * 1e9)


def test_a_recording_of_before_1970_keeps_a_clock_of_its_own() -> None:
    start = datetime(1969, 12, 31, tzinfo=UTC)
    back = read_mcap(write_mcap_bytes(Recording((Channel("u", TIMES, TIMES),), started_at=start)))
    assert back.started_at == start
    np.testing.assert_array_equal(back.channel("u").times, TIMES)


def test_the_unit_of_the_times_of_a_source_comes_back() -> None:
    channel = Channel("u", TIMES, TIMES, time_unit="min")
    assert read_mcap(write_mcap_bytes(Recording((channel,)))).channel("u").time_unit == "min"
    assert read_mcap(write_mcap_bytes(two_bases())).channels[0].time_unit == "s"
