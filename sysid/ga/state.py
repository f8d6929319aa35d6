"""What compiled generations read and change: the plan of an island and its counters."""

from typing import NamedTuple

from sysid.result import Phase
from sysid.types import FloatArray, IntArray

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
