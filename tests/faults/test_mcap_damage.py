"""Damaged and hostile MCAP files: always one clear error or a right answer, never another end."""

import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, DataEnd, Footer, Header, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType

from service.formats.limits import DEFAULT_LIMITS, UploadLimits
from service.formats.mcap.mcap_files import read_mcap, read_mcap_with_notes
from service.formats.mcap.mcap_messages import build_schema
from service.formats.mcap.mcap_writer import MCAP_MAGIC
from sysid.core.errors import UnreadableFile
from sysid.data.records import Channel, Recording
from tests.support.files.mcap_files import json_messages, write_foreign_bytes, write_mcap_bytes
from tests.support.limits import LIMIT_SECONDS
from tests.support.profiles import scale_examples

TIMES = np.arange(50) * 0.1
OURS = write_mcap_bytes(
    Recording((Channel("u", TIMES, np.sin(TIMES)), Channel("y", TIMES, TIMES**2)))
)
FOREIGN = {
    kind: write_foreign_bytes(
        json_messages("/a", *({"x": k, "y": k / 2} for k in range(20))),
        compression=kind,
    )
    for kind in CompressionType
}
FILES = [OURS, *FOREIGN.values()]
ONE_MIB = 1024**2


def read_refusal(content: bytes, limits: UploadLimits = DEFAULT_LIMITS) -> UnreadableFile:
    with pytest.raises(UnreadableFile) as caught:
        read_mcap_with_notes(content, limits)
    assert "\n" not in str(caught.value)
    return caught.value


def file_of(*records: McapRecord | bytes, summary: tuple[McapRecord, ...] = ()) -> bytes:
    """Return a file of any records, right or wrong, with a right beginning and end.

    The footer does not mention the summary.
    """
    stream = BytesIO()
    stream.write(MCAP_MAGIC)
    for record in (Header("", "test"), *records, DataEnd(0), *summary, Footer(0, 0, 0)):
        stream.write(record if isinstance(record, bytes) else as_bytes(record))
    return stream.getvalue() + MCAP_MAGIC


def as_bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def chunk_of(content: bytes, compression: str, packed: bytes, size: int | None = None) -> Chunk:
    declared = len(content) if size is None else size
    return Chunk(compression, packed, 0, 0, zlib.crc32(content), declared)


def join_records(*records: McapRecord) -> bytes:
    return b"".join(map(as_bytes, records))


CHANNEL = ChannelRecord(1, "/a", "json", {}, 0)
MESSAGE = Message(1, 5, b'{"x": 2}', 5, 0)
FLAT_SCHEMA = Schema(1, build_schema("Pair", ("x", "y")), "protobuf", "lagid.Pair")
FLAT = ChannelRecord(1, "/a", "protobuf", {}, 1)


def flat_message(log_time: int, x: float, y: float) -> Message:
    """Message of `FLAT`, laid out as in our own files: those are read as one array."""
    return Message(1, log_time, struct.pack("<BdBd", 0x09, x, 0x11, y), log_time, 0)


def flat_file(*messages: Message) -> bytes:
    """File with all messages in one chunk that holds nothing else."""
    content = join_records(*messages)
    return file_of(FLAT_SCHEMA, FLAT, chunk_of(content, "", content))


def test_the_parts_used_here_make_a_file_that_is_read() -> None:
    recording, _ = read_mcap_with_notes(file_of(CHANNEL, MESSAGE), DEFAULT_LIMITS)
    assert recording.channel("x").values[0] == 2


@pytest.mark.parametrize("content", FILES)
def test_a_file_cut_off_anywhere_is_refused_at_a_byte_of_it(content: bytes) -> None:
    places = {*range(60), *range(0, len(content), 7), *range(len(content) - 60, len(content))}
    for length in sorted(places):
        with pytest.raises(UnreadableFile) as caught:
            read_mcap(content[:length])
        assert caught.value.byte is not None
        assert 0 <= caught.value.byte <= length


