"""When a search ends: the list of all criteria, and those that are decided at a border.

A border is a generation at which all islands meet.

* *Generations* (`generations`): at the border that has this number; `has_search_ended`.
* *Target* (`stop.rms`): an island rests once its champion reaches it, and the run ends at the next
  border; `sysid.search.evolution.is_done` and `has_search_ended`.
* *Evaluations* (`stop.evaluations`): an island rests once it has used up its share
  (`sysid.search.island`), and the run ends when all rest; the same two functions.
* *Agreement* (`stop.settled`): at a border, if restarts meet one of the agreements below.
* *Seconds* (`stop.seconds`): after a compiled call; `sysid.identification.run.is_finished`. What
  follows the search has a deadline of its own (`sysid.identification.deadline`).

An agreement is one row of a table: counts of restarts that must lead to the champion, and the share
of all restarts that they must be. `list_agreements` has the rows, each with its reason.
"""

from functools import lru_cache
from math import ceil
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray, make_record_dtype
from sysid.search.island import get_target_rms
from sysid.search.state import SAME_OPTIMUM, SearchArray

# Sources: decision 22 and its notes, "First" to "Third stopping rule"; decisions 20 and 46.
_EXTRA_AGREEMENTS = 2  # to `settled` = 6: "4 to 12 confirmations: nothing missed" of 800 searches
_MIN_SHARE = 1 / 3  # of all restarts: those that led to worse optima are not the majority
_HALF_SHARE = 1 / 2  # of the random restarts; without `_MANY_STARTS` 2 of 923 stops were false
_MANY_STARTS = 2.5  # times the needed number; with 16 or 18 starts for 20, 1 of 829 was false
_RANDOM_SHARE_ROUGH = 2 / 3  # a wide optimum drew 13 of 16 searches next to a better narrow one
_NEARBY_SHARE_ROUGH = 0.9  # of hops; with the smooth rule 6 of 300 searches would stop too early
_WARM_DIVISOR = 3  # 6 becomes 2: the earlier result is evidence, too (decision 20)


class Agreement(NamedTuple):
    """A row of the table: restarts that together end a search. What is 0 or False asks nothing.

    Attributes
    ----------
    is_rough : bool
        The row is for fitness with jumps near the champion, or for smooth fitness.
    is_explained : bool
        Ask that the champion's residuals look like noise.
    is_old : bool
        Ask that the second half of the generations brought no improvement.
    confirmed, returned, both : int
        Least number of restarts that led to the champion: from random points, from near the
        champion, and together.
    confirmed_share, returned_share, both_share : float
        Least share of such restarts among all of their kind.
    independent, hops : int
        Least number of restarts from random points and from near the champion, wherever they led.
    """

    is_rough: bool
    is_explained: bool = False
    is_old: bool = False
    confirmed: int = 0
    returned: int = 0
    both: int = 0
    confirmed_share: float = 0.0
    returned_share: float = 0.0
    both_share: float = 0.0
    independent: int = 0
    hops: int = 0


_AGREEMENT = make_record_dtype(Agreement)

_AgreementArray: TypeAlias = Any
"""Array of agreements, as compiled code reads them."""


def list_agreements(settled: int, *, is_warm: bool) -> tuple[Agreement, ...]:
    """List the agreements of which one ends a search.

    Smooth fitness: suppose a better optimum attracted as many restarts as the best one. With k
    restarts that led to the best, all restarts would have missed it with probability below exp(-k).
    So restarts that led to worse optima do not count against the best, unless they are the
    majority.
    """
    # An earlier result is evidence, so a warm start needs a third of the restarts.
    least = ceil(settled / _WARM_DIVISOR) if is_warm else settled
    enough, half = least + _EXTRA_AGREEMENTS, ceil(least / 2)
    # A better optimum nearby may attract few restarts, next to a wide one that attracts many. So
    # nearly all of them must agree.
    rough = Agreement(
        is_rough=True,
        confirmed=least,
        confirmed_share=_RANDOM_SHARE_ROUGH,
        returned=least,
        returned_share=_NEARBY_SHARE_ROUGH,
    )
    # Nothing is left to explain: a better optimum could only fit the noise.
    explained = Agreement(
        is_rough=False, is_explained=True, returned=enough, returned_share=_MIN_SHARE
    )
    both = Agreement(
        is_rough=False, confirmed=half, returned=half, both=enough, both_share=_MIN_SHARE
    )
    if not is_warm:
        # Restarts near the best say little about minima far away. So if fewer than half of the
        # random restarts agree, there must be many of them.
        half_agree = both._replace(confirmed=enough, confirmed_share=_HALF_SHARE)
        many_tried = both._replace(independent=ceil(_MANY_STARTS * enough))
        return rough, explained, half_agree, many_tried
    # Nothing better came up. Nearby restarts alone would not do: around a false optimum they bring
    # no improvement.
    old = Agreement(is_rough=False, is_old=True, independent=settled, hops=1)
    return rough, explained, both, old, old._replace(is_rough=True, hops=settled)


