"""Outputs that are means over a sampling period, by an integral beside the states.

The mean of y over [t - h, t] is (Y(t) - Y(t - h)) / h with dY/dt = y. The solver integrates Y with
the states, so its accuracy is theirs. A simulation begins a period before the first mean.
"""

from collections.abc import Sequence
from dataclasses import replace

from sysid.core.errors import InvalidRecord, InvalidSettings, join_pointer
from sysid.core.settings import PredictionKind
from sysid.data.holds import MEANS
from sysid.data.records import Channel, Record
from sysid.kernels.signals.past_reads import is_difference
from sysid.language.tree import Binary, Number, PastValue
from sysid.models.model import FixedInitial, Model, ModelSignal

_PERIOD_TOLERANCE = 1e-3  # relative difference of the periods of two records


def average_outputs(
    model: Model, records: Sequence[Record], prediction: PredictionKind = "simulation"
) -> Model:
    """Return the model with means for the outputs that the records have as means.

    Its states are the model's, then an integral for each of these outputs.

    Raises
    ------
    InvalidSettings
        If not all records have an output as means of one period, or its times are irregular. If
        the model is a recursion, or is to predict one step ahead: both need values at their times.
    """
    states, equations, initial = [*model.states], [*model.equations], [*model.initial]
    outputs = []
    for output in model.outputs:
        period = _find_period(output.name, records)
        if period is None:
            outputs.append(output)
            continue
        check_mean_output(model, output.name, prediction)
        name = f"∫{output.name}"
        states.append(ModelSignal(name))
        equations.append(output.expression)
        initial.append(FixedInitial(0.0))
        rise = Binary("-", PastValue(name, "state"), PastValue(name, "state", delay=Number(period)))
        outputs.append(replace(output, expression=Binary("/", rise, Number(period))))
    if len(states) == len(model.states):
        return model
    return replace(
        model,
        states=tuple(states),
        equations=tuple(equations),
        initial=tuple(initial),
        order=(*model.order, *range(len(model.states), len(states))),
        outputs=tuple(outputs),
    )


def check_mean_output(model: Model, name: str, prediction: PredictionKind) -> None:
    """Check that an output of a model may be a mean.

    Raises
    ------
    InvalidSettings
        If the model is a recursion, or is to predict one step ahead.
    """
    if is_difference(model) or prediction != "simulation":
        what = "a recursion" if is_difference(model) else "a prediction one step ahead"
        raise InvalidSettings(
            join_pointer("hold", name),
            f"output {name!r} is a mean of a period, but {what} needs values at the times of the "
            "samples. Use a differential model and a free run, or hold auto",
        )


def locate_mean(channel: Channel) -> tuple[Channel, float]:
    """Put each mean at the end of its period; return when (s) the first one begins.

    A channel without means begins at its first sample.
    """
    if channel.hold not in MEANS:
        return channel, float(channel.times[0])
    period = channel.read_period()
    if channel.hold == "mean-after":
        return replace(channel, times=channel.times + period), float(channel.times[0])
    return channel, float(channel.times[0]) - period


def _find_period(name: str, records: Sequence[Record]) -> float | None:
    """Find the period (s) of which an output has means; None if it has none."""
    channels = [one for record in records for one in record.outputs if one.name == name]
    means = [one for one in channels if one.hold in MEANS]
    if not means:
        return None
    try:
        periods = [one.read_period() for one in means]
    except InvalidRecord as error:
        raise InvalidSettings(join_pointer("hold", name), str(error)) from None
    if len(means) < len(channels) or max(periods) - min(periods) > _PERIOD_TOLERANCE * periods[0]:
        raise InvalidSettings(
            join_pointer("hold", name),
            f"output {name!r} needs means of one period in all experiments",
        )
    return periods[0]