@pytest.mark.parametrize("content", FILES)
def test_what_is_whole_in_a_file_that_is_cut_off_is_read_and_told(content: bytes) -> None:
    whole = read_mcap(content)
    lengths = []
    for length in range(0, len(content) - len(MCAP_MAGIC), 5):
        try:
            recording, notes = read_mcap_with_notes(content[:length], DEFAULT_LIMITS)
        except UnreadableFile:
            continue  # before the first message
        assert notes[-1].startswith("the file ends inside ")
        assert f"What is whole was read, up to {recording.stop:.6g} s" in notes[-1]
        for channel in recording.channels:
            values = whole.channel(channel.name).values[: channel.values.size]
            np.testing.assert_array_equal(channel.values, values)
        lengths.append(length)
    assert lengths


def test_a_rest_of_zeros_was_never_written() -> None:
    written = MCAP_MAGIC + join_records(Header("", "test"), CHANNEL, MESSAGE)
    recording, notes = read_mcap_with_notes(written + bytes(4096), DEFAULT_LIMITS)
    assert recording.channel("x").values.tolist() == [2.0]
    assert notes[-1].startswith("the rest of the file has zeros alone; it was never written.")
    assert "opcode 0" in read_refusal(written + bytes(4096) + b"x").detail


def test_one_flipped_bit_anywhere_in_a_file_of_ours_is_found() -> None:
    for place in range(len(OURS)):
        damaged = bytearray(OURS)
        damaged[place] ^= 1 << place % 8
        read_refusal(bytes(damaged))


def test_a_damaged_summary_is_refused_by_its_checksum() -> None:
    damaged = bytearray(OURS)
    damaged[-len(MCAP_MAGIC) - 29 - 1] ^= 1  # last byte before the footer
    assert "for the summary" in read_refusal(bytes(damaged)).detail


BOMB_BYTES = 96 * ONE_MIB


def bomb(compression: str, declared: int) -> bytes:
    """File with a chunk that unpacks to far more than it declares."""
    pack = zstandard.compress if compression == "zstd" else lz4.frame.compress
    packed = pack(bytes(BOMB_BYTES))
    assert len(packed) < 0.005 * BOMB_BYTES
    return file_of(CHANNEL, Chunk(compression, packed, 0, 0, 0, declared))


def write_with_window(log: int) -> bytes:
    """File with a right message in a zstd frame that asks for a window of 2ˡᵒᵍ bytes."""
    parameters = zstandard.ZstdCompressionParameters(window_log=log)
    packer = zstandard.ZstdCompressor(compression_params=parameters).compressobj()
    content = as_bytes(MESSAGE)
    packed = packer.compress(content) + packer.flush()
    assert zstandard.get_frame_parameters(packed).window_size == 1 << log
    return file_of(CHANNEL, chunk_of(content, "zstd", packed))


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("declared", [1000, 64 * ONE_MIB, 2**40])
def test_a_bomb_is_refused(compression: str, declared: int) -> None:
    assert "chunk record declares" in read_refusal(bomb(compression, declared)).detail


def test_a_zstd_frame_that_asks_for_a_huge_window_is_refused() -> None:
    recording, _ = read_mcap_with_notes(write_with_window(23), DEFAULT_LIMITS)
    assert recording.channel("x").values[0] == 2
    for log in (24, 30):
        assert "too much memory" in read_refusal(write_with_window(log)).detail


READ_IN_LITTLE_MEMORY = """
import resource, sys
from sysid.core.errors import UnreadableFile
from service.formats.limits import DEFAULT_LIMITS
from service.formats.mcap.mcap_files import read_mcap_with_notes

right, *bombs = sys.argv[1:]
read_mcap_with_notes(right, DEFAULT_LIMITS)  # loads all that reading needs
with open("/proc/self/statm") as pages:
    used = int(pages.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 32 * 1024**2, used + 32 * 1024**2))
for path in bombs:
    try:
        read_mcap_with_notes(path, DEFAULT_LIMITS)
    except UnreadableFile as error:
        print(error.detail)
"""


