"""Short ways to make MCAP files, ours and other programs'."""

import json
from collections.abc import Sequence
from io import BytesIO

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from service.formats.mcap.mcap_files import write_recording
from sysid.data.records import Recording


def write_mcap_bytes(recording: Recording, **metadata: str) -> bytes:
    """Content of the file of a recording."""
    stream = BytesIO()
    write_recording(recording, stream, metadata=metadata)
    return stream.getvalue()


def write_foreign_bytes(
    messages: Sequence[tuple[str, int, bytes]],
    *,
    encoding: str = "json",
    schema: tuple[str, str, bytes] = ("Any", "jsonschema", b"{}"),
    compression: CompressionType = CompressionType.ZSTD,
    chunked: bool = True,
    chunk_size: int = 1024**2,
) -> bytes:
    """Content of a file made by the plain `mcap` writer from (topic, log time in ns, data)."""
    stream = BytesIO()
    writer = Writer(stream, chunk_size, compression=compression, use_chunking=chunked)
    writer.start()
    number = writer.register_schema(*schema)
    topics = dict.fromkeys(topic for topic, _, _ in messages)
    channels = {topic: writer.register_channel(topic, encoding, number) for topic in topics}
    for topic, log_time, data in messages:
        writer.add_message(channels[topic], log_time, data, log_time)
    writer.finish()
    return stream.getvalue()


def json_messages(topic: str, *values: dict[str, object]) -> list[tuple[str, int, bytes]]:
    """Messages of one topic, a tenth of a second apart."""
    return [(topic, k * 100_000_000, json.dumps(one).encode()) for k, one in enumerate(values)]


def read_run_record(content: bytes) -> dict[str, str]:
    """Read what a run's file says of its run, by the plain `mcap` reader."""
    records = make_reader(BytesIO(content)).iter_metadata()
    return next(record.metadata for record in records if record.name == "lagid.run")
