"""Settings of a search and of the problem it solves, as frozen values.

This is their only declaration: name, type, default, bounds, and under "Attributes" what each one
means. The wire types of the service, its OpenAPI document, the client's types and the table of the
search in `docs/job.md` are derived from it. So names and sentences here are those of a job.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeAlias,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from sysid.core.errors import InvalidSettings

SearchMethod = Literal["simple", "improved-paper", "improved"]
TopologyName = Literal["one-way-ring", "ring", "fully-connected", "star", "unconnected"]
SequenceKind = Literal["paper", "adaptive"]
PredictionKind = Literal["simulation", "one-step"]
LossKind = Literal["squares", "soft-l1"]
NoiseModel = Literal["auto", "white", "ar1", "plant", "load", "drift"]
FoundNoiseModel = Literal["white", "ar1", "plant", "load", "drift"]
PlantNoise = Literal["plant", "load", "drift"]
"""Noise that a Kalman filter follows."""
StartKind = Literal["rest", "free", "measured"]
InitialSetting = Literal["rest", "free", "measured", "auto"]
SEARCH_METHODS: tuple[SearchMethod, ...] = get_args(SearchMethod)
PREDICTION_KINDS: tuple[PredictionKind, ...] = get_args(PredictionKind)
LOSS_KINDS: tuple[LossKind, ...] = get_args(LossKind)
NOISE_MODELS: tuple[NoiseModel, ...] = get_args(NoiseModel)
FILTERED: tuple[PlantNoise, ...] = get_args(PlantNoise)
INITIAL_SETTINGS: tuple[InitialSetting, ...] = get_args(InitialSetting)
MIN_POPULATION = 4
"""Fewest individuals of an island: two parents, and others for their children to replace."""
MAX_BITS = 32
"""Most bits of a coded parameter."""
# The compiled search counts these in 64 bits; a run of years does not come near them.
MAX_GENERATIONS = 10**9
MAX_EVALUATIONS = 10**12


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Bounds:
    """Bounds of a number, in the annotation of its field; None: unbounded on that side.

    Attributes
    ----------
    least, most : float or None
        Bounds that the number may take.
    above, below : float or None
        Bounds that it may not take.

    Examples
    --------
    >>> Bounds(least=1, most=32)
    1 to 32
    >>> Bounds(above=0).hold(0)
    False
    """

    least: float | None = None
    above: float | None = None
    below: float | None = None
    most: float | None = None

    def hold(self, value: float) -> bool:
        """Test whether a number is within the bounds; NaN is not."""
        return (
            (self.least is None or value >= self.least)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
            and (self.most is None or value <= self.most)
        )

    def __repr__(self) -> str:
        if self.least is not None and self.most is not None:
            return f"{self.least} to {self.most}"
        if self.above is not None and self.below is not None:
            return f"between {self.above} and {self.below}"
        ends = (
            (self.least, f"{self.least} or more"),
            (self.above, "positive" if self.above == 0 else f"above {self.above}"),
            (self.below, f"below {self.below}"),
            (self.most, f"{self.most} or less"),
        )
        return ", ".join(text for end, text in ends if end is not None)


Count: TypeAlias = Annotated[int, Bounds(least=1, most=MAX_GENERATIONS)]
Generation: TypeAlias = Annotated[int, Bounds(least=0, most=MAX_GENERATIONS)]
Bits: TypeAlias = Annotated[int, Bounds(least=1, most=MAX_BITS)]
Share: TypeAlias = Annotated[float, Bounds(above=0, below=1)]
SEED = Bounds(least=0, below=2**63)
Seed: TypeAlias = Annotated[int, SEED]
Positive: TypeAlias = Annotated[float, Bounds(above=0)]
MutationSchedule: TypeAlias = tuple[tuple[Generation, float], ...]


@dataclass(frozen=True, slots=True)
class SequenceSearch:
    """The paper's sequence search (Eq. 11, 12), or the one that learns steps and directions.

    Attributes
    ----------
    kind : SequenceKind
        Fixed steps (Eq. 11, 12 of the paper), or least squares over a growing record.
    beta : float
        First step, as a share of the value or of the range.
    relative : bool
        Whether steps are relative to the value (Eq. 12 of the paper), else to the range.

    Examples
    --------
    >>> GeneticAlgorithm(sequence=SequenceSearch(kind="paper", beta=0.02)).sequence.beta
    0.02
    """

    kind: SequenceKind = "adaptive"
    beta: Share = 0.01
    relative: bool = True

    def __post_init__(self) -> None:
        check_settings(self, "/algorithm/sequence")


@dataclass(frozen=True, slots=True)
class Migration:
    """Exchange between islands.

    Attributes
    ----------
    every : int
        Generations between two migrations.
    topology : TopologyName
        Which islands send to which.
    migrants : int
        Individuals that each island sends.

    Examples
    --------
    >>> GeneticAlgorithm(migration=Migration(every=50, migrants=1)).migration.topology
    'one-way-ring'
    """

    every: Count = 25
    topology: TopologyName = "one-way-ring"
    migrants: Generation = 2

    def __post_init__(self) -> None:
        check_settings(self, "/algorithm/migration")


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

    Attributes
    ----------
    evaluations : int or None
        Most simulations, never exceeded, of search, refinement, nearby minima, noise model,
        standard errors, orders and posterior. At least one population. An individual whose fitness
        is known counts too; checks of the finished estimate do not.
    seconds : float or None
        Most computing time, s. Least squares may end a tenth later (0.2 to 10 s), and a warning
        lists what was left out. The result then depends on the machine.
    rms : float or None
        RMS error at which the search stops, in the output's unit.
    settled : int or None
        Restarts that must end at the best individual, and two more, and a third of all. None:
        never stop for them.

    Examples
    --------
    >>> GeneticAlgorithm(stop=Stop(seconds=10)).stop.settled
    6
    """

    evaluations: Annotated[int, Bounds(least=1, most=MAX_EVALUATIONS)] | None = None
    seconds: Positive | None = None
    rms: Positive | None = None
    settled: Annotated[int, Bounds(least=1)] | None = 6

    def __post_init__(self) -> None:
        check_settings(self, "/algorithm/stop")


