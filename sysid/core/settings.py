"""Settings of a search and of the problem it solves, as frozen values.

The field names are those of the job body. Names to choose from, defaults and bounds are defined
here once: the wire schemas, the forms and the command line take them from here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

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
"""Individuals of an island at least: a child needs two parents, and they others to replace."""
MAX_BITS = 32
"""Bits of a coded parameter at most."""
# What the compiled search counts in 64 bits, with room to add; no run of years comes near them.
MAX_GENERATIONS = 10**9
MAX_EVALUATIONS = 10**12
MutationSchedule = tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class SequenceSearch:
    """The paper's sequence search (Eq. 11, 12).

    ``kind`` ``"paper"``: the step stays fixed; ``"adaptive"``: it learns step sizes and
    directions. `beta` is the step, relative to the value (`relative`, Eq. 12) or to the range.
    """

    kind: SequenceKind = "adaptive"
    beta: float = 0.01
    relative: bool = True

    def __post_init__(self) -> None:
        right = ", ".join(SEQUENCE_KINDS)
        _require(self.kind in SEQUENCE_KINDS, "sequence/kind", self.kind, right)
        _require(0 < self.beta < 1, "sequence/beta", self.beta, "between 0 and 1")


@dataclass(frozen=True, slots=True)
class Migration:
    """Every how many generations, along which topology, how many migrants (pagmo's words)."""

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
    """End conditions besides the generations; whichever comes first. None: not used.

    `settled`: the best individual was found again by two searches more than that, half of that
    at least from new random places and half from beside it, and by a third of all searches; where
    fewer than half of those from random places agree, only after two and a half times as many.
    Where the fitness jumps nearby, by that many of either kind, by two thirds of those from random
    places and nine of ten from beside it. Only the adaptive sequence search makes these, so that
    the paper's methods never end by it.
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
    """What one island does otherwise; None: as the archipelago."""

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
        Individuals in all, dealt over the islands as evenly as possible, so that the budget of
        evaluations does not depend on the number of islands.
    mutation : tuple of (generation, rate)
        Schedule: from that generation on, that probability of one flipped bit in a child.
    stagnation : int
        Generations without a better champion before the sequence search begins.
    islands : int or tuple of IslandChange or None
        None: 4 for ``improved``, 1 for the two methods of the paper, which knows no islands.
    safe_limit : float or None
        Fitness above which an individual is invalid (section 3), in the output's unit.
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
            f"{self.population} or more, the simulations of one population of "
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
    """What is minimised: squares (Eq. 10), or soft-l1 with a scale in the output's unit.

    With the noise model ``ar1`` the search minimises squares; from its end on the estimates are
    those of generalised least squares under first-order noise
    (`sysid.identification.generalised_least_squares`). ``auto`` is that for free runs by squares
    whose residuals are coloured and whose model does not forget where it began
    (`sysid.identification.noise_model_choice`), else ``white``.
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


@dataclass(frozen=True, slots=True)
class FitSettings:
    """What a fit takes besides its model and its records.

    Attributes
    ----------
    parameters : mapping of str to mapping
        Changed bounds, scales or fixed values, or what a parameter is tied to.
    prediction : {"simulation", "one-step"}
        Free run or one step ahead.
    loss : Loss
        What is minimised.
    weights : mapping of str to float or None
        Weight of each output. None: 1 for one output, else 1 / its standard deviation.
    skip : int
        First samples of each output that are not scored.
    scored_from : tuple of float or None
        For each record the time (s) from which on samples are scored. None: all are.
    """

    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    prediction: PredictionKind = "simulation"
    loss: Loss = field(default_factory=Loss)
    weights: Mapping[str, float] | None = None
    skip: int = 0
    scored_from: tuple[float, ...] | None = None

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
                f"{self.loss.noise_model} is for free runs; predictions one step ahead contain the "
                "noise",
            )
        if self.skip < 0:
            raise InvalidSettings("/skip", f"{self.skip!r} is not a number of samples, 0 or more")


def _require(holds: bool, pointer: str, found: object, right: str) -> None:
    if not holds:
        raise InvalidSettings(f"/algorithm/{pointer}", f"found {found!r}; need {right}")


def _require_count(found: int, pointer: str) -> None:
    _require(1 <= found <= MAX_GENERATIONS, pointer, found, f"1 to {MAX_GENERATIONS}")


def _require_schedule(found: MutationSchedule, pointer: str) -> None:
    generations = [generation for generation, _ in found]
    holds = (
        bool(generations)
        and generations[0] == 0
        and generations[-1] <= MAX_GENERATIONS
        and generations == sorted(set(generations))
        and all(0 <= rate <= 1 for _, rate in found)
    )
    right = f"[generation, rate] pairs from generation 0 up to {MAX_GENERATIONS}, rates 0 to 1"
    _require(holds, pointer, found, right)


def _join(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"
