"""Use case: 95 % bands of a run's outputs, computed on request from its estimates.

A result does not store the covariance of its estimates. It is computed again on the same records,
with as many simulations as there are parameters, twice.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from sqlalchemy.orm import Session

from service.core.bodies.user_documents import to_finite
from service.core.computed import ComputedValues
from service.core.errors import Conflict, InvalidRequest, NotFound
from service.jobs.stored_run import StoredRun, load_estimated_run
from service.queue.daily_limit import compute_on_request
from service.runs.profiles import measure_work, read_estimate
from service.runs.run_schemas import BandExperimentOut, BandOut, BandsOut
from service.storage.objects import ObjectStore
from service.storage.sessions import find_database, release_connection
from service.storage.storage_errors import ObjectMissing, RowNotFound
from sysid.core.errors import SysidError
from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.figures.theme import thin_indices
from sysid.results.result import Result

if TYPE_CHECKING:
    from sysid.identification.fit_problems import FitRecords
    from sysid.simulation.problem import Problem
    from sysid.uncertainty.output_bands import OutputBands, ParameterSpread

MAX_WORK = 20_000_000  # of `measure_work`: about five seconds
_CACHE_SIZE = 4  # runs: a zoom reads the same bands repeatedly
_computed_bands = ComputedValues(_CACHE_SIZE)


def load_bands(
    session: Session, store: ObjectStore, stored: StoredRun
) -> "tuple[tuple[OutputBands, ...], ...]":
    """Compute the bands of each output of each record that a run was fitted to.

    Raises
    ------
    Conflict
        If the run has no standard errors, its records are gone, or the work is too much.
    BudgetExceeded
        If the project has used up its evaluations of a day.
    """
    return _computed_bands.get(
        stored.run.id,
        partial(_compute_bands, session, store, stored),
        is_final=True,
        before_wait=partial(release_connection, session),
    )


def build_bands(session: Session, store: ObjectStore, run_id: str, max_points: int) -> BandsOut:
    """Build the bands of a run, reduced so that extremes of the output stay visible.

    Raises
    ------
    NotFound
        If there is no such run.
    Conflict
        If it has no estimates, or no bands.
    BudgetExceeded
        As `load_bands`.
    """
    stored = load_estimated_run(session, run_id, "compute bands from")
    bands = load_bands(session, store, stored)
    return BandsOut(
        id=run_id,
        source=bands[0][0].source,
        experiments=[
            BandExperimentOut(
                name=f"record {number}", outputs=[_to_band_out(one, max_points) for one in outputs]
            )
            for number, outputs in enumerate(bands, 1)
        ],
    )


def _compute_bands(
    session: Session, store: ObjectStore, stored: StoredRun
) -> "tuple[tuple[OutputBands, ...], ...]":
    # These import the compiler, which most requests never need.
    from sysid.results.bands import estimate_noise
    from sysid.uncertainty.output_bands import compute_output_bands

    assert stored.result is not None
    agreement = stored.result.agreement.estimation
    with build_spread_fit(session, store, stored, "bands") as (problem, theta, spread):
        noise = estimate_noise(agreement, spread.noise_degrees)
        return compute_output_bands(problem, theta, spread, noise)


@contextmanager
def build_spread_fit(
    session: Session, store: ObjectStore, stored: StoredRun, what: str
) -> "Iterator[tuple[Problem, FloatArray, ParameterSpread]]":
    """Build the problem of a run on its whole records, its estimate, and how far that may be off.

    The block that computes `what` holds a place among simulations.

    Raises
    ------
    Conflict
        If the run has no standard errors, its records are gone, or the work is too much.
    """
    # These import the compiler, which most requests never need.
    from sysid.residuals.series import make_whitening
    from sysid.results.bands import build_fit, list_whole_records
    from sysid.uncertainty.analysis import analyse_estimate
    from sysid.uncertainty.output_bands import ParameterSpread

    run_id, result = stored.run.id, stored.result
    assert result is not None
    try:
        records = stored.read_fit_records(session, store)
        problem = stored.problem(session, store)
        release_connection(session)
        _check_work(run_id, problem, what)
        theta = read_estimate(problem, stored)
        times = result.correlation_times
        with compute_on_request(find_database(session)) as computation:
            whitening = make_whitening(problem, times) if any(times.values()) else None
            analysis = analyse_estimate(problem, theta, whitening=whitening)
            computation.evaluations = 2 * analysis.evaluations  # the bands take as many
            uncertainty = analysis.uncertainty
            if uncertainty is None:
                raise Conflict(f"run {run_id} has no standard errors, so there are no {what}")
            spread = ParameterSpread(
                problem.free_names,
                uncertainty.covariance,
                uncertainty.degrees,
                float(problem.n_scored - theta.size),
                _get_samples(result),
            )
            whole = list_whole_records(records.estimation, _list_later_parts(records))
            estimates, ties = stored.estimates, _read_ties(stored.body)
            yield (
                *build_fit(stored.model, whole, estimates, ties, stored.body["prediction"], result),
                spread,
            )
    except (SysidError, NotFound, InvalidRequest, RowNotFound, ObjectMissing) as error:
        raise Conflict(f"the {what} of run {run_id} cannot be computed: {error}") from error


def _check_work(run_id: str, problem: "Problem", what: str) -> None:
    work = measure_work(problem)
    if work > MAX_WORK:
        raise Conflict(
            f"the {what} of run {run_id} are too much work. Steps × parameters is {work:.3g}; "
            f"need at most {MAX_WORK:.3g}. Use `compute_{what}` of the Python library"
        )


def _list_later_parts(records: "FitRecords") -> list[Record]:
    """List the last parts of the records that were used for validation, with whole inputs."""
    if records.scored_from is None:
        return []
    pairs = zip(records.validation or (), records.validation_runs or (), strict=True)
    return [replace(part, inputs=whole.inputs) for part, whole in pairs]


def _read_ties(body: Mapping[str, Any]) -> dict[str, str]:
    ties = {name: change.get("tied") for name, change in body["parameters"].items()}
    return {name: tie for name, tie in ties.items() if tie is not None}


def _get_samples(result: Result) -> FloatArray | None:
    posterior = result.posterior
    return posterior.samples if posterior is not None and posterior.samples.size else None


def _to_band_out(bands: "OutputBands", max_points: int) -> BandOut:
    shown = thin_indices(bands.simulated, max_points)

    def read(values: FloatArray) -> list[float | None]:
        return [to_finite(value) for value in values[shown].tolist()]

    return BandOut(
        name=bands.output,
        unit=bands.unit,
        samples=bands.times.size,
        times=bands.times[shown].tolist(),
        simulated=read(bands.simulated),
        confidence_lower=read(bands.confidence[:, 0]),
        confidence_upper=read(bands.confidence[:, 1]),
        prediction_lower=read(bands.prediction[:, 0]),
        prediction_upper=read(bands.prediction[:, 1]),
    )
