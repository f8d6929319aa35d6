"""Tests of the residuals: whether they are white, and whether they are independent of the inputs.

What MATLAB's ``resid`` shows (Ljung, System Identification, 2nd ed., ch. 16.6), with e = y - ŷ:

whiteness
    r(k) = Σ e(t) e(t+k) / Σ e², k = 1 … 25. For white e its variance is n_k/(n(n + 2)), n_k pairs
    of n samples. Q = Σ r(k)² n(n + 2)/n_k is χ² with as many degrees of freedom as lags (Ljung and
    Box 1978, for n_k = n - k). Of predictions one step ahead, on the data of the estimate, the
    estimated coefficients on past outputs are taken off, down to 1
    (`sysid.residuals.past_outputs`). The mean is not removed: an offset of the model is a fault
    too.
independence
    c(k) = Σ e(t) u(t - kτ) / √(Σ e² Σ u²), both without their means. e may be coloured: given u,
    the covariance of two such sums is Σ R(i - j) u(i) u(j), R the autocovariance of e, from a
    Parzen window as wide as the colour of e asks for (Andrews 1991). The sum of squares over the
    lags k ≥ 0, each against its variance, is compared with a χ² of the same mean and variance
    (Satterthwaite), for neighbouring lags are not independent. Lags k < 0 are shown and not
    tested: there feedback from the output to the input would show.

Only scored samples count. Missing samples leave their pairs out. Where samples are not regular
the lags of whiteness count samples; u is read between its samples as it was held, so τ is a time
all the same, and nothing is resampled. With soft-l1 the residuals are those that the loss sees,
ψ(e) = e/√(1 + (e/s)²), so that an outlier counts as what it counted for the estimate. Under a noise
model they are whitened by it (`sysid.residuals.whitening`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.special import chdtrc

from sysid.core.types import BoolArray, FloatArray
from sysid.data.records import Channel
from sysid.residuals.autocorrelation import (
    FEWEST_SAMPLES,
    ROUNDING_SHARE,
    SpacedResiduals,
    compute_lagged_sums,
    compute_whiteness,
    smooth_spectrum_root,
    space_residuals,
)
from sysid.residuals.past_outputs import count_past_output_coefficients
from sysid.residuals.whitening import Whitening, compute_ar1_coefficient
from sysid.simulation.loss import compute_influence

if TYPE_CHECKING:  # the pages read these results without a compiler
    from sysid.simulation.problem import Problem


TEST_LEVEL = 0.05
"""Chance that a true model with white noise fails one of its tests, all of them together."""

_BAND95, _BAND99 = 1.959963984540054, 2.5758293035489004
_MOST_SAMPLES = 20_000  # consecutive samples that are enough for any test; bounds the time it takes

ResidualTestKind = Literal["whiteness", "independence"]
ResidualTestOutcome = Literal["passed", "failed", "not tested"]


@dataclass(frozen=True, slots=True)
class ResidualTest:
    """One test of one output's residuals.

    Attributes
    ----------
    experiment : int
        From 0.
    input : str or None
        None for whiteness.
    outcome : {"passed", "failed", "not tested"}
        With `reason` if not tested.
    samples, lags : int
        Scored samples; lags tested.
    inside95, inside99 : float or None
        Part of the tested lags inside the bands.
    statistic, degrees, p : float or None
        Of the χ² distribution; `p` is the chance of a larger statistic if the model is true.
    """

    experiment: int
    output: str
    kind: ResidualTestKind
    input: str | None
    outcome: ResidualTestOutcome
    samples: int
    lags: int = 0
    inside95: float | None = None
    inside99: float | None = None
    statistic: float | None = None
    degrees: float | None = None
    p: float | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class ResidualTests:
    """All tests of a result. `passed` is None where nothing could be tested."""

    data: Literal["estimation", "validation"]
    passed: bool | None
    tests: tuple[ResidualTest, ...]


@dataclass(frozen=True, slots=True, eq=False)
class CorrelationFunction:
    """A correlation function with its bands, and the test made of it.

    Attributes
    ----------
    lags : FloatArray, shape (n,)
        In periods, `period` (s) each; None where they count samples of irregular times.
    values, band95, band99 : FloatArray, shape (n,)
        Empty if not tested.
    """

    test: ResidualTest
    period: float | None
    lags: FloatArray
    values: FloatArray
    band95: FloatArray
    band99: FloatArray


class ResidualSeries(NamedTuple):
    """The residuals (N,) of one output in one experiment, as the loss sees them.

    `scored` tells which of them count; `size` is the largest measured value among those.
    `coefficients` on past outputs were estimated on all series of the output together.
    """

    experiment: int
    output: str
    times: FloatArray
    residual: FloatArray
    scored: BoolArray
    size: float
    inputs: tuple[Channel, ...]
    coefficients: int = 0


def run_residual_tests(
    problem: "Problem",
    simulated: FloatArray,
    data: Literal["estimation", "validation"],
    correlation_times: Mapping[str, float] | None = None,
) -> ResidualTests:
    """Test the residuals of simulated values (M,) on the records of a problem.

    Of an output whose noise has a correlation time (s) they are whitened first.
    """
    found = list_residual_series(problem, simulated, correlation_times)
    if data == "estimation" and problem.prediction == "one-step":
        counts = count_past_output_coefficients(problem.model, problem.all_parameters)
        found = [one._replace(coefficients=counts[one.output]) for one in found]
    return judge_tests(compute_correlations(found, both_sides=False), data)


def judge_tests(
    found: Sequence[CorrelationFunction], data: Literal["estimation", "validation"]
) -> ResidualTests:
    """The tests of some correlation functions, and whether all of them passed."""
    tests = tuple(one.test for one in found)
    tested = [one for one in tests if one.outcome != "not tested"]
    passed = all(one.outcome == "passed" for one in tested) if tested else None
    return ResidualTests(data, passed, tests)


def list_residual_series(
    problem: "Problem", simulated: FloatArray, correlation_times: Mapping[str, float] | None = None
) -> list[ResidualSeries]:
    """The residuals of every output of every experiment, from simulated values (M,)."""
    parts = zip(
        problem.records,
        problem.split_by_output(simulated),
        problem.split_by_output(problem.evaluator.measured),
        problem.split_by_output(problem.evaluator.weight),
        strict=True,
    )
    names = {one.name for one in problem.model.inputs}
    found = []
    for number, (record, model, measured, weight) in enumerate(parts):
        inputs = tuple(one for one in record.inputs if one.name in names)
        times = {channel.name: channel.times for channel in record.outputs}
        for output in (one.name for one in problem.model.outputs):
            factor = problem.output_weights[output]
            found.append(
                make_residual_series(
                    number,
                    output,
                    times[output],
                    factor * measured[output],
                    factor * model[output],
                    weight[output] > 0,
                    inputs,
                    problem.loss_scale,
                    (correlation_times or {}).get(output, 0.0),
                )
            )
    return found


def make_residual_series(
    experiment: int,
    output: str,
    times: FloatArray,
    measured: FloatArray,
    simulated: FloatArray,
    scored: BoolArray,
    inputs: tuple[Channel, ...],
    loss_scale: float = 0.0,
    correlation_time: float = 0.0,
) -> ResidualSeries:
    """Residuals from weighted outputs (N,); of a long record the last 20 000 scored samples.

    `loss_scale` is that of a soft-l1 loss, 0 with squares; `correlation_time` (s) that of the
    noise, 0 for white noise.
    """
    with np.errstate(all="ignore"):  # a missing measurement, or a simulation that diverged
        error = measured - simulated
        seen = compute_influence(error, loss_scale)
    where = np.flatnonzero(scored & np.isfinite(seen))[-_MOST_SAMPLES:]
    usable = np.zeros(times.size, dtype=np.bool_)
    usable[where] = True
    if correlation_time > 0:
        seen[where] = Whitening(compute_ar1_coefficient(times[where], correlation_time)).whiten(
            seen[where]
        )
    kept = slice(int(where[0]), int(where[-1]) + 1) if where.size else slice(0, 0)
    size = float(np.max(np.abs(measured[where]), initial=0.0))
    return ResidualSeries(experiment, output, times[kept], seen[kept], usable[kept], size, inputs)


def compute_correlations(
    found: Sequence[ResidualSeries], level: float = TEST_LEVEL, *, both_sides: bool = True
) -> list[CorrelationFunction]:
    """Autocorrelation of each series and its correlation with each input, all tested together.

    `level` is shared out (Bonferroni): of n tests each is one at `level` / n. Without
    `both_sides` the correlation with inputs to come, which is not tested, is left out.
    """
    count = sum(1 + len(one.inputs) for one in found if not _explain_untestable(one))
    each = level / max(count, 1)
    return [
        curve
        for one in found
        for curve in _correlate_series(one, each, both_sides, _count_lost_degrees(one, found))
    ]


def _count_lost_degrees(one: ResidualSeries, found: Sequence[ResidualSeries]) -> float:
    """Degrees of freedom that a series loses: its share by samples of the coefficients."""
    if not one.coefficients:
        return 0.0
    total = sum(np.count_nonzero(other.scored) for other in found if other.output == one.output)
    return one.coefficients * np.count_nonzero(one.scored) / max(total, 1)


def _correlate_series(
    one: ResidualSeries, level: float, both_sides: bool, lost: float
) -> Iterator[CorrelationFunction]:
    reason = _explain_untestable(one)
    if reason:
        yield _make_untested(one, "whiteness", None, reason)
        for channel in one.inputs:
            yield _make_untested(one, "independence", channel.name, reason)
        return
    laid = space_residuals(one.times[one.scored], one.residual[one.scored])
    yield _test_whiteness(one, laid, level, lost)
    for channel in one.inputs:
        yield _test_independence(one, laid, channel, level, both_sides=both_sides)


def _explain_untestable(one: ResidualSeries) -> str:
    n = int(np.count_nonzero(one.scored))
    if n < FEWEST_SAMPLES:
        return f"{n} samples are too few; need {FEWEST_SAMPLES} or more"
    if float(np.sqrt(np.mean(np.square(one.residual[one.scored])))) <= ROUNDING_SHARE * one.size:
        return "the residuals are rounding: the model reproduces the data exactly"
    return ""


def _test_whiteness(
    one: ResidualSeries, laid: SpacedResiduals, level: float, lost: float
) -> CorrelationFunction:
    values, deviation, statistic = compute_whiteness(laid)
    degrees = max(laid.n_lags - lost, 1.0)
    test = _make_test(one, "whiteness", None, values / deviation, statistic, degrees, level)
    band = np.concatenate([[0.0], deviation])
    return CorrelationFunction(
        test,
        laid.period if laid.is_regular else None,
        np.arange(0.0, laid.n_lags + 1),
        np.concatenate([[1.0], values]),
        _BAND95 * band,
        _BAND99 * band,
    )


def _test_independence(
    one: ResidualSeries, laid: SpacedResiduals, channel: Channel, level: float, *, both_sides: bool
) -> CorrelationFunction:
    if not np.ptp(channel.values) > 0:
        return _make_untested(one, "independence", channel.name, "the input is constant")
    residual = np.where(laid.present, laid.values - np.mean(laid.values[laid.present]), 0.0)
    if not np.max(np.abs(residual)) > ROUNDING_SHARE * np.max(np.abs(laid.values)):
        reason = "the residual is the same everywhere"
        return _make_untested(one, "independence", channel.name, reason)
    colour = smooth_spectrum_root(residual, laid.present)
    past = compute_lagged_sums(laid, residual, colour, channel, np.arange(laid.n_lags + 1.0))
    if isinstance(past, str):
        return _make_untested(one, "independence", channel.name, past)
    scaled = past.sums / past.deviation
    spread = past.covariance / np.outer(past.deviation, past.deviation)
    count, squares = scaled.size, float(np.sum(np.square(spread)))
    # A sum of squares with mean `count` and variance 2·`squares` is a χ² times squares/count.
    statistic = float(scaled @ scaled) * count / squares
    degrees = count * count / squares
    test = _make_test(one, "independence", channel.name, scaled, statistic, degrees, level)
    parts = [past]
    if both_sides:
        future = compute_lagged_sums(
            laid, residual, colour, channel, np.arange(-float(laid.n_lags), 0.0)
        )
        parts = [past] if isinstance(future, str) else [future, past]
    band = np.concatenate([part.deviation / part.norm for part in parts])
    return CorrelationFunction(
        test,
        laid.period,
        np.concatenate([part.lags for part in parts]),
        np.concatenate([part.sums / part.norm for part in parts]),
        _BAND95 * band,
        _BAND99 * band,
    )


def _make_test(
    one: ResidualSeries,
    kind: ResidualTestKind,
    channel: str | None,
    scaled: FloatArray,
    statistic: float,
    degrees: float,
    level: float,
) -> ResidualTest:
    p = float(chdtrc(degrees, statistic))
    size = np.abs(scaled)
    return ResidualTest(
        one.experiment,
        one.output,
        kind,
        channel,
        "passed" if p >= level else "failed",
        int(np.count_nonzero(one.scored)),
        scaled.size,
        np.count_nonzero(size <= _BAND95) / size.size,
        np.count_nonzero(size <= _BAND99) / size.size,
        statistic,
        degrees,
        p,
    )


def _make_untested(
    one: ResidualSeries, kind: ResidualTestKind, channel: str | None, reason: str
) -> CorrelationFunction:
    samples = int(np.count_nonzero(one.scored))
    test = ResidualTest(
        one.experiment, one.output, kind, channel, "not tested", samples, reason=reason
    )
    none = np.zeros(0)
    return CorrelationFunction(test, None, none, none, none, none)
