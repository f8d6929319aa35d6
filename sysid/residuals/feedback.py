"""Whether an input was made from the output: a record of a closed loop.

There noise reaches the input, and what fits the record best leans towards minus the inverse of the
controller; without a reference that excites the loop it is nothing else (Ljung, System
Identification, 2nd ed., ch. 13.4). The residuals show it: a controller reads them with the output.

An input is told by its own past as far as that goes (least squares, 25 samples), once without and
once with the residuals of now and the last three samples. What they tell of the rest is compared
with `_CLEAR_SHARE`. Samples at which the input does what its past tells least, a tenth of them, are
left out: there a reference has jumped. An input whose past tells all of it, such as a sine, or one
that is held between jumps, leaves no rest, and nothing is said. One that is read as straight
between its samples moves the output by the next one: there what a model misses looks the same,
where noise is small beside it, and both are told. Nothing is said where residuals are white either:
the noise of now does not tell what the input was, and a free run's estimates are unbiased.
"""

from collections.abc import Iterable

import numpy as np

from sysid.core.types import FloatArray, IntArray
from sysid.data.interpolation import interpolate_channel
from sysid.data.records import Channel
from sysid.residuals.autocorrelation import space_residuals
from sysid.residuals.residual_tests import ResidualSeries

_CLEAR_SHARE = (
    0.7  # measured: 0.90 to 1 with a linear controller, 0.5 at most without, mostly below 0.05
)
_PAST_SAMPLES = 25
_RECENT_RESIDUALS = 4  # residuals, the present one among them
_QUIET_QUANTILE = 0.9
_LEAST_REST = 1e-9  # of the input's variance: less is rounding
_RANK_TOLERANCE = 1e-9
_MOST_SAMPLES = 5_000
_SAMPLES_PER_COEFFICIENT = 4  # samples for each coefficient, at least


def describe_feedback(
    series: Iterable[ResidualSeries], *, advises_noise_model: bool = False
) -> list[str]:
    """What to say of inputs that follow the residuals of an output, each pair once."""
    found: dict[tuple[str, str], tuple[float, Channel]] = {}
    for one in series:
        for channel in one.inputs:
            pair, share = (channel.name, one.output), compute_explained_share(one, channel)
            if pair not in found or share > found[pair][0]:
                found[pair] = share, channel
    return [
        f"input {name!r} follows the residuals of {output}: they tell {100 * share:.0f} % of what "
        f"its own past does not. {_describe_causes(channel, advises_noise_model)}"
        for (name, output), (share, channel) in found.items()
        if share > _CLEAR_SHARE
    ]


def _describe_causes(channel: Channel, advises_noise_model: bool) -> str:
    """What that may come from: of an input that is not held, its way to the next sample as well."""
    is_held = channel.hold == "zero"
    # No noise model is for dynamics that a model misses, which may be the cause otherwise.
    advice = " and use loss: {noise_model: ar1}" if advises_noise_model and is_held else ""
    loop = (
        "In a closed loop noise drives the input, the estimates lean towards minus the inverse of "
        "the controller, and standard errors do not tell that: let the reference excite the loop"
        f"{advice}, or identify in an open one. "
    )
    if is_held:
        return f"{loop}If there is no controller, the output answers at once and the model does not"
    return (
        f"{loop}If there is no controller, the model misses some of how the output answers within "
        "a sample, since the input is read as going straight from one to the next: look at its "
        "order and bounds first"
    )


def compute_explained_share(one: ResidualSeries, channel: Channel) -> float:
    """Part of the input's variance beyond its own past that residuals tell; 0 if not testable."""
    times, residual = (
        one.times[one.scored][-_MOST_SAMPLES:],
        one.residual[one.scored][-_MOST_SAMPLES:],
    )
    if (
        times.size < _SAMPLES_PER_COEFFICIENT * (_PAST_SAMPLES + _RECENT_RESIDUALS)
        or not np.ptp(channel.values) > 0
    ):
        return 0.0
    laid = space_residuals(times, residual)
    if not laid.is_regular:
        return 0.0
    # Of a held input the value from each sample on, not the mean of both sides of its jump.
    after = 0.25 * laid.period if channel.hold == "zero" else 0.0
    values = interpolate_channel(channel, laid.times + after)
    values = (values - np.mean(values)) / max(float(np.std(values)), np.finfo(float).tiny)
    scale = float(np.max(np.abs(laid.values)))
    if not scale > 0:
        return 0.0
    rows = np.arange(_PAST_SAMPLES, values.size)
    present = np.all([laid.present[rows - k] for k in range(_RECENT_RESIDUALS)], axis=0)
    own = _stack_lagged(values, rows, range(1, _PAST_SAMPLES + 1), constant=True)
    rest = np.abs(_project_out(own, values[rows, None])[:, 0])
    kept = present & (rest <= np.quantile(rest, _QUIET_QUANTILE))
    if np.count_nonzero(kept) < _SAMPLES_PER_COEFFICIENT * (_PAST_SAMPLES + _RECENT_RESIDUALS):
        return 0.0
    told = _stack_lagged(laid.values / scale, rows, range(_RECENT_RESIDUALS))
    left = _project_out(own[kept], np.column_stack([values[rows], told])[kept])
    unexplained = float(left[:, 0] @ left[:, 0])
    if not unexplained > _LEAST_REST * left.shape[0]:
        return 0.0
    last = _project_out(left[:, 1:], left[:, :1])[:, 0]
    return 1.0 - float(last @ last) / unexplained


def _stack_lagged(
    values: FloatArray, rows: IntArray, lags: range, *, constant: bool = False
) -> FloatArray:
    columns = [values[rows - lag] for lag in lags]
    return np.column_stack([*columns, np.ones(rows.size)] if constant else columns)


def _project_out(columns: FloatArray, targets: FloatArray) -> FloatArray:
    """What least squares by the columns leaves of the targets."""
    found = np.linalg.lstsq(columns, targets, rcond=_RANK_TOLERANCE)[0]
    return np.asarray(targets - columns @ found)
