"""What the dispatcher writes about the runs of one job: in bulk, fenced by the lease."""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from sqlalchemy.orm import Session

from service.dispatch.checkpoints import packed
from service.dispatch.fitted_signals import Place, Shelved
from service.dispatch.results import history_points, migrant_points, outcome_of
from service.queue.leases import Claim, Progress, Queue
from service.queue.previous_attempts import tally
from service.queue.reuse import take_over
from service.queue.run_writes import RunLedger, RunOutcome
from service.repositories.history import HistoryPoint, MigrantPoint
from service.storage.columns import Document
from service.storage.errors import ObjectStoreFailed
from service.storage.sessions import Database
from service.storage.tables import State
from sysid.identification.result import Identification
from sysid.islands.state import RunState
from sysid.search.state import Improvement, Migrant
from workers.errors import RecordsUnavailable
from workers.ports import Concluded, Failure

_log = logging.getLogger(__name__)

RESULTS_SECONDS = 1.0
"""A transaction costs as much as the rows of many runs; what comes after a pause goes at once."""
PROGRESS_SECONDS = 1.0
CHECKPOINT_SECONDS = 4.0
KEPT_REASONS = 3

SaveSignals = Callable[[str, Identification], Shelved | None]
"""Makes the file of a run's fitted signals, which can be stored."""


@dataclass(slots=True)
class _Live:
    """A run in progress: its latest state, and how much of it is written."""

    state: RunState
    seconds: float
    begun_at: int = 0  # its generation when this attempt took it up
    written: dict[int, int] = field(default_factory=dict)
    migrants: int = 0
    changed: bool = True


@dataclass(slots=True)
class _Pending:
    """What the next transaction will write."""

    started: list[str] = field(default_factory=list)
    known: dict[str, str] = field(default_factory=dict)
    outcomes: list[RunOutcome] = field(default_factory=list)
    history: list[HistoryPoint] = field(default_factory=list)
    migrants: list[MigrantPoint] = field(default_factory=list)
    signals: dict[str, Shelved] = field(default_factory=dict)
    complaints: list[str] = field(default_factory=list)
    kills: dict[str, int] = field(default_factory=dict)

    @property
    def has_runs(self) -> bool:
        """Whether a run has begun, ended or lost its worker."""
        return bool(self.outcomes or self.started or self.known or self.kills)


