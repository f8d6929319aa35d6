"""Writes of the dispatcher about the runs of one job: in bulk, fenced by the lease."""

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import accumulate

from sqlalchemy.orm import Session

from service.core import metrics
from service.core.states import JobState
from service.dispatch.checkpoints import pack_state
from service.dispatch.fitted_signals import store_signals
from service.dispatch.results import to_history_points, to_migrant_points
from service.queue.leases import Claim, JobProgress, LeaseQueue
from service.queue.packed_results import PackedResults
from service.queue.previous_attempts import summarize_attempts
from service.queue.reuse import take_over_runs
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.history import HistoryPoint, MigrantPoint
from service.storage.columns import Document
from service.storage.errors import ObjectStoreFailed
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from sysid.islands.state import RunState
from workers.protocol import Encoder, RunFailure

_log = logging.getLogger(__name__)

RESULTS_SECONDS = 1.0
"""A transaction costs as much as the rows of many runs. After a pause, rows are written at once."""
PROGRESS_SECONDS = 1.0
CHECKPOINT_SECONDS = 4.0
MAX_REASONS = 3
MAX_ENDED = 1000
"""Runs that one transaction ends, about. A longer one would hold up the heartbeat of the job."""
MAX_STARTED = 500
"""Runs marked as running in one transaction. Of thousands of short runs most end unmarked."""

RunEndNotice = Callable[[str, Mapping[str, float] | None], None]
"""Receives a run that has ended, and its estimates if it succeeded and they were encoded."""


@dataclass(slots=True)
class _LiveRun:
    """Run in progress: its latest state, and how much of it is written."""

    state: RunState
    seconds: float
    first_generation: int = 0  # its generation at the start of this attempt
    written: dict[int, int] = field(default_factory=dict)
    migrants: int = 0
    changed: bool = True


@dataclass(slots=True)
class _PendingWrites:
    """Rows of the next transaction."""

    started: list[str] = field(default_factory=list)
    reused: dict[str, str] = field(default_factory=dict)
    outcomes: list[RunOutcome] = field(default_factory=list)
    packs: list[PackedResults] = field(default_factory=list)
    history: list[HistoryPoint] = field(default_factory=list)
    migrants: list[MigrantPoint] = field(default_factory=list)
    stored_signals: set[str] = field(default_factory=set)
    lost_signals: set[str] = field(default_factory=set)
    messages: list[str] = field(default_factory=list)
    kills: dict[str, int] = field(default_factory=dict)

    @property
    def has_runs(self) -> bool:
        """Whether a run has begun, ended or lost its worker."""
        return bool(self.outcomes or self.packs or self.started or self.reused or self.kills)


