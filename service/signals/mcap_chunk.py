"""Chunks of an MCAP file, decompressed to their declared size and never beyond."""

import zlib

import lz4.frame
import zstandard

from service.signals.limits import Limits
from service.signals.mcap_walk import Cursor, Located


def open_chunk(record: Located, limits: Limits) -> bytes:
    """Content of a chunk record.

    Raises
    ------
    InvalidUpload
        If it is too large as declared or in truth, damaged, or compressed in an unknown way.
    """
    fields = Cursor(record)
    fields.u64(), fields.u64()  # first and last time: the messages say it themselves
    size, crc, compression = fields.u64(), fields.u32(), fields.text()
    if size > limits.record_bytes:
        record.fail(f"declares {size} bytes of content; at most {limits.record_bytes} are read")
    content = _decompress(record, compression, fields.blob(fields.u64()), size)
    if len(content) != size:
        more = "more" if len(content) > size else f"{len(content)}"
        record.fail(f"declares {size} bytes of content, but holds {more}")
    if crc not in (0, zlib.crc32(content)):
        record.fail(
            f"has the checksum {crc:08x}, its content {zlib.crc32(content):08x}: it is damaged"
        )
    return content


def _decompress(record: Located, compression: str, data: bytes, size: int) -> bytes:
    try:
        if compression == "zstd":
            # The window is memory too, and a frame's header may ask for gigabytes of it.
            window = max(1 << 10, 1 << size.bit_length())
            reader = zstandard.ZstdDecompressor(max_window_size=max(window, 1 << 23))
            with reader.stream_reader(data) as stream:
                return bytes(stream.read(size + 1))
        if compression == "lz4":
            return _unlz4(data, size)
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError) as error:
        record.fail(f"cannot be decompressed ({_first_line(error)}): it is damaged")
    if compression:
        record.fail(f"is compressed with {compression[:40]!r}; need zstd, lz4 or none")
    return data


def _unlz4(data: bytes, size: int) -> bytes:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    parts: list[bytes] = []
    wanted = size + 1
    while wanted > 0 and not decompressor.eof:
        part = decompressor.decompress(data, max_length=wanted)
        if not part and not data:
            break
        parts.append(part)
        wanted, data = wanted - len(part), b""
    return b"".join(parts)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:80]