def test_a_bomb_needs_no_more_memory_than_it_declares(tmp_path: Path) -> None:
    files = {
        "right": (write_with_window(23), ""),
        "zstd": (bomb("zstd", 1000), "declares 1000 bytes of content, but holds more"),
        "lz4": (bomb("lz4", 1000), "declares 1000 bytes of content, but holds more"),
        "huge": (bomb("zstd", 2**40), "at most 67108864"),
        "window": (write_with_window(30), "requires too much memory"),
        "length": (file_of(b"\5" + struct.pack("<Q", 2**40)), "at most 67108864"),
    }
    for name, (content, _) in files.items():
        (tmp_path / name).write_bytes(content)
    done = subprocess.run(
        [sys.executable, "-c", READ_IN_LITTLE_MEMORY, *(tmp_path / name for name in files)],
        capture_output=True,
        text=True,
        timeout=LIMIT_SECONDS,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    for line, (_, words) in zip(lines, list(files.values())[1:], strict=True):
        assert words in line


def test_many_small_chunks_are_counted_together() -> None:
    content = bytes(60 * ONE_MIB)
    chunk = chunk_of(
        content,
        "zstd",
        zstandard.compress(b"\x80" + struct.pack("<Q", len(content) - 9) + content[9:]),
    )
    chunk = replace(chunk, uncompressed_crc=0)
    limits = replace(DEFAULT_LIMITS, total_bytes=100 * ONE_MIB)
    assert "to more than" in read_refusal(file_of(chunk, chunk), limits).detail


MAP_PAST_ITS_LENGTH = struct.pack("<II", 0, 8) + struct.pack("<I", 1) + b"a" + bytes(4)


@pytest.mark.parametrize(
    ("records", "words"),
    [
        ((MESSAGE,), "refers to channel 1"),
        ((replace(CHANNEL, schema_id=3),), "refers to schema 3"),
        ((CHANNEL, replace(CHANNEL, topic="/b")), "with another definition"),
        ((Schema(0, b"", "", ""),), "not available"),
        ((Schema(1, b"", "", "a"), Schema(1, b"", "", "b")), "not available"),
        ((Schema(1, bytes(2 * ONE_MIB), "", "a"),), "at most 1048576"),
        ((CHANNEL, replace(MESSAGE, log_time=2**63)), "2⁶³"),
        ((chunk_of(b"", "brotli", b""),), "'brotli'"),
        ((chunk_of(as_bytes(MESSAGE), "", as_bytes(MESSAGE), 5),), "declares 5 bytes"),
        ((replace(chunk_of(b"", "", b""), uncompressed_crc=7),), "checksum"),
        ((chunk_of(b"\5", "", b"\5"),), "inside the head"),
        ((chunk_of(b"\5" + bytes(7) + b"\1", "", b"\5" + bytes(7) + b"\1"),), "inside the message"),
        ((b"\0" + bytes(8),), "opcode 0"),
        ((b"\5" + b"\xff" * 8,), "at most 67108864"),
        ((struct.pack("<BQ", Opcode.MESSAGE, 3) + b"abc",), "its head alone"),
        ((struct.pack("<BQI", Opcode.METADATA, 4, 99),), "inner length"),
        ((Footer(0, 0, 0),), "before the end of the data"),
        ((DataEnd(0), CHANNEL, MESSAGE), "in the summary"),
        ((DataEnd(77),), "for the data section"),
        ((DataEnd(0), Footer(5, 0, 0)), "summary begins"),
        (
            (struct.pack("<BQ", Opcode.METADATA, 4 + 4 + 9) + MAP_PAST_ITS_LENGTH,),
            "past its length",
        ),
        ((Metadata("lagid.dataset", {"format": "9"}), CHANNEL, MESSAGE), "cannot be used"),
        ((Metadata("lagid.dataset", {}), CHANNEL, MESSAGE), "cannot be used"),
    ],
)
def test_a_record_that_cannot_be_right_is_refused(
    records: tuple[McapRecord, ...], words: str
) -> None:
    assert words in read_refusal(file_of(*records)).detail


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (UploadLimits(file_bytes=10), "at most 10"),
        (UploadLimits(record_bytes=30), "at most 30"),
        (UploadLimits(messages=19), "messages to more than 19"),
        (UploadLimits(channels=1), "more than 1 fields"),
        (UploadLimits(total_bytes=100), "to more than 100"),
        (UploadLimits(schema_bytes=1), "at most 1"),
    ],
)
def test_every_limit_is_kept(limits: UploadLimits, words: str) -> None:
    assert words in read_refusal(FOREIGN[CompressionType.ZSTD], limits).detail


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (UploadLimits(messages=3), "messages to more than 3"),
        (UploadLimits(channels=1), "at most 1 are read"),
        (UploadLimits(total_bytes=150), "to more than 150"),
    ],
)
def test_the_limits_hold_for_messages_that_are_read_as_one_array(
    limits: UploadLimits, words: str
) -> None:
    content = flat_file(*(flat_message(k, k, -k) for k in range(4)))
    recording, _ = read_mcap_with_notes(content, DEFAULT_LIMITS)
    np.testing.assert_array_equal(recording.channel("y").values, [0, -1, -2, -3])
    assert words in read_refusal(content, limits).detail


