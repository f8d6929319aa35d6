"""Writes of the dispatcher about the runs of one parcel: in bulk, fenced by the lease."""

import logging
import math
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import accumulate

from sqlalchemy.orm import Session

from service.core.process import service_metrics
from service.core.process.logs import bind_ids
from service.core.process.loop_watch import allow_long_step
from service.core.states import JobState
from service.dispatch.checkpoints import pack_state
from service.dispatch.fitted_signals import store_signals
from service.dispatch.history_points import to_history_points, to_migrant_points
from service.dispatch.overlap import RunBeside, run_at_once
from service.queue.leases import Claim, FinalState, JobProgress, LeaseQueue
from service.queue.packed_results import PackedResults
from service.queue.previous_attempts import (
    PreviousAttempts,
    list_failure_reasons,
    summarize_attempts,
)
from service.queue.reuse import take_over_runs
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.history_rows import HistoryPoint, MigrantPoint
from service.storage.columns import Document
from service.storage.objects import ObjectStore
from service.storage.retry import GIVE_UP_SECONDS, retry_transient
from service.storage.sessions import Database
from service.storage.storage_errors import ObjectStoreFailed
from sysid.islands.run_state import RunState
from workers.protocol import Encoder, RunFailure

_log = logging.getLogger(__name__)

RESULTS_SECONDS = 1.0
"""A transaction costs as much as the rows of many runs. After a pause, rows are written at once."""
PROGRESS_SECONDS = 1.0
CHECKPOINT_SECONDS = 4.0
MAX_REASONS = 3
MAX_ENDED = 1000
"""Runs that one transaction ends, about. A longer one would hold up the heartbeat of the job."""
MAX_STARTED = 200
"""Runs marked as running in one transaction. Of thousands of short runs most end unmarked."""

FEW_ENDED = 100
"""Ended runs that are written sooner than a thread would begin."""
MAX_UNWRITTEN = 5000
"""Ended runs that wait for the database at most; then the dispatcher waits too."""

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
class JobSpeed:
    """Start of a job in this dispatcher, from which its speed is measured; parcels share it.

    Attributes
    ----------
    begun : float
        Time of the first claim, by the stopwatch.
    n_begun : int
        Runs that had ended then, and those that were reused since.
    """

    begun: float
    n_begun: int


@dataclass(slots=True)
class _PendingWrites:
    """Rows of the next transactions."""

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
        """Whether a run has begun, ended or lost its worker, or there is something to tell."""
        ended = self.outcomes or self.packs or self.reused
        return bool(ended or self.started or self.kills or self.messages)

    def count_ended(self) -> int:
        """Count the runs that have ended."""
        return len(self.outcomes) + len(self.reused) + sum(len(pack.runs) for pack in self.packs)

    def append(self, later: "_PendingWrites") -> None:
        """Append what came later."""
        for item in fields(self):
            mine = getattr(self, item.name)
            if isinstance(mine, list):
                mine.extend(getattr(later, item.name))
            else:
                mine.update(getattr(later, item.name))


@dataclass(slots=True)
class _Batch:
    """What the next transactions write, taken at one moment.

    Attributes
    ----------
    progress : JobProgress or None
        Progress without the runs that are taken over in these transactions.
    estimate_left : callable
        The remaining time of the job (s), from its number of ended runs.
    live : dict
        Runs in progress whose history and checkpoint are written, with their states.
    reused_outcomes : list
        What was taken over from other runs.
    has_ended : bool or None
        Whether it ended the parcel; None if it was not the parcel's last one.
    """

    taken_at: float
    pending: _PendingWrites
    progress: JobProgress | None
    estimate_left: Callable[[int], float | None]
    live: dict[str, tuple[_LiveRun, RunState]]
    with_checkpoints: bool
    reused_outcomes: list[RunOutcome] = field(default_factory=list)
    has_ended: bool | None = None


