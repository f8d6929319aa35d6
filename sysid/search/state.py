"""What compiled generations read and change: the plan of an island and its arrays."""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias

from sysid.core.types import FloatArray, IntArray, WordArray, make_record_dtype

SearchPhase = Literal["start", "genetic", "sequence", "migration", "refinement"]


class Improvement(NamedTuple):
    """A better champion of one island: the RMS history is kept as these only, without loss.

    `rms` is the fitness: J of Eq. 10, with soft-l1 √(robust loss / n) in its stead.
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
    """What one island found, before and after refinement (for the waterfall).

    The two RMS are fitnesses: J of Eq. 10, with soft-l1 √(robust loss / n) in its stead.
    """

    champion_rms: float
    refined_rms: float | None
    parameters: tuple[float, ...]
    evaluations: int


METHOD_SIMPLE, METHOD_PAPER, METHOD_IMPROVED, METHOD_IMPROVED_FIXED_SEQUENCE = 0, 1, 2, 3
"""Methods: simple GA; with the fixed sequence; improved with adaptive, with fixed sequence."""


class SearchRecord(Protocol):
    """How far the search of an island has got. What reads as a statement is 0 or 1."""

    generation: int
    evaluations: int
    stagnation: int  # generations since the last better champion
    in_sequence_search: int
    step_count: int  # of this sequence search, or of the generations since the last
    failed_steps: int  # one after the other
    local_searches: int  # begun so far
    champion_converged: int  # a local search of the champion has come to its end
    probe_count: int
    from_random_start: int  # this local search
    random_starts: int  # local searches from random places that have ended
    confirmed_starts: int  # those of them that led to the champion
    hop_kind: int  # 0: this local search is none
    hop_count: int  # hops that have ended
    returned_hops: int  # those of them that led back to the champion
    champion_discontinuities: int  # lines beside this champion on which the fitness jumps
    is_warm_start: int
    fitness_discontinuities: int  # the same beside any champion, and what neighbours have met
    wide_differences: int  # slopes are taken over distances that are drawn
    damping: float
    horizon: float  # part of the record that counts
    horizon_growth: float  # factor from one part to the next
    replaced_fitness: float  # of the individual whose place a local search takes
    reached_fitness: float  # by this local search, over the whole record


SEARCH_RECORD = make_record_dtype(SearchRecord)

SearchArray: TypeAlias = Any
"""A `numpy.recarray` of search records; NumPy's own types do not know the fields."""


class IslandArrays(NamedTuple):
    """One island as compiled code reads and changes it, in place.

    Numba passes it as an argument but does not return it.

    Attributes
    ----------
    chromosomes : WordArray, shape (P, D)
        Fittest first.
    fitness : FloatArray, shape (P,)
        Ascending; ``nan`` is not evaluated yet.
    search : SearchRecord
    point : FloatArray, shape (D,)
        Where the local search stands, in [0, 1].
    """

    chromosomes: WordArray
    fitness: FloatArray
    search: SearchRecord
    point: FloatArray


# Columns of an improvement; the D physical values follow.
COLUMN_GENERATION, COLUMN_EVALUATIONS, COLUMN_RMS, COLUMN_PHASE, COLUMN_VALUES = range(5)
PHASE_START, PHASE_GENETIC, PHASE_LOCAL, PHASE_MIGRATION = range(4)
PHASE_NAMES: tuple[SearchPhase, ...] = ("start", "genetic", "sequence", "migration")

SAME_OPTIMUM = 1e-4  # relative: champions this near in fitness are one optimum


class IslandPlan(NamedTuple):
    """How one island searches, as compiled code reads it.

    Attributes
    ----------
    seed, island : int
        What its random numbers derive from.
    first, total : int
        Number of its first individual among the `total` of the archipelago.
    method : int
        One of `METHOD_SIMPLE`, `METHOD_PAPER`, `METHOD_IMPROVED`, `METHOD_IMPROVED_FIXED_SEQUENCE`.
    bits, survivors, stagnation : int
    relative : int
        1: `beta` is relative to the value (Eq. 12); 0: to the range.
    evaluations : int
        After that many simulations the island rests.
    beta : float
    rms : float
        At that fitness the island rests; negative: never.
    loss_scale : float
        Scale of the soft-l1 loss; 0: squares.
    starts, rates : arrays
        Mutation schedule.
    progress : FloatArray, shape (M,)
        How far in its record (0 … 1) each measured value lies.
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
