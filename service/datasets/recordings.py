"""Recordings from the object store; the last few stay in memory."""

from collections import OrderedDict
from collections.abc import Iterable
from threading import Lock

from service.datasets.signal_channels import SignalChannels
from service.formats.mcap import read_recording
from service.storage.objects import ObjectStore
from service.storage.tables import Dataset
from sysid.data.records import Record, Recording

KEPT = 4
LARGEST_KEPT = 2_000_000  # samples over all channels: 32 MB


class _Kept:
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
        if sum(channel.known_samples for channel in recording.channels) > LARGEST_KEPT:
            return
        with self._lock:
            self._found[sha256] = recording
            while len(self._found) > KEPT:
                self._found.popitem(last=False)


_kept = _Kept()


def recording_of(store: ObjectStore, sha256: str) -> Recording:
    """The recording that an object holds.

    Raises
    ------
    ObjectMissing
        If the store has lost it.
    """
    found = _kept.get(sha256)
    if found is None:
        found = read_recording(store.get(sha256))
        _kept.put(sha256, found)
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
        for record in channels.cut_records(recording_of(store, row.sha256), row.name)
    )
