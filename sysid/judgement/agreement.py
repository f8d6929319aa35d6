"""Agreement with the data: whether the model explains them at all."""

from collections.abc import Iterator, Sequence
from math import isfinite

import numpy as np

from sysid.core.distributions import chi_square_limit
from sysid.core.findings import Finding, Severity
from sysid.core.text import join_names
from sysid.core.types import FloatArray
from sysid.core.units import format_unit
from sysid.judgement.levels import STRONG_ODDS, UNLIKELY
from sysid.judgement.yardstick import NOTABLE_SHARE, Yardstick, fit_reverse, fit_yardstick
from sysid.simulation.fit_metrics import ChannelMetrics, Metrics
from sysid.simulation.problem import Problem

_LITTLE = 30.0
"""%: a smaller fit beside residuals that are not noise is a failure. Measured with
`benchmarks.judgement`, a record of each of 102 kinds: 20 or 40 change the statuses of one each."""
_SHARE_OF_DEGREES = 0.25  # of the samples: degrees of freedom of a variance, if the pole is 0.77


def find_disagreement(
    metrics: Metrics, limit: float | None, *, are_residuals_noise: bool
) -> Iterator[Finding]:
    """Find a model that fails: above the safe limit, or worse than a constant or a line."""
    if limit is not None and metrics.rms > limit:
        yield Finding(
            "safe limit",
            "structure",
            "serious",
            "the model is invalid",
            f"the RMS error {metrics.rms:.4g} is above the safe limit {limit:g}, so the model is "
            "not valid.",
            status="refuted",
        )
    fit = metrics.fit_percent
    if isfinite(fit) and fit <= 0:
        yield Finding(
            "constant",
            "structure",
            "serious",
            "the model does not explain the output",
            f"the fit is {fit:.1f} %: a constant fits {'better' if fit < 0 else 'as well'}.",
            "Choose another model, or look at channels and bounds.",
            status="refuted",
        )
    elif isfinite(fit) and fit < _LITTLE and not are_residuals_noise:
        yield Finding(
            "little fit",
            "structure",
            "serious",
            "the model explains little of the output",
            f"the fit is {fit:.1f} %, and what is left is not noise.",
            "Choose another model, or look at channels and bounds.",
            status="refuted",
        )
    yield from _find_straight_lines(metrics.channels)


def find_better_yardstick(
    yardstick: Yardstick | None, names: Sequence[str], explanations: Sequence[Finding]
) -> Iterator[Finding]:
    """Find a linear black box that predicts left-out blocks clearly better than the model.

    It says that the model fails, not why. So beside an explanation that gains more, or that is a
    clear doubt already, it is a note without advice: that of the explanation helps.
    """
    if yardstick is None or not yardstick.is_clearly_better:
        return
    gain = 2.0 * yardstick.gain
    is_explained = any(
        (one.gain or 0.0) > (gain if one.severity == "note" else STRONG_ODDS)
        for one in explanations
        if not one.is_of_noise
    )
    own, other = yardstick.own_fit_percent, yardstick.fit_percent
    yield Finding(
        "linear black box",
        "structure",
        "note" if is_explained else "caution",
        f"a linear model of order {yardstick.order} explains {other:.0f} %, yours {own:.0f} %",
        f"a linear model of order {yardstick.order} explains {other:.1f} % of {yardstick.output} "
        f"in blocks that were left out of it. This model explains {own:.1f} % of the same samples.",
        "" if is_explained else "Choose another model, or look at channels and bounds.",
        None if is_explained else gain,
        parameters=() if is_explained else tuple(names),
    )


