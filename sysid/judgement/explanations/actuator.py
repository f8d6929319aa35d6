"""Actuator and input: what acts on the plant is not what was recorded.

Each is a column ŷ(other input) - ŷ, of one simulation: a limit, a curve, a dead zone, backlash, a
limit of the rate, a direct path to the output, and noise on the recorded input, which smoothing
takes away (errors in variables: Söderström, Automatica 43 (2007) 939).
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from sysid.core.errors import SysidError
from sysid.core.types import FloatArray
from sysid.data.interpolation import interpolate_channel
from sysid.judgement.residual_context import Candidate, ResidualContext
from sysid.results.findings import Family

_LIMITS = (0.5, 0.65, 0.8, 0.9, 0.96)  # of the span
_PLAYS = (0.03, 0.07, 0.15, 0.3)  # of the span
_RATES = (0.01, 0.03, 0.1, 0.3)  # of the span, in a sample
_WIDTHS = (3, 5, 9, 17)  # samples

Change = Callable[[FloatArray], FloatArray]


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose that another signal than the recorded input acts on the plant."""
    for channel in context.moving_inputs:
        name = channel.name
        low, high = float(np.min(channel.values)), float(np.max(channel.values))
        span = high - low
        for change, explanation, family, brief, text in _list_changes(name, low, high, span):
            try:
                other = context.simulate(context.replace_input(name, change))
            except SysidError:
                continue
            moved = other - context.simulated
            if np.all(np.isfinite(moved)) and np.any(moved != 0):
                yield Candidate(
                    explanation,
                    family,
                    context.weigh(moved),
                    brief,
                    text,
                    counted=1,
                )
        direct = np.zeros(context.times.size)
        for part in context.parts:
            record = context.problem.records[part.experiment]
            for own in record.inputs:
                if own.name == name:
                    direct[part.rows] = interpolate_channel(own, part.times)
        yield Candidate(
            "direct path",
            "sensor",
            context.weigh(direct - np.mean(direct)),
            f"{name} acts on the output at once",
            f"{name} acts on the output at once, beside the model: by crosstalk, or past the plant",
            f"Add a term c*{name} to the output in the model's document, and c to its parameters.",
        )


def _list_changes(
    name: str, low: float, high: float, span: float
) -> Iterator[tuple[Change, str, Family, str, str]]:
    """List changes of an input (N,), with their words."""
    for share in _LIMITS:
        limit, brief = "limit of an actuator", f"{name} has a limit"
        text = (
            f"what acts on the plant stays {{}} about {{:.4g}}, while {name} goes further: an "
            "actuator at its limit"
        )
        top, bottom = low + share * span, high - share * span
        clip_high = partial(np.minimum, top)
        yield clip_high, limit, "actuator", brief, text.format("below", top)
        clip_low = partial(np.maximum, bottom)
        yield clip_low, limit, "actuator", brief, text.format("above", bottom)
    middle = 0.5 * (low + high)
    for power, word in ((2, "the square"), (3, "the cube")):
        yield (
            partial(_bend, middle=middle, span=span, power=power),
            "curve of an actuator",
            "actuator",
            f"{name} acts along a curve",
            f"the plant follows {name} along a curve, about {word} of it: a nonlinear actuator",
        )
    for share in _PLAYS:
        yield (
            partial(_play, width=share * span),
            "backlash",
            "actuator",
            f"{name} has backlash",
            f"what acts on the plant follows {name} with a play of about {2 * share * span:.3g}",
        )
        yield (
            partial(_ignore_small, middle=middle, width=share * span),
            "dead zone",
            "actuator",
            f"{name} has a dead zone",
            f"Small values of {name} do not act on the plant",
        )
    for share in _RATES:
        yield (
            partial(_limit_rate, most=share * span),
            "limit of the rate",
            "actuator",
            f"{name} has a limit of its rate",
            f"what acts on the plant follows {name} at most by {share * span:.3g} in a sample",
        )
    for width in _WIDTHS:
        yield (
            partial(_smooth, width=width),
            "noise of an input",
            "input",
            f"{name} was recorded with noise",
            f"a mean of {name} over {width} samples explains the output better than {name} itself: "
            "its record has noise or steps of a converter that do not act on the plant",
        )


def _bend(values: FloatArray, middle: float, span: float, power: int) -> FloatArray:
    return np.asarray(values + span * ((values - middle) / span) ** power)


def _play(values: FloatArray, width: float) -> FloatArray:
    """Follow values with a play of a width to either side (Krasnosel'skii and Pokrovskii 1989)."""
    moved, last = np.empty(values.size), float(values[0])
    for i, value in enumerate(values.tolist()):
        last = min(max(last, value - width), value + width)
        moved[i] = last
    return moved


def _ignore_small(values: FloatArray, middle: float, width: float) -> FloatArray:
    away = values - middle
    return np.asarray(middle + np.sign(away) * np.maximum(np.abs(away) - width, 0.0))


def _limit_rate(values: FloatArray, most: float) -> FloatArray:
    moved, last = np.empty(values.size), float(values[0])
    for i, value in enumerate(values.tolist()):
        last += min(max(value - last, -most), most)
        moved[i] = last
    return moved


def _smooth(values: FloatArray, width: int) -> FloatArray:
    padded = np.pad(values, width // 2, mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
