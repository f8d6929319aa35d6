"""Files of other programs: what is read, what is left out, and what is refused."""

import struct
from io import BytesIO

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Kind
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.writer import CompressionType, Writer

from service.formats.limits import DEFAULT_LIMITS
from service.formats.mcap.mcap_files import read_mcap_with_notes
from service.formats.mcap.mcap_messages import build_schema
from service.formats.read_options import Clock
from sysid.core.errors import UnreadableFile
from sysid.data.records import Recording
from tests.support.files.mcap_files import json_messages, write_foreign_bytes

KINDS = {
    "value": Kind.TYPE_DOUBLE,
    "small": Kind.TYPE_FLOAT,
    "count": Kind.TYPE_INT32,
    "on": Kind.TYPE_BOOL,
    "name": Kind.TYPE_STRING,
}


def read(content: bytes) -> tuple[Recording, tuple[str, ...]]:
    return read_mcap_with_notes(content, DEFAULT_LIMITS)


def build_robot() -> FileDescriptorSet:
    """Schema of demo.Robot: numbers, a text, a list, and a joint that is itself a message."""
    files = FileDescriptorSet()
    file = files.file.add(name="robot.proto", package="demo", syntax="proto3")
    joint = file.message_type.add(name="Joint")
    joint.field.add(name="angle", number=1, type=Kind.TYPE_DOUBLE, label=Kind.LABEL_OPTIONAL)
    robot = file.message_type.add(name="Robot")
    for number, (name, kind) in enumerate(KINDS.items(), 1):
        robot.field.add(name=name, number=number, type=kind, label=Kind.LABEL_OPTIONAL)
    robot.field.add(name="list", number=8, type=Kind.TYPE_DOUBLE, label=Kind.LABEL_REPEATED)
    robot.field.add(
        name="joint",
        number=9,
        type=Kind.TYPE_MESSAGE,
        type_name=".demo.Joint",
        label=Kind.LABEL_OPTIONAL,
    )
    return files


def robot_file(rows: list[dict[str, object]]) -> bytes:
    pool = DescriptorPool()
    pool.Add(build_robot().file[0])
    made = GetMessageClass(pool.FindMessageTypeByName("demo.Robot"))
    messages = []
    for k, row in enumerate(rows):
        message = made(**{name: value for name, value in row.items() if name != "angle"})
        message.joint.angle = row.get("angle", 0.0)
        messages.append(("/robot", k * 10**8, message.SerializeToString()))
    schema = ("demo.Robot", "protobuf", build_robot().SerializeToString())
    return write_foreign_bytes(messages, encoding="protobuf", schema=schema)


def test_protobuf_that_omits_zeros_is_read_with_its_nested_numbers() -> None:
    recording, _ = read(
        robot_file(
            [
                {"value": 1.5, "count": -3, "on": True, "name": "a", "list": [1.0]},
                {"value": 0.0, "small": 0.5, "angle": 2.0},
            ]
        )
    )
    assert recording.names == ("value", "small", "count", "on", "joint.angle")
    columns = {one.name: one.values.tolist() for one in recording.channels}
    assert columns == {
        "value": [1.5, 0],
        "small": [0, 0.5],
        "count": [-3, 0],
        "on": [1, 0],
        "joint.angle": [0, 2],
    }
    np.testing.assert_array_equal(recording.channels[0].times, [0, 0.1])


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_json_is_read_by_its_keys(compression: CompressionType, chunked: bool) -> None:
    messages = json_messages("/a", {"x": 1, "in": {"y": 2.5}, "text": "z"}, {"x": 3, "late": True})
    recording, _ = read(write_foreign_bytes(messages, compression=compression, chunked=chunked))
    assert set(recording.names) == {"x", "in.y", "late"}
    np.testing.assert_array_equal(recording.channel("x").values, [1, 3])
    np.testing.assert_array_equal(recording.channel("in.y").values, [2.5, np.nan])
    np.testing.assert_array_equal(recording.channel("late").values, [np.nan, 1])


