"""Residual tests: whiteness, and independence of the inputs.

The tests are those of MATLAB's ``resid`` (Ljung, System Identification, 2nd ed., ch. 16.6), with
e = y - ŷ:

whiteness
    r(k) = Σ e(t) e(t+k) / Σ e², k = 1 … 25. For white e its variance is n_k/(n(n + 2)), with n_k
    pairs of n samples. Q = Σ r(k)² n(n + 2)/n_k is χ² with as many degrees of freedom as lags
    (Ljung and Box 1978, for n_k = n - k). Predictions one step ahead on the estimation data lose a
    degree of freedom for each estimated coefficient of past outputs, down to 1
    (`sysid.residuals.past_outputs`). The mean is not removed, because an offset of the model is a
    fault too.
independence
    c(k) = Σ e(t) u(t - kτ) / √(Σ e² Σ u²), both without their means. e may be coloured. Given u,
    the covariance of two such sums is Σ R(i - j) u(i) u(j), with the autocovariance R of e. R comes
    from a Parzen window whose width follows the colour of e (Andrews 1991). The squares over the
    lags k ≥ 0, each divided by its variance, are summed. The sum is compared with a χ² of the same
    mean and variance (Satterthwaite), because neighbouring lags are not independent. Lags k < 0
    are shown but not tested. They would show feedback from the output to the input.

Only scored samples count. A missing sample removes its pairs. If samples are irregular, the lags of
whiteness count samples. u is read between its samples according to its hold, so τ stays a time and
nothing is resampled. With soft-l1 the residuals are replaced by their influence on the loss,
ψ(e) = e/√(1 + (e/s)²). So an outlier counts as in the estimate. A noise model whitens the residuals
(`sysid.residuals.whitening`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from sysid.core.distributions import chi_square_tail
from sysid.core.types import BoolArray, FloatArray
from sysid.data.records import Channel
from sysid.residuals.autocorrelation import (
    MIN_SAMPLES,
    ROUNDING_SHARE,
    SpacedResiduals,
    compute_lagged_sums,
    compute_whiteness,
    smooth_spectrum_root,
    space_residuals,
)
from sysid.residuals.past_outputs import count_past_output_coefficients
from sysid.residuals.whitening import Whitening, compute_ar1_coefficient
from sysid.simulation.fit_metrics import compute_mean
from sysid.simulation.loss import compute_influence

if TYPE_CHECKING:  # the web pages read these results without a compiler
    from sysid.simulation.problem import Problem


TEST_LEVEL = 0.05
"""Probability that a true model with white noise fails at least one of its tests."""

_BAND95, _BAND99 = 1.959963984540054, 2.5758293035489004
_MAX_SAMPLES = 20_000  # consecutive samples, enough for any test; limits the computing time

ResidualTestKind = Literal["whiteness", "independence"]
ResidualTestOutcome = Literal["passed", "failed", "not tested"]


@dataclass(frozen=True, slots=True)
class ResidualTest:
    """One test of one output's residuals.

    Attributes
    ----------
    experiment : int
        Record, from 0.
    output : str
        Output whose residuals are tested.
    test : {"whiteness", "independence"}
        Whiteness: with their own past. Independence: with an input.
    input : str or None
        Input of the test; none for whiteness.
    outcome : {"passed", "failed", "not tested"}
        Outcome of the test.
    samples : int
        Scored residuals of the test.
    lags_tested : int
        Lags of the statistic.
    inside95 : float or None
        Share of the tested lags within the 95 % band.
    inside99 : float or None
        Share of the tested lags within the 99 % band.
    statistic : float or None
        Test statistic, χ² distributed if the model is true.
    degrees : float or None
        Degrees of freedom of the statistic.
    p : float or None
        Probability of a larger statistic if the model is true.
    reason : str
        Why it was not tested, or what failed.
    """

    experiment: int
    output: str
    test: ResidualTestKind
    input: str | None
    outcome: ResidualTestOutcome
    samples: int
    lags_tested: int = 0
    inside95: float | None = None
    inside99: float | None = None
    statistic: float | None = None
    degrees: float | None = None
    p: float | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class ResidualTests:
    """All tests of a result.

    Attributes
    ----------
    data : {"estimation", "validation"}
        Data of the residuals.
    passed : bool or None
        Whether all tests passed; none if nothing could be tested.
    tests : tuple of ResidualTest
        Each test.
    level : float
        Probability that a true model fails at least one of its tests.
    """

    data: Literal["estimation", "validation"]
    passed: bool | None
    tests: tuple[ResidualTest, ...]
    level: float = TEST_LEVEL


@dataclass(frozen=True, slots=True, eq=False)
class CorrelationFunction:
    """A correlation function with its bands and its test.

    Attributes
    ----------
    lags : FloatArray, shape (n,)
        In periods of `period` (s); `period` is None if they count irregular samples.
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
    """Residuals (N,) of one output in one experiment, as their influence on the loss.

    `scored` marks those that count, and `size` is the largest measured value among them.
    `coefficients` of past outputs were estimated on all series of the output together.
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

    If the noise of an output has a correlation time (s), its residuals are whitened first.
    """
    series = list_residual_series(problem, simulated, correlation_times)
    if data == "estimation" and not problem.is_free_run:
        counts = count_past_output_coefficients(problem.model, problem.all_parameters)
        series = [residuals._replace(coefficients=counts[residuals.output]) for residuals in series]
    return judge_tests(compute_correlations(series, both_sides=False), data)


