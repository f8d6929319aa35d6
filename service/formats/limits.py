"""Limits of an upload, and of the process that reads it."""

from dataclasses import dataclass

MIB = 1024**2
GIB = 1024**3


@dataclass(frozen=True, slots=True)
class UploadLimits:
    """Limits of one upload. They hold for declared and for actual lengths.

    Attributes
    ----------
    file_bytes : int
    record_bytes : int
        One MCAP record, and one chunk after decompression.
    total_bytes : int
        All chunks of a file after decompression.
    messages, channels : int
    schema_bytes : int
    seconds : float
        Wall-clock and processor time of the reading process.
    memory_bytes : int
        Address space of the reading process.
    """

    file_bytes: int = 2 * GIB
    record_bytes: int = 64 * MIB
    total_bytes: int = 8 * GIB
    messages: int = 20_000_000
    channels: int = 1000
    schema_bytes: int = MIB
    seconds: float = 120.0
    memory_bytes: int = 4 * GIB


DEFAULT_LIMITS = UploadLimits()
