"""Use case of a run's response: measured and simulated outputs, stored or computed again."""

from functools import lru_cache, partial
from itertools import groupby

from sqlalchemy.orm import Session

from service.core.computed import ComputedValues
from service.core.errors import Conflict, InvalidRequest, NotFound
from service.core.process.concurrency import simulation_places
from service.core.states import JobState
from service.datasets.datasets import to_series
from service.formats.mcap.mcap_files import (
    FittedOutput,
    list_fitted_outputs,
    read_fitted_outputs,
)
from service.jobs.stored_run import StoredRun, load_run
from service.queue.daily_limit import count_evaluations
from service.runs.run_schemas import ExperimentOut, ResponseOut
from service.storage.objects import ObjectStore
from service.storage.sessions import find_database, find_project, release_connection
from service.storage.storage_errors import ObjectDamaged, ObjectMissing, RowNotFound
from sysid.core.errors import SysidError, UnreadableFile
from sysid.data.records import Channel

_CACHE_SIZE = 4
"""Runs whose signals stay in memory: a zoom reads the same ones repeatedly."""
_computed_signals = ComputedValues(_CACHE_SIZE)


def load_fitted_signals(
    session: Session, store: ObjectStore, stored: StoredRun
) -> tuple[FittedOutput, ...] | None:
    """Load the measured and simulated outputs of a run; None if it has not succeeded.

    Signals that were not stored are computed again. That counts as one evaluation, but is not
    refused if none are left: a project sees what it has.

    Raises
    ------
    ObjectMissing, ObjectDamaged, ObjectStoreFailed
        If the object is not there, or cannot be read.
    Conflict
        If they are not stored and cannot be computed again.
    """
    run = stored.run
    if run.signals_sha256 is not None:
        return _read_object(store, run.signals_sha256, run.signals_start, run.signals_size)
    if run.state is not JobState.SUCCEEDED:
        return None
    return _computed_signals.get(
        run.id,
        partial(_compute_signals, session, store, stored),
        is_final=True,
        before_wait=partial(release_connection, session),
    )


@lru_cache(maxsize=_CACHE_SIZE)
def _read_object(
    store: ObjectStore, sha256: str, start: int | None, size: int | None
) -> tuple[FittedOutput, ...]:
    """Read the signals of an object, which never changes."""
    if start is None or size is None:
        return read_fitted_outputs(store.get_bytes(sha256))
    try:
        return read_fitted_outputs(store.get_range(sha256, start, size))
    except UnreadableFile as error:  # a part of an object has checksums of its own
        raise ObjectDamaged(sha256) from error


def _compute_signals(
    session: Session, store: ObjectStore, stored: StoredRun
) -> tuple[FittedOutput, ...]:
    release_connection(session)
    with simulation_places.hold(find_project(session)):
        try:
            records, signals = stored.resimulate(session, store)
        except (SysidError, NotFound, InvalidRequest, RowNotFound, ObjectMissing) as error:
            raise Conflict(
                f"the signals of run {stored.run.id} are not stored, and cannot be computed "
                f"again: {error}"
            ) from error
    count_evaluations(find_database(session), 1)
    fits = list_fitted_outputs("estimation", records.estimation, signals.simulated)
    if records.validation is not None:
        validated = signals.simulated_validation
        fits += list_fitted_outputs("validation", records.validation, validated)
    return tuple(fits)


def build_response(
    session: Session, store: ObjectStore, run_id: str, max_points: int
) -> ResponseOut:
    """Build measured and simulated outputs of a run, reduced so that extremes stay visible.

    Raises
    ------
    NotFound
        If the run has no signals: it has not succeeded, or not yet.
    """
    stored = load_run(session, run_id)
    fits = load_fitted_signals(session, store, stored)
    if fits is None:
        raise NotFound("response of run", run_id, f"; the run is {stored.run.state.value}")
    experiments = [
        _to_experiment_out(name, list(outputs), max_points)
        for name, outputs in groupby(fits, key=lambda fit: fit.experiment)
    ]
    return ResponseOut(id=run_id, experiments=experiments)


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
