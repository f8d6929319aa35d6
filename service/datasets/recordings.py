"""Recordings from the object store; the last few stay in memory."""

from collections import OrderedDict
from collections.abc import Iterable
from threading import Lock

from service.datasets.signal_channels import SignalChannels
from service.formats.mcap import read_recording
from service.storage.objects import ObjectStore
from service.storage.tables import Dataset
from sysid.data.records import Record, Recording

CACHE_SIZE = 4
MAX_CACHED_SAMPLES = 2_000_000  # samples over all channels: 32 MB


class _RecordingCache:
    """The recordings read last, by hash: an object never changes."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._found: OrderedDict[str, Recording] = OrderedDict()

    def get(self, sha256: str) -> Recording | None:
        with self._lock:
            if sha256 in self._found:
                self._found.move_to_end(sha256)
            return self._found.get(sha256)

    def put(self, sha256: str, recording: Recording) -> None:
        if sum(channel.total_samples for channel in recording.channels) > MAX_CACHED_SAMPLES:
            return
        with self._lock:
            self._found[sha256] = recording
            while len(self._found) > CACHE_SIZE:
                self._found.popitem(last=False)


_recording_cache = _RecordingCache()


def load_recording(store: ObjectStore, sha256: str) -> Recording:
    """The recording that an object holds.

    Raises
    ------
    ObjectMissing
        If the store has lost it.
    """
    found = _recording_cache.get(sha256)
    if found is None:
        found = read_recording(store.get_bytes(sha256))
        _recording_cache.put(sha256, found)
    return found


def read_records(
    store: ObjectStore, rows: Iterable[Dataset], channels: SignalChannels
) -> tuple[Record, ...]:
    """Read the records of a model's signals from datasets, one for each segment.

    Raises
    ------
    ObjectMissing
        If the store has lost a dataset.
    InvalidRecord
        If a channel is not there, or cannot be that signal.
    """
    return tuple(
        record
        for row in rows
        for record in channels.cut_records(load_recording(store, row.sha256), row.name)
    )