def test_topics_keep_their_own_times_and_give_their_names() -> None:
    content = write_foreign_bytes(
        [*json_messages("/a", {"x": 1}, {"x": 2}), *json_messages("/b", {"x": 3})]
    )
    recording, _ = read(content)
    assert recording.names == ("a.x", "b.x")
    assert [one.times.size for one in recording.channels] == [2, 1]


def test_the_times_of_a_clock_are_counted_from_the_first_exactly() -> None:
    start = 1_700_000_000_123_456_789
    content = write_foreign_bytes([("/a", start + k * 10**6, b'{"x": 1}') for k in range(3)])
    recording, notes = read(content)
    np.testing.assert_array_equal(recording.channels[0].times, [0, 0.001, 0.002])
    assert any(str(start) in note for note in notes)


def test_the_times_of_a_clock_are_counted_from_the_first_of_any_topic() -> None:
    start = 1_700_000_000_000_000_000
    content = write_foreign_bytes(
        [("/late", start + 10**9, b'{"x": 1}'), ("/early", start, b'{"x": 2}')]
    )
    recording, _ = read(content)
    assert recording.channel("early.x").times.tolist() == [0.0]
    assert recording.channel("late.x").times.tolist() == [1.0]


PERIOD, SENT, LOGGED = 100_000_000, 3_000_000, 7_000_000  # ns
START_NS = 1_760_000_000 * 10**9


def write_clocks(stamp: str = '"header": {"stamp": {"sec": %d, "nanosec": %d}}, ') -> bytes:
    """JSON messages stamped each 0.1 s, sent 3 ms later, and logged 7 ms later and with jitter."""
    stream = BytesIO()
    writer = Writer(stream)
    writer.start()
    number = writer.register_schema("A", "jsonschema", b"{}")
    channel = writer.register_channel("/a", "json", number)
    for k in range(20):
        moment = START_NS + k * PERIOD
        head = stamp % divmod(moment, 10**9) if stamp else ""
        logged = moment + LOGGED + (k % 3) * 1_000_000
        writer.add_message(channel, logged, f'{{{head}"x": {k}}}'.encode(), moment + SENT)
    writer.finish()
    return stream.getvalue()


@pytest.mark.parametrize("clock", ["publish", "stamp"])
def test_times_are_those_of_the_chosen_clock(clock: Clock) -> None:
    recording, notes = read_mcap_with_notes(write_clocks(), DEFAULT_LIMITS, clock)
    assert recording.names == ("x",)
    np.testing.assert_array_equal(recording.channel("x").times, np.arange(20) / 10)
    assert recording.started_at is not None
    delay = SENT if clock == "publish" else 0
    assert recording.started_at.timestamp() == (START_NS + delay) / 1e9
    told = " ".join(notes)
    assert "the log time comes 5 ms after the publish time in the median, 4 to 6 ms" in told
    assert "comes 8 ms after the stamp in the header in the median, 7 to 9 ms" in told
    assert "The clock is chosen by clock=publish" in told


def test_the_log_time_is_the_clock_if_none_is_chosen() -> None:
    recording, _ = read(write_clocks())
    late = np.arange(20) / 10 + (np.arange(20) % 3) / 1000
    np.testing.assert_allclose(recording.channel("x").times, late, atol=1e-12)


def test_messages_without_the_clock_are_refused_with_those_they_have() -> None:
    with pytest.raises(UnreadableFile) as caught:
        read_mcap_with_notes(write_clocks(""), DEFAULT_LIMITS, "stamp")
    assert str(caught.value) == (
        "topic '/a' has no stamp in a header, such as header.stamp; its clocks are log, publish: "
        "give one of them as clock"
    )


PAIR = ("lagid.Pair", "protobuf", build_schema("Pair", ("x", "y")))


def pair(x: float, y: float) -> bytes:
    """Message of `PAIR` with both fields written, as our own writer does."""
    return struct.pack("<BdBd", 0x09, x, 0x11, y)