class Recorder:
    """Writes one job's runs; implements `workers.ports.RunObserver`.

    Nothing is written when something happens, but by `flush`: results at most every
    `RESULTS_SECONDS`, progress and history every second, checkpoints every `CHECKPOINT_SECONDS`.
    """

    def __init__(
        self,
        database: Database,
        claim: Claim,
        save_signals: SaveSignals,
        tell_failed: Callable[[str], None],
    ) -> None:
        self.lease = claim.lease
        self._tell_failed = tell_failed
        self.is_stopped = False
        with database.write() as session:
            before = tally(session, claim.lease, KEPT_REASONS)
        self._reasons = list(before.reasons)
        self._waiting = before.waiting  # evaluations of runs that have not gone on yet
        self._database, self._save_signals = database, save_signals
        self._live: dict[str, _Live] = {}
        self._pending = _Pending()
        self._n_runs, self._n_done = claim.job.n_runs, claim.job.n_done
        self._evaluations, self._generation = before.evaluations, before.generations
        self._best = math.inf if claim.job.best_rms is None else claim.job.best_rms
        self._generations = max(1, int(claim.job.spec["algorithm"]["generations"]))
        self._n_begun, self._begun = claim.job.n_done, time.monotonic()
        self._n_known = 0
        self._taken: list[RunOutcome] = []  # from other runs, in the present transaction
        self._told = self._wrote = self._kept = 0.0
        self._news = False

    def started(self, run: str) -> None:
        """The run was given to a worker."""
        self._pending.started.append(run)

    def blamed(self, run: str, kills: int) -> None:
        """A worker died over the run alone, `kills` times since it last went on."""
        self._pending.kills[run] = kills
        self._wrote = 0.0  # at once: what counts them may die as well

    def progress(self, run: str, state: RunState, seconds: float) -> None:
        """The run can go on from `state`."""
        live = self._live.get(run)
        if live is None:
            begun_at = state.generation if run in self._waiting else 0
            live = self._live[run] = _Live(state, seconds, begun_at)
            self._waiting.pop(run, None)
        live.state, live.seconds, live.changed = state, seconds, True
        self._news = True

    def result(self, run: str, concluded: Concluded, seconds: float) -> None:
        """The run is complete."""
        self._waiting.pop(run, None)
        found, live = concluded.identification, self._live.pop(run, None)
        self._collect_history(run, found.history, found.migrations, live)
        try:
            signals = self._save_signals(run, found)
        except (ObjectStoreFailed, RecordsUnavailable) as error:
            self._complain_of_signals([run], error)
            signals = None
        if signals is not None:
            self._pending.signals[run] = signals
        self._pending.outcomes.append(outcome_of(run, concluded, seconds))
        self._evaluations += found.evaluations
        self._generation = max(self._generation, found.generations)
        self._best = min(self._best, found.rms)
        self._n_done += 1
        self._news = True

    def failure(self, run: str, failure: Failure) -> None:
        """The run cannot be carried out."""
        self._tell_failed(run)
        live, evaluations = self._live.pop(run, None), self._waiting.pop(run, 0)
        if live is not None:
            self._collect_history(run, live.state.history, live.state.migrations, live)
            evaluations = live.state.evaluations
        evaluations = failure.evaluations or evaluations
        self._evaluations += evaluations
        self._pending.outcomes.append(RunOutcome(
            run_id=run, state=State.FAILED, error=failure.reason, evaluations=evaluations
        ))  # fmt: skip
        if failure.reason not in self._reasons and len(self._reasons) < KEPT_REASONS:
            self._reasons.append(failure.reason)
            self._pending.complaints.append(f"{run} failed: {failure.reason}")
        self._n_done += 1
        self._news = True

    def known(self, run: str, source: str) -> None:
        """The run is what another run was."""
        self._pending.known[run] = source
        self._waiting.pop(run, None)
        self._n_done += 1
        self._n_begun += 1  # it tells nothing of how long the others take
        self._n_known += 1
        self._news = True

    def should_stop(self) -> bool:
        """Whether the job was cancelled or its lease lost."""
        return self.is_stopped

    def flush(self) -> None:
        """Write what is due.

        Raises
        ------
        LeaseLost
            If the job is no longer this dispatcher's; nothing was written.
        """
        now = time.monotonic()
        tell = self._news and now - self._told > PROGRESS_SECONDS
        keep = bool(self._live) and now - self._kept > CHECKPOINT_SECONDS
        some = self._pending.has_runs
        if tell or keep or (some and now - self._wrote > RESULTS_SECONDS):
            self._commit(now, tell=tell, keep=keep)

    def keep(self) -> None:
        """Write everything, checkpoints too, because the dispatcher stops."""
        self._commit(time.monotonic(), tell=True, keep=True)

    def finish(self, floors: Document | None = None) -> None:
        """Write the last results and end the job, in one transaction.

        Where floors are told, the results were written before (`store`): they are made of them.
        """
        self._store_signals()
        with self._database.write() as session:
            self._write(session, tell=True, keep=False)
            queue = Queue(session)
            if floors is not None:
                queue.tell_floors(self.lease, floors)
            job = queue.hold(self.lease)
            session.refresh(job)
            complaint = self._complaint(job.n_failed, job.n_runs)
            if self._n_known:
                text = f"{self._n_known} of {job.n_runs} runs had been computed before: reused"
                queue.tell(self.lease, "log", {"message": text})
            if job.n_failed == job.n_runs:
                queue.finish(self.lease, State.FAILED, complaint)
            else:
                queue.finish(self.lease, State.SUCCEEDED, complaint)

    def store(self) -> None:
        """Write the last results; the job goes on."""
        self._commit(time.monotonic(), tell=True, keep=False)

    def cancel(self) -> None:
        """End the job as cancelled; what its runs gave before stays."""
        self._store_signals()
        with self._database.write() as session:
            self._write(session, tell=True, keep=True)
            Queue(session).finish(self.lease, State.CANCELLED)

    def _progress(self) -> Progress:
        """How far the job is; the generation is that of the run that is furthest."""
        states = [live.state for live in self._live.values()]
        best = min([self._best, *_rms_of(self._taken), *(state.rms for state in states)])
        return Progress(
            evaluations=self._evaluations
            + sum(self._waiting.values())
            + sum(one.evaluations for one in self._taken)
            + sum(state.evaluations for state in states),
            generation=max(
                [
                    self._generation,
                    *(one.generations for one in self._taken),
                    *(state.generation for state in states),
                ]
            ),
            best_rms=best if math.isfinite(best) else None,
            seconds_left=self._seconds_left(),
        )

    def _seconds_left(self) -> float | None:
        """What is left if the rest goes as fast as what was done since the claim."""
        total = self._generations * self._n_runs
        open_runs = sum(live.state.generation for live in self._live.values())
        before = sum(live.begun_at for live in self._live.values())
        done = (self._n_done - self._n_begun) * self._generations + open_runs - before
        left = total - self._n_done * self._generations - open_runs
        elapsed = time.monotonic() - self._begun
        return max(0.0, elapsed * left / done) if done > 0 else None

    def _complaint(self, n_failed: int, n_runs: int) -> str | None:
        if n_failed == 0:
            return None
        reasons = "; ".join(self._reasons)
        return reasons if n_runs == 1 else f"{n_failed} of {n_runs} runs failed: {reasons}"

    def _collect_history(
        self,
        run: str,
        history: tuple[tuple[Improvement, ...], ...],
        migrants: tuple[Migrant, ...],
        live: _Live | None,
    ) -> None:
        written, logged = ({}, 0) if live is None else (live.written, live.migrants)
        self._pending.history.extend(history_points(run, history, written))
        self._pending.migrants.extend(migrant_points(run, migrants, logged))

    def _commit(self, now: float, *, tell: bool, keep: bool) -> None:
        self._store_signals()
        with self._database.write() as session:
            self._write(session, tell=tell, keep=keep)
        self._written(now, tell=tell, keep=keep)

    def _complain_of_signals(self, runs: Sequence[str], error: Exception) -> None:
        """The numbers are worth more than the plot: they are written without it."""
        others = f" and {len(runs) - 1} others" if len(runs) > 1 else ""
        text = f"the signals of {runs[0]}{others} are not stored: {error}"
        _log.error(text)
        self._pending.complaints.append(text)

    def _store_signals(self) -> None:
        """Store the files of ended runs, before the rows that name them."""
        places: dict[str, Place] = {}
        failed: dict[int, tuple[Exception, list[str]]] = {}
        for run, shelved in self._pending.signals.items():
            try:
                places[run] = shelved.place()
            except ObjectStoreFailed as error:
                failed.setdefault(id(error), (error, []))[1].append(run)
        for reason, runs in failed.values():
            self._complain_of_signals(runs, reason)
        self._pending.signals = {}
        self._pending.outcomes = [
            one if one.run_id not in places else _with_signals(one, places[one.run_id])
            for one in self._pending.outcomes
        ]

    def _write(self, session: Session, *, tell: bool, keep: bool) -> None:
        ledger, pending = RunLedger(session, self.lease), self._pending
        self._taken = take_over(session, self.lease, pending.known)
        ledger.start(pending.started)
        ledger.record(pending.outcomes, pending.history, pending.migrants)
        ledger.blame(pending.kills)
        for text in pending.complaints:
            Queue(session).tell(self.lease, "log", {"message": text})
        if tell:
            for run, live in self._live.items():
                points = history_points(run, live.state.history, live.written)
                ledger.append(points, migrant_points(run, live.state.migrations, live.migrants))
            Queue(session).report(self.lease, self._progress())
        if keep:
            changed = [(run, live) for run, live in self._live.items() if live.changed]
            ledger.save((run, live.state.evaluations, packed(live.state)) for run, live in changed)

    def _written(self, now: float, *, tell: bool, keep: bool) -> None:
        self._pending, self._wrote = _Pending(), now
        self._evaluations += sum(one.evaluations for one in self._taken)
        self._generation = max([self._generation, *(one.generations for one in self._taken)])
        self._best = min([self._best, *_rms_of(self._taken)])
        self._taken = []
        if tell:
            self._told, self._news = now, False
            for live in self._live.values():
                live.written = dict(enumerate(map(len, live.state.history)))
                live.migrants = len(live.state.migrations)
        if keep:
            self._kept = now
            for live in self._live.values():
                live.changed = False


def _with_signals(one: RunOutcome, place: Place) -> RunOutcome:
    return replace(
        one, signals_sha256=place.sha256, signals_start=place.start, signals_size=place.size
    )


def _rms_of(outcomes: list[RunOutcome]) -> list[float]:
    return [one.best_rms for one in outcomes if one.best_rms is not None]