def judge_tests(
    functions: Sequence[CorrelationFunction], data: Literal["estimation", "validation"]
) -> ResidualTests:
    """Collect the tests of correlation functions, and whether all of them passed."""
    tests = tuple(test.test for test in functions)
    tested = [test for test in tests if test.outcome != "not tested"]
    passed = all(test.outcome == "passed" for test in tested) if tested else None
    return ResidualTests(data, passed, tests)


def list_residual_series(
    problem: "Problem", simulated: FloatArray, correlation_times: Mapping[str, float] | None = None
) -> list[ResidualSeries]:
    """List the residuals of every output of every experiment from simulated values (M,)."""
    parts = zip(
        problem.records,
        problem.split_by_output(simulated),
        problem.split_by_output(problem.evaluator.measured),
        problem.split_by_output(problem.evaluator.weight),
        strict=True,
    )
    names = {item.name for item in problem.model.inputs}
    series = []
    for number, (record, model, measured, weight) in enumerate(parts):
        inputs = tuple(item for item in record.inputs if item.name in names)
        times = {channel.name: channel.times for channel in record.outputs}
        for output in (item.name for item in problem.model.outputs):
            factor = float(np.max(weight[output], initial=0.0))
            series.append(
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
    return series


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
    """Make the residuals of weighted outputs (N,); at most the last 20 000 scored samples.

    `loss_scale` is the scale of the soft-l1 loss, or 0 for squares. `correlation_time` (s) is that
    of the noise, or 0 for white noise.
    """
    with np.errstate(all="ignore"):  # a missing measurement, or a simulation that diverged
        error = measured - simulated
        influence = compute_influence(error, loss_scale)
    usable_rows = np.flatnonzero(scored & np.isfinite(influence))[-_MAX_SAMPLES:]
    usable = np.zeros(times.size, dtype=np.bool_)
    usable[usable_rows] = True
    if correlation_time > 0:
        influence[usable_rows] = Whitening(
            compute_ar1_coefficient(times[usable_rows], correlation_time)
        ).whiten(influence[usable_rows])
    span = slice(int(usable_rows[0]), int(usable_rows[-1]) + 1) if usable_rows.size else slice(0, 0)
    size = float(np.max(np.abs(measured[usable_rows]), initial=0.0))
    return ResidualSeries(
        experiment, output, times[span], influence[span], usable[span], size, inputs
    )


def compute_correlations(
    all_series: Sequence[ResidualSeries], level: float = TEST_LEVEL, *, both_sides: bool = True
) -> list[CorrelationFunction]:
    """Compute the autocorrelation of each series and its correlation with each input.

    All are tested together at `level`: each of n tests has `level` / n (Bonferroni). Without
    `both_sides` the correlation with future inputs, which is not tested, is omitted.
    """
    reasons = [_explain_untestable(series) for series in all_series]
    pairs = [*zip(all_series, reasons, strict=True)]
    each = level / max(sum(1 + len(series.inputs) for series, reason in pairs if not reason), 1)
    return [
        curve
        for series, reason in pairs
        for curve in _correlate_series(
            series, reason, each, both_sides, _count_lost_degrees(series, all_series)
        )
    ]


def _count_lost_degrees(series: ResidualSeries, all_series: Sequence[ResidualSeries]) -> float:
    """Count the degrees of freedom that a series loses: its share of the coefficients."""
    if not series.coefficients:
        return 0.0
    total = sum(
        np.count_nonzero(other.scored) for other in all_series if other.output == series.output
    )
    return series.coefficients * np.count_nonzero(series.scored) / max(total, 1)


def _correlate_series(
    series: ResidualSeries, reason: str, level: float, both_sides: bool, lost: float
) -> Iterator[CorrelationFunction]:
    if reason:
        yield _make_untested(series, "whiteness", None, reason)
        for channel in series.inputs:
            yield _make_untested(series, "independence", channel.name, reason)
        return
    spaced = space_residuals(series.times[series.scored], series.residual[series.scored])
    yield _test_whiteness(series, spaced, level, lost)
    for channel in series.inputs:
        yield _test_independence(series, spaced, channel, level, both_sides=both_sides)


def _explain_untestable(series: ResidualSeries) -> str:
    n = int(np.count_nonzero(series.scored))
    if n < MIN_SAMPLES:
        return f"{n} samples are too few; need {MIN_SAMPLES} or more"
    if (
        float(np.sqrt(compute_mean(np.square(series.residual[series.scored]))))
        <= ROUNDING_SHARE * series.size
    ):
        return "the residuals are rounding: the model reproduces the data exactly"
    return ""


def _test_whiteness(
    series: ResidualSeries, spaced: SpacedResiduals, level: float, lost: float
) -> CorrelationFunction:
    values, deviation, statistic = compute_whiteness(spaced)
    degrees = max(values.size - lost, 1.0)
    test = _make_test(series, "whiteness", None, values / deviation, statistic, degrees, level)
    band = np.concatenate([[0.0], deviation])
    return CorrelationFunction(
        test,
        spaced.period if spaced.is_regular else None,
        np.arange(0.0, values.size + 1),
        np.concatenate([[1.0], values]),
        _BAND95 * band,
        _BAND99 * band,
    )


def _test_independence(
    series: ResidualSeries,
    spaced: SpacedResiduals,
    channel: Channel,
    level: float,
    *,
    both_sides: bool,
) -> CorrelationFunction:
    if not np.ptp(channel.values) > 0:
        return _make_untested(series, "independence", channel.name, "the input is constant")
    residual = np.where(
        spaced.present, spaced.values - compute_mean(spaced.values[spaced.present]), 0.0
    )
    if not np.max(np.abs(residual)) > ROUNDING_SHARE * np.max(np.abs(spaced.values)):
        reason = "the residual is the same everywhere"
        return _make_untested(series, "independence", channel.name, reason)
    colour = smooth_spectrum_root(residual, spaced.present)
    lags = float(spaced.n_lags)
    past = compute_lagged_sums(spaced, residual, colour, channel, np.arange(lags + 1.0))
    if isinstance(past, str):
        return _make_untested(series, "independence", channel.name, past)
    scaled = past.sums / past.deviation
    spread = past.covariance / np.outer(past.deviation, past.deviation)
    count, squares = scaled.size, float(np.sum(np.square(spread)))
    # A sum of squares with mean `count` and variance 2·`squares` is a χ² times squares/count.
    statistic = float(scaled @ scaled) * count / squares
    degrees = count * count / squares
    test = _make_test(series, "independence", channel.name, scaled, statistic, degrees, level)
    parts = [past]
    if both_sides:
        future = compute_lagged_sums(spaced, residual, colour, channel, np.arange(-lags, 0.0))
        parts = [past] if isinstance(future, str) else [future, past]
    band = np.concatenate([part.deviation / part.norm for part in parts])
    return CorrelationFunction(
        test,
        spaced.period,
        np.concatenate([part.lags for part in parts]),
        np.concatenate([part.sums / part.norm for part in parts]),
        _BAND95 * band,
        _BAND99 * band,
    )


def _make_test(
    series: ResidualSeries,
    kind: ResidualTestKind,
    channel: str | None,
    scaled: FloatArray,
    statistic: float,
    degrees: float,
    level: float,
) -> ResidualTest:
    p = chi_square_tail(degrees, statistic)
    size = np.abs(scaled)
    return ResidualTest(
        series.experiment,
        series.output,
        kind,
        channel,
        "passed" if p >= level else "failed",
        int(np.count_nonzero(series.scored)),
        scaled.size,
        np.count_nonzero(size <= _BAND95) / size.size,
        np.count_nonzero(size <= _BAND99) / size.size,
        statistic,
        degrees,
        p,
    )


def _make_untested(
    series: ResidualSeries, kind: ResidualTestKind, channel: str | None, reason: str
) -> CorrelationFunction:
    samples = int(np.count_nonzero(series.scored))
    test = ResidualTest(
        series.experiment, series.output, kind, channel, "not tested", samples, reason=reason
    )
    none = np.zeros(0)
    return CorrelationFunction(test, None, none, none, none, none)
