"""What each run of a job begins with: nothing, an earlier run's estimates, or its neighbour's.

With ``"previous"`` a run waits for those before it in its chain, so that the result depends on
neither the number of workers nor their speed. Where the one before failed, the last before it that
succeeded serves; where there is none, the run begins cold.
"""

from collections.abc import Mapping
from typing import Any

from sqlalchemy import select

from service.cells import stored_groups
from service.chains import Chain
from service.dispatch.open_chains import OpenChains
from service.schemas_jobs import PREVIOUS, SweepIn
from service.storage.runs import RunRepository
from service.storage.sessions import Database
from service.storage.tables import OPEN, Job, Run, State
from service.sweeps import positions_of
from sysid.identification.result import Identification
from workers.ports import Warm

PATH = "/warm_start"


class WarmStarts:
    """Of one claimed job. What its own runs gave is known at once, before it is written."""

    def __init__(self, database: Database, job: Job) -> None:
        self._database, self._job = database, job
        self._chains: OpenChains | None = None
        self._numbers: dict[str, int] = {}
        self._earlier: dict[str, Mapping[str, float]] = {}

    def chains(self) -> OpenChains | None:
        """The chains of the job, begun where it was left; None if no run waits for another."""
        waits = _Waits(self._job)
        axes = SweepIn.model_validate(self._job.spec.get("sweep") or {}).axes
        chain = Chain.along(axes)
        if chain is None or not waits.any:
            return None
        with self._database.read() as session:
            query = select(Run.number).where(
                Run.job_id == self._job.id, Run.state.in_([one for one in State if one not in OPEN])
            )
            ended = set(session.scalars(query))
        self._chains = OpenChains(chain, self._job.n_runs, waits, ended)
        return self._chains

    def given(self, row: Run) -> None:
        """A run of a chain is given to the workers: others wait until it is over."""
        self._numbers[row.id] = row.number

    def of(self, row: Run, body: Mapping[str, Any]) -> Warm:
        """Values for a run to begin with; those before it in its chain are over.

        Raises
        ------
        StorageError
            If the run that it names is not there.
        """
        reference = body.get("warm_start")
        if reference is None:
            return ()
        if reference != PREVIOUS:
            return (self._estimates(reference),)
        assert self._chains is not None  # a job without axes is refused
        values = self._chains.before(row.number, self._stored)
        return () if values is None else (values,)

    def note(self, run: str, found: Identification) -> None:
        """A run of the job has succeeded."""
        self._over(run, {one.name: float(one.value) for one in found.estimates})

    def note_known(self, run: str, source: str) -> None:
        """A run of the job is what another was."""
        if run in self._numbers:
            self._over(run, self._estimates(source))

    def note_failed(self, run: str) -> None:
        """A run of the job has failed."""
        self._over(run, None)

    def _over(self, run: str, values: Mapping[str, float] | None) -> None:
        number = self._numbers.pop(run, None)
        if number is not None and self._chains is not None:
            self._chains.over(number, values)

    def _stored(self, before: range) -> tuple[int, Mapping[str, float]] | None:
        """Number and estimates of the last of these runs that succeeded."""
        query = select(Run.number, Run.estimates).where(
            Run.job_id == self._job.id, Run.state == State.SUCCEEDED,
            Run.number >= before.start, Run.number < before.stop,
            (Run.number - before.start) % before.step == 0,
        )  # fmt: skip
        with self._database.read() as session:
            found = session.execute(query.order_by(Run.number.desc()).limit(1)).one_or_none()
        return None if found is None else (found[0], _values(found[1]))

    def _estimates(self, run: str) -> Mapping[str, float]:
        if run not in self._earlier:
            with self._database.read() as session:
                row = RunRepository(session, self._job.project_id).get(run)
                self._earlier[run] = _values(row.estimates)
        return self._earlier[run]


class _Waits:
    """Which runs of a job wait for their neighbour: all, none, or those that an axis tells to."""

    def __init__(self, job: Job) -> None:
        groups = stored_groups(job.spec)
        self._lengths = [len(steps) for steps in groups]
        swept = [
            (place, values)
            for place, steps in enumerate(groups)
            for _, axis, values in steps.columns
            if axis.path == PATH
        ]
        self._swept = swept[0] if swept else None
        if self._swept is None:
            self.any = job.spec.get("warm_start") == PREVIOUS
        else:
            self.any = PREVIOUS in self._swept[1]

    def __call__(self, number: int) -> bool:
        if self._swept is None:
            return self.any
        place, values = self._swept
        waits: bool = values[positions_of(number, self._lengths)[place]] == PREVIOUS
        return waits


def _values(estimates: Mapping[str, Any] | None) -> Mapping[str, float]:
    return {name: float(one["value"]) for name, one in (estimates or {}).items()}
