"""Stopping rule: all generations, target RMS, agreement of restarts, or all islands at rest."""

from typing import NamedTuple

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray
from sysid.search.state import SAME_OPTIMUM, SearchArray

_PARTS_OF_EACH, _EXTRA_AGREEMENTS = 2, 2
_MIN_SHARE = 1 / 3  # of all restarts
# This share of the random restarts must agree, or there must be so many times the needed number.
_CONFIRMED_SHARE, _MANY_STARTS = 0.5, 2.5
_CONFIRMED_SHARE_ROUGH = 2 / 3  # of the random restarts, where the fitness jumps
_RETURNED_SHARE_ROUGH = 0.9  # of the restarts near the best individual, where the fitness jumps
_WARM_DIVISOR = 3  # a warm start needs one third of the agreeing restarts


class StoppingRule(NamedTuple):
    """Stopping conditions, checked when all islands have reached a border.

    Attributes
    ----------
    most_generations : int
    target_rms : float
        Negative: none.
    agreed_restarts : int
        Restarts that must agree; 0: agreement does not end a run.
    is_warm : bool
        Whether the run started from an earlier result.
    """

    most_generations: int
    target_rms: float
    agreed_restarts: int
    is_warm: bool


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
    """Return whether one of the stopping conditions holds at the border `generation`.

    `is_old`: the second half of the generations brought no improvement. It matters only for a warm
    start.
    """
    if generation >= rule.most_generations or np.min(rms) <= rule.target_rms:
        return True
    if rule.agreed_restarts > 0 and _restarts_agree(
        rule.agreed_restarts, rule.is_warm, count_restarts(rms, search), is_old
    ):
        return True
    # Only islands that have used up their evaluations stay below the border.
    return bool(np.all(search.generation < generation))


@jit_compile
def _restarts_agree(settled: int, is_warm: bool, restarts: RestartCounts, is_old: bool) -> bool:
    """Return whether restarts, random ones and nearby ones, keep leading to the best individual.

    Smooth fitness: suppose a better optimum attracted as many restarts as the best one. With k
    restarts that led to the best, all restarts would have missed it with probability below exp(-k).
    So restarts that led to worse optima do not count against the best, unless they are the
    majority.

    Smooth fitness, and residuals of the best that look like noise: nothing is left to explain. A
    better optimum could only fit the noise. So nearby restarts alone are enough.

    Fitness with jumps: a better optimum nearby may attract few restarts, next to a wide one that
    attracts many. Then nearly all restarts must agree.

    Restarts near the best say little about minima far away. So if fewer than half of the random
    restarts agree, there must be many of them. At 5 of 14, one search in a hundred ended at twice
    the least RMS.

    A warm start has an earlier result, so a third of the agreeing restarts is enough. It also ends
    if neither restarts nor the second half of the generations brought an improvement. This takes
    `settled` random restarts and one nearby restart, or `settled` nearby ones if the fitness jumps.
    Nearby restarts alone would not do: around a false optimum they bring no improvement.
    """
    if is_warm:
        needed_hops = settled if restarts.has_discontinuities else 1
        if is_old and restarts.independent >= settled and restarts.hops >= needed_hops:
            return True
        settled = -(-settled // _WARM_DIVISOR)
    if restarts.has_discontinuities:
        nearly_all_returned = restarts.returned >= max(
            settled, _RETURNED_SHARE_ROUGH * restarts.hops
        )
        return nearly_all_returned and restarts.confirmed >= max(
            settled, _CONFIRMED_SHARE_ROUGH * restarts.independent
        )
    agreed, enough = restarts.confirmed + restarts.returned, settled + _EXTRA_AGREEMENTS
    if restarts.is_explained and restarts.returned >= max(enough, _MIN_SHARE * restarts.hops):
        return True
    if min(restarts.confirmed, restarts.returned) < -(-settled // _PARTS_OF_EACH):
        return False
    is_confirmed = restarts.confirmed >= max(enough, _CONFIRMED_SHARE * restarts.independent)
    if not (is_warm or is_confirmed or restarts.independent >= _MANY_STARTS * enough):
        return False
    return agreed >= max(enough, _MIN_SHARE * (restarts.independent + restarts.hops))
