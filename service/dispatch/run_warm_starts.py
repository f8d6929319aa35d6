"""Warm starts of a job's runs: none, an earlier run's estimates, or those of the previous run.

With ``"previous"`` a run waits for those before it in its chain. The result is therefore
independent of the number of workers and of their speed. A run starts from the last run before it
that succeeded, or cold if there is none. Chains run in parallel, and each chain one run after
another.
"""

from collections import deque
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import select

from service.core.bodies.job_fields import WARM_START_PATH
from service.core.states import OPEN_STATES, JobState
from service.jobs.axes import locate_cell
from service.jobs.job_schemas import PREVIOUS, SweepIn
from service.jobs.stored_cells import read_axis_groups
from service.jobs.warm_start_order import ChainLayout
from service.queue.run_writes import WaitingRun
from service.repositories.run_rows import RunRepository
from service.storage.sessions import Database
from service.storage.tables import Job, Run
from workers.protocol import WarmStartValues

MAX_OPEN_CHAINS = 1_000
"""Most open chains. More cores hardly ever work on one job."""


@dataclass(slots=True)
class _OpenChain:
    """Chain in progress."""

    numbers: range
    position: int = 0  # position of its next run
    running: set[int] = field(default_factory=set)
    values: Mapping[str, float] | None = None  # of the last run that succeeded
    last_success: int = -1  # the number of that run
    has_skipped: bool = False  # runs that an earlier attempt ended were skipped


class OpenChains:
    """Chains of one job, opened one after another as runs are needed.

    For each chain it stores the position, the running runs and the last values. It does not store
    runs.

    Parameters
    ----------
    chain : ChainLayout
        Layout of the chains of this sweep.
    n_runs : int
        Runs of the job.
    wait_rule : callable
        Whether the run with a number waits for those before it in its chain.
    ended : container of int
        Numbers of runs that an earlier attempt has ended. They are skipped.
    """

    def __init__(
        self,
        chain: ChainLayout,
        n_runs: int,
        wait_rule: Callable[[int], bool],
        ended: Container[int] = frozenset(),
    ) -> None:
        self._chain, self._wait_rule, self._ended = chain, wait_rule, ended
        self._n_chains, self._opened = n_runs // chain.length, 0
        self._open: dict[int, _OpenChain] = {}
        self._n_unfinished = 0  # open chains with runs left to take
        self._free: deque[int] = deque()  # chains whose next run may begin

    @property
    def is_exhausted(self) -> bool:
        """Whether every run was taken."""
        return self._opened == self._n_chains and self._n_unfinished == 0

    @property
    def has_ready(self) -> bool:
        """Whether a run may begin. One that `take_ready` did not return is not created yet."""
        return bool(self._free)

    def take_ready(self, limit: int, n_created: int) -> list[int]:
        """Take at most `limit` numbers below `n_created` of runs that may begin, each once."""
        self._open_chains(limit)
        numbers: list[int] = []
        for _ in range(len(self._free)):
            key = self._free.popleft()
            chain = self._open[key]
            if len(numbers) < limit and chain.numbers[chain.position] < n_created:
                numbers.append(self._take_next(chain))
            if self._is_ready(chain):
                self._free.append(key)
        return numbers

    def end_run(self, number: int, values: Mapping[str, float] | None = None) -> None:
        """End a run; `values` are its estimates if it succeeded. Repeated calls are harmless."""
        key = self._chain.find_chain(number)
        chain = self._open.get(key)
        if chain is None or number not in chain.running:
            return
        was_free = self._is_ready(chain)
        chain.running.discard(number)
        if values is not None and number > chain.last_success:
            chain.values, chain.last_success = values, number
        if chain.position == len(chain.numbers) and not chain.running:
            del self._open[key]
        elif self._is_ready(chain) and not was_free:
            self._free.append(key)

    def find_previous_values(
        self, number: int, stored: Callable[[range], tuple[int, Mapping[str, float]] | None]
    ) -> Mapping[str, float] | None:
        """Find the estimates of the last successful run before that one in its chain.

        `stored` finds it, with its number, among runs that an earlier attempt has ended.
        """
        chain = self._open[self._chain.find_chain(number)]
        if chain.has_skipped:
            last = stored(chain.numbers[: chain.numbers.index(number)])
            if last is not None and last[0] > chain.last_success:
                chain.last_success, chain.values = last
            chain.has_skipped = False
        return chain.values

    def _open_chains(self, n_runs: int) -> None:
        room = MAX_OPEN_CHAINS - len(self._open)
        while len(self._free) < n_runs and room > 0 and self._opened < self._n_chains:
            key, self._opened = self._opened, self._opened + 1
            chain = _OpenChain(self._chain.list_runs(key))
            self._skip_ended(chain)
            if chain.position < len(chain.numbers):
                self._open[key] = chain
                self._n_unfinished += 1
                self._free.append(key)
                room -= 1

    def _take_next(self, chain: _OpenChain) -> int:
        number = chain.numbers[chain.position]
        chain.running.add(number)
        chain.position += 1
        self._skip_ended(chain)
        self._n_unfinished -= chain.position == len(chain.numbers)
        return number

    def _skip_ended(self, chain: _OpenChain) -> None:
        while chain.position < len(chain.numbers) and chain.numbers[chain.position] in self._ended:
            chain.position, chain.has_skipped = chain.position + 1, True

    def _is_ready(self, chain: _OpenChain) -> bool:
        if chain.position == len(chain.numbers):
            return False
        return not chain.running or not self._wait_rule(chain.numbers[chain.position])


