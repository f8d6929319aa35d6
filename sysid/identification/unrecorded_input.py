"""Test whether the estimates depend on input from before the record.

For t < L a model reads the input from before the record's first sample. If that was not recorded,
its first value is assumed. This is right for a plant at rest, and a guess for any other record.

Without the samples that read the assumed input, the estimate would move by -(S'ᵀS')⁻¹S'ᵀe'. Here
S' and e' are the sensitivities and residuals of the other samples (one Gauss-Newton step; Cook
1977). If one estimate uses a part of the data of another, the variance of their difference is the
difference of their variances (Hausman 1978). A far larger move shows that these samples do not fit
the others. Only then is the model fitted again without them, and the move is reported.
"""

import numpy as np

from sysid.core.errors import InvalidRecord
from sysid.core.linear_algebra import truncated_svd
from sysid.core.types import RANK_TOLERANCE, BoolArray, FloatArray
from sysid.data.records import Channel, Record
from sysid.kernels.reads import list_delayed_values
from sysid.models.delays import compute_longest_delay, list_past_values
from sysid.models.model import EstimatedInitial
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis, compute_physical_scale
from sysid.uncertainty.estimates import Estimate

_NOTABLE_MOVE = 1.0  # of a standard error
_UNLIKELY_MOVE = 4.0  # deviations of the difference of both estimates
_MIN_SAMPLES_PER_PARAMETER = 2  # samples for each parameter, that are left
_MAX_STEPS = 30  # of least squares, with as many simulations as there are parameters and one


def warn_unrecorded_input(problem: Problem, analysis: Analysis) -> list[str]:
    """Warn about estimates that change without the samples that read an assumed input."""
    if (
        analysis.residuals_and_sensitivities is None
        or analysis.linear_model is None
        or problem.prediction != "simulation"
    ):
        return []  # whitened, or not of squares
    if analysis.is_cut_short:
        return []  # the time is over
    if not all(isinstance(initial, EstimatedInitial) for initial in problem.model.initial):
        return []  # a fixed start carries the effect of the assumption into the other samples
    parts = find_assumed_samples(problem, analysis)
    assumed = np.concatenate(parts)[problem.scored_rows]
    count = int(np.count_nonzero(assumed))
    left = assumed.size - count
    if not count or left <= _MIN_SAMPLES_PER_PARAMETER * len(problem.free_parameters):
        return []
    if not _would_move(problem, analysis, assumed):
        return []
    moves = _describe_moves(problem, analysis, _refit_without_assumed(problem, analysis))
    if not moves:
        return []
    subject, pronoun = (
        ("one sample reads", "it") if count == 1 else (f"{count} samples read", "them")
    )
    return [
        f"{subject} an input from before the record, which was not recorded. Its first value is "
        f"assumed there. Without {pronoun} {', '.join(moves)}. Give the input before the record "
        "(trim a longer recording, or put rows with an empty output before it), or skip: "
        f"{max(int(np.count_nonzero(part)) for part in parts)}"
    ]


def find_assumed_samples(problem: Problem, analysis: Analysis) -> list[BoolArray]:
    """Mark the samples of every output that read an input from before its recorded part."""
    return [
        channel.times < until
        for record, until in zip(
            problem.records, _find_recorded_starts(problem, analysis), strict=True
        )
        for channel in _order_outputs(problem, record)
    ]


def _order_outputs(problem: Problem, record: Record) -> list[Channel]:
    channels = {channel.name: channel for channel in record.outputs}
    return [channels[output.name] for output in problem.model.outputs]


def _find_recorded_starts(problem: Problem, analysis: Analysis) -> list[float]:
    """Find the time (s) in each experiment from which only recorded inputs are read."""
    reach = _compute_longest_input_delay(problem, analysis)
    return [
        experiment.grid.start + reach - record.history_duration
        for record, experiment in zip(problem.records, problem.experiments, strict=True)
    ]


