"""Submit jobs repeatedly and compare each with an undisturbed job of its kind."""

import threading
import time
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any

from sqlalchemy import select

from benchmarks import paper_example
from benchmarks.breaking.audit import Finding, audit, is_over
from benchmarks.breaking.stand import Stand, until
from service.client.calls import ClientError
from service.storage.retry import TRANSIENT_ERRORS
from service.storage.tables import Checkpoint, Job

STUCK_SECONDS = 180.0
"""A job that has not ended so long after the last fault is stuck."""
LONG_SECONDS = 8.0
"""What the long run takes at least, alone and on any machine: two checkpoints."""
DEADLY, GREEDY = (9013, 9014), (9077,)
"""Seeds of runs that kill their workers, and of one that takes all memory (`shim`)."""
ALWAYS = ("sweep", "diverging", "long")
"""Kinds of jobs of which usually one is open; the others are what a fault submits."""


def bodies(dataset: str, size: float = 1.0) -> dict[str, dict[str, Any]]:
    """The jobs, by kind; `size` scales their work.

    A sweep; one of which half the cells diverge; a long run on islands; a sweep with runs that
    kill their workers or take all memory; one to be cancelled, which ends with bounds.
    """
    # Signals of sweeps are kept here, so that faults meet their storage too.
    common = {"model": "duffing-eq16", "datasets": [dataset], "reuse": False, "keep_signals": True}
    unstable = {
        "path": "/parameters/b",
        "values": [{"fixed": 5.0}, {"lower": -1e9, "upper": 10.0, "fixed": -1e8}],
    }
    generations = round(40_000 * size)
    long = {"generations": generations, "islands": 4, "stop": {"settled": None}}
    seeds, few = _seeds(range(1, 1 + round(200 * size))), _seeds(range(1, 1 + round(30 * size)))
    bad = [*range(1, 6), *DEADLY, *range(6, 11), *GREEDY, *range(11, 16)]
    sigmas = {"path": "/noise/sigma", "values": [0.01, 0.02]}
    return {
        "sweep": {**common, "sweep": {"axes": [seeds]}},
        "diverging": {**common, "sweep": {"axes": [unstable, few]}},
        "long": {**common, "seed": 7, "algorithm": long},
        "bad": {**common, "sweep": {"axes": [_seeds(bad)]}},
        "cancelled": {**common, "sweep": {"axes": [sigmas, few]}},
    }


def _seeds(values: Collection[int]) -> dict[str, Any]:
    return {"path": "/seed", "values": list(values)}


@dataclass(frozen=True, slots=True)
class _Open:
    """A job that has not ended, as far as is known; `ends` is how often it may."""

    kind: str
    ends: int = 1


