"""Schedule of the local searches: which kind comes next, as tables of named kinds.

The local searches of an island count from 1. The first four have rows of their own. Later ones
take their row from a cycle, by their number: from `SMOOTH_CYCLE`, or from `ROUGH_CYCLE` once the
fitness is known to jump. Better optima are then near the champion, so most searches are hops. Those
that grow from far away grow fast, so that they cost little (decisions 22, 28 and 47).

A row has three columns. `unsettled` holds until a search from the champion on the whole record has
ended, because later searches begin around it. Then `settled` holds, or `coloured` if the fitness
jumps and the champion's residuals are more than noise. An entry names three kinds, and each is
drawn in a third of the cases.
"""

from typing import NamedTuple, TypeAlias

from sysid.core.jit import jit_compile
from sysid.search.operators import RandomWords, to_integer, to_uniform
from sysid.search.state import SearchRecord

AT_CHAMPION, AT_INDIVIDUAL, AT_RANDOM_POINT = range(3)
"""Where a local search begins; an individual is drawn, a random point is the best of several."""
NO_HOP, HOP_ALONG_COVARIANCE, HOP_IN_ONE_PARAMETER = range(3)
"""How the start is moved away, by some standard errors (`sysid.search.basin_hopping`)."""
NO_GROWTH, FAST_GROWTH, SLOW_GROWTH = range(3)
"""How the fitted part of the record grows: not, by doubling, or by a drawn smaller factor."""
_SLOW_FACTORS = 3  # drawn: a half, a quarter or an eighth of a doubling


class LocalSearch(NamedTuple):
    """A kind of local search.

    Attributes
    ----------
    begins : int
        `AT_CHAMPION`, `AT_INDIVIDUAL` or `AT_RANDOM_POINT`.
    hop : int
        `NO_HOP`, `HOP_ALONG_COVARIANCE` or `HOP_IN_ONE_PARAMETER`.
    is_evidence : bool
        Whether a hop counts as a restart that confirms the champion, or does not.
    growth : int
        `NO_GROWTH`, `FAST_GROWTH` or `SLOW_GROWTH`.
    least_doublings, most_doublings : float
        From the first part that is fitted to the whole record; drawn in between.
    probes : int
        Points drawn around the estimate for every three individuals. Probes of a part are only
        tried. Three replace the individuals: they scatter the population around the champion.
    """

    begins: int
    hop: int = NO_HOP
    is_evidence: bool = False
    growth: int = NO_GROWTH
    least_doublings: float = 0.0
    most_doublings: float = 0.0
    probes: int = 0


Thirds: TypeAlias = tuple[LocalSearch, LocalSearch, LocalSearch]
"""Three kinds, each in a third of the cases."""


class Turn(NamedTuple):
    """A row of a schedule; `asks_residuals`: whether `coloured` differs from `settled`."""

    unsettled: Thirds
    settled: Thirds
    coloured: Thirds
    asks_residuals: bool


FROM_CHAMPION = LocalSearch(AT_CHAMPION)
FROM_RANDOM_POINT = LocalSearch(AT_RANDOM_POINT)
SCATTER = LocalSearch(AT_CHAMPION, probes=3)

HOP = LocalSearch(AT_CHAMPION, HOP_ALONG_COVARIANCE, is_evidence=True)
HOP_FROM_INDIVIDUAL = HOP._replace(begins=AT_INDIVIDUAL)
HOP_FROM_RANDOM_POINT = HOP._replace(begins=AT_RANDOM_POINT)
SINGLE_HOP = LocalSearch(AT_CHAMPION, HOP_IN_ONE_PARAMETER, is_evidence=True)

# Probes fill vector elements that would be idle.
GROW_FROM_CHAMPION = LocalSearch(AT_CHAMPION, growth=SLOW_GROWTH, most_doublings=4.0, probes=1)
GROW_FROM_INDIVIDUAL = GROW_FROM_CHAMPION._replace(begins=AT_INDIVIDUAL)
GROW_FROM_RANDOM_POINT = GROW_FROM_CHAMPION._replace(begins=AT_RANDOM_POINT)
GROW_FAST = LocalSearch(AT_RANDOM_POINT, growth=FAST_GROWTH, most_doublings=4.0)
GROW_FAST_FROM_FAR = GROW_FAST._replace(least_doublings=2.0)
# Near the champion the later signs of velocities are right, so a shorter growth is enough. It need
# not lead back where a better optimum lies near, so it is no evidence.
GROW_NEARBY = LocalSearch(AT_CHAMPION, HOP_IN_ONE_PARAMETER, growth=FAST_GROWTH, most_doublings=1.5)


def _always(kind: LocalSearch) -> Thirds:
    return kind, kind, kind


def _make_turn(
    unsettled: LocalSearch | Thirds,
    settled: LocalSearch | Thirds,
    coloured: LocalSearch | None = None,
) -> Turn:
    """Make a row; a single kind is drawn always."""
    thirds = [
        _always(entry) if isinstance(entry, LocalSearch) else entry
        for entry in (unsettled, settled, settled if coloured is None else coloured)
    ]
    return Turn(thirds[0], thirds[1], thirds[2], coloured is not None)