class RunRecorder:
    """Writes the runs of one parcel; implements `workers.protocol.RunObserver`.

    Events are collected, and `write_due` writes them. Results are written at most every
    `RESULTS_SECONDS`, progress and history every second, checkpoints every `CHECKPOINT_SECONDS`.
    One batch at a time may be written beside the main thread, while the next one is collected.

    Parameters
    ----------
    store : ObjectStore
        Where fitted signals go.
    encoder : Encoder
        Encodes complete runs as `PackedResults` in the worker.
    report_end : callable
        Receives each run that ended, and its estimates if it succeeded and they are encoded.
    run_beside : callable, optional
        Carries out a write. By default it is done at once.
    speed : JobSpeed, optional
        Shared by the parcels of the job. By default it begins now.
    stopwatch : callable
        Elapsed seconds of this process.

    Attributes
    ----------
    is_stopped : bool
        Whether the job was cancelled or its lease lost.
    has_ended : bool or None
        Whether the parcel has ended, once `end_parcel` is written. The last one of a job has not.
    """

    def __init__(
        self,
        database: Database,
        claim: Claim,
        store: ObjectStore,
        encoder: Encoder,
        report_end: RunEndNotice,
        *,
        run_beside: RunBeside | None = None,
        speed: JobSpeed | None = None,
        stopwatch: Callable[[], float] = time.monotonic,
    ) -> None:
        self.lease = claim.lease
        self.encoder = encoder
        self.is_stopped = self._is_ending = False
        self.has_ended: bool | None = None
        self._report_end, self._stopwatch, self._run_beside = (
            report_end,
            stopwatch,
            run_beside or run_at_once,
        )
        before, told = PreviousAttempts(), list[str]()
        if not claim.is_new:
            with database.write_session() as session:
                before = summarize_attempts(session, claim.lease)
                told = list_failure_reasons(session, claim.job.id, MAX_REASONS)
        # Evaluations of runs that have not continued yet.
        self._checkpoint_evaluations = before.checkpoint_evaluations
        self._database, self._store = database, store
        self._live: dict[str, _LiveRun] = {}
        self._pending = _PendingWrites()
        self._written_beside: tuple[_Batch, Future[None]] | None = None
        self._n_runs = claim.job.n_runs
        self._evaluations, self._generation = before.evaluations, before.generations
        self._best = math.inf if claim.job.best_rms is None else claim.job.best_rms
        self._generations = max(1, int(claim.job.spec["algorithm"]["generations"]))
        self._speed = speed or JobSpeed(self._stopwatch(), claim.job.n_done)
        self._reasons = told  # in the log
        self._progress_written_at = 0.0  # these three by the stopwatch
        self._results_written_at = 0.0
        self._checkpoints_written_at = 0.0
        self._has_new_progress = False

    def record_start(self, run: str) -> None:
        """Record that the run was sent to a worker."""
        self._pending.started.append(run)

    def record_worker_death(self, run: str, kills: int) -> None:
        """Record that the run alone killed its worker, `kills` times since its last progress."""
        self._pending.kills[run] = kills  # written at once: the dispatcher may die too

    def record_silent_worker(self, text: str) -> None:
        """Record that a worker did not answer and is replaced, as the text tells."""
        service_metrics.silent_workers.inc()
        self._pending.messages.append(text)

    def record_delay(self, reason: str) -> None:
        """Record that runs wait, because their records cannot be loaded now."""
        with bind_ids(job_id=self.lease.job_id, attempt=self.lease.attempt):
            _log.warning("runs wait for their recordings: %s", reason)
        self._pending.messages.append(f"its runs wait for their recordings: {reason}")

    def record_progress(self, run: str, state: RunState, seconds: float) -> None:
        """Record a state from which the run can continue."""
        live = self._live.get(run)
        service_metrics.evaluations.inc(max(0, state.evaluations - self._count_evaluations(run)))
        if live is None:
            begun_at = state.generation if run in self._checkpoint_evaluations else 0
            live = self._live[run] = _LiveRun(state, seconds, begun_at)
            self._checkpoint_evaluations.pop(run, None)
        live.state, live.seconds, live.changed = state, seconds, True
        self._has_new_progress = True

    def record_results(self, packed: PackedResults) -> None:
        """Record the complete runs of a pack."""
        self._pending.packs.append(packed)
        counted = 0
        if self._live or self._checkpoint_evaluations:
            counted = sum(map(self._count_evaluations, packed.runs))
            for run in packed.runs:
                self._checkpoint_evaluations.pop(run, None)
                self._end_live_run(run)
        service_metrics.evaluations.inc(max(0, packed.evaluations - counted))
        service_metrics.runs.labels("succeeded").inc(len(packed.runs))
        for run, estimates in packed.estimates.items():
            self._report_end(run, estimates)
        self._evaluations += packed.evaluations
        self._generation = max(self._generation, packed.generations)
        if packed.best_rms is not None:
            self._best = min(self._best, packed.best_rms)
        self._has_new_progress = True

    def record_failure(self, run: str, failure: RunFailure) -> None:
        """Record that the run failed."""
        self._report_end(run, None)
        service_metrics.runs.labels("failed").inc()
        counted = self._count_evaluations(run)
        evaluations = self._checkpoint_evaluations.pop(run, 0)
        live = self._end_live_run(run)
        if live is not None:
            evaluations = live.state.evaluations
        evaluations = failure.evaluations or evaluations
        service_metrics.evaluations.inc(max(0, evaluations - counted))
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
        self._has_new_progress = True

    def record_reuse(self, run: str, source: str) -> None:
        """Record that the run takes over the result of `source`."""
        self._pending.reused[run] = source
        service_metrics.runs.labels("reused").inc()
        self._checkpoint_evaluations.pop(run, None)
        self._speed.n_begun += 1  # reused runs do not count for the speed
        self._has_new_progress = True

    def _count_evaluations(self, run: str) -> int:
        """Count the evaluations of an open run that its progress has told already."""
        live = self._live.get(run)
        return self._checkpoint_evaluations.get(run, 0) if live is None else live.state.evaluations

    def should_stop(self) -> bool:
        """Test whether the job was cancelled or its lease lost."""
        return self.is_stopped

    def write_due(self) -> None:
        """Write everything that is due, after what is being written beside.

        Raises
        ------
        LeaseLost
            If another dispatcher holds the parcel. Nothing was written.
        """
        if self._written_beside is not None:
            may_wait = self._pending.count_ended() < MAX_UNWRITTEN and not self._pending.kills
            if may_wait and not self._written_beside[1].done():
                return
            self._finish_batch()
        if self.has_ended:  # its lease is gone
            return
        if self._is_ending:
            self._write_end()
            return
        now = self._stopwatch()
        with_progress = (
            self._has_new_progress and now - self._progress_written_at > PROGRESS_SECONDS
        )
        with_checkpoints = (
            bool(self._live) and now - self._checkpoints_written_at > CHECKPOINT_SECONDS
        )
        has_results = self._pending.has_runs and now - self._results_written_at > RESULTS_SECONDS
        is_urgent = self._pending.kills or self._pending.count_ended() >= MAX_ENDED
        if with_progress or with_checkpoints or has_results or is_urgent:
            batch = self._take_batch(with_progress=with_progress, with_checkpoints=with_checkpoints)
            self._pending.packs = _take_surplus(batch.pending)  # they follow when this is written
            self._begin_batch(batch, self._run_beside)

    def write_all(self) -> None:
        """Write everything, including checkpoints, because the dispatcher stops."""
        self._write_now(with_checkpoints=True)

    def end_parcel(self) -> None:
        """Begin to write the last results, and to end the parcel unless it is its job's last.

        The last one stays open until the job ends. `write_due` goes on until `has_ended` tells
        the outcome. Few results are written at once.

        Raises
        ------
        LeaseLost
            If another dispatcher holds the parcel. `write_due` raises it too.
        """
        self._is_ending = True
        if self._written_beside is None:
            self._write_end()

    def wait_for_end(self) -> None:
        """Wait until the end of the parcel is written."""
        while self._is_ending:
            if self._written_beside is not None:
                wait([self._written_beside[1]])
            self.write_due()

    def _write_end(self) -> None:
        """Write everything and the end of the parcel, in one batch, which is the last one."""
        is_small = self._pending.count_ended() <= FEW_ENDED
        batch = self._take_batch(with_progress=True, with_checkpoints=False)

        def end(session: Session) -> None:
            batch.has_ended = LeaseQueue(session).end_parcel(self.lease)

        self._begin_batch(batch, run_at_once if is_small else self._run_beside, end)

    def finish_job(self, cramer_rao: Document | None = None) -> None:
        """Write the last results and end the job, in one transaction.

        All other parcels of the job have ended. With `cramer_rao`, all results are already written,
        because the bounds refer to them.
        """

        def end(session: Session) -> None:
            queue = LeaseQueue(session)
            if cramer_rao is not None:
                queue.write_cramer_rao(self.lease, cramer_rao)
            job = queue.lock_lease(self.lease).job
            complaint = None
            if job.n_failed:
                complaint = self._summarise_failures(session, job.n_failed)
            if job.n_reused:
                text = f"{job.n_reused} of {job.n_runs} runs were taken over from earlier runs"
                queue.append_event(self.lease, "log", {"message": text})
            state: FinalState = JobState.INCOMPLETE if job.n_failed else JobState.SUCCEEDED
            if job.n_failed == job.n_runs:
                state = JobState.FAILED
            queue.finish_job(self.lease, state, complaint)

        self._write_now(last=end)

    def cancel_parcel(self) -> None:
        """End the parcel as cancelled. Earlier results of its runs remain."""
        self._write_now(
            last=lambda session: LeaseQueue(session).cancel_parcel(self.lease),
            with_checkpoints=True,
        )

    def _write_now(
        self, last: Callable[[Session], None] | None = None, *, with_checkpoints: bool = False
    ) -> None:
        """Write everything in this thread; `last` is carried out in the last transaction."""
        if self._written_beside is not None:
            self._finish_batch()
        batch = self._take_batch(with_progress=True, with_checkpoints=with_checkpoints)
        self._written_beside = batch, run_at_once(partial(self._write_batch, batch, last))
        self._finish_batch()

    def _take_batch(self, *, with_progress: bool, with_checkpoints: bool) -> _Batch:
        pending, self._pending = self._pending, _PendingWrites()
        is_wanted = with_progress or with_checkpoints
        live = {
            run: (live, live.state)
            for run, live in self._live.items()
            if is_wanted and (with_progress or live.changed)
        }
        if with_progress:
            self._has_new_progress = False
        return _Batch(
            self._stopwatch(),
            pending,
            self._compute_progress() if with_progress else None,
            self._build_estimate(),
            live,
            with_checkpoints,
        )

    def _begin_batch(
        self, batch: _Batch, run: RunBeside, last: Callable[[Session], None] | None = None
    ) -> None:
        work = partial(self._write_batch, batch, last)
        self._written_beside = batch, run(partial(retry_transient, work))
        if self._written_beside[1].done():
            self._finish_batch()

    def _finish_batch(self) -> None:
        """Wait for the batch that is being written, and note that it is; else keep its rows."""
        assert self._written_beside is not None
        batch, written = self._written_beside
        self._written_beside = None
        try:
            with allow_long_step(GIVE_UP_SECONDS):
                written.result()
        except BaseException:
            batch.pending.append(self._pending)
            self._pending = batch.pending
            self._count_reused(batch.reused_outcomes)
            self._has_new_progress = True
            raise
        self._note_written(batch)

    def _note_written(self, batch: _Batch) -> None:
        if batch.has_ended is not None:
            self.has_ended, self._is_ending = batch.has_ended, False
        self._pending.started[:0] = batch.pending.started  # those beyond `MAX_STARTED`
        self._results_written_at = batch.taken_at
        self._count_reused(batch.reused_outcomes)
        if batch.progress is not None:
            self._progress_written_at = batch.taken_at
        if batch.with_checkpoints:
            self._checkpoints_written_at = batch.taken_at
        for live, state in batch.live.values():
            if batch.progress is not None:
                live.written = dict(enumerate(map(len, state.history)))
                live.migrants = len(state.migrations)
            if batch.with_checkpoints and live.state is state:
                live.changed = False

    def _count_reused(self, reused: list[RunOutcome]) -> None:
        """Count runs whose results were taken over, once they are committed."""
        self._evaluations += sum(outcome.evaluations for outcome in reused)
        self._generation = max([self._generation, *(outcome.generations for outcome in reused)])
        self._best = min([self._best, *_list_rms(reused)])

    def _compute_progress(self) -> JobProgress:
        """Compute the parcel's progress; its generation is that of the most advanced run."""
        states = [live.state for live in self._live.values()]
        best = min([self._best, *(state.rms for state in states)])
        return JobProgress(
            evaluations=self._evaluations
            + sum(self._checkpoint_evaluations.values())
            + sum(state.evaluations for state in states),
            generation=max([self._generation, *(state.generation for state in states)]),
            best_rms=best if math.isfinite(best) else None,
        )

    def _build_estimate(self) -> Callable[[int], float | None]:
        """Return the estimate of the remaining time of the job, by its speed since the claim."""
        total = self._generations * self._n_runs
        open_runs = sum(live.state.generation for live in self._live.values())
        before = sum(live.first_generation for live in self._live.values())
        n_begun, elapsed = self._speed.n_begun, self._stopwatch() - self._speed.begun

        def estimate(n_done: int) -> float | None:
            done = (n_done - n_begun) * self._generations + open_runs - before
            left = total - n_done * self._generations - open_runs
            return max(0.0, elapsed * left / done) if done > 0 else None

        return estimate

    def _summarise_failures(self, session: Session, n_failed: int) -> str:
        reasons = "; ".join(list_failure_reasons(session, self.lease.job_id, MAX_REASONS))
        if self._n_runs == 1:
            return reasons
        return f"{n_failed} of {self._n_runs} runs failed: {reasons}"

    def _end_live_run(self, run: str) -> _LiveRun | None:
        """End a run in progress: the history up to its last state is written with its end."""
        live = self._live.pop(run, None)
        if live is not None:
            points = to_history_points(run, live.state.history, live.written)
            self._pending.history.extend(points)
            migrants = to_migrant_points(run, live.state.migrations, live.migrants)
            self._pending.migrants.extend(migrants)
        return live

    def _write_batch(self, batch: _Batch, last: Callable[[Session], None] | None = None) -> None:
        """Write a batch: signals first, then about `MAX_ENDED` results in each transaction.

        It may be repeated. What was committed is taken out of the batch.
        """
        pending = batch.pending
        self._store_signals(pending)
        _drop_ended_starts(pending)
        while surplus := _take_surplus(pending):
            try:
                with self._database.write_session() as session:
                    reused = self._write_pending(session, pending)
            except BaseException:
                pending.packs += surplus
                raise
            batch.reused_outcomes += reused
            started = pending.started[MAX_STARTED:]
            signals = pending.stored_signals, pending.lost_signals
            pending = batch.pending = _PendingWrites(started, packs=surplus)
            pending.stored_signals, pending.lost_signals = signals
        with self._database.write_session() as session:
            reused = self._write_pending(session, pending)
            self._write_live(session, batch, batch.reused_outcomes + reused)
            if last is not None:
                last(session)
        batch.reused_outcomes += reused
        batch.pending = _PendingWrites(pending.started[MAX_STARTED:])

    def _store_signals(self, pending: _PendingWrites) -> None:
        """Store the signals of ended runs, before the rows that refer to them.

        Without its signals a result is written all the same.
        """
        runs, reason = list[str](), ""
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

    def _write_pending(self, session: Session, pending: _PendingWrites) -> list[RunOutcome]:
        """Write runs that began or ended; return the outcomes of those that were taken over."""
        writer, queue = RunWriter(session, self.lease), LeaseQueue(session)
        writer.start_runs(pending.started[:MAX_STARTED])
        writer.write_kills(pending.kills)
        # What follows locks the row of the job, for which other parcels wait: the bulk is first.
        writer.record_results(pending.packs, pending.lost_signals)
        writer.record_outcomes(pending.outcomes, pending.history, pending.migrants)
        reused = take_over_runs(session, self.lease, pending.reused)
        for text in pending.messages:
            queue.append_event(self.lease, "log", {"message": text})
        return reused

    def _write_live(self, session: Session, batch: _Batch, reused: list[RunOutcome]) -> None:
        """Write the progress of the parcel, and history and checkpoints of runs in progress."""
        writer, queue = RunWriter(session, self.lease), LeaseQueue(session)
        if batch.with_checkpoints:
            changed = [(run, live, state) for run, (live, state) in batch.live.items()]
            writer.save_checkpoints(
                (run, state.evaluations, pack_state(state))
                for run, live, state in changed
                if live.changed
            )
        if batch.progress is None:
            return
        for run, (live, state) in batch.live.items():
            writer.append_history(
                to_history_points(run, state.history, live.written),
                to_migrant_points(run, state.migrations, live.migrants),
            )
        known = batch.progress
        best = min(
            [math.inf if known.best_rms is None else known.best_rms, *_list_rms(reused)],
        )
        progress = replace(
            known,
            evaluations=known.evaluations + sum(outcome.evaluations for outcome in reused),
            generation=max([known.generation, *(outcome.generations for outcome in reused)]),
            best_rms=best if math.isfinite(best) else None,
            seconds_left=batch.estimate_left(queue.read_n_done(self.lease)),
        )
        queue.write_progress(self.lease, progress)


def _take_surplus(pending: _PendingWrites) -> list[PackedResults]:
    """Take the packs that are too many for one transaction; at least one stays."""
    counts = accumulate(len(pack.runs) for pack in pending.packs)
    n_kept = max(1, sum(count <= MAX_ENDED for count in counts))
    surplus = pending.packs[n_kept:]
    del pending.packs[n_kept:]
    return surplus


def _drop_ended_starts(pending: _PendingWrites) -> None:
    """Leave out starts of runs that have ended, which their results tell."""
    ended = set[str]().union(*(pack.runs for pack in pending.packs))
    pending.started = [run for run in pending.started if run not in ended]


def _list_rms(outcomes: list[RunOutcome]) -> list[float]:
    return [outcome.best_rms for outcome in outcomes if outcome.best_rms is not None]