class Stream:
    """Keeps one job of some kinds open, from a thread of its own, and watches others.

    Parameters
    ----------
    kinds : collection of str
        What is always open.
    size : float
        Scale of the work of the jobs.
    """

    def __init__(
        self,
        stand: Stand,
        folder: Path,
        *,
        kinds: Collection[str] = ALWAYS,
        size: float = 1.0,
    ) -> None:
        path = paper_example.write_csv(folder / "record.csv", seed=1)
        dataset = stand.client.add_dataset(path, name="example 1")["id"]
        self._stand, self._bodies, self._always = stand, bodies(dataset, size), tuple(kinds)
        self.undisturbed: dict[str, Finding] = {}
        self._open: dict[str, _Open] = {}
        self.counts: Counter[str] = Counter()
        self._rate = 1.0  # evaluations a second of the long run, alone
        self.different: list[str] = []
        self._n_submitted = 0
        self._lock = threading.RLock()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._go_on, daemon=True)

    @property
    def kinds(self) -> tuple[str, ...]:
        """All that can be submitted."""
        return tuple(self._bodies)

    def measure(self, *others: str) -> dict[str, float]:
        """Carry out what is always open and these kinds once, undisturbed; gives their seconds.

        The long run gets more generations until it is long on this machine.
        """
        took = {}
        for kind in dict.fromkeys((*self._always, *others)):
            job, took[kind] = self._carry_out(kind)
            while kind == "long" and took[kind] < LONG_SECONDS:
                factor = ceil(2 * LONG_SECONDS / took[kind])
                self._bodies[kind]["algorithm"]["generations"] *= factor
                job, took[kind] = self._carry_out(kind)
            self.undisturbed[kind] = audit(self._stand, job)
            if kind == "long":
                self._rate = self._evaluations(job)[0] / took[kind]
        return took

    def _carry_out(self, kind: str) -> tuple[str, float]:
        job = str(self._stand.client.submit(self._bodies[kind])["id"])
        return job, until(lambda: is_over(self._stand, job), f"{kind} ended", 300.0)

    def at_risk(self) -> float:
        """Seconds of work of the long run that are in no checkpoint: what a kill now repeats."""
        with self._lock:
            job = next(
                (job for job, open_job in self._open.items() if open_job.kind == "long"), None
            )
        if job is None:
            return 0.0
        done, saved = self._evaluations(job)
        return max(0, done - saved) / self._rate

    def _evaluations(self, job: str) -> tuple[int, int]:
        """Those of a job of one run so far, and those in its checkpoint."""
        with self._stand.database.read_session() as session:
            done = session.get_one(Job, job).evaluations
            saved = select(Checkpoint.evaluations).where(Checkpoint.job_id == job)
            return done, session.scalar(saved) or 0

    def start(self) -> None:
        """Begin to submit."""
        self._thread.start()

    def jobs(self) -> list[str]:
        """The jobs that are open now."""
        with self._lock:
            return list(self._open)

    def submit(self, kind: str) -> str:
        """Submit a job, which nobody watches yet; gives its id.

        Raises
        ------
        ClientError
            If the web does not take it. With a key, a submission whose answer was lost is not
            made twice.
        """
        with self._lock:
            key = f"{kind}-{self._n_submitted}"
            answer = self._stand.client.submit(self._bodies[kind], idempotency_key=key)
            self._n_submitted += 1
        return str(answer["id"])

    def watch(self, job: str, kind: str, *, ends: int = 1) -> None:
        """Hold a job against the undisturbed one when it has ended, for the last of `ends`."""
        with self._lock:
            self._open[job] = _Open(kind, ends)

    def finish(self) -> int:
        """Submit nothing more and wait for what is open; gives the jobs that are stuck."""
        self._ending.set()
        self._thread.join()
        limit = time.monotonic() + STUCK_SECONDS
        while self._open and time.monotonic() < limit:
            self._look(submits=False)
            time.sleep(0.2)
        return len(self._open)

    def _go_on(self) -> None:
        while not self._ending.wait(0.2):
            self._look(submits=True)

    def _look(self, *, submits: bool) -> None:
        for job in self.jobs():
            with self._lock:
                self._try(lambda job=job: self._compare(job))
        there = {open_job.kind for open_job in self._open.values()}
        for kind in self._always if submits else ():
            if kind not in there:
                self._try(lambda kind=kind: self.watch(self.submit(kind), kind))

    @staticmethod
    def _try(work: Any) -> None:
        try:
            work()
        except (ClientError, *TRANSIENT_ERRORS):
            return  # a part is away; tried again at the next look

    def _compare(self, job: str) -> None:
        if not is_over(self._stand, job):
            return
        open_job = self._open[job]
        finding = audit(self._stand, job, ends=open_job.ends)
        wanted, counts = self.undisturbed[open_job.kind], self.counts
        counts["jobs"] += 1
        counts[open_job.kind] += 1
        counts["runs"] += len(finding.states)
        counts["doubled"] += finding.doubled
        counts["unplotted"] += finding.unplotted
        given_up = finding.count_given_up(wanted)
        counts["given up"] += finding.given_up
        counts["runs given up"] += given_up
        if not given_up:
            counts["lost"] += finding.count_lost(wanted)
            if finding.figures != wanted.figures:
                self.different.append(job)
                print(
                    f"{open_job.kind} {job} differs: {finding.list_differences(wanted)}", flush=True
                )
        del self._open[job]
