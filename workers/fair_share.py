"""Fair share: which job of several projects gets the next slot at the workers.

The rules, in this order (`docs/decisions/0017-fair-sharing-of-workers.md`):

1. A higher priority goes first.
2. A job's first `HEADSTART_SECONDS` of compute go before jobs that have had theirs. So a single
   identification does not wait for a sweep. A project that is ahead of another by this amount
   loses the privilege until the other has caught up.
3. Projects share equally, and the jobs of a project share its part equally. The lead of a project
   is remembered while it has no jobs, until the others have caught up.
4. Every sixteenth pack goes to the job that has waited longest, regardless of the rules above, so
   no job starves.
"""

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeAlias, TypeVar

from workers.packing import PACK_SECONDS

HEADSTART_SECONDS = 30.0
"""Compute time that a new job gets before jobs that have had as much."""

MAX_SAVED_SECONDS = 2 * HEADSTART_SECONDS
"""Largest lag behind the others: unused time beyond it is not saved for later."""

MAX_ABSENT_PROJECTS = 256
"""Largest number of stored accounts of projects without jobs: those furthest ahead."""

WAIT_TURN_INTERVAL = 16
"""Of this many packs, one goes to the job that has waited longest."""

Key = TypeVar("Key", bound=Hashable)
Rank: TypeAlias = tuple[int, bool]
"""Priority (negated) and whether the head start is used up: a smaller rank goes first."""


@dataclass(slots=True, eq=False)
class _Account:
    """Compute time that a job or project has had, in s; equal levels mean equal shares.

    The level is raised for one that came later, or did not use its part.
    """

    level: float = 0.0


@dataclass(slots=True, eq=False)
class _JobAccount(_Account):
    """Account of a job; `last_pack` is the number of its last pack."""

    received_seconds: float = 0.0
    priority: int = 0
    project: str = ""
    last_pack: int = 0


@dataclass(slots=True)
class FairShare(Generic[Key]):
    """Accounts of the jobs of a scheduler."""

    _jobs: dict[Key, _JobAccount] = field(default_factory=dict)
    _projects: dict[str, _Account] = field(default_factory=dict)
    _n_packs: int = 0

    def open_account(self, job: Key, *, priority: int = 0, project: str = "") -> None:
        """Open an account that starts neither ahead of the present jobs nor behind them.

        A project that comes back continues with its account. Otherwise one job after another, each
        within its head start, would always start again.
        """
        floor = self._find_lowest_level()
        account = self._projects.setdefault(project, _Account(floor))
        account.level = max(account.level, floor)
        self._jobs[job] = _JobAccount(priority=priority, project=project, last_pack=self._n_packs)

    def close_account(self, job: Key) -> None:
        """Close the account of a job that has ended.

        The account of its project stays while it is ahead of a project with jobs.
        """
        del self._jobs[job]
        active, floor = self._list_active_projects(), self._find_lowest_level()
        ahead = sorted(
            (name for name in self._projects.keys() - active if self._projects[name].level > floor),
            key=lambda name: (-self._projects[name].level, name),
        )
        retained = active | set(ahead[:MAX_ABSENT_PROJECTS]) if active else set()
        self._projects = {
            name: account for name, account in self._projects.items() if name in retained
        }

    def get_project(self, job: Key) -> str:
        """Return the project of a job."""
        return self._jobs[job].project

    def record_pack(self, job: Key) -> None:
        """Record that a pack of this job was sent."""
        self._n_packs += 1
        self._jobs[job].last_pack = self._n_packs

    def charge_seconds(self, job: Key, seconds: float) -> None:
        """Charge a job for `seconds` of compute time of a pack."""
        account = self._jobs[job]
        was_fresh = account.received_seconds < HEADSTART_SECONDS
        account.received_seconds += seconds
        account.level += seconds
        others = [
            self._jobs[other]
            for other in self._list_past_headstart(account.project)
            if other != job
        ]
        if was_fresh and account.received_seconds >= HEADSTART_SECONDS:
            account.level = max(account.level, min((other.level for other in others), default=0.0))
        _raise_levels(account, others)
        project = self._projects[account.project]
        project.level += seconds
        _raise_levels(project, self._projects.values())

    def compute_rank(self, job: Key) -> Rank:
        """Compute the rank of a job, which goes before any used compute time."""
        return self._rank_account(self._jobs[job], self._find_lowest_level())

    def order_jobs(self, in_flight: Mapping[Key, int]) -> list[Key]:
        """Order the jobs of `in_flight`; the first one should get the next slot.

        Parameters
        ----------
        in_flight : mapping
            Packs that each job has with the workers; they count as if they were charged.
        """
        project_packs: dict[str, int] = dict.fromkeys(self._projects, 0)
        for job, count in in_flight.items():
            project_packs[self._jobs[job].project] += count
        floor = self._find_lowest_level()

        def sort_key(job: Key) -> tuple[Rank, float, float]:
            account = self._jobs[job]
            project_level = (
                self._projects[account.project].level
                + PACK_SECONDS * project_packs[account.project]
            )
            return (
                self._rank_account(account, floor),
                project_level,
                account.level + PACK_SECONDS * in_flight[job],
            )

        ordered = sorted(in_flight, key=sort_key)
        if ordered and self._n_packs % WAIT_TURN_INTERVAL == WAIT_TURN_INTERVAL - 1:
            patient = min(ordered, key=lambda job: self._jobs[job].last_pack)
            ordered.remove(patient)
            ordered.insert(0, patient)
        return ordered

    def _list_active_projects(self) -> set[str]:
        """List the projects with jobs."""
        return {account.project for account in self._jobs.values()}

    def _find_lowest_level(self) -> float:
        """Find the lowest level of a project with jobs."""
        return min(
            (self._projects[name].level for name in self._list_active_projects()), default=0.0
        )

    def _rank_account(self, account: _JobAccount, floor: float) -> Rank:
        privileged = self._projects[account.project].level - floor < HEADSTART_SECONDS
        return -account.priority, not (privileged and account.received_seconds < HEADSTART_SECONDS)

    def _list_past_headstart(self, project: str) -> list[Key]:
        """List the jobs of a project that have had their head start."""
        return [
            job
            for job, account in self._jobs.items()
            if account.project == project and account.received_seconds >= HEADSTART_SECONDS
        ]


def _raise_levels(ahead: _Account, others: Iterable[_Account]) -> None:
    for account in others:
        account.level = max(account.level, ahead.level - MAX_SAVED_SECONDS)
