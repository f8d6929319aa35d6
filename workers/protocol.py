"""Messages to and from the workers, and the protocols of executor, observer and source."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property, lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias

from sysid.core.settings import FitSettings, GeneticAlgorithm
from sysid.data.noise import Noise
from sysid.data.records import Record
from sysid.identification.fingerprint import compute_fingerprint
from sysid.islands.run_state import RunState
from sysid.results.identification import Identification
from sysid.search.island import Island

_WORKERS = Path(__file__).parent  # they split records and add noise
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

    def replace_noise(self, noise: Noise) -> "ProblemSpec":
        """Return the same fit with other noise; the key of all else is not computed again."""
        key = self.noise_free_key
        other = object.__new__(ProblemSpec)  # `replace` looks up each field, run by run
        other.__dict__.update(self.__dict__, noise=noise, noise_free_key=key)
        other.__dict__.pop("cache_key", None)
        return other

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
    compare_orders: bool = False
    """Whether a process is compared with one order more and one less."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the fields as they are: a dataclass would look them up by name, run by run."""
        return RunSpec, (
            self.problem,
            self.algorithm,
            self.seed,
            self.warm_starts,
            self.posterior,
            self.compare_orders,
        )

    @property
    def reuse_key(self) -> str | None:
        """Key that is equal for runs of equal results; None if the result depends on the clock."""
        if self.algorithm.stop.seconds is not None:
            return None
        parts = (
            self.problem.cache_key,
            _describe_algorithm(self.algorithm),
            self.seed,
            [sorted(values.items()) for values in self.warm_starts],  # JSONB sorts the names too
            self.posterior,
            self.compare_orders,
        )
        fingerprint = compute_fingerprint(_WORKERS)
        return blake2b(f"{parts}{fingerprint}".encode(), digest_size=16).hexdigest()


@lru_cache(maxsize=256)
def _describe_algorithm(algorithm: GeneticAlgorithm) -> str:
    return repr(algorithm)


@dataclass(frozen=True, slots=True)
class AdvanceRun:
    """Work on a whole run for about `seconds`; from the start if `state` is None.

    Attributes
    ----------
    spent : float
        Compute time so far, in s.
    is_reported : bool
        Whether the observer has been told `state`.
    """

    run: str
    spec: RunSpec
    state: RunState | None
    seconds: float
    spent: float = 0.0
    is_reported: bool = False

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the fields as they are, as `RunSpec` does."""
        fields = (self.run, self.spec, self.state, self.seconds, self.spent, self.is_reported)
        return AdvanceRun, fields


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


@dataclass(frozen=True, slots=True)
class RunEnd:
    """The run is complete; its result is encoded with those of its pack."""


@dataclass(frozen=True, slots=True)
class RunFailure:
    """The run failed; `reason` is a sentence for its user.

    `evaluations` are those of a search that was completed.
    """

    reason: str
    kind: str = ""
    evaluations: int = 0


Outcome: TypeAlias = RunProgress | IslandProgress | RunConclusion | RunEnd | RunFailure


EncodedRuns: TypeAlias = Any
"""Complete runs of a pack as they are stored; only the observer looks into it."""


class ItemResult(NamedTuple):
    """Outcome of one item and its compute time in s; None: it was not processed.

    A worker computes a `RunConclusion`. The driver gets a `RunEnd` in its place.
    """

    run: str
    outcome: Outcome | None
    seconds: float


class PackResult(NamedTuple):
    """What a worker returns of a pack: a result for each item, and its complete runs encoded.

    `compile_seconds` is the time in which it compiled kernels.
    """

    results: tuple[ItemResult, ...]
    encoded: EncodedRuns | None = None
    compile_seconds: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class CompleteRun:
    """A complete run as its encoder gets it.

    Attributes
    ----------
    seconds : float
        Compute time over all workers.
    reported : RunState or None
        The last state that the observer was told: its history need not be encoded again.
    """

    run: str
    spec: RunSpec
    concluded: RunConclusion
    seconds: float
    reported: RunState | None = None


Encoder: TypeAlias = Callable[[Sequence[CompleteRun], Mapping[str, Records]], EncodedRuns]
"""Encodes the complete runs of a pack, in the worker."""


@dataclass(frozen=True, slots=True)
class Pack:
    """Items that a worker processes in one call.

    Attributes
    ----------
    records : mapping
        What `Executor.share_records` returned for the records of the items, by their keys.
    encoder : Encoder
        Encodes the runs that are complete after this pack.
    """

    items: Sequence[WorkItem]
    records: Mapping[str, Any]
    encoder: Encoder


class Executor(Protocol):
    """Computes packs: a Ray cluster, or this process."""

    slots: int

    def share_records(self, records: Records) -> Any:
        """Share records once; afterwards only the reference is sent."""

    def submit_pack(self, pack: Pack) -> PackHandle:
        """Send a pack."""

    def wait_for_packs(self, timeout: float) -> tuple[PackHandle, ...]:
        """Return handles of packs that ended; wait at most `timeout` seconds for the first."""

    def fetch_results(self, handle: PackHandle) -> PackResult:
        """Return the results of a finished pack, or raise `PackLost`."""

    def cancel_pack(self, handle: PackHandle, *, force: bool) -> None:
        """Interrupt a pack, or kill its worker."""

    def check_cluster_alive(self) -> None:
        """Raise `ClusterLost` if the cluster does not respond; never waits."""

    def close(self) -> None:
        """Release the workers."""


class RunObserver(Protocol):
    """Receives the events of the runs of one job.

    Attributes
    ----------
    encoder : Encoder
        Encodes complete runs for `record_results`.
    """

    encoder: Encoder

    def record_start(self, run: str) -> None:
        """The run was sent to a worker for the first time, from its checkpoint or the start."""

    def record_worker_death(self, run: str, kills: int) -> None:
        """The worker died on this run alone, `kills` times so far; 0: it made progress since."""

    def record_silent_worker(self, text: str) -> None:
        """A worker did not answer and is replaced, as the text tells."""

    def record_delay(self, reason: str) -> None:
        """The runs wait, because their records cannot be loaded now."""

    def record_progress(self, run: str, state: RunState, seconds: float) -> None:
        """The run can continue from `state` after `seconds` of compute time."""

    def record_results(self, encoded: EncodedRuns) -> None:
        """Runs of a pack are complete."""

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
        """Return the records of that key; else `RecordsUnavailable`, or `RecordsDelayed`."""