FIRST_TURNS = (
    _make_turn(FROM_CHAMPION, FROM_CHAMPION),
    _make_turn(FROM_RANDOM_POINT, FROM_RANDOM_POINT),
    _make_turn(FROM_RANDOM_POINT, FROM_RANDOM_POINT),
    _make_turn(GROW_FAST, GROW_FAST),
)
"""Cheap local searches in immediate succession, before the long ones."""

FIRST_WARM_TURNS = (
    *FIRST_TURNS[:-1],
    _make_turn(GROW_FAST, (HOP_FROM_RANDOM_POINT, HOP_FROM_INDIVIDUAL, HOP)),
)
"""The same after a warm start: a hop confirms or refutes the earlier result sooner."""

SMOOTH_CYCLE = (
    _make_turn(
        (GROW_FROM_RANDOM_POINT, GROW_FROM_INDIVIDUAL, GROW_FROM_CHAMPION),
        (GROW_FROM_RANDOM_POINT, GROW_FROM_INDIVIDUAL, HOP),
    ),
    _make_turn(FROM_CHAMPION, HOP),
    _make_turn(
        (GROW_FROM_RANDOM_POINT, GROW_FROM_INDIVIDUAL, GROW_FROM_CHAMPION),
        (GROW_FROM_RANDOM_POINT, GROW_FROM_INDIVIDUAL, HOP),
    ),
    _make_turn(FROM_CHAMPION, SCATTER),
)
"""Where the fitness is smooth: the row of a search is its number modulo 4."""

ROUGH_CYCLE = (
    _make_turn(FROM_CHAMPION, (GROW_FROM_INDIVIDUAL, GROW_FAST, GROW_FAST)),
    _make_turn(FROM_CHAMPION, HOP),
    _make_turn(FROM_CHAMPION, SCATTER),
    _make_turn(FROM_CHAMPION, SINGLE_HOP, coloured=GROW_FAST_FROM_FAR),
    _make_turn(FROM_CHAMPION, GROW_NEARBY),
    _make_turn(FROM_CHAMPION, HOP, coloured=GROW_FAST_FROM_FAR),
    _make_turn(FROM_CHAMPION, SCATTER),
    _make_turn(FROM_CHAMPION, SINGLE_HOP, coloured=GROW_FAST_FROM_FAR),
)
"""Where the fitness jumps: the row of a search is its number modulo 8."""

EARLY_SEARCHES = len(FIRST_TURNS)


@jit_compile
def _follows_rough_cycle(search: SearchRecord) -> bool:
    return search.fitness_discontinuities > 0 and search.local_searches > EARLY_SEARCHES


@jit_compile
def _get_rough_turn(search: SearchRecord) -> Turn:
    return ROUGH_CYCLE[search.local_searches % len(ROUGH_CYCLE)]


@jit_compile
def _get_turn(search: SearchRecord) -> Turn:
    """Get the row of this local search."""
    number = search.local_searches
    if number <= EARLY_SEARCHES:
        return FIRST_WARM_TURNS[number - 1] if search.is_warm_start else FIRST_TURNS[number - 1]
    if _follows_rough_cycle(search):
        return _get_rough_turn(search)
    return SMOOTH_CYCLE[number % len(SMOOTH_CYCLE)]


@jit_compile
def has_scattered(search: SearchRecord) -> bool:
    """Return whether the rough cycle scatters at the last local search, whichever is followed."""
    return bool(_get_rough_turn(search).settled[0].probes == SCATTER.probes)


@jit_compile
def asks_residuals(search: SearchRecord) -> bool:
    """Return whether this turn depends on the residuals of a settled champion."""
    return bool(
        _get_rough_turn(search).asks_residuals
        and search.champion_converged
        and search.fitness_discontinuities > 0
    )


@jit_compile
def choose_local_search(
    size: int, word: RandomWords, is_coloured: bool, search: SearchRecord
) -> tuple[LocalSearch, int]:
    """Choose the kind of this local search; return it and the individual that it may begin at.

    Parameters
    ----------
    size : int
        Individuals of the island.
    word : RandomWords
        Four words that belong to this local search.
    is_coloured : bool
        Whether the champion's residuals are more than noise, where the turn asks for it.
    """
    turn = _get_turn(search)
    thirds = turn.unsettled
    if search.champion_converged:
        thirds = turn.coloured if is_coloured else turn.settled
    drawn = to_integer(word[1], 3 * size)
    third, individual = drawn // size, drawn % size
    if _follows_rough_cycle(search):
        individual = to_integer(word[2], size)
    return thirds[third], individual


@jit_compile
def begin_growth(kind: LocalSearch, word: RandomWords, search: SearchRecord) -> None:
    """Draw the part of the record that a local search fits first, and how it grows."""
    span = kind.most_doublings - kind.least_doublings
    search.horizon = 0.5 ** (kind.least_doublings + span * to_uniform(word[0]))
    if kind.growth == FAST_GROWTH:
        search.horizon_growth = 2.0
    elif kind.growth == SLOW_GROWTH:
        search.horizon_growth = 2.0 ** (0.5 ** (1 + to_integer(word[3], _SLOW_FACTORS)))
    search.wide_differences = (
        kind.growth != NO_GROWTH or search.champion_converged or _follows_rough_cycle(search)
    )
