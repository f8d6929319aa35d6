"""What goes into the workers and what comes out: values, and two small protocols."""

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
"""Parameter vectors of earlier results, to seed part of a population with."""
PackHandle: TypeAlias = Any
"""Names a pack in flight; only the crew that gave it knows more."""


@dataclass(frozen=True)
class ProblemSpec:
    """What is fitted to what.

    Attributes
    ----------
    model : Mapping
        Model document.
    records : str
        Key under which the crew shares the records; equal keys mean equal records.
    validation : str or None
        Key of the records kept for validation.
    validation_fraction : float or None
        Else the last fraction of each record that is kept for it.
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
        """Equal for equal specifications; names a built problem in a worker's cache."""
        return blake2b(f"{self.noise_free_key}{self.noise}".encode(), digest_size=16).hexdigest()

    @cached_property
    def noise_free_key(self) -> str:
        """Equal for specifications that differ in their noise only.

        What is written in another order is another one: the parameters' order is that in which a
        search draws them.
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
    """A part that JSON does not know."""
    return dict(value) if isinstance(value, Mapping) else asdict(value)


@dataclass(frozen=True, slots=True)
class RunSpec:
    """One identification, complete: the same specification gives the same bits anywhere."""

    problem: ProblemSpec
    algorithm: GeneticAlgorithm
    seed: int = 1
    warm_starts: WarmStartValues = ()

    @property
    def reuse_key(self) -> str | None:
        """Equal for runs of equal results; None where the clock has a say in the result."""
        if self.algorithm.stop.seconds is not None:
            return None
        parts = (
            self.problem.cache_key,
            repr(self.algorithm),
            self.seed,
            [*map(dict, self.warm_starts)],
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
    """The run goes on from here."""

    state: RunState


@dataclass(frozen=True, slots=True)
class IslandProgress:
    """The island has got to the border `target`, or rests before it."""

    island: Island
    target: int


@dataclass(frozen=True, slots=True, eq=False)
class RunConclusion:
    """The run is complete; `rms_noise_free` is its RMS against the records without noise."""

    identification: Identification
    rms_noise_free: float | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Improvements and migrants as plain tuples: named ones cost several times as much."""
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
    """The run cannot be carried out; `reason` is a sentence for its user.

    `evaluations` are those of a search that was carried out to its end.
    """

    reason: str
    kind: str = ""
    evaluations: int = 0


Outcome: TypeAlias = RunProgress | IslandProgress | RunConclusion | RunFailure


@dataclass(frozen=True, slots=True, eq=False)
class ItemResult:
    """What became of one item, and the compute time it took; None: its turn did not come."""

    run: str
    outcome: Outcome | None
    seconds: float


class Executor(Protocol):
    """Those who compute packs: a Ray cluster, or this process."""

    slots: int

    def share_records(self, records: Records) -> Any:
        """Make records known once; the reference travels instead of them."""

    def submit_pack(
        self, pack: Sequence[WorkItem], keys: Sequence[str], shared: Sequence[Any]
    ) -> PackHandle:
        """Send a pack; `keys` name the shared records in order."""

    def wait_for_packs(self, timeout: float) -> tuple[PackHandle, ...]:
        """Handles of packs that ended, waiting at most `timeout` seconds for the first."""

    def fetch_results(self, handle: PackHandle) -> tuple[ItemResult, ...]:
        """What a finished pack gave; raises `PackLost`."""

    def cancel_pack(self, handle: PackHandle, *, force: bool) -> None:
        """Interrupt a pack, or kill its worker."""

    def check_cluster_alive(self) -> None:
        """Raise `ClusterLost` if the crew shows no sign of life; never waits."""

    def close(self) -> None:
        """Let the crew go."""


class RunObserver(Protocol):
    """Who is told about the runs of one job."""

    def record_start(self, run: str) -> None:
        """The run was given to a worker for the first time, from its checkpoint or the start."""

    def record_worker_death(self, run: str, kills: int) -> None:
        """The worker died over this run alone, `kills` times by now; 0: it has gone on since."""

    def record_progress(self, run: str, state: RunState, seconds: float) -> None:
        """The run can go on from `state` after `seconds` of compute time."""

    def record_result(self, run: str, concluded: RunConclusion, seconds: float) -> None:
        """The run is complete."""

    def record_failure(self, run: str, failure: RunFailure) -> None:
        """The run cannot be carried out."""

    def record_reuse(self, run: str, source: str) -> None:
        """The run need not be computed: it is what the run `source` was."""

    def should_stop(self) -> bool:
        """Whether the job was cancelled or lost: asked between packs."""


@dataclass(frozen=True, slots=True)
class QueuedRun:
    """A run that waits for its turn.

    `state` is its checkpoint, if there is one; `kills` is how often its worker died over it, and
    over no other run, since it last went on.
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
    """A run whose specification has been carried out before, by the run `source`."""

    run: str
    source: str


@dataclass(frozen=True, slots=True)
class RunNotReady:
    """The next run waits for the result of one that is not over; ask again."""


JobEntry: TypeAlias = QueuedRun | InvalidRun | ReusedRun | RunNotReady


class JobSource(Protocol):
    """Where a job's runs and records come from, asked for as they are needed."""

    def iterate_runs(self) -> Iterable[JobEntry]:
        """The runs, in order; the iterable is read lazily."""

    def load_records(self, key: str) -> Records:
        """Return the records of that key, or raise `RecordsUnavailable`."""
