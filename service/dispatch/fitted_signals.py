"""Storage of fitted signals: one file per run, several files per object."""

import io
import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple
from weakref import WeakSet

from service.formats.mcap import FitRole, FittedOutput, write_fitted_outputs
from service.storage.errors import ObjectStoreFailed
from service.storage.objects import ObjectStore
from sysid.core.types import FloatArray
from sysid.data.records import Record
from workers.protocol import Records

UPLOAD_BYTES = 4 << 20
"""Bytes held in memory until they are stored with those of other runs."""
RETRY_SECONDS = 15.0
"""Longest wait for a store that accepts nothing, such as a full disk."""
RETRY_PAUSE_SECONDS = 0.3
_unavailable_stores: "WeakSet[ObjectStore]" = WeakSet()
"""Stores that timed out."""


class SignalsLocation(NamedTuple):
    """Location of a run's file; `start` is None if it is the whole object."""

    sha256: str
    start: int | None = None
    size: int | None = None


FittedPart = tuple[FitRole, Records, tuple[tuple[FloatArray, ...], ...]]
"""Role of the records, the records, and the simulated outputs of each."""


class _RetryingStore:
    """Puts objects into a store that may be full or unavailable for a while.

    After a time-out a store is not retried until it has accepted an object. This holds for all jobs
    of the dispatcher, because all of them would wait.
    """

    def __init__(self, store: ObjectStore) -> None:
        self._store = store

    def put(self, blocks: Sequence[bytes]) -> str:
        begun = time.monotonic()
        while True:
            try:
                sha256 = self._store.put_stream(blocks).sha256
            except ObjectStoreFailed:
                if self._store in _unavailable_stores or time.monotonic() - begun > RETRY_SECONDS:
                    _unavailable_stores.add(self._store)
                    raise
                time.sleep(RETRY_PAUSE_SECONDS)
            else:
                _unavailable_stores.discard(self._store)
                return sha256


class _Upload:
    """Concatenated files that become one object. Its failure is reported to all of them."""

    def __init__(self, store: _RetryingStore) -> None:
        self._store = store
        self._files: list[bytes] = []
        self._sha256: str | None = None
        self._failed: ObjectStoreFailed | None = None
        self.size = self._n_files = 0

    @property
    def is_closed(self) -> bool:
        """Whether no more files can be added."""
        return self._sha256 is not None or self._failed is not None

    def add_file(self, file: bytes) -> int:
        start = self.size
        self._files.append(file)
        self._n_files += 1
        self.size += len(file)
        return start

    def store_files(self) -> str:
        if self._failed is not None:
            raise self._failed
        if self._sha256 is None:
            try:
                self._sha256 = self._store.put(self._files)
            except ObjectStoreFailed as error:
                self._failed = error
                raise
            finally:
                self._files = []
        return self._sha256

    def locate_file(self, start: int, size: int) -> SignalsLocation:
        sha256 = self.store_files()
        return (
            SignalsLocation(sha256, start, size) if self._n_files > 1 else SignalsLocation(sha256)
        )


class StoredSignals(NamedTuple):
    """File of a run that waits to be stored."""

    upload: _Upload
    start: int
    size: int

    def store_file(self) -> SignalsLocation:
        """Store the file with the others of its upload.

        Raises
        ------
        ObjectStoreFailed
            If it cannot be written, now or earlier.
        """
        return self.upload.locate_file(self.start, self.size)


class SignalsBatch:
    """Collects the files of runs, because an object per file would cost more than the file."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = _RetryingStore(store)
        self._upload = _Upload(self._store)

    def add_file(self, file: bytes) -> StoredSignals:
        """Add a file to the current upload. A full upload is stored at once.

        Raises
        ------
        ObjectStoreFailed
            If that cannot be written.
        """
        upload = self._upload
        if upload.is_closed:
            upload = self._upload = _Upload(self._store)
        start = upload.add_file(file)
        if upload.size >= UPLOAD_BYTES:
            upload.store_files()
        return StoredSignals(upload, start, len(file))


def add_fitted_signals(
    batch: SignalsBatch,
    run: str,
    parts: Sequence[FittedPart],
) -> StoredSignals:
    """Write measured and simulated outputs of a run to a file, and add it to the batch.

    Parameters
    ----------
    parts : sequence of (role, records, simulated)
        `role` is ``estimation`` or ``validation``.
    """
    target = io.BytesIO()
    fits = [
        fit
        for role, records, simulated in parts
        for fit in _list_fitted_outputs(role, records, simulated)
    ]
    write_fitted_outputs(run, fits, target)
    return batch.add_file(target.getvalue())


def _list_fitted_outputs(
    role: FitRole, records: Sequence[Record], simulated: tuple[tuple[FloatArray, ...], ...]
) -> Iterator[FittedOutput]:
    for number, (record, outputs) in enumerate(zip(records, simulated, strict=True), 1):
        for channel, values in zip(record.outputs, outputs, strict=True):
            yield FittedOutput(
                role, number, channel.name, channel.unit, channel.times, channel.values, values
            )
