"""Results of runs that no search has found: for tests of what becomes of results."""

from service.dispatch.encoding import ResultEncoder
from service.queue.leases import Lease, LeaseQueue
from service.queue.packed_results import PackedResults
from service.queue.run_writes import RunWriter
from service.storage.sessions import Database
from sysid.islands.state import RunState
from sysid.results.result import Identification, SearchEvidence
from sysid.search.state import Improvement, Migrant
from sysid.uncertainty.estimates import Criteria, Estimate
from tests.runs import spec
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
            estimates=tuple(_build_estimate(name, *pair) for name, pair in estimates.items()),
            rms=rms,
            fit_percent=90.0,
            rms_validation=None,
            fit_percent_validation=None,
            valid=True,
            evaluations=evaluations,
            generations=generations,
            islands=(),
            history=history,
            migrations=migrations,
            uncertainty=None,
            simulated=(),
            simulated_validation=(),
            agreement=(),
            agreement_validation=(),
            warnings=(),
            selection=(),
            criteria=Criteria(0.0, None, 0.0, samples, max(1, len(estimates))),
            residual_tests=None,
            onset_delays=(),
            correlation_times={},
            input_holds=(),
            data_bounds=(),
            sample_time=0.1,
            search=SearchEvidence(True, "starts", 10, 5),
            substeps=1,
            known_before=(),
            known_before_validation=(),
        ),
        rms_noise_free=rms / 2,
    )


def _build_estimate(name: str, value: float, stderr: float | None) -> Estimate:
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