@dataclass(frozen=True, slots=True)
class IslandChange:
    """Settings in which one island differs from the others; None: as theirs.

    Attributes
    ----------
    method : SearchMethod or None
        Method of this island.
    bits : int or None
        Bits of each parameter in the chromosome.
    mutation : MutationSchedule or None
        Pairs of a generation and, from it on, the probability of one flipped bit in a child.

    Examples
    --------
    >>> GeneticAlgorithm(islands=(IslandChange(), IslandChange(bits=12))).n_islands
    2
    """

    method: SearchMethod | None = None
    bits: Bits | None = None
    mutation: MutationSchedule | None = None

    def __post_init__(self) -> None:
        check_settings(self, "/algorithm/islands")
        if self.mutation is not None:
            _require_schedule(self.mutation, "islands")


@dataclass(frozen=True, slots=True)
class GeneticAlgorithm:
    """A whole search: the paper's genetic algorithm, its improvement, and the islands.

    Attributes
    ----------
    method : SearchMethod
        The paper's two methods as printed, or ours.
    population : int
        Individuals of all islands together, distributed as evenly as possible. The budget of
        evaluations does not depend on the number of islands.
    generations : int
        Most generations.
    bits : int
        Bits of each parameter in the chromosome.
    selection_rate : float
        Share of an island that survives.
    mutation : MutationSchedule
        Pairs of a generation and, from it on, the probability of one flipped bit in a child. The
        first generation is 0.
    stagnation : int
        Generations without a better champion before the sequence search, or a restart, begins.
    sequence : SequenceSearch
        Settings of the sequence search.
    islands : int or tuple of IslandChange or None
        Number of islands, or the settings of each. None: 4 for ``improved`` with 16 individuals or
        more, else 1. The paper has no islands.
    migration : Migration
        Exchange between islands.
    refine : bool
        Whether least squares continues from the champions of ``improved``.
    safe_limit : float or None
        RMS error above which a result is not valid (section 3 of the paper), in the output's unit.
    stop : Stop
        What ends the search before the last generation, whichever comes first.

    Examples
    --------
    A larger search than the default, for a model with many minima:

    >>> GeneticAlgorithm(population=200, generations=1000, islands=8).n_islands
    8
    """

    method: SearchMethod = "improved"
    population: Annotated[int, Bounds(least=MIN_POPULATION)] = 50
    generations: Count = 400
    bits: Bits = 24
    selection_rate: Share = 0.5
    mutation: MutationSchedule = ((0, 0.2), (50, 0.8))
    stagnation: Count = 30
    sequence: SequenceSearch = field(default_factory=SequenceSearch)
    islands: int | tuple[IslandChange, ...] | None = None
    migration: Migration = field(default_factory=Migration)
    refine: bool = True
    safe_limit: Positive | None = None
    stop: Stop = field(default_factory=Stop)

    def __post_init__(self) -> None:
        check_settings(self, "/algorithm")
        _require_schedule(self.mutation, "mutation")
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
    (`sysid.noise_models.generalised_least_squares`). ``auto`` selects ``ar1`` for free runs by
    squares whose coloured residuals have no other explanation (`sysid.judgement.judge`), else
    ``white``. ``plant`` and ``load`` are noise inside the plant, and ``drift`` is that of a sensor:
    the likelihood of a Kalman filter is maximised (`sysid.models.kalman_filter`). With `noise` in
    the document, ``auto`` does that if it is likelier (`sysid.identification.plant_noise_choice`).

    Attributes
    ----------
    kind : LossKind
        What is minimised; ``soft-l1`` limits the influence of outliers.
    scale : float
        Residual beyond which ``soft-l1`` grows linearly, in the output's unit.
    noise_model : NoiseModel
        Noise model of the estimates.

    Examples
    --------
    Outliers beyond about 0.5 of the output's unit count less:

    >>> Loss("soft-l1", scale=0.5).kind
    'soft-l1'
    """

    kind: LossKind = "squares"
    scale: Positive = 1.0
    noise_model: NoiseModel = "auto"

    def __post_init__(self) -> None:
        check_settings(self, "/loss")
        if self.noise_model not in ("auto", "white") and self.kind != "squares":
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
        Changes of the model's parameters by name: bounds, scales, fixed values or ties.
    prediction : PredictionKind
        What is compared with the outputs: a free run from the model's own past, or predictions one
        step ahead from the measured past.
    loss : Loss
        What is minimised.
    weights : mapping of str to float or sequence of float, or None
        Weight of each output, one number or one for each experiment. None: 1 for one output, else
        1 / its standard deviation; then the noise of each output in each experiment is estimated.
    skip : int
        First samples of each output that are not scored.
    initial : InitialSetting or None
        Where the states start: at rest under the first inputs, at estimated or at measured values.
        auto compares them by the data. None: as the model's document says.
    scored_from : tuple of float or None
        For each record the time (s) from which samples are scored. None: all samples.
    deviations : tuple of tuple of float, or None
        Relative standard deviation of the noise by experiment and output, which divides the
        weight. None: all are equal.
    commands : tuple of str, or None
        Inputs that a controller computes from the outputs. They are read held, and noise inside the
        plant is looked for. None: the data tell. Empty: there is no controller.
    """

    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    prediction: PredictionKind = "simulation"
    loss: Loss = field(default_factory=Loss)
    weights: Weights | None = None
    skip: Annotated[int, Bounds(least=0)] = 0
    initial: InitialSetting | None = None
    scored_from: tuple[float, ...] | None = None
    deviations: tuple[tuple[float, ...], ...] | None = None
    commands: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", dict(self.parameters))
        if self.commands is not None:
            object.__setattr__(self, "commands", tuple(self.commands))
        if self.weights is not None:
            object.__setattr__(self, "weights", dict(self.weights))
        check_settings(self, "")
        if self.prediction == "one-step" and self.loss.noise_model not in ("auto", "white"):
            raise InvalidSettings(
                "/loss/noise_model",
                f"{self.loss.noise_model} needs the prediction 'simulation'; one-step predictions "
                "already contain the noise",
            )


