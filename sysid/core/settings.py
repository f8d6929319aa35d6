"""Settings of a search and of the problem it solves, as frozen values.

The field names are those of the job body. Choices, defaults and bounds are defined here once. The
wire schemas, the forms and the command line take them from here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias, get_args

from sysid.core.errors import InvalidSettings

SearchMethod = Literal["simple", "improved-paper", "improved"]
TopologyName = Literal["one-way-ring", "ring", "fully-connected", "star", "unconnected"]
SequenceKind = Literal["paper", "adaptive"]
PredictionKind = Literal["simulation", "one-step"]
LossKind = Literal["squares", "soft-l1"]
NoiseModel = Literal["auto", "white", "ar1"]
SEARCH_METHODS: tuple[SearchMethod, ...] = get_args(SearchMethod)
TOPOLOGIES: tuple[TopologyName, ...] = get_args(TopologyName)
SEQUENCE_KINDS: tuple[SequenceKind, ...] = get_args(SequenceKind)
PREDICTION_KINDS: tuple[PredictionKind, ...] = get_args(PredictionKind)
LOSS_KINDS: tuple[LossKind, ...] = get_args(LossKind)
NOISE_MODELS: tuple[NoiseModel, ...] = get_args(NoiseModel)
MIN_POPULATION = 4
"""Fewest individuals of an island: two parents, and others for their children to replace."""
MAX_BITS = 32
"""Most bits of a coded parameter."""
# The compiled search counts these in 64 bits; a run of years does not come near them.
MAX_GENERATIONS = 10**9
MAX_EVALUATIONS = 10**12
MutationSchedule = tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class SequenceSearch:
    """The paper's sequence search (Eq. 11, 12).

    With ``kind="paper"`` the step stays fixed. With ``kind="adaptive"`` the search learns step
    sizes and directions. `beta` is the step, relative to the value (`relative`, Eq. 12) or to the
    range.

    Examples
    --------
    >>> GeneticAlgorithm(sequence=SequenceSearch(kind="paper", beta=0.02)).sequence.beta
    0.02
    """

    kind: SequenceKind = "adaptive"
    beta: float = 0.01
    relative: bool = True

    def __post_init__(self) -> None:
        allowed = ", ".join(SEQUENCE_KINDS)
        _require(self.kind in SEQUENCE_KINDS, "sequence/kind", self.kind, allowed)
        _require(0 < self.beta < 1, "sequence/beta", self.beta, "between 0 and 1")


@dataclass(frozen=True, slots=True)
class Migration:
    """Migration between islands: interval in generations, topology, number of migrants.

    Examples
    --------
    >>> GeneticAlgorithm(migration=Migration(every=50, migrants=1)).migration.topology
    'one-way-ring'
    """

    every: int = 25
    topology: TopologyName = "one-way-ring"
    migrants: int = 2

    def __post_init__(self) -> None:
        _require_count(self.every, "migration/every")
        _require(
            self.topology in TOPOLOGIES, "migration/topology", self.topology, ", ".join(TOPOLOGIES)
        )
        _require(
            0 <= self.migrants <= MAX_GENERATIONS,
            "migration/migrants",
            self.migrants,
            f"0 to {MAX_GENERATIONS}",
        )


@dataclass(frozen=True, slots=True)
class Stop:
    """Stopping conditions besides the generations; the first one met ends the search.

    None disables a condition. `settled` stops the search by agreement of restarts:

    * `settled` + 2 restarts must confirm the best individual. At least half of `settled` must
      start from random points and half near the best individual.
    * At least a third of all restarts must agree.
    * If fewer than half of the random restarts agree, two and a half times as many are needed.
    * If the best individual's residuals look like noise, those near it are enough.
    * If the fitness jumps nearby, that many of either kind must agree. So must two thirds of the
      random restarts and nine of ten of those nearby.

    Only the adaptive sequence search makes restarts, so the paper's methods never stop by it.

    Examples
    --------
    >>> GeneticAlgorithm(stop=Stop(seconds=10)).stop.settled
    6
    """

    evaluations: int | None = None
    seconds: float | None = None
    rms: float | None = None
    settled: int | None = 6

    def __post_init__(self) -> None:
        for name in ("evaluations", "seconds", "rms", "settled"):
            value = getattr(self, name)
            _require(value is None or value > 0, f"stop/{name}", value, "positive")
        _require(
            self.evaluations is None or self.evaluations <= MAX_EVALUATIONS,
            "stop/evaluations",
            self.evaluations,
            f"1 to {MAX_EVALUATIONS}",
        )


@dataclass(frozen=True, slots=True)
class IslandChange:
    """Settings of one island that differ from the archipelago's; None: the same.

    Examples
    --------
    >>> GeneticAlgorithm(islands=(IslandChange(), IslandChange(bits=12))).n_islands
    2
    """

    method: SearchMethod | None = None
    bits: int | None = None
    mutation: MutationSchedule | None = None

    def __post_init__(self) -> None:
        if self.mutation is not None:
            _require_schedule(self.mutation, "islands")


@dataclass(frozen=True, slots=True)
class GeneticAlgorithm:
    """A whole search: the paper's genetic algorithm, its improvement, and the islands.

    Attributes
    ----------
    population : int
        Individuals of all islands together, distributed as evenly as possible. The budget of
        evaluations does not depend on the number of islands.
    mutation : tuple of (generation, rate)
        Schedule: probability of one flipped bit in a child, from that generation on.
    stagnation : int
        Generations without a better champion before the sequence search begins.
    islands : int or tuple of IslandChange or None
        None: 4 for ``improved``, 1 for the two methods of the paper, which has no islands.
    safe_limit : float or None
        Fitness above which an individual is invalid (section 3), in the output's unit.

    Examples
    --------
    A larger search than the default, for a model with many minima:

    >>> GeneticAlgorithm(population=200, generations=1000, islands=8).n_islands
    8
    """

    method: SearchMethod = "improved"
    population: int = 50
    generations: int = 400
    bits: int = 24
    selection_rate: float = 0.5
    mutation: MutationSchedule = ((0, 0.2), (50, 0.8))
    stagnation: int = 30
    sequence: SequenceSearch = field(default_factory=SequenceSearch)
    islands: int | tuple[IslandChange, ...] | None = None
    migration: Migration = field(default_factory=Migration)
    refine: bool = True
    safe_limit: float | None = None
    stop: Stop = field(default_factory=Stop)

    def __post_init__(self) -> None:
        _require(self.method in SEARCH_METHODS, "method", self.method, ", ".join(SEARCH_METHODS))
        _require(
            self.population >= MIN_POPULATION,
            "population",
            self.population,
            f"{MIN_POPULATION} or more",
        )
        _require_count(self.generations, "generations")
        _require(1 <= self.bits <= MAX_BITS, "bits", self.bits, f"1 to {MAX_BITS}")
        _require(
            0 < self.selection_rate < 1, "selection_rate", self.selection_rate, "between 0 and 1"
        )
        _require_count(self.stagnation, "stagnation")
        _require_schedule(self.mutation, "mutation")
        _require(
            self.safe_limit is None or self.safe_limit > 0,
            "safe_limit",
            self.safe_limit,
            "positive",
        )
        _require(self.n_islands >= 1, "islands", self.islands, "1 or more")
        budget = self.stop.evaluations
        _require(
            budget is None or budget >= self.population,
            "stop/evaluations",
            budget,
            f"{self.population} or more, one simulation for each of the "
            f"{self.population} individuals",
        )
        _require(
            self.population >= MIN_POPULATION * self.n_islands,
            "population",
            self.population,
            f"{MIN_POPULATION} or more for each of the {self.n_islands} islands",
        )

    @property
    def n_islands(self) -> int:
        """Number of islands."""
        if self.islands is None:
            return 4 if self.method == "improved" and self.population >= 16 else 1
        return self.islands if isinstance(self.islands, int) else len(self.islands)


@dataclass(frozen=True, slots=True)
class Loss:
    """Loss to minimise: squares (Eq. 10), or soft-l1 with a scale in the output's unit.

    With the noise model ``ar1`` the search minimises squares. Then generalised least squares
    under first-order noise gives the estimates
    (`sysid.noise_models.generalised_least_squares`). ``auto`` selects, for free runs by
    squares with coloured residuals, the one that predicts left-out data better
    (`sysid.noise_models.noise_model_choice`), else ``white``.

    Examples
    --------
    Outliers beyond about 0.5 of the output's unit count less:

    >>> Loss("soft-l1", scale=0.5).kind
    'soft-l1'
    """

    kind: LossKind = "squares"
    scale: float = 1.0
    noise_model: NoiseModel = "auto"

    def __post_init__(self) -> None:
        if self.kind not in LOSS_KINDS:
            raise InvalidSettings("/loss/kind", f"{self.kind!r} is not {_join(LOSS_KINDS)}")
        if not self.scale > 0:
            raise InvalidSettings("/loss/scale", f"{self.scale!r} is not a positive number")
        if self.noise_model not in NOISE_MODELS:
            detail = f"{self.noise_model!r} is not {_join(NOISE_MODELS)}"
            raise InvalidSettings("/loss/noise_model", detail)
        if self.noise_model == "ar1" and self.kind != "squares":
            raise InvalidSettings(
                "/loss/noise_model",
                f"{self.noise_model} is not available with {self.kind}; need the loss 'squares'",
            )


Weights: TypeAlias = Mapping[str, float | Sequence[float]]
"""Weight of each output: one number, or one for each experiment."""


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Settings of a fit, besides its model and its records.

    Attributes
    ----------
    parameters : mapping of str to mapping
        Changed bounds, scales, fixed values or ties.
    prediction : {"simulation", "one-step"}
        Free run or one step ahead.
    loss : Loss
        Loss to minimise.
    weights : mapping of str to float or sequence of float, or None
        Weight of each output, one number or one for each experiment. None: 1 for one output, else
        1 / its standard deviation; then the noise of each output in each experiment is estimated.
    skip : int
        First samples of each output that are not scored.
    scored_from : tuple of float or None
        For each record the time (s) from which samples are scored. None: all samples.
    deviations : tuple of tuple of float, or None
        Relative standard deviation of the noise by experiment and output, which divides the
        weight. None: all are equal.
    """

    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    prediction: PredictionKind = "simulation"
    loss: Loss = field(default_factory=Loss)
    weights: Weights | None = None
    skip: int = 0
    scored_from: tuple[float, ...] | None = None
    deviations: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", dict(self.parameters))
        if self.weights is not None:
            object.__setattr__(self, "weights", dict(self.weights))
        if self.prediction not in PREDICTION_KINDS:
            raise InvalidSettings(
                "/prediction",
                f"{self.prediction!r} is not {_join(list(map(repr, PREDICTION_KINDS)))}",
            )
        if self.prediction == "one-step" and self.loss.noise_model == "ar1":
            raise InvalidSettings(
                "/loss/noise_model",
                f"{self.loss.noise_model} is for free runs; one-step predictions already "
                "contain the noise",
            )
        if self.skip < 0:
            raise InvalidSettings(
                "/skip", f"{self.skip!r} is not a number of samples; need 0 or more"
            )


def _require(holds: bool, pointer: str, value: object, allowed: str) -> None:
    if not holds:
        raise InvalidSettings(f"/algorithm/{pointer}", f"found {value!r}; need {allowed}")


def _require_count(value: int, pointer: str) -> None:
    _require(1 <= value <= MAX_GENERATIONS, pointer, value, f"1 to {MAX_GENERATIONS}")


def _require_schedule(schedule: MutationSchedule, pointer: str) -> None:
    generations = [generation for generation, _ in schedule]
    holds = (
        bool(generations)
        and generations[0] == 0
        and generations[-1] <= MAX_GENERATIONS
        and generations == sorted(set(generations))
        and all(0 <= rate <= 1 for _, rate in schedule)
    )
    allowed = f"[generation, rate] pairs from generation 0 up to {MAX_GENERATIONS}, rates 0 to 1"
    _require(holds, pointer, schedule, allowed)


def _join(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"
