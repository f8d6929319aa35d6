"""Load recordings from the object store; the latest few stay in memory."""

from collections import OrderedDict
from collections.abc import Iterable
from threading import Lock

from service.datasets.signal_channels import SignalChannels
from service.formats.mcap.mcap_files import read_mcap
from service.storage.objects import ObjectStore
from service.storage.tables import Dataset
from sysid.data.records import Record, Recording

CACHE_SIZE = 4
MAX_CACHED_SAMPLES = 2_000_000  # samples over all channels: 32 MB


class _RecordingCache:
    """The latest recordings, by hash; an object never changes."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._recordings: OrderedDict[str, Recording] = OrderedDict()

    def get(self, sha256: str) -> Recording | None:
        with self._lock:
            if sha256 in self._recordings:
                self._recordings.move_to_end(sha256)
            return self._recordings.get(sha256)

    def put(self, sha256: str, recording: Recording) -> None:
        if sum(channel.total_samples for channel in recording.channels) > MAX_CACHED_SAMPLES:
            return
        with self._lock:
            self._recordings[sha256] = recording
            while len(self._recordings) > CACHE_SIZE:
                self._recordings.popitem(last=False)


_recording_cache = _RecordingCache()


def load_recording(store: ObjectStore, sha256: str) -> Recording:
    """Load the recording of an object.

    Raises
    ------
    ObjectMissing
        If the object is missing from the store.
    """
    recording = _recording_cache.get(sha256)
    if recording is None:
        recording = read_mcap(store.get_bytes(sha256))
        _recording_cache.put(sha256, recording)
    return recording


def read_records(
    store: ObjectStore, rows: Iterable[Dataset], channels: SignalChannels
) -> tuple[Record, ...]:
    """Read the records of a model's signals from datasets, one for each segment.

    Raises
    ------
    ObjectMissing
        If the object of a dataset is missing from the store.
    InvalidRecord
        If a channel is missing, or cannot be that signal.
    """
    return tuple(
        record
        for row in rows
        for record in channels.cut_records(load_recording(store, row.sha256), row.name)
    )