def find_exchanged_channels(
    problem: Problem, simulated: FloatArray, metrics: Metrics
) -> Iterator[Finding]:
    """Find an input that an output explains where the model explains little of that output.

    A linear model of the cause explains its effect, and not the other way round: that would have
    to know the future. So it must explain left-out blocks of the input clearly better than both
    the model and a linear one explain the output. Only a failed model is asked.
    """
    if not metrics.fit_percent < _LITTLE:
        return
    forward: Yardstick | None = None
    for effect in problem.output_weights:
        for cause in (channel.name for channel in problem.model.inputs):
            reverse = fit_reverse(problem, simulated, cause, effect)
            if reverse is None or not reverse.is_clearly_better:
                continue
            forward = forward or fit_yardstick(problem, simulated)
            own = 0.0 if forward is None else forward.fit_percent
            if (100.0 - reverse.fit_percent) ** 2 > (1.0 - NOTABLE_SHARE) * (100.0 - own) ** 2:
                continue
            yield Finding(
                "exchanged channels",
                "record",
                "serious",
                f"{effect} drives {cause}: their channels are exchanged, or the loop is closed",
                f"a linear model of {effect} explains {reverse.fit_percent:.0f} % of {cause} in "
                f"blocks that were left out of it, and this model {metrics.fit_percent:.0f} % of "
                f"{effect}. So {effect} is the cause of {cause}.",
                f"Give {cause} the channel of {effect}, and {effect} that of {cause}. If a "
                f"controller moves {cause}, excite its set point instead.",
                2.0 * reverse.gain,
                status="refuted",
            )


def find_constant_outputs(problem: Problem) -> Iterator[Finding]:
    """Find outputs whose scored samples are all equal, in every experiment."""
    measured = problem.split_by_output(problem.evaluator.measured)
    weights = problem.split_by_output(problem.evaluator.weight)
    still = []
    for output in problem.model.outputs:
        values = np.concatenate(
            [y[output.name][w[output.name] > 0] for y, w in zip(measured, weights, strict=True)]
        )
        if np.ptp(values) == 0.0:
            still.append((output.name, values, format_unit(output.unit)))
    for name, values, unit in still:
        severity: Severity = "serious" if len(still) == len(problem.model.outputs) else "caution"
        yield Finding(
            "constant output",
            "record",
            severity,
            "the output is constant" if severity == "serious" else f"{name} is constant",
            f"output {name!r} is constant ({values[0]:.4g}{unit}) at all {values.size} samples: it "
            "contains no dynamics, and the fit % is undefined.",
            "Choose another channel, or a record in which it moves.",
        )


def _find_straight_lines(channels: Sequence[ChannelMetrics]) -> Iterator[Finding]:
    """Find outputs that a straight line explains better, over all experiments or in one.

    In an experiment in which nothing moves a line always fits better, as it has more parameters
    for the same noise. So it is a doubt only where the model leaves more than elsewhere.
    """
    outputs = dict.fromkeys(one.output for one in channels if one.is_worse_than_line)
    failed = [name for name in outputs if _is_worse_than_line(channels, name)]
    has_several = any(channel.experiment for channel in channels)
    for channel in channels:
        if not channel.is_worse_than_line:
            continue
        where = f" of experiment {channel.experiment + 1}" if has_several else ""
        severity: Severity = "caution" if _leaves_more(channel, channels) else "note"
        yield Finding(
            "straight line",
            "structure",
            "serious" if channel.output in failed else severity,
            f"a straight line explains {join_names(failed)} better"
            if failed
            else f"a straight line explains a part of {join_names(list(outputs))} better",
            f"the model fits {channel.output}{where} worse than a straight line (RMS "
            f"{channel.rms:.4g} against {channel.line_rms:.4g}{format_unit(channel.unit)}).",
            "Choose another model, or look at channels, bounds, and a change during the recording."
            if failed
            else "These records tell little of the model, or it does not hold there.",
            status="refuted",
        )


def _leaves_more(channel: ChannelMetrics, channels: Sequence[ChannelMetrics]) -> bool:
    """Whether the model leaves more of an output in an experiment than over all of them."""
    own = [one for one in channels if one.output == channel.output]
    samples = sum(one.samples for one in own)
    variance = sum(one.samples * one.rms**2 for one in own) / samples
    degrees = max(round(_SHARE_OF_DEGREES * channel.samples), 1)
    return channel.rms**2 > variance * chi_square_limit(degrees, UNLIKELY) / degrees


def _is_worse_than_line(channels: Sequence[ChannelMetrics], output: str) -> bool:
    """Whether straight lines fit an output better than the model, over all experiments."""
    own = [one for one in channels if one.output == output and isfinite(one.line_rms)]
    return sum(one.samples * (one.rms**2 - one.line_rms**2) for one in own) > 0