class RunRecorder:
    """Writes one job's runs; implements `workers.protocol.RunObserver`.

    Events are collected, and `write_due` writes them. Results are written at most every
    `RESULTS_SECONDS`, progress and history every second, checkpoints every `CHECKPOINT_SECONDS`.

    Parameters
    ----------
    store : ObjectStore
        Where fitted signals go.
    encoder : Encoder
        Encodes complete runs as `PackedResults` in the worker.
    report_end : callable
        Receives each run that ended, and its estimates if it succeeded and they are encoded.
    stopwatch : callable
        Elapsed seconds of this process.
    """

    def __init__(
        self,
        database: Database,
        claim: Claim,
        store: ObjectStore,
        encoder: Encoder,
        report_end: RunEndNotice,
        *,
        stopwatch: Callable[[], float] = time.monotonic,
    ) -> None:
        self.lease = claim.lease
        self.encoder = encoder
        self._report_end, self._stopwatch = report_end, stopwatch
        self.is_stopped = False
        with database.write_session() as session:
            before = summarize_attempts(session, claim.lease, MAX_REASONS)
        self._reasons = list(before.failure_reasons)
        # Evaluations of runs that have not continued yet.
        self._checkpoint_evaluations = before.checkpoint_evaluations
        self._database, self._store = database, store
        self._live: dict[str, _LiveRun] = {}
        self._pending = _PendingWrites()
        self._n_runs, self._n_done = claim.job.n_runs, claim.job.n_done
        self._evaluations, self._generation = before.evaluations, before.generations
        self._best = math.inf if claim.job.best_rms is None else claim.job.best_rms
        self._generations = max(1, int(claim.job.spec["algorithm"]["generations"]))
        self._n_begun, self._begun = claim.job.n_done, self._stopwatch()
        self._n_reused = 0
        self._reused_outcomes: list[RunOutcome] = []  # from other runs, in the present transaction
        self._progress_written_at = 0.0  # these three by the stopwatch
        self._results_written_at = 0.0
        self._checkpoints_written_at = 0.0
        self._has_new_progress = False

    def record_start(self, run: str) -> None:
        """Record that the run was sent to a worker."""
        self._pending.started.append(run)

    def record_worker_death(self, run: str, kills: int) -> None:
        """Record that the run alone killed its worker, `kills` times since its last progress."""
        self._pending.kills[run] = kills
        self._results_written_at = 0.0  # write at once: the dispatcher may die too

    def record_progress(self, run: str, state: RunState, seconds: float) -> None:
        """Record a state from which the run can continue."""
        live = self._live.get(run)
        metrics.evaluations.inc(max(0, state.evaluations - self._count_evaluations(run)))
        if live is None:
            begun_at = state.generation if run in self._checkpoint_evaluations else 0
            live = self._live[run] = _LiveRun(state, seconds, begun_at)
            self._checkpoint_evaluations.pop(run, None)
        live.state, live.seconds, live.changed = state, seconds, True
        self._has_new_progress = True

    def record_results(self, packed: PackedResults) -> None:
        """Record the complete runs of a pack."""
        self._pending.packs.append(packed)
        counted = sum(map(self._count_evaluations, packed.runs))
        metrics.evaluations.inc(max(0, packed.evaluations - counted))
        metrics.runs.labels("succeeded").inc(len(packed.runs))
        if self._live or self._checkpoint_evaluations:
            for run in packed.runs:
                self._checkpoint_evaluations.pop(run, None)
                self._end_live_run(run)
        for run, estimates in packed.estimates.items():
            self._report_end(run, estimates)
        self._evaluations += packed.evaluations
        self._generation = max(self._generation, packed.generations)
        if packed.best_rms is not None:
            self._best = min(self._best, packed.best_rms)
        self._n_done += len(packed.runs)
        self._has_new_progress = True

    def record_failure(self, run: str, failure: RunFailure) -> None:
        """Record that the run failed."""
        self._report_end(run, None)
        metrics.runs.labels("failed").inc()
        counted = self._count_evaluations(run)
        evaluations = self._checkpoint_evaluations.pop(run, 0)
        live = self._end_live_run(run)
        if live is not None:
            evaluations = live.state.evaluations
        evaluations = failure.evaluations or evaluations
        metrics.evaluations.inc(max(0, evaluations - counted))
        self._evaluations += evaluations
        self._pending.outcomes.append(
            RunOutcome(
                run_id=run, state=JobState.FAILED, error=failure.reason, evaluations=evaluations
            )
        )
        if failure.reason not in self._reasons and len(self._reasons) < MAX_REASONS:
            self._reasons.append(failure.reason)
            self._pending.messages.append(f"{run} failed: {failure.reason}")
            _log.warning("%s failed: %s", run, failure.reason, extra={"run_id": run})
        self._n_done += 1
        self._has_new_progress = True

    def record_reuse(self, run: str, source: str) -> None:
        """Record that the run takes over the result of `source`."""
        self._pending.reused[run] = source
        metrics.runs.labels("reused").inc()
        self._checkpoint_evaluations.pop(run, None)
        self._n_done += 1
        self._n_begun += 1  # reused runs do not count for the speed
        self._n_reused += 1
        self._has_new_progress = True

    def _count_evaluations(self, run: str) -> int:
        """Count the evaluations of an open run that its progress has told already."""
        live = self._live.get(run)
        return self._checkpoint_evaluations.get(run, 0) if live is None else live.state.evaluations

    def should_stop(self) -> bool:
        """Test whether the job was cancelled or its lease lost."""
        return self.is_stopped

    def write_due(self) -> None:
        """Write everything that is due.

        Raises
        ------
        LeaseLost
            If another dispatcher holds the job. Nothing was written.
        """
        now = self._stopwatch()
        with_progress = (
            self._has_new_progress and now - self._progress_written_at > PROGRESS_SECONDS
        )
        with_checkpoints = (
            bool(self._live) and now - self._checkpoints_written_at > CHECKPOINT_SECONDS
        )
        has_results = self._pending.has_runs and now - self._results_written_at > RESULTS_SECONDS
        if with_progress or with_checkpoints or has_results:
            self._commit_writes(now, with_progress=with_progress, with_checkpoints=with_checkpoints)

    def write_all(self) -> None:
        """Write everything, including checkpoints, because the dispatcher stops."""
        self._commit_writes(self._stopwatch(), with_progress=True, with_checkpoints=True)

    def finish_job(self, floors: Document | None = None) -> None:
        """Write the last results and end the job, in one transaction.

        With `floors`, the results are already written (`write_results`), because the bounds refer
        to them.
        """
        self._prepare_writes()
        with self._database.write_session() as session:
            self._write_rows(session, with_progress=True, with_checkpoints=False)
            queue = LeaseQueue(session)
            if floors is not None:
                queue.write_floors(self.lease, floors)
            job = queue.lock_job(self.lease)
            session.refresh(job)
            complaint = self._summarise_failures(job.n_failed, job.n_runs)
            if self._n_reused:
                text = f"{self._n_reused} of {job.n_runs} runs were taken over from earlier runs"
                queue.append_event(self.lease, "log", {"message": text})
            if job.n_failed == job.n_runs:
                queue.finish_job(self.lease, JobState.FAILED, complaint)
            else:
                queue.finish_job(self.lease, JobState.SUCCEEDED, complaint)

    def write_results(self) -> None:
        """Write the last results without ending the job."""
        self._commit_writes(self._stopwatch(), with_progress=True, with_checkpoints=False)

    def cancel_job(self) -> None:
        """End the job as cancelled. Earlier results of its runs remain."""
        self._prepare_writes()
        with self._database.write_session() as session:
            self._write_rows(session, with_progress=True, with_checkpoints=True)
            LeaseQueue(session).finish_job(self.lease, JobState.CANCELLED)

    def _compute_progress(self) -> JobProgress:
        """Compute the job's progress; its generation is that of the most advanced run."""
        states = [live.state for live in self._live.values()]
        best = min(
            [self._best, *_list_rms(self._reused_outcomes), *(state.rms for state in states)]
        )
        return JobProgress(
            evaluations=self._evaluations
            + sum(self._checkpoint_evaluations.values())
            + sum(outcome.evaluations for outcome in self._reused_outcomes)
            + sum(state.evaluations for state in states),
            generation=max(
                [
                    self._generation,
                    *(outcome.generations for outcome in self._reused_outcomes),
                    *(state.generation for state in states),
                ]
            ),
            best_rms=best if math.isfinite(best) else None,
            seconds_left=self._estimate_seconds_left(),
        )

    def _estimate_seconds_left(self) -> float | None:
        """Estimate the remaining time from the speed since the claim."""
        total = self._generations * self._n_runs
        open_runs = sum(live.state.generation for live in self._live.values())
        before = sum(live.first_generation for live in self._live.values())
        done = (self._n_done - self._n_begun) * self._generations + open_runs - before
        left = total - self._n_done * self._generations - open_runs
        elapsed = self._stopwatch() - self._begun
        return max(0.0, elapsed * left / done) if done > 0 else None

    def _summarise_failures(self, n_failed: int, n_runs: int) -> str | None:
        if n_failed == 0:
            return None
        reasons = "; ".join(self._reasons)
        return reasons if n_runs == 1 else f"{n_failed} of {n_runs} runs failed: {reasons}"

    def _end_live_run(self, run: str) -> _LiveRun | None:
        """End a run in progress: the history up to its last state is written with its end."""
        live = self._live.pop(run, None)
        if live is not None:
            points = to_history_points(run, live.state.history, live.written)
            self._pending.history.extend(points)
            migrants = to_migrant_points(run, live.state.migrations, live.migrants)
            self._pending.migrants.extend(migrants)
        return live

    def _prepare_writes(self) -> None:
        """Store signals, and write results beyond those of one transaction in others before it."""
        self._store_signals()
        self._drop_ended_starts()
        while surplus := self._take_surplus():
            try:
                with self._database.write_session() as session:
                    self._write_rows(session, with_progress=False, with_checkpoints=False)
            except BaseException:
                self._pending.packs += surplus
                raise
            signals = self._pending.stored_signals, self._pending.lost_signals
            self._mark_written(self._stopwatch(), with_progress=False, with_checkpoints=False)
            self._pending.packs = surplus
            self._pending.stored_signals, self._pending.lost_signals = signals

    def _take_surplus(self) -> list[PackedResults]:
        """Take the packs that are too many for one transaction; at least one stays."""
        counts = accumulate(len(pack.runs) for pack in self._pending.packs)
        n_kept = max(1, sum(count <= MAX_ENDED for count in counts))
        surplus = self._pending.packs[n_kept:]
        del self._pending.packs[n_kept:]
        return surplus

    def _drop_ended_starts(self) -> None:
        """Leave out starts of runs that have ended, which their results tell."""
        ended = set[str]().union(*(pack.runs for pack in self._pending.packs))
        started = self._pending.started
        self._pending.started = [run for run in started if run not in ended]

    def _commit_writes(self, now: float, *, with_progress: bool, with_checkpoints: bool) -> None:
        self._prepare_writes()
        with self._database.write_session() as session:
            self._write_rows(
                session, with_progress=with_progress, with_checkpoints=with_checkpoints
            )
        self._mark_written(now, with_progress=with_progress, with_checkpoints=with_checkpoints)

    def _store_signals(self) -> None:
        """Store the signals of ended runs, before the rows that refer to them.

        Without its signals a result is written all the same.
        """
        pending, runs, reason = self._pending, list[str](), ""
        for pack in pending.packs:
            name = pack.signals_sha256
            if name is None or name in pending.stored_signals or name in pending.lost_signals:
                continue
            try:
                store_signals(self._store, pack.signals)
                pending.stored_signals.add(name)
            except ObjectStoreFailed as error:
                pending.lost_signals.add(name)
                runs += pack.runs
                reason = str(error)
        if runs:
            others = f" and {len(runs) - 1} others" if len(runs) > 1 else ""
            text = f"the signals of {runs[0]}{others} are not stored: {reason}"
            _log.error(text, extra={"run_id": runs[0]})
            pending.messages.append(text)

    def _write_rows(self, session: Session, *, with_progress: bool, with_checkpoints: bool) -> None:
        writer, pending = RunWriter(session, self.lease), self._pending
        self._reused_outcomes = take_over_runs(session, self.lease, pending.reused)
        writer.start_runs(pending.started[:MAX_STARTED])
        writer.record_outcomes(pending.outcomes, pending.history, pending.migrants)
        writer.record_results(pending.packs, pending.lost_signals)
        writer.write_kills(pending.kills)
        for text in pending.messages:
            LeaseQueue(session).append_event(self.lease, "log", {"message": text})
        if with_progress:
            for run, live in self._live.items():
                points = to_history_points(run, live.state.history, live.written)
                writer.append_history(
                    points, to_migrant_points(run, live.state.migrations, live.migrants)
                )
            LeaseQueue(session).write_progress(self.lease, self._compute_progress())
        if with_checkpoints:
            changed = [(run, live) for run, live in self._live.items() if live.changed]
            writer.save_checkpoints(
                (run, live.state.evaluations, pack_state(live.state)) for run, live in changed
            )

    def _mark_written(self, now: float, *, with_progress: bool, with_checkpoints: bool) -> None:
        started = self._pending.started[MAX_STARTED:]
        self._pending, self._results_written_at = _PendingWrites(started), now
        self._evaluations += sum(outcome.evaluations for outcome in self._reused_outcomes)
        self._generation = max(
            [self._generation, *(outcome.generations for outcome in self._reused_outcomes)]
        )
        self._best = min([self._best, *_list_rms(self._reused_outcomes)])
        if with_progress:
            self._progress_written_at, self._has_new_progress = now, False
            for live in self._live.values():
                live.written = dict(enumerate(map(len, live.state.history)))
                live.migrants = len(live.state.migrations)
        if with_checkpoints:
            self._checkpoints_written_at = now
            for live in self._live.values():
                live.changed = False


def _list_rms(outcomes: list[RunOutcome]) -> list[float]:
    return [outcome.best_rms for outcome in outcomes if outcome.best_rms is not None]
