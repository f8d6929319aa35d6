"""Messages to and from the workers, and the protocols of executor, observer and source."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from sysid.core.settings import FitSettings, GeneticAlgorithm
from sysid.data.noise import Noise
from sysid.data.records import Record
from sysid.identification.fingerprint import compute_fingerprint
from sysid.identification.result import Identification
from sysid.islands.state import RunState
from sysid.search.island import Island
from sysid.search.state import Improvement, Migrant

Records: TypeAlias = tuple[Record, ...]
WarmStartValues: TypeAlias = tuple[Mapping[str, float], ...]
"""Parameter vectors of earlier results that seed part of a population."""
PackHandle: TypeAlias = Any
"""Identifies a pack in flight; its content is private to the executor."""


@dataclass(frozen=True)
class ProblemSpec:
    """Model, records and settings of a fit.

    Attributes
    ----------
    model : Mapping
        Model document.
    records : str
        Key under which the executor shares the records; equal keys mean equal records.
    validation : str or None
        Key of the records for validation.
    validation_fraction : float or None
        Otherwise, the last fraction of each record that is used for validation.
    noise : Noise
        Added to the records that the model is fitted to.
    """

    model: Mapping[str, Any]
    records: str
    validation: str | None = None
    validation_fraction: float | None = None
    settings: FitSettings = field(default_factory=FitSettings)
    noise: Noise = field(default_factory=Noise)

    @cached_property
    def cache_key(self) -> str:
        """Key of a built problem in a worker's cache; equal for equal specifications."""
        return blake2b(f"{self.noise_free_key}{self.noise}".encode(), digest_size=16).hexdigest()

    @cached_property
    def noise_free_key(self) -> str:
        """Key that is equal for specifications that differ in their noise only.

        The order of the parameters matters, because a search draws them in that order.
        """
        parts = {
            item.name: getattr(self, item.name) for item in fields(self) if item.name != "noise"
        }
        text = json.dumps(parts, default=_to_json_value)
        return blake2b(text.encode(), digest_size=16).hexdigest()

    @property
    def record_keys(self) -> tuple[str, ...]:
        """Keys of the shared records."""
        return (self.records,) if self.validation is None else (self.records, self.validation)


def _to_json_value(value: Any) -> dict[str, Any]:
    """Convert a value that JSON cannot represent."""
    return dict(value) if isinstance(value, Mapping) else asdict(value)


@dataclass(frozen=True, slots=True)
class RunSpec:
    """Complete specification of one identification; it gives the same bits anywhere."""

    problem: ProblemSpec
    algorithm: GeneticAlgorithm
    seed: int = 1
    warm_starts: WarmStartValues = ()
    posterior: bool = False
    """Whether the posterior is sampled."""

    @property
    def reuse_key(self) -> str | None:
        """Key that is equal for runs of equal results; None if the result depends on the clock."""
        if self.algorithm.stop.seconds is not None:
            return None
        parts = (
            self.problem.cache_key,
            repr(self.algorithm),
            self.seed,
            [*map(dict, self.warm_starts)],
            self.posterior,
        )
        fingerprint = compute_fingerprint(
            Path(__file__).parent
        )  # workers split records and add noise
        return blake2b(f"{parts}{fingerprint}".encode(), digest_size=16).hexdigest()


@dataclass(frozen=True, slots=True)
class AdvanceRun:
    """Work on a whole run for about `seconds`; from the start if `state` is None."""

    run: str
    spec: RunSpec
    state: RunState | None
    seconds: float


@dataclass(frozen=True, slots=True)
class EvolveIsland:
    """Work on one island of a run, up to the generation `target` of its next border."""

    run: str
    spec: RunSpec
    island: Island
    target: int


WorkItem: TypeAlias = AdvanceRun | EvolveIsland


@dataclass(frozen=True, slots=True)
class RunProgress:
    """State from which the run continues."""

    state: RunState


@dataclass(frozen=True, slots=True)
class IslandProgress:
    """An island that reached the border `target`, or came to rest before it."""

    island: Island
    target: int


