"""Detection of feedback: records of a closed loop, where the input depends on the output.

In a closed loop noise reaches the input, and the best fit is biased towards minus the inverse of
the controller. Without a reference that excites the loop, the fit is nothing else (Ljung, System
Identification, 2nd ed., ch. 13.4). The residuals show it, because the controller reads them with
the output.

The input is predicted from its own past (least squares, 25 samples), once without and once with the
present and the last three residuals. The share of the remainder that the residuals explain is
compared with `_CLEAR_SHARE`. The tenth of the samples that the past predicts worst is excluded,
because a reference has jumped there.

There is no warning in these cases. An input that its past predicts completely, such as a sine or a
held input between jumps, leaves no remainder. White residuals do not predict the input, and
estimates of a free run are then unbiased.

An input that is interpolated linearly moves the output already before its next sample. If the noise
is small, unmodelled dynamics then look the same as feedback, and the warning names both.
"""

from collections.abc import Iterable

import numpy as np

from sysid.core.types import FloatArray, IntArray
from sysid.data.interpolation import interpolate_channel
from sysid.data.records import Channel
from sysid.residuals.autocorrelation import space_residuals
from sysid.residuals.residual_tests import ResidualSeries

# Measured: 0.90 to 1 with a linear controller; without one at most 0.5, mostly below 0.05.
_CLEAR_SHARE = 0.7
# One step ahead in an unstable plant: 0.23 to 0.90 with a controller.
_LIKELY_SHARE = 0.2
_PAST_SAMPLES = 25
_RECENT_RESIDUALS = 4  # including the present one
_QUIET_QUANTILE = 0.9
_MIN_REST = 1e-9  # of the input's variance: less is rounding
_RANK_TOLERANCE = 1e-9
_MAX_SAMPLES = 5_000
_SAMPLES_PER_COEFFICIENT = 4  # least number for each coefficient


def describe_feedback(series: Iterable[ResidualSeries]) -> list[str]:
    """Describe inputs that follow the residuals of an output, each pair once."""
    return [
        f"input {name!r} follows the residuals of {output}: they explain {100 * share:.0f} % "
        f"of what its past does not. {_describe_causes(channel)}"
        for (name, output), (share, channel) in _compute_shares(series).items()
        if share > _CLEAR_SHARE
    ]


def find_commands(series: Iterable[ResidualSeries], *, is_clear: bool = False) -> set[str]:
    """Find inputs that a controller seems to compute from an output: they follow its residuals.

    White residuals count too. They leave a free run unbiased, but the command is held. `is_clear`:
    only those that nothing else explains beside a stable plant.
    """
    least = _CLEAR_SHARE if is_clear else _LIKELY_SHARE
    return {name for (name, _), (share, _) in _compute_shares(series).items() if share > least}


def _compute_shares(
    series: Iterable[ResidualSeries],
) -> dict[tuple[str, str], tuple[float, Channel]]:
    """Compute the largest explained share of each pair of input and output, with its channel."""
    shares: dict[tuple[str, str], tuple[float, Channel]] = {}
    for residuals in series:
        for channel in residuals.inputs:
            pair, share = (
                (channel.name, residuals.output),
                compute_explained_share(residuals, channel),
            )
            if pair not in shares or share > shares[pair][0]:
                shares[pair] = share, channel
    return shares


def _describe_causes(channel: Channel) -> str:
    """Describe the possible causes: feedback, or dynamics that the model misses."""
    loop = (
        "In a closed loop noise drives the input. The estimates are then biased towards minus the "
        "inverse of the controller, and standard errors do not show it. Excite the loop by the "
        "reference, or identify in open loop. "
    )
    if channel.effective_hold == "zero":
        return (
            f"{loop}If there is no controller, the output responds at once and the model does not"
        )
    return (
        f"{loop}If there is no controller, the model misses part of the response within a sample, "
        "because the input is interpolated linearly. Check the order and the bounds of the model "
        "first"
    )


def compute_explained_share(series: ResidualSeries, channel: Channel) -> float:
    """Compute the share of the input's innovation that residuals explain; 0 if not testable."""
    times, residual = (
        series.times[series.scored][-_MAX_SAMPLES:],
        series.residual[series.scored][-_MAX_SAMPLES:],
    )
    if (
        times.size < _SAMPLES_PER_COEFFICIENT * (_PAST_SAMPLES + _RECENT_RESIDUALS)
        or not np.ptp(channel.values) > 0
    ):
        return 0.0
    spaced = space_residuals(times, residual)
    if not spaced.is_regular:
        return 0.0
    channel = channel.acting
    # A held input is read after its jump, not as the mean of both sides.
    after = 0.25 * spaced.period if channel.effective_hold == "zero" else 0.0
    values = interpolate_channel(channel, spaced.times + after)
    values = (values - np.mean(values)) / max(float(np.std(values)), np.finfo(float).tiny)
    scale = float(np.max(np.abs(spaced.values)))
    if not scale > 0:
        return 0.0
    rows = np.arange(_PAST_SAMPLES, values.size)
    present = np.all([spaced.present[rows - k] for k in range(_RECENT_RESIDUALS)], axis=0)
    past = _stack_lagged(values, rows, range(1, _PAST_SAMPLES + 1), constant=True)
    innovation = np.abs(_project_out(past, values[rows, None])[:, 0])
    usable = present & (innovation <= np.quantile(innovation, _QUIET_QUANTILE))
    if np.count_nonzero(usable) < _SAMPLES_PER_COEFFICIENT * (_PAST_SAMPLES + _RECENT_RESIDUALS):
        return 0.0
    recent = _stack_lagged(spaced.values / scale, rows, range(_RECENT_RESIDUALS))
    remainder = _project_out(past[usable], np.column_stack([values[rows], recent])[usable])
    unexplained = float(remainder[:, 0] @ remainder[:, 0])
    if not unexplained > _MIN_REST * remainder.shape[0]:
        return 0.0
    unpredicted = _project_out(remainder[:, 1:], remainder[:, :1])[:, 0]
    return 1.0 - float(unpredicted @ unpredicted) / unexplained


def _stack_lagged(
    values: FloatArray, rows: IntArray, lags: range, *, constant: bool = False
) -> FloatArray:
    columns = [values[rows - lag] for lag in lags]
    return np.column_stack([*columns, np.ones(rows.size)] if constant else columns)


def _project_out(columns: FloatArray, targets: FloatArray) -> FloatArray:
    """Compute the least-squares residuals of the targets on the columns."""
    coefficients = np.linalg.lstsq(columns, targets, rcond=_RANK_TOLERANCE)[0]
    return np.asarray(targets - columns @ coefficients)