def test_a_time_beyond_the_clock_is_refused_in_an_array_of_messages_too() -> None:
    assert "2⁶³" in read_refusal(flat_file(flat_message(1, 0, 0), flat_message(2**63, 0, 0))).detail


def test_a_footer_that_denies_the_summary_is_refused() -> None:
    error = read_refusal(file_of(CHANNEL, MESSAGE, summary=(CHANNEL,)))
    assert "says that the summary begins at 0" in error.detail


def test_a_record_longer_than_the_limit_is_refused_unread_whatever_it_holds() -> None:
    content = file_of(Metadata("notes", {"text": "x" * 2000}), CHANNEL, MESSAGE)
    assert read_mcap_with_notes(content, DEFAULT_LIMITS)[0].names == ("x",)
    error = read_refusal(content, replace(DEFAULT_LIMITS, record_bytes=1000))
    assert "the metadata record declares" in error.detail
    assert "at most 1000" in error.detail


def test_the_number_of_channels_is_limited() -> None:
    channels = [replace(CHANNEL, id=number) for number in range(1, 5)]
    assert (
        "at most 3" in read_refusal(file_of(*channels), replace(DEFAULT_LIMITS, channels=3)).detail
    )


def test_bytes_after_the_end_and_a_wrong_end_are_refused() -> None:
    assert "after the end" in read_refusal(OURS + b"\0").detail
    assert "magic bytes" in read_refusal(OURS[:-1] + b"x").detail
    assert read_refusal(b"PK\x03\x04 not mcap").byte == 0