class WarmStarts:
    """Warm starts of one claimed job, whose runs are one parcel if some wait for others.

    Results of its own runs are available before they are written.
    """

    def __init__(self, database: Database, job: Job) -> None:
        self._database, self._job = database, job
        self._chains: OpenChains | None = None
        self._numbers: dict[str, int] = {}
        self._earlier: dict[str, Mapping[str, float]] = {}

    def open_chains(self) -> OpenChains | None:
        """Open the chains of the job where it was left; None if no run waits for another."""
        if not self.may_wait:
            return None
        wait_rule = _WaitRule(self._job)
        axes = SweepIn.model_validate(self._job.spec["sweep"]).axes
        chain = ChainLayout.from_axes(axes)
        if chain is None or not wait_rule.any:
            return None
        with self._database.read_session() as session:
            query = select(Run.number).where(
                Run.job_id == self._job.id,
                Run.state.in_([state for state in JobState if state not in OPEN_STATES]),
            )
            ended = set(session.scalars(query))
        self._chains = OpenChains(chain, self._job.n_runs, wait_rule, ended)
        return self._chains

    def register_run(self, row: WaitingRun) -> None:
        """Register a run that is sent to the workers. Later runs of its chain wait for it."""
        self._numbers[row.id] = row.number

    def find_values(self, row: WaitingRun, reference: str | None) -> WarmStartValues:
        """Find the values that a run begins with. Earlier runs of its chain have ended.

        Raises
        ------
        StorageError
            If the run that it names is missing.
        """
        if reference is None:
            return ()
        if reference != PREVIOUS:
            return (self._read_estimates(reference),)
        assert self._chains is not None  # a job without axes is refused
        values = self._chains.find_previous_values(row.number, self._read_last_success)
        return () if values is None else (values,)

    @property
    def may_wait(self) -> bool:
        """Whether runs of the job may start from runs before them."""
        return may_wait(self._job)

    def record_end(self, run: str, values: Mapping[str, float] | None) -> None:
        """Record that a run of the job has ended; `values` are its estimates if it succeeded."""
        number = self._numbers.pop(run, None)
        if number is not None and self._chains is not None:
            self._chains.end_run(number, values)

    def record_reuse(self, run: str, source: str) -> None:
        """Record that a run takes over the result of `source`."""
        if run in self._numbers:
            self.record_end(run, self._read_estimates(source))

    def _read_last_success(self, before: range) -> tuple[int, Mapping[str, float]] | None:
        """Read number and estimates of the last successful run among these."""
        query = select(Run.number, Run.estimates).where(
            Run.job_id == self._job.id,
            Run.state == JobState.SUCCEEDED,
            Run.deleted_at.is_(None),
            Run.number >= before.start,
            Run.number < before.stop,
            (Run.number - before.start) % before.step == 0,
        )
        with self._database.read_session() as session:
            row = session.execute(query.order_by(Run.number.desc()).limit(1)).one_or_none()
        return None if row is None else (row[0], _to_values(row[1]))

    def _read_estimates(self, run: str) -> Mapping[str, float]:
        if run not in self._earlier:
            with self._database.read_session() as session:
                row = RunRepository(session, self._job.project_id).get(run)
                self._earlier[run] = _to_values(row.estimates)
        return self._earlier[run]


def may_wait(job: Job) -> bool:
    """Return whether runs of a job may start from runs before them."""
    swept = any(axis["path"] == WARM_START_PATH for axis in job.spec["sweep"]["axes"])
    return swept or job.spec["warm_start"] == PREVIOUS


class _WaitRule:
    """Rule which runs wait for the previous one: all, none, or as an axis says."""

    def __init__(self, job: Job) -> None:
        groups = read_axis_groups(job.spec)
        self._lengths = [len(steps) for steps in groups]
        swept = [
            (group, values)
            for group, steps in enumerate(groups)
            for _, axis, values in steps.columns
            if axis.path == WARM_START_PATH
        ]
        self._swept = swept[0] if swept else None
        if self._swept is None:
            self.any: bool = job.spec["warm_start"] == PREVIOUS
        else:
            self.any = PREVIOUS in self._swept[1]

    def __call__(self, number: int) -> bool:
        if self._swept is None:
            return self.any
        group, values = self._swept
        waits: bool = values[locate_cell(number, self._lengths)[group]] == PREVIOUS
        return waits


def _to_values(estimates: Mapping[str, Any] | None) -> Mapping[str, float]:
    return {name: float(estimate["value"]) for name, estimate in (estimates or {}).items()}
