"""The fitted signals of runs: a file of each, the files of several as one object."""

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
"""Bytes that are kept in memory until they are stored with those of other runs."""
RETRY_SECONDS = 15.0
"""How long a store that takes nothing, such as a full disk, is waited for."""
RETRY_PAUSE_SECONDS = 0.3
_unavailable_stores: "WeakSet[ObjectStore]" = WeakSet()
"""Stores that have not come back in time."""


class SignalsLocation(NamedTuple):
    """Where a run's file is stored; `start` is None where it is the whole object."""

    sha256: str
    start: int | None = None
    size: int | None = None


FittedPart = tuple[FitRole, Records, tuple[tuple[FloatArray, ...], ...]]
"""What the records are for, the records, and the simulated outputs of each."""


class _RetryingStore:
    """Puts objects into a store that may be full or away for a while.

    A store that has not come back in time is not waited for again until it has taken something,
    by none of the jobs that a dispatcher holds: all of them wait meanwhile.
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
    """Files behind one another, which become one object. What made that fail is told to all."""

    def __init__(self, store: _RetryingStore) -> None:
        self._store = store
        self._files: list[bytes] = []
        self._sha256: str | None = None
        self._failed: ObjectStoreFailed | None = None
        self.size = self._n_files = 0

    @property
    def is_closed(self) -> bool:
        """Whether another file would come too late."""
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
    """A run's file that waits to be stored."""

    upload: _Upload
    start: int
    size: int

    def store_file(self) -> SignalsLocation:
        """Store it, with the others of its parcel.

        Raises
        ------
        ObjectStoreFailed
            If it cannot be written, now or before.
        """
        return self.upload.locate_file(self.start, self.size)


class SignalsBatch:
    """Collects the files of runs: an object of each would cost more than the file itself."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = _RetryingStore(store)
        self._parcel = _Upload(self._store)

    def add_file(self, file: bytes) -> StoredSignals:
        """Put a file to those that are stored next; a full parcel is stored at once.

        Raises
        ------
        ObjectStoreFailed
            If that cannot be written.
        """
        parcel = self._parcel
        if parcel.is_closed:
            parcel = self._parcel = _Upload(self._store)
        start = parcel.add_file(file)
        if parcel.size >= UPLOAD_BYTES:
            parcel.store_files()
        return StoredSignals(parcel, start, len(file))


def add_fitted_signals(
    shelf: SignalsBatch,
    run: str,
    parts: Sequence[FittedPart],
) -> StoredSignals:
    """What a run's model gives beside what was measured, as a file on the shelf.

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
    return shelf.add_file(target.getvalue())


def _list_fitted_outputs(
    role: FitRole, records: Sequence[Record], simulated: tuple[tuple[FloatArray, ...], ...]
) -> Iterator[FittedOutput]:
    for number, (record, outputs) in enumerate(zip(records, simulated, strict=True), 1):
        for channel, values in zip(record.outputs, outputs, strict=True):
            yield FittedOutput(
                role, number, channel.name, channel.unit, channel.times, channel.values, values
            )
