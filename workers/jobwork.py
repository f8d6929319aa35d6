"""The runs of one job on the driver's side: which items come next, what became of them."""

import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

from workers.errors import RecordsUnavailable
from workers.packing import Cost, deal, pack_size
from workers.ports import (
    Advanced,
    Coming,
    Concluded,
    Crew,
    Done,
    Evolve,
    Evolved,
    Failure,
    Handle,
    Item,
    JobSource,
    KnownRun,
    NotYet,
    RefusedRun,
    RunObserver,
)  # fmt: skip
from workers.progress import MAX_KILLS, ActiveRun

KEPT_RECORDS = 16
"""Sets of records that a job keeps with the crew."""


class JobWork:
    """One job's runs: waiting, with the workers, or done.

    Attributes
    ----------
    flying : dict
        Items of each pack in flight.
    """

    def __init__(self, source: JobSource, observer: RunObserver, crew: Crew) -> None:
        self.observer = observer
        self.flying: dict[Handle, tuple[Item, ...]] = {}
        self._source, self._crew = source, crew
        self._coming: Iterator[Coming] = iter(source.runs())
        self._ready: deque[ActiveRun] = deque()
        self._active: dict[str, ActiveRun] = {}
        self._shared: dict[str, Any] = {}
        self._untold: deque[tuple[str, Concluded, float]] = deque()
        self._cost = Cost()
        self._exhausted = False
        self._has_no_more = False  # at present: what follows waits for runs that are not over

    @property
    def is_done(self) -> bool:
        """Whether all runs were read and told of; nothing waits or is with the workers."""
        return self._exhausted and not (self.flying or self._ready or self._untold)

    @property
    def has_news(self) -> bool:
        """Whether there are results that the observer has not been told of."""
        return bool(self._untold)

    @property
    def untold_seconds(self) -> float:
        """Compute time of the results that the observer has not been told of."""
        return sum(seconds for _, _, seconds in self._untold)

    @property
    def is_hungry(self) -> bool:
        """Whether a run that was read waits for a worker."""
        return bool(self._ready)

    def read_ahead(self, wanted: int, deadline: float) -> bool:
        """Ask the source until `wanted` runs wait or the time is up; whether a run waits now.

        One is asked for in any case.
        """
        while not self._exhausted and len(self._ready) < wanted:
            queued = next(self._coming, None)
            self._has_no_more = queued is None or isinstance(queued, NotYet)
            if queued is None:
                self._exhausted = True
            elif isinstance(queued, NotYet):
                break
            elif isinstance(queued, RefusedRun):
                self.observer.failure(queued.run, queued.failure)
            elif isinstance(queued, KnownRun):
                self.observer.known(queued.run, queued.source)
            else:
                run = ActiveRun.of(queued)
                self._active[run.run] = run
                self._ready.append(run)
            if time.monotonic() > deadline:
                break
        return bool(self._ready)

    def feed(self, idle: int) -> None:
        """Send the next pack, or one run's islands as several packs if `idle` cores allow."""
        run = self._ready[0]
        if run.should_spread(idle if len(self._ready) == 1 else 0):
            self._ready.popleft()
            self._spread(run)
        elif run.goes_alone:
            self._send([self._ready.popleft().whole()])
        else:
            shared_by = self._crew.slots if self._has_no_more else 1  # else more follow
            size = pack_size(self._cost, len(self._ready), shared_by)
            self._send([run.whole(self._cost) for run in self._take_fresh(size)])

    def absorb(self, handle: Handle, done: tuple[Done, ...]) -> None:
        """Take in what a pack gave; islands whose turn did not come are sent again."""
        items = self.flying.pop(handle)
        waiting = self._waiting(handle, items)
        again: list[Item] = []
        for item, one in zip(items, done, strict=True):
            run = self._active.get(one.run)
            if run is None:
                continue  # it failed while another of its islands was still out
            run.seconds += one.seconds
            if run not in waiting:
                continue
            if one.outcome is not None:
                self._take(run, one)
            elif isinstance(item, Evolve):
                again.append(item)
            else:
                self._ready.appendleft(run)
        again = [item for item in again if item.run in self._active]
        if again:
            self._send(again)

    def tell(self) -> bool:
        """Tell the observer of the next result, which takes it a while; whether there was one."""
        if self._untold:
            self.observer.result(*self._untold.popleft())
            return True
        return False

    def lose(self, handle: Handle, reason: str) -> None:
        """A worker died: its runs go on from where they were, each alone.

        Only a run that was alone is blamed, and not for what came of it elsewhere: two packs of
        its islands that are lost at once are one death.
        """
        items = self.flying.pop(handle)
        are_several = len({item.run for item in items}) > 1
        for run in self._waiting(handle, items):
            run.gather_again()
            run.is_suspect = True
            if are_several or self._may_go_on(run, reason):
                self._ready.append(run)

    def fail(self, handle: Handle, reason: str) -> None:
        """A programming error: the runs of the pack fail with it."""
        for run in self._waiting(handle, self.flying.pop(handle)):
            self._fail(run.run, Failure(reason, "InternalError"))

    def stop(self) -> None:
        """Begin nothing more."""
        self._ready.clear()
        self._exhausted = True

    def _take_fresh(self, size: int) -> list[ActiveRun]:
        """The next `size` runs that have not been begun and see the same records."""
        chosen = [self._ready.popleft()]
        while self._ready and len(chosen) < size:
            following = self._ready[0]
            if following.goes_alone or following.spec.problem.needs != chosen[0].spec.problem.needs:
                break
            chosen.append(self._ready.popleft())
        return chosen

    def _spread(self, run: ActiveRun) -> None:
        items = run.split()
        costs = [float(item.island.words.size) for item in items]
        for bundle in deal(costs, self._crew.slots):
            self._send([items[index] for index in bundle])

    def _send(self, items: list[Item]) -> None:
        keys = items[0].spec.problem.needs
        try:
            shared = [self._share(key) for key in keys]
        except RecordsUnavailable as error:
            for name in {item.run for item in items}:
                self._fail(name, Failure(str(error), type(error).__name__))
            return
        for name in dict.fromkeys(item.run for item in items):
            self._tell_begin(self._active[name])
        handle = self._crew.submit(items, keys, shared)
        self.flying[handle] = tuple(items)
        for item in items:
            self._active[item.run].packs.add(handle)

    def _waiting(self, handle: Handle, items: Sequence[Item]) -> list[ActiveRun]:
        """The runs that wait for this pack, which is back; not those that go on without it."""
        names = dict.fromkeys(item.run for item in items)
        found = [self._active[name] for name in names if name in self._active]
        found = [run for run in found if handle in run.packs]
        for run in found:
            run.packs.discard(handle)
        return found

    def _tell_begin(self, run: ActiveRun) -> None:
        if not run.is_begun:
            run.is_begun = True
            self.observer.started(run.run)

    def _share(self, key: str) -> Any:
        if key not in self._shared:
            while len(self._shared) >= KEPT_RECORDS:
                self._shared.pop(next(iter(self._shared)))
            self._shared[key] = self._crew.share(self._source.records(key))
        return self._shared[key]

    def _take(self, run: ActiveRun, one: Done) -> None:
        match one.outcome:
            case Failure() as failure:
                self._cost = self._cost.observe(one.seconds)
                self._fail(run.run, failure)
            case Concluded() as concluded:
                self._cost = self._cost.observe(run.seconds)
                del self._active[run.run]
                self._untold.append((run.run, concluded, run.seconds))
            case Advanced(state):
                run.advance(state, one.seconds)
                self._go_on(run)
            case Evolved() as evolved:
                if run.gather(evolved, one.seconds):
                    self._go_on(run)

    def _may_go_on(self, run: ActiveRun, reason: str) -> bool:
        """Whether a run over which its worker died is tried once more; else it fails."""
        run.kills += 1
        self.observer.blamed(run.run, run.kills)
        if run.kills >= MAX_KILLS:
            text = f"its worker process died {run.kills} times; the last time: {reason}"
            self._fail(run.run, Failure(text, "WorkerDied"))
        return run.kills < MAX_KILLS

    def _go_on(self, run: ActiveRun) -> None:
        assert run.state is not None
        if run.kills:
            run.kills = 0
            self.observer.blamed(run.run, 0)
        self.observer.progress(run.run, run.state, run.seconds)
        self._ready.appendleft(run)  # what was begun is ended first: few runs are under way

    def _fail(self, name: str, failure: Failure) -> None:
        if self._active.pop(name, None) is not None:
            self.observer.failure(name, failure)