def test_two_topics_of_one_schema_do_not_mix_wherever_their_chunks_end() -> None:
    messages = [
        (topic, k * 10**6, pair(sign * k, sign * (k + 0.5)))
        for k in range(100)
        for topic, sign in (("/a", 1), ("/b", -1))
    ]
    for size in (200, 1000, 10**6):
        content = write_foreign_bytes(messages, encoding="protobuf", schema=PAIR, chunk_size=size)
        recording, _ = read(content)
        assert recording.names == ("a.x", "a.y", "b.x", "b.y")
        for name, sign in (("a", 1), ("b", -1)):
            steps = np.arange(100)
            np.testing.assert_array_equal(recording.channel(f"{name}.x").values, sign * steps)
            np.testing.assert_array_equal(
                recording.channel(f"{name}.y").values, sign * (steps + 0.5)
            )
            np.testing.assert_array_equal(recording.channel(f"{name}.x").times, steps / 1000)


def test_fields_count_by_their_number_and_not_by_their_place() -> None:
    swapped = struct.pack("<BdBd", 0x11, 2.0, 0x09, 1.0)
    messages = [("/a", k, data) for k, data in enumerate([pair(1, 2), *[swapped] * 60])]
    recording, _ = read(
        write_foreign_bytes(messages, encoding="protobuf", schema=PAIR, chunk_size=100)
    )
    np.testing.assert_array_equal(recording.channel("x").values, np.ones(61))
    np.testing.assert_array_equal(recording.channel("y").values, np.full(61, 2.0))


def test_messages_of_one_time_keep_their_order_when_a_topic_is_sorted() -> None:
    times = [5] * 50 + [1] * 50
    content = write_foreign_bytes([("/a", time, b'{"x": %d}' % k) for k, time in enumerate(times)])
    recording, _ = read(content)
    np.testing.assert_array_equal(recording.channel("x").values, [*range(50, 100), *range(50)])


def test_messages_out_of_order_are_sorted_and_it_is_said() -> None:
    content = write_foreign_bytes([("/a", 2, b'{"x": 2}'), ("/a", 1, b'{"x": 1}')])
    recording, notes = read(content)
    np.testing.assert_array_equal(recording.channels[0].values, [1, 2])
    assert any("not in order of time" in note for note in notes)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (write_foreign_bytes([]), "no channel"),
        (write_foreign_bytes([("/a", 0, b"\0")], encoding="cdr"), "ROS 2 CDR"),
        (write_foreign_bytes([("/a", 0, b"\0")], encoding="cbor"), "'cbor'"),
        (write_foreign_bytes([("/a", 0, b"{")]), "not JSON"),
        (write_foreign_bytes([("/a", 0, b"[1]")]), "not a JSON object"),
        (write_foreign_bytes([("/a", 0, b'{"x": "text"}')]), "no signal"),
        (
            write_foreign_bytes([("/a", 0, b'{"x": 1' + b"0" * 400 + b"}")]),
            "too large for a double",
        ),
        (write_foreign_bytes([("/a", 0, b"[" * 5000 + b"]" * 5000)]), "JSON"),
        (write_foreign_bytes([("/a", 0, b"\x08")], encoding="protobuf"), "no protobuf schema"),
        (
            write_foreign_bytes(
                [("/a", 0, b"\xff")],
                encoding="protobuf",
                schema=("demo.Robot", "protobuf", build_robot().SerializeToString()),
            ),
            "does not follow its schema",
        ),
        (
            write_foreign_bytes(
                [("/a", 0, b"")],
                encoding="protobuf",
                schema=("demo.Missing", "protobuf", build_robot().SerializeToString()),
            ),
            "its schema cannot be used",
        ),
        (
            write_foreign_bytes(
                [("/a", 0, b"")], encoding="protobuf", schema=("x", "protobuf", b"\xff\xff")
            ),
            "its schema cannot be used",
        ),
    ],
)
def test_what_holds_no_signal_is_refused_with_the_reason(content: bytes, words: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(content)
    assert words in caught.value.detail
    assert "\n" not in caught.value.detail
