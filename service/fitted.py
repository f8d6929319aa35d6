"""The fitted signals of a run, as they are stored: an object, or a part of one."""

from functools import lru_cache

from service.signals.reader import read_fit
from service.signals.writer import FittedOutput
from service.storage.objects import ObjectStore
from service.storage.tables import Run

# An object never changes, so what was read of it stays true; a zoom asks for it again and again.
_KEPT = 4


def fits_of(store: ObjectStore, run: Run) -> tuple[FittedOutput, ...]:
    """What was measured and simulated, output by output; the run has signals.

    Raises
    ------
    ObjectMissing, ObjectStoreFailed
        If the object is not there, or cannot be read.
    """
    assert run.signals_sha256 is not None
    return _read(store, run.signals_sha256, run.signals_start, run.signals_size)


@lru_cache(maxsize=_KEPT)
def _read(
    store: ObjectStore, sha256: str, start: int | None, size: int | None
) -> tuple[FittedOutput, ...]:
    if start is None or size is None:
        return read_fit(store.get(sha256))
    return read_fit(store.get_range(sha256, start, size))