class StoppingRule(NamedTuple):
    """Criteria that are asked when all islands have reached a border.

    Attributes
    ----------
    most_generations : int
    target_rms : float
        Negative: none.
    agreements : array of Agreement
        Empty: agreement does not end a run.
    """

    most_generations: int
    target_rms: float
    agreements: _AgreementArray


@lru_cache(maxsize=64)
def make_stopping_rule(algorithm: GeneticAlgorithm, *, is_warm: bool) -> StoppingRule:
    """Make the stopping rule of a run; `is_warm`: it started from an earlier result."""
    settled = algorithm.stop.settled
    agreements = () if settled is None else list_agreements(settled, is_warm=is_warm)
    rows = np.array([tuple(row) for row in agreements], _AGREEMENT)
    return StoppingRule(algorithm.generations, get_target_rms(algorithm), rows)


class RestartCounts(NamedTuple):
    """Restarts of all islands, and how many of them led to the best champion.

    Attributes
    ----------
    independent, confirmed : int
        Restarts from random points, and how many of them led to the champion.
    hops, returned : int
        Restarts near the champion, and how many of them led back.
    has_discontinuities : bool
        Whether an island with the best champion has met jumps of the fitness.
    is_explained : bool
        Whether the residuals of the best champion look like noise.
    """

    independent: int
    confirmed: int
    hops: int
    returned: int
    has_discontinuities: bool
    is_explained: bool


@jit_compile
def count_restarts(rms: FloatArray, search: SearchArray) -> RestartCounts:
    """Count the restarts of islands from their champions' RMS (I,) and search records (I,)."""
    independent = confirmed = hops = returned = 0
    has_discontinuities, is_explained = False, False
    largest_rms = np.min(rms) * (1.0 + SAME_OPTIMUM)
    for i in range(rms.size):
        independent += search[i].random_starts
        if rms[i] <= largest_rms:
            confirmed += search[i].confirmed_starts
            hops += search[i].hop_count
            returned += search[i].returned_hops
            has_discontinuities |= search[i].champion_discontinuities > 0
            is_explained |= search[i].champion_explained
    return RestartCounts(independent, confirmed, hops, returned, has_discontinuities, is_explained)


@jit_compile
def has_search_ended(
    rule: StoppingRule, generation: int, rms: FloatArray, search: SearchArray, is_old: bool
) -> bool:
    """Return whether one of the criteria holds at the border `generation`.

    `is_old`: the second half of the generations brought no improvement. It matters only for a warm
    start.
    """
    restarts = count_restarts(rms, search)
    # Only islands that have used up their evaluations stay below the border.
    all_rest = bool(np.all(search.generation < generation))
    return bool(
        generation >= rule.most_generations
        or np.min(rms) <= rule.target_rms
        or _restarts_agree(rule.agreements, restarts, is_old)
        or all_rest
    )


@jit_compile
def _restarts_agree(agreements: _AgreementArray, restarts: RestartCounts, is_old: bool) -> bool:
    """Return whether the restarts meet one of the agreements."""
    agrees = False
    for i in range(agreements.size):
        agrees |= _is_met(agreements[i], restarts, is_old)
    return agrees


@jit_compile
def _is_met(row: Agreement, restarts: RestartCounts, is_old: bool) -> bool:
    confirmed, independent = restarts.confirmed, restarts.independent
    returned, hops = restarts.returned, restarts.hops
    both, all_restarts = confirmed + returned, independent + hops
    return bool(
        row.is_rough == restarts.has_discontinuities
        and (restarts.is_explained or not row.is_explained)
        and (is_old or not row.is_old)
        and confirmed >= max(row.confirmed, row.confirmed_share * independent)
        and returned >= max(row.returned, row.returned_share * hops)
        and both >= max(row.both, row.both_share * all_restarts)
        and independent >= row.independent
        and hops >= row.hops
    )
