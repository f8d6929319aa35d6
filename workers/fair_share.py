"""Who has the next place at the workers: jobs of several projects share them.

The rules, in this order (`docs/decisions/0017-who-goes-next.md`):

1. A higher priority goes first.
2. A job's first `HEADSTART_SECONDS` of compute go before the work of those that had theirs, so a
   single identification does not wait for a sweep. A project that had so much more than another
   one loses this privilege until that one has caught up.
3. Projects share equally, and the jobs of a project share its part equally. What a project had
   more than the others stays known while it has no jobs, until these have caught up.
4. Every sixteenth pack goes to the job that has waited longest, whatever the rules above say:
   nobody starves.
"""

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeAlias, TypeVar

from workers.packing import PACK_SECONDS

HEADSTART_SECONDS = 30.0
"""Compute time that a new job gets before those that had as much."""

MAX_SAVED_SECONDS = 2 * HEADSTART_SECONDS
"""Nobody falls further behind than this: unused time is not saved for later."""

MAX_ABSENT_PROJECTS = 256
"""Projects without jobs whose accounts are kept: those that are furthest ahead."""

LONGEST_WAIT_INTERVAL = 16
"""Each so many packs, one goes to who has waited longest."""

Key = TypeVar("Key", bound=Hashable)
Rank: TypeAlias = tuple[int, bool]
"""Priority (negated) and whether the head start is used up: a smaller rank goes first."""


@dataclass(slots=True, eq=False)
class _Account:
    """What a job or project has had, in seconds of compute: shares are equal where levels are.

    It is raised where one came later, or did not ask for its part.
    """

    level: float = 0.0


@dataclass(slots=True, eq=False)
class _JobAccount(_Account):
    """A job's account; `served` is the number of the last pack it was given."""

    received_seconds: float = 0.0
    priority: int = 0
    project: str = ""
    last_pack: int = 0


@dataclass(slots=True)
class FairShare(Generic[Key]):
    """The accounts of the jobs that a crew works on."""

    _jobs: dict[Key, _JobAccount] = field(default_factory=dict)
    _projects: dict[str, _Account] = field(default_factory=dict)
    _n_packs: int = 0

    def open_account(self, job: Key, *, priority: int = 0, project: str = "") -> None:
        """Open an account: nobody begins ahead of those who are here, or behind them.

        A project that comes back goes on with its own: else one job after another, each within
        its head start, would always begin anew.
        """
        floor = self._find_lowest_level()
        account = self._projects.setdefault(project, _Account(floor))
        account.level = max(account.level, floor)
        self._jobs[job] = _JobAccount(priority=priority, project=project, last_pack=self._n_packs)

    def close_account(self, job: Key) -> None:
        """Close the account of a job that has ended.

        That of its project stays while it is ahead of a project with jobs.
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
        """The project that a job belongs to."""
        return self._jobs[job].project

    def record_pack(self, job: Key) -> None:
        """A pack of this job was sent."""
        self._n_packs += 1
        self._jobs[job].last_pack = self._n_packs

    def charge_seconds(self, job: Key, seconds: float) -> None:
        """A pack of this job has taken `seconds` of compute time."""
        account = self._jobs[job]
        was_fresh = account.received_seconds < HEADSTART_SECONDS
        account.received_seconds += seconds
        account.level += seconds
        mates = [
            self._jobs[mate] for mate in self._list_past_headstart(account.project) if mate != job
        ]
        if was_fresh and account.received_seconds >= HEADSTART_SECONDS:
            account.level = max(account.level, min((mate.level for mate in mates), default=0.0))
        _raise_levels(account, mates)
        project = self._projects[account.project]
        project.level += seconds
        _raise_levels(project, self._projects.values())

    def compute_rank(self, job: Key) -> Rank:
        """Which jobs it goes before, whatever each has had."""
        return self._rank_account(self._jobs[job], self._find_lowest_level())

    def order_jobs(self, in_flight: Mapping[Key, int]) -> list[Key]:
        """The jobs of `in_flight`, the one that should have the next place first.

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
        if ordered and self._n_packs % LONGEST_WAIT_INTERVAL == LONGEST_WAIT_INTERVAL - 1:
            patient = min(ordered, key=lambda job: self._jobs[job].last_pack)
            ordered.remove(patient)
            ordered.insert(0, patient)
        return ordered

    def _list_active_projects(self) -> set[str]:
        """Projects with jobs."""
        return {account.project for account in self._jobs.values()}

    def _find_lowest_level(self) -> float:
        """The least that a project with jobs has had."""
        return min(
            (self._projects[name].level for name in self._list_active_projects()), default=0.0
        )

    def _rank_account(self, account: _JobAccount, floor: float) -> Rank:
        privileged = self._projects[account.project].level - floor < HEADSTART_SECONDS
        return -account.priority, not (privileged and account.received_seconds < HEADSTART_SECONDS)

    def _list_past_headstart(self, project: str) -> list[Key]:
        """Jobs of a project that have had their head start."""
        return [
            job
            for job, account in self._jobs.items()
            if account.project == project and account.received_seconds >= HEADSTART_SECONDS
        ]


def _raise_levels(ahead: _Account, others: Iterable[_Account]) -> None:
    for account in others:
        account.level = max(account.level, ahead.level - MAX_SAVED_SECONDS)
