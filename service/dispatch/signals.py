"""The fitted signals of a run, as an object."""

import io
from collections.abc import Iterator, Sequence

from service.signals.writer import FittedOutput, write_fit
from service.storage.objects import ObjectStore
from sysid.records import Record
from sysid.types import FloatArray
from workers.ports import Records


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
