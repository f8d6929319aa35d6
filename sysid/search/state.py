"""Plan and state of an island, as compiled generations read and change them."""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias

from sysid.core.types import FloatArray, IntArray, WordArray, make_record_dtype

SearchPhase = Literal["start", "genetic", "sequence", "migration", "refinement"]


class Improvement(NamedTuple):
    """A better champion of one island; the RMS history consists of these, without loss.

    `rms` is the fitness: J of Eq. 10, or √(robust loss / n) with soft-l1.
    """

    generation: int
    evaluations: int
    rms: float
    phase: SearchPhase
    parameters: tuple[float, ...]


class Migrant(NamedTuple):
    """One line of the migration log."""

    epoch: int
    source: int
    destination: int
    fitness: float


@dataclass(frozen=True, slots=True)
class IslandSummary:
    """Champion of one island before and after refinement (for the waterfall plot).

    The two RMS are fitnesses: J of Eq. 10, or √(robust loss / n) with soft-l1.

    Attributes
    ----------
    champion_rms : float
        RMS error of the search, in the unit of the result's `rms`.
    refined_rms : float or None
        RMS error after least squares, in the same unit; none without.
    parameters : tuple of float
        Values of the free parameters, in their units.
    evaluations : int
        Simulations of the island.
    """

    champion_rms: float
    refined_rms: float | None
    parameters: tuple[float, ...]
    evaluations: int


METHOD_SIMPLE, METHOD_PAPER, METHOD_IMPROVED, METHOD_IMPROVED_FIXED_SEQUENCE = 0, 1, 2, 3
"""Methods: simple GA, GA with fixed sequence, improved with adaptive or with fixed sequence."""


class KnownFitness(NamedTuple):
    """Fitness of chromosomes of one island; a new one replaces an older one.

    Attributes
    ----------
    words : WordArray, shape (S, D)
        Chromosomes, each at the index that its own words give. S is 0 without memory.
    fitness : FloatArray, shape (S,)
        Their fitness; ``nan`` where nothing is stored.
    """

    words: WordArray
    fitness: FloatArray


class SearchRecord(Protocol):
    """State of the search of an island."""

    generation: int
    evaluations: int
    stagnation: int  # generations since the last better champion
    in_sequence_search: bool
    step_count: int  # of this sequence search, or generations since the last one
    failed_steps: int  # in succession
    local_searches: int  # started so far
    champion_converged: bool  # a local search of the champion has ended
    probe_count: int
    from_random_start: bool  # this local search began at a random point
    random_starts: int  # ended local searches from random points
    confirmed_starts: int  # of these, those that led to the champion
    hop: int  # of this local search, as `sysid.search.schedule.LocalSearch` says
    hop_is_evidence: bool
    hop_count: int  # ended hops
    returned_hops: int  # of these, those that led back to the champion
    champion_discontinuities: int  # lines through this champion on which the fitness jumps
    champion_explained: bool  # its residuals were noise when a hop last returned to it
    is_warm_start: bool
    fitness_discontinuities: int  # the same for any champion, and for those of neighbours
    wide_differences: bool  # slopes are taken over random distances
    damping: float
    horizon: float  # part of the record that is fitted
    horizon_growth: float  # factor from one part to the next
    replaced_fitness: float  # of the individual that a local search replaces
    reached_fitness: float  # by this local search, over the whole record


SEARCH_RECORD = make_record_dtype(SearchRecord)

SearchArray: TypeAlias = Any
"""Array of search records. Python reads a field by key; attributes of a recarray are slow."""


class IslandArrays(NamedTuple):
    """One island as compiled code reads and changes it, in place.

    Numba passes it as an argument but does not return it.

    Attributes
    ----------
    chromosomes : WordArray, shape (P, D)
        Fittest first.
    fitness : FloatArray, shape (P,)
        Ascending; ``nan``: not evaluated yet.
    search : SearchRecord
    point : FloatArray, shape (D,)
        Present point of the local search, in [0, 1].
    archive : FloatArray, shape (16, 2 + D)
        Minima in which searches from random points ended (`sysid.search.archive`).
    known : KnownFitness
        Fitness of the chromosomes that were evaluated lately.
    """

    chromosomes: WordArray
    fitness: FloatArray
    search: SearchRecord
    point: FloatArray
    archive: FloatArray
    known: KnownFitness


# Columns of an improvement; the D physical values follow.
COLUMN_GENERATION, COLUMN_EVALUATIONS, COLUMN_RMS, COLUMN_PHASE, COLUMN_VALUES = range(5)
PHASE_START, PHASE_GENETIC, PHASE_LOCAL, PHASE_MIGRATION = range(4)
PHASE_NAMES: tuple[SearchPhase, ...] = ("start", "genetic", "sequence", "migration")

SAME_OPTIMUM = 1e-4  # relative: champions this near in fitness are one optimum


class IslandPlan(NamedTuple):
    """Search plan of one island, as compiled code reads it.

    Attributes
    ----------
    seed, island : int
        Random numbers derive from these.
    first_individual, population : int
        Number of its first individual among the `population` of the archipelago.
    method : int
        One of `METHOD_SIMPLE`, `METHOD_PAPER`, `METHOD_IMPROVED`, `METHOD_IMPROVED_FIXED_SEQUENCE`.
    bits, survivors, stagnation : int
    is_relative : int
        1: `beta` is relative to the value (Eq. 12); 0: to the range.
    most_evaluations : int
        The island rests after so many simulations.
    beta : float
    target_rms : float
        The island rests at this fitness; negative: never.
    loss_scale : float
        Scale of the soft-l1 loss; 0: squares.
    mutation_starts, mutation_rates : arrays
        Mutation schedule.
    progress : FloatArray, shape (M,)
        Position of each measured value in its record (0 … 1).
    """

    seed: int
    island: int
    first_individual: int
    population: int
    method: int
    bits: int
    survivors: int
    stagnation: int
    is_relative: int
    most_evaluations: int
    beta: float
    target_rms: float
    loss_scale: float
    mutation_starts: IntArray
    mutation_rates: FloatArray
    progress: FloatArray
