"""Settling: whether something shows that the search missed no better minimum."""

from collections.abc import Callable, Iterator, Sequence

from sysid.core.findings import Finding, note
from sysid.core.settings import GeneticAlgorithm
from sysid.identifiability.active_bounds import ActiveBound
from sysid.results.parts import SearchEvidence
from sysid.search.island import get_island_settings
from sysid.uncertainty.estimates import Estimate

_NOTABLE_GAIN = 0.01  # of the squared error, by one step of least squares


def find_unsettled(
    evidence: SearchEvidence,
    estimates: Sequence[Estimate],
    holding: Callable[[], Sequence[ActiveBound]] = tuple,
    *,
    is_filter: bool = False,
) -> Iterator[Finding]:
    """Find a search that did not settle: nothing shows that its minimum is the best.

    `holding` finds the bounds that are the cause, if some are. Residuals beside a filter
    (`is_filter`) are no evidence.
    """
    if evidence.settled:
        return
    agreed = (
        "it made no independent starts"
        if evidence.independent_starts == 0
        else f"{evidence.agreeing_starts} of {evidence.independent_starts} independent starts "
        "ended in the best minimum"
    )
    white = "the residuals are not noise"
    residuals = "a filter leaves noise in any minimum" if is_filter else white
    bounds = holding()
    cause = f" Bounds are the cause: {', '.join(map(str, bounds))}." if bounds else ""
    yield Finding(
        "not settled",
        "search",
        "serious",
        "not settled",
        f"the search did not settle: {agreed}, and {residuals}. A better minimum may have been "
        f"missed, or the model is wrong.{cause}",
        "Repeat the search with another seed, more generations or other bounds, and compare the "
        "RMS.",
        parameters=tuple(one.name for one in estimates if one.is_free),
        status="not settled",
        reason="nothing shows that the search found the best minimum",
    )


def find_rough_end(
    algorithm: GeneticAlgorithm, gain: float, *, is_cut_short: bool, lacks_neighbours: bool
) -> Iterator[Finding]:
    """Find estimates that are no optimum, or whose surroundings were not searched."""
    if is_cut_short:
        yield note(
            "time limit",
            "search",
            "the time limit ended least squares before all islands' champions were refined. The "
            "estimate is the best so far and need not be the optimum. Allow more seconds, or use a "
            "shorter record.",
        )
    if lacks_neighbours:
        yield note(
            "no local search",
            "search",
            "the time limit left no search for minima near the estimate. Where the loss is rough, "
            "the intervals are too narrow.",
        )
    if gain > _NOTABLE_GAIN:
        methods = {get_island_settings(algorithm, i).method for i in range(algorithm.n_islands)}
        found = "" if "improved" in methods else f" ({', '.join(sorted(methods))}: as found)"
        yield note(
            "no optimum",
            "search",
            "the estimate is not a local optimum: one least-squares step would remove "
            f"{100 * gain:.0f} % of the squared error, so the standard errors are rough{found}",
        )
