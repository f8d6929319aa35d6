"""Whether a search settled: whether something shows that no better minimum was missed.

Either at least two searches from random points ended in the best minimum, or nothing but noise is
left in the residuals, or they are negligible. A false minimum leaves a part of the response in
them. Searches that start near the best individual show nothing: they return to a false minimum as
well. Nor do the innovations of a filter: with a large load they are white in any minimum.
"""

from typing import Literal

from sysid.islands.run_state import RunState
from sysid.islands.stopping import count_restarts
from sysid.minima.minima import FoundMinima
from sysid.residuals.residual_tests import ResidualTests
from sysid.results.parts import SearchEvidence
from sysid.simulation.problem import Problem

_ENOUGH_STARTS = 2  # that agree
_UNLIKELY = 1e-3  # probability of such residuals if they are noise
_NEGLIGIBLE_SHARE = 1e-3  # of the output: a false minimum leaves more


def assess_search(
    problem: Problem,
    state: RunState,
    rms: float,
    tests: ResidualTests | None,
    minima: FoundMinima,
) -> SearchEvidence:
    """Assess the evidence that the estimate, with its RMS and residual tests, is the best."""
    restarts = count_restarts(*state.champions_and_counters)
    because: Literal["starts", "residuals"] | None = None
    if minima.agreeing >= _ENOUGH_STARTS:
        because = "starts"
    elif not problem.model.corrections and is_explained(problem, rms, tests):
        because = "residuals"
    return SearchEvidence(
        because is not None,
        because,
        restarts.independent + minima.projected,
        minima.agreeing,
        minima.minima,
    )


def is_explained(problem: Problem, rms: float, tests: ResidualTests | None) -> bool:
    """Whether the residuals are negligible, or no test of them finds anything but noise.

    False if they are not negligible and no test was possible.
    """
    if rms <= _NEGLIGIBLE_SHARE * problem.output_scale:
        return True
    known = [] if tests is None else [test.p for test in tests.tests if test.p is not None]
    return bool(known) and min(known) > _UNLIKELY
