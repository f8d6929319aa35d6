"""Test whether the estimates depend on input from before the record.

For t < L a model reads the input from before the record's first sample. If that was not recorded,
its first value is assumed. This is right for a plant at rest, and a guess for any other record.

Without the samples that read the assumed input, the estimate would move by -(S'ᵀS')⁻¹S'ᵀe'. Here
S' and e' are the sensitivities and residuals of the other samples (one Gauss-Newton step; Cook
1977). If one estimate uses a part of the data of another, the variance of their difference is the
difference of their variances (Hausman 1978). A far larger move shows that these samples do not fit
the others. Only then is the model fitted again without them, and the move is reported.

The assumption also decides between minima: a longer time lag reads the assumed input for longer.
If the data contradict it (predictive test of Chow, Econometrica 28 (1960) 591), the minima are
compared again on the samples that read recorded input with every time lag in question. So are they
if the estimate reads no assumed input, because then no sample supports the assumption.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sysid.core.distributions import f_tail
from sysid.core.errors import InvalidRecord
from sysid.core.findings import Finding
from sysid.core.types import BoolArray, FloatArray
from sysid.data.records import Channel, Record
from sysid.judgement.levels import UNLIKELY
from sysid.kernels.signals.past_reads import list_delayed_values
from sysid.language.functions import Interval
from sysid.minima.minima import Fit, collect_minima, scan_parameters
from sysid.models.model_delays import compute_longest_delay, list_past_values
from sysid.results.parts import Minimum
from sysid.search.refine import RefinedCandidate, refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis

_NAME = "input before the record"
GIVE_HISTORY = (
    "Give the input before the record: trim a longer recording, or put rows with an empty output "
    "before it."
)
_MIN_SAMPLES_PER_PARAMETER = 2  # samples for each parameter, that are left
_CONTRADICTION = 3.0  # mean square of samples that read assumed input, over that of the others
_RELEASE = 1e6  # times their range
_MAX_STEPS = 30  # of least squares, with as many simulations as there are parameters and one


def find_unrecorded_input(
    problem: Problem,
    analysis: Analysis,
    explained: Sequence[Finding],
    *,
    is_contradicted: bool,
) -> Iterator[Finding]:
    """Find an assumed input before the record that the data contradict, unless it is explained.

    `is_contradicted` is that of `compare_where_recorded`.
    """
    if not is_contradicted or any(one.explanation == _NAME for one in explained):
        return
    parts = find_assumed_samples(problem, analysis)
    most = max(int(np.count_nonzero(part)) for part in parts)
    yield Finding(
        _NAME,
        "history",
        "note",
        "the input moved before the record",
        "samples at the start of the record read an input from before it, which was not recorded. "
        "Its first value is assumed there, and the data contradict it.",
        f"{GIVE_HISTORY} Or use skip: {most}.",
    )


def find_assumed_samples(problem: Problem, analysis: Analysis) -> list[BoolArray]:
    """Mark the samples of every output that read an input from before its recorded part."""
    reach = compute_reach(problem, analysis)
    return [
        channel.times < until
        for record, until in zip(
            problem.records, _find_recorded_starts(problem, reach), strict=True
        )
        for channel in _order_outputs(problem, record)
    ]


def _order_outputs(problem: Problem, record: Record) -> list[Channel]:
    channels = {channel.name: channel for channel in record.outputs}
    return [channels[output.name] for output in problem.model.outputs]


def _find_recorded_starts(problem: Problem, reach: float) -> list[float]:
    """Find the time (s) in each experiment from which a lag of `reach` reads recorded inputs."""
    return [
        experiment.grid.start + reach - record.history_duration
        for record, experiment in zip(problem.records, problem.experiments, strict=True)
    ]


def compute_reach(problem: Problem, analysis: Analysis) -> float:
    """Compute how far (s) the time lags of inputs reach back at the estimate."""
    spans = {one.name: (one.value, one.value) for one in analysis.estimates}
    return _compute_longest_input_delay(problem, spans)


def _compute_longest_input_delay(problem: Problem, spans: Mapping[str, Interval]) -> float:
    """Compute how far (s) the time lags of inputs reach back at most, inside these bounds."""
    if not list_delayed_values(problem.model, "input"):
        return 0.0
    step = problem.experiments[0].grid.integration_step
    return max(
        compute_longest_delay(problem.model, past, {**spans, **problem.delaying_ranges}, step)
        for past in list_past_values(problem.model)
        if past.kind == "input"
    )


def _select_recorded(
    problem: Problem, reach: float, parameters: Mapping[str, Mapping[str, Any]] | None = None
) -> Problem | None:
    """Score only samples that read recorded inputs; None if one record would be left empty."""
    scored_from = problem.settings.scored_from or [-np.inf] * len(problem.records)
    from_then = zip(_find_recorded_starts(problem, reach), scored_from, strict=True)
    try:
        return problem.rebuild(
            weights=problem.output_weights,
            scored_from=tuple(max(pair) for pair in from_then),
            parameters={**problem.settings.parameters, **(parameters or {})},
        )
    except InvalidRecord:
        return None


def _leaves_samples_out(problem: Problem, reach: float) -> bool:
    """Whether some scored sample reads an input from before its recorded part."""
    starts = _find_recorded_starts(problem, reach)
    weights = problem.split_by_output(problem.evaluator.weight)
    return any(
        bool(np.any(channel.times[weight[channel.name] > 0] < start))
        for record, start, weight in zip(problem.records, starts, weights, strict=True)
        for channel in _order_outputs(problem, record)
    )


def _release_initial_states(problem: Problem) -> dict[str, dict[str, Any]]:
    """Widen the bounds of initial states: these make up for an input that is assumed wrongly."""
    declared = {parameter.name for parameter in problem.model.parameters}
    return {
        one.name: {
            **problem.settings.parameters.get(one.name, {}),
            "lower": one.lower - _RELEASE * (one.upper - one.lower),
            "upper": one.upper + _RELEASE * (one.upper - one.lower),
        }
        for one in problem.free_parameters
        if one.name not in declared
    }


class RecordedComparison(NamedTuple):
    """Minima compared where the input is recorded, and the simulations spent.

    `is_contradicted`: the data contradict the input that is assumed before the record.
    """

    minima: tuple[Minimum, ...] = ()
    evaluations: int = 0
    is_contradicted: bool = False


def compare_where_recorded(
    problem: Problem,
    theta: FloatArray,
    analysis: Analysis,
    delays: Sequence[int],
    budget: int,
    is_late: Callable[[], bool],
) -> RecordedComparison:
    """Compare minima where the input is recorded, unless the data support the input assumed before.

    It takes about `budget` simulations at most. There are no minima if the assumption holds, or if
    too little is recorded. Time lags are compared up to half of the shortest record.
    """
    assumed = np.concatenate(find_assumed_samples(problem, analysis))[problem.scored_rows]
    if not delays or not problem.is_free_run:
        return RecordedComparison()
    if assumed.any() and not _may_contradict(analysis, assumed):
        return RecordedComparison()
    evaluator = problem.evaluator
    spans = {one.name: (one.value, one.value) for one in analysis.estimates}
    ends = zip(evaluator.lower.tolist(), evaluator.upper.tolist(), strict=True)
    spans |= dict(zip(problem.free_names, ends, strict=True))
    shortest = min(record.duration for record in problem.records)
    reach = min(_compute_longest_input_delay(problem, spans), 0.5 * shortest)
    if not _leaves_samples_out(problem, reach):
        return RecordedComparison()  # no time lag in question reads an assumed input
    others = _select_recorded(problem, reach, _release_initial_states(problem))
    if others is None or others.n_scored <= _MIN_SAMPLES_PER_PARAMETER * theta.size:
        return RecordedComparison()
    (end,) = refine_candidates(others, [theta], min(budget, _MAX_STEPS * (theta.size + 1)))
    is_contradicted = end is not None and _is_contradicted(problem, end, others, assumed)
    if end is None or not (is_contradicted or not assumed.any()):
        return RecordedComparison(evaluations=0 if end is None else end.evaluations)
    left = budget - end.evaluations
    scanned = scan_parameters(others, end, delays, left, is_late, only_delays=True)

    def reaches_back(values: FloatArray) -> float:
        found = zip(problem.free_names, values.tolist(), strict=True)
        return _compute_longest_input_delay(
            problem, spans | {name: (value, value) for name, value in found}
        )

    kept = [Fit(one.theta, one.rms) for one in scanned.ends if reaches_back(one.theta) <= reach]
    since = _find_recorded_starts(problem, reach)[0] - problem.records[0].start
    return RecordedComparison(
        collect_minima(others, kept, recorded_from=since),
        end.evaluations + scanned.evaluations,
        is_contradicted,
    )


def _may_contradict(analysis: Analysis, assumed: BoolArray) -> bool:
    """Whether samples that read an assumed input (n,) fit far worse than the others."""
    if analysis.residuals_and_sensitivities is None or not assumed.any() or assumed.all():
        return False
    error = analysis.residuals_and_sensitivities[0]
    return bool(np.mean(error[assumed] ** 2) > _CONTRADICTION * np.mean(error[~assumed] ** 2))


def _is_contradicted(
    problem: Problem, end: RefinedCandidate, others: Problem, assumed: BoolArray
) -> bool:
    """Whether samples that read an assumed input (n,) do not follow from a fit of the others."""
    if not assumed.any():
        return False
    error = problem.compute_residuals(end.theta[None])[0][assumed]
    degrees = others.n_scored - end.theta.size
    count = int(np.count_nonzero(assumed))
    variance = end.rms**2 * others.n_scored / degrees
    if variance <= 0:
        return bool(np.any(error != 0))
    ratio = float(np.mean(error**2)) / variance
    return f_tail(count, degrees, ratio) < UNLIKELY
