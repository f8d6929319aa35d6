"""Use case of a run's response: measured against simulated, experiment by experiment."""

from itertools import groupby

from sqlalchemy.orm import Session

from service.datasets import series
from service.errors import NotFound
from service.fitted import fits_of
from service.schemas_runs import ExperimentOut, ResponseOut
from service.signals.writer import FittedOutput
from service.storage.objects import ObjectStore
from service.storage.runs import RunRepository
from sysid.data.records import Channel


def response(session: Session, store: ObjectStore, run_id: str, max_points: int) -> ResponseOut:
    """Measured and simulated outputs of a run, reduced so that extremes stay visible.

    Raises
    ------
    NotFound
        If the run has no signals: it has not succeeded, or not yet.
    """
    run = RunRepository(session).get(run_id)
    if run.signals_sha256 is None:
        raise NotFound("response of run", run_id, f"; the run is {run.state.value}")
    fits = fits_of(store, run)
    experiments = [
        _experiment(name, list(outputs), max_points)
        for name, outputs in groupby(fits, key=lambda fit: fit.experiment)
    ]
    return ResponseOut(id=run.id, experiments=experiments)


def _experiment(name: str, outputs: list[FittedOutput], max_points: int) -> ExperimentOut:
    return ExperimentOut(
        name=name,
        measured=[
            series(Channel(fit.name, fit.times, fit.measured, fit.unit), max_points)
            for fit in outputs
        ],
        simulated=[
            series(Channel(fit.name, fit.times, fit.simulated, fit.unit), max_points)
            for fit in outputs
        ],
    )