@pytest.mark.parametrize(
    "change",
    [
        {"channels": "[]"},
        {"channels": "{"},
        {"channels": '[{"name": "u"}]'},
        {"channels": '[{"name":"u","unit":"V","hold":"wild","topic":"/a","field":"x"}]'},
        {"channels": '[{"name":"u","unit":"V","hold":"first","topic":"/b","field":"x"}]'},
        {"channels": '[{"name":"u","unit":"V","hold":"first","topic":"/a","field":"z"}]'},
        {"topics": "[]"},
        {"topics": '{"/a": {"rule": "guess", "epoch": 0, "start": 0, "period": 0}}'},
        {"topics": '{"/a": {"rule": "regular", "epoch": 0, "start": 0, "period": 1e999}}'},
        {"topics": '{"/a": {"rule": "regular", "epoch": 0, "start": 0, "period": -1}}'},
        {"topics": '{"/a": {"rule": "nanoseconds", "epoch": 1e9, "start": 0, "period": 0}}'},
        {"topics": '{"/a": {"rule": "field", "epoch": -99999999999, "start": 0, "period": 0}}'},
        {"segments": '[{"start": 1, "stop": 0, "origin": 0, "labels": {}}]'},
        {"segments": '[{"start": 0, "stop": 0, "origin": 0, "labels": {"a": []}}]'},
        {"segments": "[" * 3000},
        {"history": "[]"},
        {"history": '{"u": 1}'},
        {"history": '{"u": {"topic": "/b", "field": "x"}}'},
        {"history": '{"u": {"topic": ["/a"], "field": "x"}}'},
        {"history": '{"u": {"topic": "/a", "field": "z"}}'},
        {"history": '{"u": {"topic": "/a", "field": 7}}'},
        {"history": '{"v": {"topic": "/a", "field": "x"}}'},
        {"history": '{"u": {"topic": "/a", "field": "x"}}'},  # not before the first sample
    ],
)
def test_a_manifest_that_cannot_be_right_is_refused(change: dict[str, str]) -> None:
    manifest = {
        "format": "1",
        "channels": '[{"name":"u","unit":"V","hold":"first","topic":"/a","field":"x"}]',
        "topics": '{"/a": {"rule": "nanoseconds", "epoch": 0, "start": 0, "period": 0}}',
        "segments": "[]",
        "history": "{}",
    }
    later = replace(MESSAGE, log_time=10)
    good = file_of(Metadata("lagid.dataset", manifest), CHANNEL, MESSAGE, later)
    assert read_mcap_with_notes(good, DEFAULT_LIMITS)[0].names == ("u",)
    bad = file_of(Metadata("lagid.dataset", {**manifest, **change}), CHANNEL, MESSAGE, later)
    read_refusal(bad)


@pytest.mark.parametrize("content", FILES)
@given(data=st.data())
@settings(max_examples=scale_examples(150))
def test_flipped_bits_are_found_or_change_nothing(content: bytes, data: st.DataObject) -> None:
    whole, _ = read_mcap_with_notes(content, DEFAULT_LIMITS)
    damaged = bytearray(content)
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(content) - 1))
        damaged[place] ^= 1 << data.draw(st.integers(0, 7))
    try:
        read, _ = read_mcap_with_notes(bytes(damaged), DEFAULT_LIMITS)
    except UnreadableFile:
        return
    for before, after in zip(whole.channels, read.channels, strict=True):
        np.testing.assert_array_equal(before.values, after.values)


def is_read_whole_or_refused(content: bytes) -> bool:
    """Whether a file gives channels with a value for every time, or a reason; nothing else may."""
    try:
        recording, _ = read_mcap_with_notes(content, DEFAULT_LIMITS)
    except UnreadableFile as error:
        return bool(str(error))
    return bool(recording.channels) and all(
        one.times.shape == one.values.shape for one in recording.channels
    )


@given(st.binary(max_size=400), st.sampled_from(FILES), st.data())
@settings(max_examples=scale_examples(150))
def test_any_bytes_put_anywhere_are_refused_with_a_reason_or_read_whole(
    junk: bytes, content: bytes, data: st.DataObject
) -> None:
    place = data.draw(st.integers(0, len(content)))
    damaged = content[:place] + junk + content[place + data.draw(st.integers(0, 400)) :]
    assert is_read_whole_or_refused(damaged)


@given(st.lists(st.tuples(st.integers(0, 20), st.binary(max_size=80)), max_size=8))
@settings(max_examples=scale_examples(200))
def test_records_of_any_content_are_read_or_refused(records: list[tuple[int, bytes]]) -> None:
    raw = [struct.pack("<BQ", opcode, len(body)) + body for opcode, body in records]
    for content in (
        file_of(CHANNEL, *raw, MESSAGE),
        file_of(chunk_of(b"".join(raw), "", b"".join(raw))),
    ):
        assert is_read_whole_or_refused(content)
