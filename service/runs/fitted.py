"""Use case of a run's response: measured and simulated outputs, from the stored signals."""

from functools import lru_cache
from itertools import groupby

from sqlalchemy.orm import Session

from service.core.errors import NotFound
from service.datasets.datasets import to_series
from service.formats.mcap import FittedOutput, read_fitted_outputs
from service.repositories.runs import RunRepository
from service.runs.schemas import ExperimentOut, ResponseOut
from service.storage.objects import ObjectStore
from service.storage.tables import Run
from sysid.data.records import Channel

# Objects never change, so their contents can be cached. A zoom reads the same object repeatedly.
_CACHE_SIZE = 4


def read_fitted_signals(store: ObjectStore, run: Run) -> tuple[FittedOutput, ...]:
    """Read the measured and simulated outputs of a run that has signals.

    Raises
    ------
    ObjectMissing, ObjectStoreFailed
        If the object is not there, or cannot be read.
    """
    assert run.signals_sha256 is not None
    return _read_object(store, run.signals_sha256, run.signals_start, run.signals_size)


@lru_cache(maxsize=_CACHE_SIZE)
def _read_object(
    store: ObjectStore, sha256: str, start: int | None, size: int | None
) -> tuple[FittedOutput, ...]:
    if start is None or size is None:
        return read_fitted_outputs(store.get_bytes(sha256))
    return read_fitted_outputs(store.get_range(sha256, start, size))


def build_response(
    session: Session, store: ObjectStore, run_id: str, max_points: int
) -> ResponseOut:
    """Build measured and simulated outputs of a run, reduced so that extremes stay visible.

    Raises
    ------
    NotFound
        If the run has no signals: it has not succeeded, or not yet.
    """
    run = RunRepository(session).get(run_id)
    if run.signals_sha256 is None:
        raise NotFound("response of run", run_id, f"; the run is {run.state.value}")
    fits = read_fitted_signals(store, run)
    experiments = [
        _to_experiment_out(name, list(outputs), max_points)
        for name, outputs in groupby(fits, key=lambda fit: fit.experiment)
    ]
    return ResponseOut(id=run.id, experiments=experiments)


def _to_experiment_out(name: str, outputs: list[FittedOutput], max_points: int) -> ExperimentOut:
    return ExperimentOut(
        name=name,
        measured=[
            to_series(Channel(fit.name, fit.times, fit.measured, fit.unit), max_points)
            for fit in outputs
        ],
        simulated=[
            to_series(Channel(fit.name, fit.times, fit.simulated, fit.unit), max_points)
            for fit in outputs
        ],
    )
