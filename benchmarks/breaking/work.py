"""Jobs that are submitted again and again, each held against an undisturbed one of its kind."""

import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

from sqlalchemy import select

from benchmarks import paper_example
from benchmarks.breaking.audit import Finding, audit, is_over
from benchmarks.breaking.stand import Stand, until
from service.calls import ClientError
from service.storage.patience import PASSING
from service.storage.tables import Checkpoint, Job

STUCK_SECONDS = 180.0
"""A job that has not ended so long after the last fault is stuck."""


def bodies(dataset: str) -> dict[str, dict[str, Any]]:
    """The jobs: a sweep, one of which half the cells diverge, and one long run on islands."""
    common = {"model": "duffing-eq16", "datasets": [dataset], "reuse": False}
    seeds = {"path": "/seed", "values": list(range(1, 201))}
    unstable = {"path": "/parameters/b", "values": [
        {"fixed": 5.0}, {"lower": -1e9, "upper": 10.0, "fixed": -1e8},
    ]}  # fmt: skip
    few = {"path": "/seed", "values": list(range(1, 31))}
    endless = {"generations": 40_000, "islands": 4, "stop": {"settled": None}}
    return {
        "sweep": {**common, "sweep": {"axes": [seeds]}},
        "diverging": {**common, "sweep": {"axes": [unstable, few]}},
        "long": {**common, "seed": 7, "algorithm": endless},
    }


class Stream:
    """Keeps one job of each kind open, from a thread of its own."""

    def __init__(self, stand: Stand, folder: Path) -> None:
        path = paper_example.write_csv(folder / "record.csv", seed=1)
        dataset = stand.client.add_dataset(path, name="example 1")["id"]
        self._stand, self._bodies = stand, bodies(dataset)
        self.undisturbed: dict[str, Finding] = {}
        self.open: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self._rate = 1.0  # evaluations a second of the long run, alone
        self.different: list[str] = []
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._go_on, daemon=True)

    def measure(self) -> dict[str, float]:
        """Carry out every kind once, undisturbed; gives their seconds."""
        took = {}
        for kind, body in self._bodies.items():
            job = self._stand.client.submit(body)["id"]
            took[kind] = until(lambda job=job: is_over(self._stand, job), f"{kind} ended", 300.0)
            self.undisturbed[kind] = audit(self._stand, job)
            if kind == "long":
                self._rate = self._evaluations(job)[0] / took[kind]
        return took

    def at_risk(self) -> float:
        """Seconds of work of the long run that are in no checkpoint: what a kill now repeats."""
        job = self.open.get("long")
        if job is None:
            return 0.0
        told, kept = self._evaluations(job)
        return max(0, told - kept) / self._rate

    def _evaluations(self, job: str) -> tuple[int, int]:
        """Those of a job of one run so far, and those in its checkpoint."""
        with self._stand.database.read() as session:
            told = session.get_one(Job, job).evaluations
            kept = select(Checkpoint.evaluations).where(Checkpoint.job_id == job)
            return told, session.scalar(kept) or 0

    def start(self) -> None:
        """Begin to submit."""
        self._thread.start()

    def jobs(self) -> list[str]:
        """The jobs that are open now."""
        return list(self.open.values())

    def finish(self) -> int:
        """Submit nothing more and wait for what is open; gives the jobs that are stuck."""
        self._ending.set()
        self._thread.join()
        limit = time.monotonic() + STUCK_SECONDS
        while self.open and time.monotonic() < limit:
            self._look(submits=False)
            time.sleep(0.2)
        return len(self.open)

    def _go_on(self) -> None:
        while not self._ending.wait(0.2):
            self._look(submits=True)

    def _look(self, *, submits: bool) -> None:
        for kind, body in self._bodies.items():
            try:
                if kind in self.open:
                    self._compare(kind, self.open[kind])
                elif submits:
                    # With a key, a submission whose answer was lost is not made twice.
                    key = f"{kind}-{self.counts[kind]}"
                    made = self._stand.client.submit(body, idempotency_key=key)
                    self.open[kind] = made["id"]
            except (ClientError, *PASSING):
                continue  # a part is away; tried again at the next look

    def _compare(self, kind: str, job: str) -> None:
        if not is_over(self._stand, job):
            return
        found, wanted = audit(self._stand, job), self.undisturbed[kind]
        self.counts[kind] += 1
        self.counts["runs"] += len(found.states)
        self.counts["lost"] += found.lost_beside(wanted)
        self.counts["doubled"] += found.doubled
        self.counts["given up"] += found.given_up
        if found.figures != wanted.figures:
            self.different.append(job)
        del self.open[kind]
