"""Recordings in, fitted signals out: between the object store and the records of runs."""

import io
from collections import OrderedDict
from collections.abc import Iterator, Sequence

from service.signals.reader import read_recording
from service.signals.writer import FittedOutput, write_fit
from service.storage.objects import ObjectStore
from sysid.records import Record, Recording
from sysid.types import FloatArray
from workers.ports import Records

KEPT_RECORDINGS = 8


class Recordings:
    """Recordings of the object store by their hash; the last few are kept."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._kept: OrderedDict[str, Recording] = OrderedDict()

    def read(self, sha256: str) -> Recording:
        """The recording in that object.

        Raises
        ------
        StorageError
            If the object is not there or cannot be read.
        """
        if sha256 not in self._kept:
            self._kept[sha256] = read_recording(self._store.get(sha256))
            while len(self._kept) > KEPT_RECORDINGS:
                self._kept.popitem(last=False)
        self._kept.move_to_end(sha256)
        return self._kept[sha256]


def save_fit(
    store: ObjectStore,
    run: str,
    parts: Sequence[tuple[str, Records, tuple[tuple[FloatArray, ...], ...]]],
) -> str:
    """Store what a run's model gives beside what was measured; gives the object's hash.

    Parameters
    ----------
    parts : sequence of (role, records, simulated)
        `role` is ``estimation`` or ``validation``.
    """
    target = io.BytesIO()
    fits = [fit for role, records, simulated in parts for fit in _fits(role, records, simulated)]
    write_fit(run, fits, target)
    return store.put_bytes(target.getvalue()).sha256


def _fits(
    role: str, records: Sequence[Record], simulated: tuple[tuple[FloatArray, ...], ...]
) -> Iterator[FittedOutput]:
    for number, (record, outputs) in enumerate(zip(records, simulated, strict=True), 1):
        for channel, values in zip(record.outputs, outputs, strict=True):
            yield FittedOutput(
                f"{role} {number}", channel.name, channel.unit, channel.times, channel.values,
                values,
            )  # fmt: skip
