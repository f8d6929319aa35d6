"""When a run has ended at a border: its generations, the target, searches that agree, or rest."""

from typing import NamedTuple

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray
from sysid.search.state import SAME_OPTIMUM, SearchArray

_PARTS_OF_EACH, _EXTRA_AGREEMENTS = 2, 2
_LEAST_SHARE = 1 / 3  # of all searches
_CONFIRMED_SHARE, _MANY_STARTS = (
    0.5,
    2.5,
)  # of those from random places agree, or there are so many times enough
_CONFIRMED_SHARE_ROUGH = 2 / 3  # of the searches from random places, where the fitness jumps
_RETURNED_SHARE_ROUGH = 0.9  # of those from beside the best individual
_WARM_DIVISOR = 3  # of the searches that agree, a warm start needs one in three


class StoppingRule(NamedTuple):
    """End conditions that are looked at where all islands have got to a border.

    Attributes
    ----------
    generations : int
    rms : float
        Target; negative: none.
    settled : int
        Searches that agree; 0: they do not end a run.
    is_warm : bool
        Whether an earlier result stands behind the run.
    """

    most_generations: int
    target_rms: float
    agreed_restarts: int
    is_warm: bool


class RestartCounts(NamedTuple):
    """What the searches of all islands found, as far as it is the best champion.

    Attributes
    ----------
    independent, confirmed : int
        Searches that began at new random places, and how many of them led to it.
    hops, returned : int
        Searches from beside it, and how many of them led back.
    has_cliffs : bool
        Whether one of these has met jumps of the fitness.
    """

    independent: int
    confirmed: int
    hops: int
    returned: int
    has_discontinuities: bool


@jit_compile
def count_restarts(rms: FloatArray, search: SearchArray) -> RestartCounts:
    """Count them over islands with these champions' RMS (I,) and records (I,)."""
    independent = confirmed = hops = returned = 0
    has_cliffs, most = False, np.min(rms) * (1.0 + SAME_OPTIMUM)
    for i in range(rms.size):
        independent += search[i].random_starts
        if rms[i] <= most:
            confirmed += search[i].confirmed_starts
            hops += search[i].hop_count
            returned += search[i].returned_hops
            has_cliffs |= search[i].champion_discontinuities > 0
    return RestartCounts(independent, confirmed, hops, returned, has_cliffs)


@jit_compile
def has_process_ended(
    ends: StoppingRule, generation: int, rms: FloatArray, search: SearchArray, is_old: bool
) -> bool:
    """Whether one of the conditions holds at the border `generation`.

    `is_old`: nothing better was found in the second half of the generations. It matters behind a
    warm start alone.
    """
    if generation >= ends.most_generations or np.min(rms) <= ends.target_rms:
        return True
    if ends.agreed_restarts > 0 and _restarts_agree(
        ends.agreed_restarts, ends.is_warm, count_restarts(rms, search), is_old
    ):
        return True
    # Below the border only those islands stay that have used up their evaluations.
    return bool(np.all(search.generation < generation))


@jit_compile
def _restarts_agree(settled: int, is_warm: bool, made: RestartCounts, is_old: bool) -> bool:
    """Whether searches keep finding the best individual, from random places and from beside it.

    Had a better one as many ways that lead to it, all of k searches that found the best again and
    those that found others would have missed it with a probability below exp(-k). So where the
    fitness around is smooth, those that led to worse ones say nothing against the best, unless
    they are the most. Where it jumps, a better one nearby may draw few searches beside a wide one
    that draws many: then nearly all must agree.
    But what was found from beside the best says little of minima far away. So where fewer than
    half of those from random places agree, these must be many: at 5 of 14 one search in a hundred
    ended at twice the least RMS.
    Behind a warm start stands an earlier result. So a third of them is enough, and so it is that
    as many from random places, one from beside it (where the fitness jumps, as many) and the
    second half of the generations have found nothing better. Those from beside it alone would not
    do: around a false optimum they find nothing better.
    """
    if is_warm:
        beside = settled if made.has_discontinuities else 1
        if is_old and made.independent >= settled and made.hops >= beside:
            return True
        settled = -(-settled // _WARM_DIVISOR)
    if made.has_discontinuities:
        every = made.returned >= max(settled, _RETURNED_SHARE_ROUGH * made.hops)
        return every and made.confirmed >= max(settled, _CONFIRMED_SHARE_ROUGH * made.independent)
    again, enough = made.confirmed + made.returned, settled + _EXTRA_AGREEMENTS
    if min(made.confirmed, made.returned) < -(-settled // _PARTS_OF_EACH):
        return False
    agree = made.confirmed >= max(enough, _CONFIRMED_SHARE * made.independent)
    if not (is_warm or agree or made.independent >= _MANY_STARTS * enough):
        return False
    return again >= max(enough, _LEAST_SHARE * (made.independent + made.hops))