def check_settings(settings: Any, pointer: str) -> None:
    """Check that settings are among the choices and within the bounds of their declaration.

    Raises
    ------
    InvalidSettings
        With the pointer of the first field that is not; `pointer` is that of the settings.
    """
    for name, rule in _list_rules(settings.__class__):
        value = getattr(settings, name)
        if not rule.hold(value):
            raise InvalidSettings(f"{pointer}/{name}", f"found {value!r}; need {rule}")


@dataclass(frozen=True, slots=True)
class _Rule:
    """What a field may be: one of `choices`, or within `bounds`."""

    choices: tuple[object, ...]
    bounds: Bounds | None
    may_be_none: bool

    def hold(self, value: Any) -> bool:
        if value is None:
            return self.may_be_none
        return value in self.choices if self.bounds is None else self.bounds.hold(value)

    def __str__(self) -> str:
        if self.bounds is not None:
            return str(self.bounds)
        *others, last = map(str, self.choices)
        return f"{', '.join(others)} or {last}"


@lru_cache
def _list_rules(kind: type) -> tuple[tuple[str, _Rule], ...]:
    """List the fields of settings that have choices or bounds."""
    hints = get_type_hints(kind, include_extras=True)
    rules = ((name, _read_rule(list_members(hint))) for name, hint in hints.items())
    return tuple((name, rule) for name, rule in rules if rule.choices or rule.bounds)


def _read_rule(members: Sequence[Any]) -> _Rule:
    names = [get_args(member) for member in members if get_origin(member) is Literal]
    bounds = filter(None, map(find_bounds, members))
    return _Rule(tuple(chain(*names)), next(bounds, None), NoneType in members)


def list_members(annotation: Any) -> tuple[Any, ...]:
    """List the members of a union; any other type is the only member."""
    return get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)


def find_bounds(annotation: Any) -> Bounds | None:
    """Find the bounds in the annotation of a number; None if it has none."""
    extras = getattr(annotation, "__metadata__", ())
    return next((extra for extra in extras if isinstance(extra, Bounds)), None)


def _require(holds: bool, pointer: str, value: object, allowed: str) -> None:
    if not holds:
        raise InvalidSettings(f"/algorithm/{pointer}", f"found {value!r}; need {allowed}")


def _require_schedule(schedule: MutationSchedule, pointer: str) -> None:
    generations = [generation for generation, _ in schedule]
    holds = (
        generations[:1] == [0]
        and generations[-1] <= MAX_GENERATIONS
        and generations == sorted(set(generations))
        and all(0 <= rate <= 1 for _, rate in schedule)
    )
    allowed = f"[generation, rate] pairs from generation 0 up to {MAX_GENERATIONS}, rates 0 to 1"
    _require(holds, pointer, schedule, allowed)