def _compute_longest_input_delay(problem: Problem, analysis: Analysis) -> float:
    """Compute how far (s) the estimated time lags of inputs reach back."""
    if not list_delayed_values(problem.model, "input"):
        return 0.0
    spans = {estimate.name: (estimate.value, estimate.value) for estimate in analysis.estimates}
    step = problem.experiments[0].grid.integration_step
    return max(
        compute_longest_delay(problem.model, past, spans, step)
        for past in list_past_values(problem.model)
        if past.kind == "input"
    )


def _would_move(problem: Problem, analysis: Analysis, assumed: BoolArray) -> bool:
    """Whether a step without these samples moves an estimate by far more than chance."""
    if analysis.residuals_and_sensitivities is None:
        return False
    error, columns = analysis.residuals_and_sensitivities
    recorded = columns[~assumed]
    move = -np.linalg.lstsq(recorded, error[~assumed], rcond=RANK_TOLERANCE)[0]
    by_all, by_recorded = _compute_variances(columns), _compute_variances(recorded)
    scale = compute_physical_scale(problem, _to_theta(problem, analysis))
    for d, estimate in enumerate(_select_identified(problem, analysis)):
        if estimate is None or not estimate.stderr or not 0.0 < by_all[d] < np.inf:
            continue
        chance = np.sqrt(max(by_recorded[d] / by_all[d] - 1.0, 0.0))
        if abs(move[d] * scale[d]) / estimate.stderr > max(_NOTABLE_MOVE, _UNLIKELY_MOVE * chance):
            return True
    return False


def _select_identified(problem: Problem, analysis: Analysis) -> list[Estimate | None]:
    """List the identified estimates in the order of the free parameters (D,); None for others."""
    names = {estimate.name for estimate in problem.model.parameters}
    by_name = {
        estimate.name: estimate
        for estimate in analysis.estimates
        if estimate.status == "identified"
    }
    return [by_name.get(name) if name in names else None for name in problem.free_names]


def _to_theta(problem: Problem, analysis: Analysis) -> FloatArray:
    by_name = {estimate.name: estimate.value for estimate in analysis.estimates}
    return np.array([by_name[name] for name in problem.free_names])


def _refit_without_assumed(problem: Problem, analysis: Analysis) -> FloatArray:
    """Fit the other samples, from the estimate (D,) on; return the estimate if that fails."""
    theta = _to_theta(problem, analysis)
    scored_from = problem.settings.scored_from or [-np.inf] * len(problem.records)
    from_then = zip(_find_recorded_starts(problem, analysis), scored_from, strict=True)
    try:
        others = problem.rebuild(
            weights=problem.output_weights, scored_from=tuple(max(pair) for pair in from_then)
        )
    except InvalidRecord:  # of one record nothing would be left
        return theta
    (end,) = refine_candidates(others, [theta], _MAX_STEPS * (theta.size + 1))
    return theta if end is None else end.theta


def _describe_moves(problem: Problem, analysis: Analysis, end: FloatArray) -> list[str]:
    """Describe estimates that would change, with their moves in standard errors."""
    moves = []
    for estimate, value in zip(_select_identified(problem, analysis), end.tolist(), strict=True):
        if estimate is None or not estimate.stderr:
            continue
        shift = abs(value - estimate.value) / estimate.stderr
        if shift > _NOTABLE_MOVE:
            moves.append(
                f"{estimate.name} is {value:.4g} instead of {estimate.value:.4g}, {shift:.2g} of "
                "its standard errors away"
            )
    return moves


def _compute_variances(columns: FloatArray) -> FloatArray:
    """Compute the diagonal of (SᵀS)⁻¹, (D,); inf for parameters that these rows leave open."""
    triangle = np.asarray(np.linalg.qr(columns, mode="r"))  # of a long record in half the time
    _, singular, rows, retained = truncated_svd(triangle)
    variances: FloatArray = np.sum((rows[retained].T / singular[retained]) ** 2, axis=1)
    is_open = np.max(np.abs(rows[~retained]), axis=0, initial=0.0) > RANK_TOLERANCE
    return np.where(is_open, np.inf, variances)
