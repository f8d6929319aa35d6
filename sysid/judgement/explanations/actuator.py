"""Actuator and input: what acts on the plant is not what was recorded.

Each is a column ŷ(other input) - ŷ, of one simulation: a limit, a curve, a dead zone, backlash, a
limit of the rate, a direct path to the output, and noise on the recorded input, which smoothing
takes away (errors in variables: Söderström, Automatica 43 (2007) 939).
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sysid.core.findings import Family
from sysid.core.robust import estimate_deviation
from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.judgement.residual_context import (
    AS_TOLD,
    TO_THE_NEXT,
    Candidate,
    ResidualContext,
)
from sysid.judgement.unrecorded_input import compute_reach

_LIMITS = (0.5, 0.65, 0.8, 0.9, 0.96)  # of the span
_PLAYS = (0.03, 0.07, 0.15, 0.3)  # of the span
_RATES = (0.01, 0.03, 0.1, 0.3)  # of the span, in a sample
_WIDTHS = (3, 5, 9, 17)  # samples


class _Change(NamedTuple):
    """A change of the values (N,) of an input, with its words."""

    apply: Callable[[FloatArray], FloatArray]
    explanation: str
    family: Family
    brief: str
    text: str
    most: float | None = TO_THE_NEXT


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose that another signal than the recorded input acts on the plant."""
    for channel in context.moving_inputs:
        name = channel.name
        low, high = float(np.min(channel.values)), float(np.max(channel.values))
        changes = list(_list_changes(name, low, high))
        if channel.effective_hold != "zero":  # a command that is held has no noise
            changes += _list_smoothings(name)
        for change in changes:
            records = context.replace_input(name, change.apply)
            moved = context.compute_effect(records)
            if moved is not None:
                yield Candidate(
                    change.explanation,
                    change.family,
                    context.weigh(moved),
                    change.brief,
                    change.text,
                    counted=1,
                    change={"records": records},
                    is_vague=change.family == "input",
                    most=change.most,
                )
        direct = context.read_input(name)
        yield Candidate(
            "direct path",
            "sensor",
            context.weigh(direct - np.mean(direct)),
            f"{name} acts on the output at once",
            f"{name} acts on the output at once, beside the model: by crosstalk, or past the plant",
            f"Add a term c*{name} to the output in the model's document, and c to its parameters.",
        )


def propose_loads(context: ResidualContext) -> Iterator[Candidate]:
    """Propose a load that begins to act at the input of the plant where an innovation is large.

    An input acts after its time lag, so the load began by so much earlier. One that began before
    the record is where the plant starts.
    """
    reach = compute_reach(context.problem, context.analysis)
    for channel, position in product(context.moving_inputs[:1], context.find_shocks()):
        begin = float(context.times[position]) - reach
        experiment = context.find_experiment(position)
        records = list(context.problem.records)
        if begin <= records[experiment].start:
            continue
        records[experiment] = _add_step(
            records[experiment], channel.name, begin, float(np.ptp(channel.values))
        )
        moved = context.compute_effect(records)
        if moved is not None:
            moment = context.describe_moment(begin, experiment)
            yield Candidate(
                "load",
                "input",
                context.weigh(moved),
                f"a load acts from about {moment} on",
                f"from about {moment} on a load acts on the plant beside {channel.name}, "
                "or another input",
                "Record the load as an input.",
                counted=1,
            )


def _add_step(record: Record, name: str, begin: float, size: float) -> Record:
    """Add a step of a size to an input from a time (s) on."""
    inputs = (
        replace(
            one,
            values=one.values + np.where(one.times >= begin, size, 0.0),
            hold=one.effective_hold,
        )
        if one.name == name
        else one
        for one in record.inputs
    )
    return replace(record, inputs=tuple(inputs))


