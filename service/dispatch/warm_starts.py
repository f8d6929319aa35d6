"""What each run of a job begins with: nothing, an earlier run's estimates, or its neighbour's.

With ``"previous"`` a run waits for the one before it in its chain, so that the result depends on
neither the number of workers nor their speed. Where that one failed, the last before it that
succeeded serves; where there is none, the run begins cold.
"""

import time
from collections.abc import Mapping
from typing import Any

from sqlalchemy import select

from service.chains import Chain
from service.schemas_jobs import PREVIOUS, SweepIn
from service.storage.runs import RunRepository
from service.storage.sessions import Database
from service.storage.tables import Job, Run, State
from sysid.result import Identification
from workers.ports import Warm

LOOK_SECONDS = 0.1
"""How often the database is asked about a run that others wait for."""


class WarmStarts:
    """Of one claimed job. What its own runs gave is known at once, before it is written."""

    def __init__(self, database: Database, job: Job) -> None:
        self._database, self._job = database, job
        axes = SweepIn.model_validate(job.spec.get("sweep") or {}).axes
        self._chain = Chain.along(axes)
        swept = any(axis.path == "/warm_start" for axis in axes)
        self._is_chained = swept or job.spec.get("warm_start") == PREVIOUS
        self._numbers: dict[str, int] = {}
        self._found: dict[int, Mapping[str, float]] = {}
        self._earlier: dict[str, Mapping[str, float]] = {}
        self._looked = float("-inf")

    def of(self, row: Run, body: Mapping[str, Any]) -> Warm | None:
        """Values for a run to begin with; None while a run that it depends on is not over.

        Raises
        ------
        StorageError
            If the run that it names is not there.
        """
        if self._is_chained:
            self._numbers[row.id] = row.number
        reference = body.get("warm_start")
        if reference is None:
            return ()
        if reference != PREVIOUS:
            return (self._estimates(reference),)
        return self._of_neighbour(row.number)

    def note(self, run: str, found: Identification) -> None:
        """A run of the job has succeeded."""
        number = self._numbers.pop(run, None)
        if number is not None:
            self._found[number] = {one.name: float(one.value) for one in found.estimates}

    def note_known(self, run: str, source: str) -> None:
        """A run of the job is what another was."""
        number = self._numbers.pop(run, None)
        if number is not None:
            self._found[number] = self._estimates(source)

    def _of_neighbour(self, number: int) -> Warm | None:
        assert self._chain is not None  # a job without axes is refused
        before = self._chain.before(number)
        if before is None:
            return ()
        if before in self._found:
            return (self._found.pop(before),)
        if time.monotonic() - self._looked < LOOK_SECONDS:
            return None
        self._looked = time.monotonic()
        return self._stored(before)

    def _stored(self, before: int | None) -> Warm | None:
        """Estimates of the last run of the chain that succeeded; None if one may still do so."""
        while before is not None:
            with self._database.read() as session:
                query = select(Run.state, Run.estimates).where(
                    Run.job_id == self._job.id, Run.number == before
                )
                state, estimates = session.execute(query).one()
            if state is State.SUCCEEDED:
                return (_values(estimates),)
            if not state.is_terminal:
                return None
            assert self._chain is not None
            before = self._chain.before(before)
        self._looked = float("-inf")
        return ()

    def _estimates(self, run: str) -> Mapping[str, float]:
        if run not in self._earlier:
            with self._database.read() as session:
                row = RunRepository(session, self._job.project_id).get(run)
                self._earlier[run] = _values(row.estimates)
        return self._earlier[run]


def _values(estimates: Mapping[str, Any] | None) -> Mapping[str, float]:
    return {name: float(one["value"]) for name, one in (estimates or {}).items()}
