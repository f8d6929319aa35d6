"""Whether more is to be found far from the champion, and whether a start far away leads nowhere.

Both compare with nothing but the champion's own errors, so no scale enters.
"""

from sysid.ga.chromosome import decoded, located
from sysid.ga.gauss_newton import partial_fitness
from sysid.ga.state import EVALUATIONS, Plan
from sysid.kernels.caching import compiled
from sysid.kernels.evaluation import partial_predictions
from sysid.kernels.evaluator import Evaluator
from sysid.types import FloatArray, IntArray, WordArray

COLOURED = 0.5  # correlation of neighbouring errors: noise has none, a wrong response nearly 1


@compiled
def _champion(
    evaluator: Evaluator, plan: Plan, words: WordArray, horizon: float, counters: IntArray
) -> FloatArray:
    """Predictions (M, 1 or more) of the champion up to that part of the record."""
    counters[EVALUATIONS] += 1
    champion = located(evaluator, decoded(words[:1], plan.bits))
    return partial_predictions(evaluator, champion, horizon)


@compiled
def is_coloured(evaluator: Evaluator, plan: Plan, words: WordArray, counters: IntArray) -> bool:
    """Whether the champion's errors go together with their neighbours: a simulation.

    Then far more than noise is left to explain. Neighbours are so in the list of measured values.
    """
    predicted = _champion(evaluator, plan, words, 1.0, counters)
    products, squares, last = 0.0, 0.0, 0.0
    for m in range(predicted.shape[0]):
        if evaluator.weight[m] != 0.0:
            error = evaluator.weight[m] * (predicted[m, 0] - evaluator.measured[m])
            products += error * last
            squares += error * error
            last = error
    return bool(products > COLOURED * squares)


@compiled
def is_behind(
    evaluator: Evaluator, plan: Plan, words: WordArray, counters: IntArray, horizon: float,
    reached: float,
) -> bool:  # fmt: skip
    """Whether the champion fits a part better than what was fitted to it: a simulation.

    Not where the budget ends.
    """
    if counters[EVALUATIONS] >= plan.evaluations:
        return False
    predicted = _champion(evaluator, plan, words, horizon, counters)
    return bool(partial_fitness(evaluator, plan, predicted, horizon)[0] < reached)