def _list_changes(name: str, low: float, high: float) -> Iterator[_Change]:
    """List changes of an input whose values lie between two, with their words."""
    middle, span = 0.5 * (low + high), high - low
    for share in _LIMITS:
        for clip, level, word in (
            (np.minimum, low + share * span, "below"),
            (np.maximum, high - share * span, "above"),
        ):
            yield _Change(
                partial(clip, level),
                "limit of an actuator",
                "actuator",
                f"{name} has a limit",
                f"what acts on the plant stays {word} about {level:.4g}, while {name} goes "
                "further: an actuator at its limit",
            )
    for power, word in ((2, "the square"), (3, "the cube")):
        yield _Change(
            partial(_bend, middle=middle, span=span, power=power),
            "curve of an actuator",
            "actuator",
            f"{name} acts along a curve",
            f"the plant follows {name} along a curve, about {word} of it: a nonlinear actuator",
            None,
        )
    for share in _PLAYS:
        yield _Change(
            partial(_play, width=share * span),
            "backlash",
            "actuator",
            f"{name} has backlash",
            f"what acts on the plant follows {name} with a play of about {2 * share * span:.3g}",
        )
        yield _Change(
            partial(_ignore_small, middle=middle, width=share * span),
            "dead zone",
            "actuator",
            f"{name} has a dead zone",
            f"small values of {name} do not act on the plant",
        )
    for share in _RATES:
        yield _Change(
            partial(_limit_rate, most=share * span),
            "limit of the rate",
            "actuator",
            f"{name} has a limit of its rate",
            f"what acts on the plant follows {name} at most by {share * span:.3g} in a sample",
        )


def _list_smoothings(name: str) -> Iterator[_Change]:
    yield _Change(
        _round_to_levels,
        "noise of an input",
        "input",
        f"{name} was recorded with noise",
        f"the levels between which {name} steps explain the output better than {name} itself: its "
        "record has noise that does not act on the plant",
        AS_TOLD,
    )
    for width, smooth in product(_WIDTHS, (_smooth, _take_medians, _keep_edges)):
        yield _Change(
            partial(smooth, width=width),
            "noise of an input",
            "input",
            f"{name} was recorded with noise",
            f"a mean of {name} over {width} samples explains the output better than {name} itself. "
            "Its record has noise or steps of a converter that do not act on the plant",
            AS_TOLD,
        )


def _measure_noise(values: FloatArray) -> float:
    """Measure the deviation of white noise by the differences of neighbours."""
    return estimate_deviation(np.diff(values)) / sqrt(2.0)


def _round_to_levels(values: FloatArray) -> FloatArray:
    """Round values to the means of their clusters, between which nothing lies (single linkage)."""
    order = np.argsort(values, kind="stable")
    gaps = np.diff(values[order])
    deviation = _measure_noise(values)
    numbers = np.concatenate([[0], np.cumsum(gaps > deviation)])
    means = np.bincount(numbers, values[order]) / np.bincount(numbers)
    rounded = np.empty(values.size)
    rounded[order] = means[numbers]
    return rounded


def _bend(values: FloatArray, middle: float, span: float, power: int) -> FloatArray:
    return np.asarray(values + span * ((values - middle) / span) ** power)


def _play(values: FloatArray, width: float) -> FloatArray:
    """Follow values with a play of a width to either side (Krasnosel'skii and Pokrovskii 1989)."""
    moved, last = list[float](), float(values[0])
    for value in values.tolist():
        if last < value - width:
            last = value - width
        elif last > value + width:
            last = value + width
        moved.append(last)
    return np.array(moved)


def _ignore_small(values: FloatArray, middle: float, width: float) -> FloatArray:
    away = values - middle
    return np.asarray(middle + np.sign(away) * np.maximum(np.abs(away) - width, 0.0))


def _limit_rate(values: FloatArray, most: float) -> FloatArray:
    moved, last = list[float](), float(values[0])
    for value in values.tolist():
        if value > last + most:
            last += most
        elif value < last - most:
            last -= most
        else:
            last = value
        moved.append(last)
    return np.array(moved)


def _smooth(values: FloatArray, width: int) -> FloatArray:
    padded = np.pad(values, width // 2, mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")


def _take_medians(values: FloatArray, width: int) -> FloatArray:
    """Take the median of each value's neighbours: noise goes, and jumps stay (Tukey 1977)."""
    padded = np.pad(values, width // 2, mode="edge")
    return np.asarray(np.median(sliding_window_view(padded, width), axis=1))


def _keep_edges(values: FloatArray, width: int) -> FloatArray:
    """Average each value with neighbours that differ by little (bilateral: Tomasi, Manduchi 1998).

    Little is a few deviations of the differences between neighbours.
    """
    deviation = _measure_noise(values)
    if not deviation > 0:  # levels that are held have no noise
        return values
    padded = np.pad(values, width // 2, mode="edge")
    windows = sliding_window_view(padded, width)
    weights = np.exp(-0.5 * ((windows - values[:, None]) / (3.0 * deviation)) ** 2)
    return np.asarray(np.sum(weights * windows, axis=1) / np.sum(weights, axis=1))
