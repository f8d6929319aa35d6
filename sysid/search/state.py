"""What compiled generations read and change: the plan of an island and its counters."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

from sysid.core.types import FloatArray, IntArray

Phase = Literal["start", "genetic", "sequence", "migration", "refinement"]


class Improvement(NamedTuple):
    """A better champion of one island: the RMS history is kept as these only, without loss.

    `rms` is the fitness: J of Eq. 10, with soft-l1 √(robust loss / n) in its stead.
    """

    generation: int
    evaluations: int
    rms: float
    phase: Phase
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


SIMPLE, PAPER, IMPROVED, IMPROVED_PAPER_STEPS = 0, 1, 2, 3
"""Methods: simple GA; with the fixed sequence; improved with adaptive, with fixed sequence."""

# Places in an island's counters.
(
    GENERATION, EVALUATIONS, STAGNATION, SEQUENCE, STEP, FAILED, DEVELOPMENTS, SETTLED, PROBES,
    FRESH, TRIED, CONFIRMED, HOP, HOPS, RETURNED, CLIFFS, WARMED, JUMPS,
) = range(18)  # fmt: skip
N_COUNTERS = 18

# Places in an island's memory of the sequence search; the point's D places follow.
DAMPING, HORIZON, GROWTH, ROUGH, OLD, REACHED, POINT = range(7)

# Columns of an improvement; the D physical values follow.
AT_GENERATION, AT_EVALUATIONS, RMS, PHASE, VALUES = range(5)
START, GENETIC, LOCAL, MIGRATION = range(4)
PHASES: tuple[Phase, ...] = ("start", "genetic", "sequence", "migration")

SAME = 1e-4  # relative: champions this near in fitness are one optimum


class Plan(NamedTuple):
    """How one island searches, as compiled code reads it.

    Attributes
    ----------
    seed, island : int
        What its random numbers derive from.
    first, total : int
        Number of its first individual among the `total` of the archipelago.
    method : int
        One of `SIMPLE`, `PAPER`, `IMPROVED`, `IMPROVED_PAPER_STEPS`.
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
    first: int
    total: int
    method: int
    bits: int
    survivors: int
    stagnation: int
    relative: int
    evaluations: int
    beta: float
    rms: float
    loss_scale: float
    starts: IntArray
    rates: FloatArray
    progress: FloatArray
