"""Results of runs that no search has found: for tests of what becomes of results."""

from math import inf
from typing import Any

import numpy as np

from service.dispatch.encoding import ResultEncoder
from service.jobs.stored_results import write_result_document
from service.queue.leases import Lease, LeaseQueue
from service.queue.packed_results import PackedResults
from service.queue.run_writes import RunWriter
from service.storage.sessions import Database
from sysid.islands.run_state import RunState
from sysid.residuals.residual_tests import ResidualTests
from sysid.results.identification import Identification
from sysid.results.parts import SearchEvidence
from sysid.results.result import Agreements, FitPercent, Identifiability, KnownBefore
from sysid.results.verdict import Verdict
from sysid.search.state import Improvement, Migrant
from sysid.uncertainty.estimates import Criteria, Estimate
from tests.support.cluster.small_runs import spec
from workers.protocol import CompleteRun, RunConclusion


def conclude(
    rms: float = 0.5,
    *,
    evaluations: int = 50,
    generations: int = 5,
    history: tuple[tuple[Improvement, ...], ...] = (),
    migrations: tuple[Migrant, ...] = (),
    samples: int = 100,
    **estimates: tuple[float, float | None],
) -> RunConclusion:
    """The conclusion of a run of `fopdt` with these estimates: value and standard error."""
    return RunConclusion(
        Identification(
            valid=True,
            parameters=tuple(build_estimate(name, *pair) for name, pair in estimates.items()),
            rms=rms,
            rms_validation=None,
            fit_percent=FitPercent(90.0, None),
            agreement=Agreements((), ()),
            evaluations=evaluations,
            generations=generations,
            islands=(),
            identifiability=Identifiability(None, (), np.zeros(0)),
            criteria=Criteria(0.0, None, 0.0, samples, max(1, len(estimates))),
            correlation=None,
            noise_sd=None,
            noise_colour=None,
            noise_model="white",
            correlation_times={},
            noise_deviations=None,
            residual_tests=ResidualTests("estimation", None, ()),
            onset_delays=(),
            time_unit="s",
            data_bounds=(),
            input_hold=(),
            commands=(),
            known_before=KnownBefore((), ()),
            search=SearchEvidence(True, "starts", 10, 5),
            posterior=None,
            order_comparison=None,
            delays=(),
            findings=(),
            explained=True,
            verdict=Verdict("trustworthy", "trustworthy"),
            warnings=(),
            substeps=1,
            selection=(),
            history=history,
            migrations=migrations,
            covariance=None,
            degrees=inf,
            simulated=(),
            simulated_validation=(),
            sample_time=0.1,
        ),
        rms_noise_free=rms / 2,
    )


def write_result(**parts: Any) -> dict[str, Any]:
    """The stored document of a run, with these parts in place of those of `conclude`."""
    return {**write_result_document(conclude().identification, 1.0), **parts}


def build_estimate(name: str, value: float, stderr: float | None) -> Estimate:
    """An identified estimate with an interval of two standard errors."""
    ends = None if stderr is None else (value - 2.0 * stderr, value + 2.0 * stderr)
    unit = "s" if name in ("T", "L") else "1"
    return Estimate(name, unit, value, 0.0, 100.0, stderr, ends, "identified")


def write_results(database: Database, lease: Lease, results: dict[str, RunConclusion]) -> None:
    """End runs of a leased job with these results."""
    with database.write_session() as session:
        packed = encode_results(results, database)
        RunWriter(session, lease).record_results([packed])


def encode_results(
    results: dict[str, RunConclusion],
    database: Database,
    reported: dict[str, RunState] | None = None,
) -> PackedResults:
    """Encode results as a worker does, without signals."""
    encoder = ResultEncoder("sqlite" if database.is_sqlite else "postgresql", keeps_signals=False)
    told, one = reported or {}, spec()
    return encoder(
        [
            CompleteRun(run, one, concluded, 1.0, told.get(run))
            for run, concluded in results.items()
        ],
        {},
    )


def claim_job(database: Database, job: str) -> Lease:
    """Claim the only job that waits."""
    with database.write_session() as session:
        claim = LeaseQueue(session).claim_job("d1")
    assert claim is not None
    assert claim.job.id == job
    return claim.lease