@dataclass(frozen=True, slots=True, eq=False)
class RunConclusion:
    """The run is complete; `rms_noise_free` is its RMS against the records without noise."""

    identification: Identification
    rms_noise_free: float | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle improvements and migrants as plain tuples: named ones cost several times more."""
        identification = self.identification
        histories = [[tuple(item) for item in island] for island in identification.history]
        migrants = [tuple(item) for item in identification.migrations]
        rest = replace(identification, history=(), migrations=())
        return _rebuild_conclusion, (rest, histories, migrants, self.rms_noise_free)


def _rebuild_conclusion(
    rest: Identification,
    histories: list[list[Any]],
    migrants: list[Any],
    rms_noise_free: float | None,
) -> RunConclusion:
    history = tuple(tuple(map(Improvement._make, island)) for island in histories)
    identification = replace(rest, history=history, migrations=tuple(map(Migrant._make, migrants)))
    return RunConclusion(identification, rms_noise_free)


@dataclass(frozen=True, slots=True)
class RunFailure:
    """The run failed; `reason` is a sentence for its user.

    `evaluations` are those of a search that was completed.
    """

    reason: str
    kind: str = ""
    evaluations: int = 0


Outcome: TypeAlias = RunProgress | IslandProgress | RunConclusion | RunFailure


@dataclass(frozen=True, slots=True, eq=False)
class ItemResult:
    """Outcome of one item and its compute time in s; None: it was not processed."""

    run: str
    outcome: Outcome | None
    seconds: float


class Executor(Protocol):
    """Computes packs: a Ray cluster, or this process."""

    slots: int

    def share_records(self, records: Records) -> Any:
        """Share records once; afterwards only the reference is sent."""

    def submit_pack(
        self, pack: Sequence[WorkItem], keys: Sequence[str], shared: Sequence[Any]
    ) -> PackHandle:
        """Send a pack; `keys` name the shared records in order."""

    def wait_for_packs(self, timeout: float) -> tuple[PackHandle, ...]:
        """Return handles of packs that ended; wait at most `timeout` seconds for the first."""

    def fetch_results(self, handle: PackHandle) -> tuple[ItemResult, ...]:
        """Return the results of a finished pack, or raise `PackLost`."""

    def cancel_pack(self, handle: PackHandle, *, force: bool) -> None:
        """Interrupt a pack, or kill its worker."""

    def check_cluster_alive(self) -> None:
        """Raise `ClusterLost` if the cluster does not respond; never waits."""

    def close(self) -> None:
        """Release the workers."""


class RunObserver(Protocol):
    """Receives the events of the runs of one job."""

    def record_start(self, run: str) -> None:
        """The run was sent to a worker for the first time, from its checkpoint or the start."""

    def record_worker_death(self, run: str, kills: int) -> None:
        """The worker died on this run alone, `kills` times so far; 0: it made progress since."""

    def record_progress(self, run: str, state: RunState, seconds: float) -> None:
        """The run can continue from `state` after `seconds` of compute time."""

    def record_result(self, run: str, concluded: RunConclusion, seconds: float) -> None:
        """The run is complete."""

    def record_failure(self, run: str, failure: RunFailure) -> None:
        """The run failed."""

    def record_reuse(self, run: str, source: str) -> None:
        """The run need not be computed: it equals the run `source`."""

    def should_stop(self) -> bool:
        """Whether the job was cancelled or lost; called between packs."""


@dataclass(frozen=True, slots=True)
class QueuedRun:
    """A run that waits for a worker.

    `state` is its checkpoint, if there is one. `kills` counts how often a worker died on it alone
    since its last progress.
    """

    run: str
    spec: RunSpec
    state: RunState | None = None
    kills: int = 0


@dataclass(frozen=True, slots=True)
class InvalidRun:
    """A run whose specification cannot be used."""

    run: str
    failure: RunFailure


@dataclass(frozen=True, slots=True)
class ReusedRun:
    """A run whose specification was computed before, by the run `source`."""

    run: str
    source: str


@dataclass(frozen=True, slots=True)
class RunNotReady:
    """The next run waits for the result of an unfinished one; ask again."""


JobEntry: TypeAlias = QueuedRun | InvalidRun | ReusedRun | RunNotReady


class JobSource(Protocol):
    """Source of a job's runs and records, read as they are needed."""

    def iterate_runs(self) -> Iterable[JobEntry]:
        """Return the runs, in order; the iterable is read lazily."""

    def load_records(self, key: str) -> Records:
        """Return the records of that key, or raise `RecordsUnavailable`."""
