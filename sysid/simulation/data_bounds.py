"""Bounds and units that follow the data, for parameters of generic models.

A gain of 1 between a heater in % and an oven in °C is no more likely than one of 0.01. So a generic
model declares what a parameter is. Its bounds come from spans, range, period and duration, and its
unit, °C/%, from those of the channels.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.core.types import FloatArray
from sysid.core.units import divide_units, is_blank_unit
from sysid.data.records import Channel, Record
from sysid.models.kalman_filter import NoiseScales
from sysid.models.model import Model, ModelSignal, Output
from sysid.models.parameters import RATE_UNIT, BoundsRule, Parameter

Interval = tuple[float, float]

_REACH = 5.0  # largest gain, in ratios of spans
_OFFSET_REACH = 2.0  # the same, for what the input adds to an offset
_SLOW = 0.4  # of the record: time constant of a process that an input hardly moves
_LONGEST = 2.0  # of the record: largest time constant
_SHORTEST = 0.1  # of a sampling period: smallest time constant


@dataclass(frozen=True, slots=True)
class _Spans:
    """What the records say about the size of parameters.

    Attributes
    ----------
    outputs : tuple of float
        Range of all measured values.
    gain, rate : float
        Span of the output over that of the input, and over that of the input's integral. The gain
        is larger for an input that is faster than a slow process.
    offset : float
        Largest input, in its span, times the span of the output.
    period, duration : float
        Smallest sampling period and duration of the shortest record (s).
    """

    outputs: Interval
    gain: float
    rate: float
    offset: float
    period: float
    duration: float


def bound_by_data(
    parameters: tuple[Parameter, ...], records: Sequence[Record]
) -> tuple[Parameter, ...]:
    """Replace the bounds of parameters that follow the data.

    Bounds that the records say nothing about are left as they are. The input may be constant, for
    example, and so say nothing about a gain.
    """
    if not any(parameter.bounds for parameter in parameters):
        return parameters
    spans = _measure_spans(records)
    has_offset = any(parameter.bounds == "offset" for parameter in parameters)
    return tuple(
        parameter
        if parameter.bounds is None
        else _set_interval(parameter, _choose_interval(parameter.bounds, spans, has_offset))
        for parameter in parameters
    )


def add_units_of_data(
    parameters: tuple[Parameter, ...], records: Sequence[Record]
) -> tuple[Parameter, ...]:
    """Give their units to parameters that have those of the data, such as °C/% to a gain.

    Parameters stay without a unit where the inputs or the outputs have none, or several.
    """
    if not any(parameter.has_unit_of_data for parameter in parameters):
        return parameters
    output = _find_common_unit(channel for record in records for channel in record.outputs)
    driven = _find_common_unit(channel for record in records for channel in record.inputs)
    return tuple(
        replace(parameter, unit=_choose_unit(parameter, output, driven))
        if parameter.has_unit_of_data
        else parameter
        for parameter in parameters
    )


def _choose_unit(parameter: Parameter, output: str | None, driven: str | None) -> str:
    if output is None or (parameter.bounds in ("gain", "rate") and driven is None):
        return parameter.unit
    if parameter.bounds == "gain":
        return divide_units(output, str(driven))
    if parameter.bounds == "rate":
        return RATE_UNIT if output == driven else divide_units(output, f"{driven}·s")
    return output


def find_signal_units(records: Sequence[Record]) -> dict[str, str]:
    """Find the units of the recorded signals by name; those of several units are left out."""
    channels = [c for record in records for c in (*record.inputs, *record.outputs)]
    units = {c.name: _find_common_unit(d for d in channels if d.name == c.name) for c in channels}
    return {name: unit for name, unit in units.items() if unit is not None}


def list_units(model: Model, records: Sequence[Record]) -> dict[str, str]:
    """List the units of states, inputs and outputs: the records' where the model has none."""
    signals: list[ModelSignal | Output] = [*model.states, *model.inputs, *model.outputs]
    recorded = find_signal_units(records)
    return {
        one.name: recorded.get(one.name, one.unit) if is_blank_unit(one.unit) else one.unit
        for one in signals
    }


def _find_common_unit(channels: Iterable[Channel]) -> str | None:
    """Find the unit that channels share; None if they have none, or several."""
    units = {channel.unit for channel in channels if not is_blank_unit(channel.unit)}
    return units.pop() if len(units) == 1 else None


def measure_noise_scales(records: Sequence[Record]) -> NoiseScales:
    """Measure what bounds the noise of a plant."""
    measured: dict[str, list[FloatArray]] = {}
    for record in records:
        for channel in (*record.inputs, *record.outputs):
            measured.setdefault(channel.name, []).append(_drop_missing(channel).values)
    values = {name: np.concatenate(parts) for name, parts in measured.items()}
    spans = {name: float(np.ptp(one)) for name, one in values.items() if one.size}
    outputs = [channel for record in records for channel in record.outputs]
    period = min(_find_period(_drop_missing(channel)) for channel in outputs)
    duration = min(record.stop - record.start for record in records)
    distances = [step for one in outputs for step in np.diff(one.times).tolist() if step > 0]
    return NoiseScales(spans, period, duration, min(distances, default=period))


def _choose_interval(rule: BoundsRule, spans: _Spans, has_offset: bool) -> Interval:
    lower, upper = spans.outputs
    match rule:
        case "gain":
            return -_REACH * spans.gain, _REACH * spans.gain
        case "rate":
            return -_REACH * spans.rate, _REACH * spans.rate
        case "time":
            return _SHORTEST * spans.period, _LONGEST * spans.duration
        case "delay":
            return 0.0, 0.5 * spans.duration
        case "offset":
            reach = (upper - lower) + _OFFSET_REACH * spans.offset
            return lower - reach, upper + reach
        case "state":
            reach = (upper - lower) + _OFFSET_REACH * spans.offset
            # Without the offset that is estimated with it, a state is around zero.
            return (
                (lower - upper - reach, upper - lower + reach)
                if has_offset
                else (
                    lower - (upper - lower),
                    upper + (upper - lower),
                )
            )


def _set_interval(parameter: Parameter, interval: Interval) -> Parameter:
    lower, upper = interval
    is_usable = np.isfinite([lower, upper]).all() and lower < upper
    if not is_usable or (parameter.scale == "log" and lower <= 0):
        return parameter
    return replace(parameter, lower=lower, upper=upper)


def _measure_spans(records: Sequence[Record]) -> _Spans:
    outputs = [_drop_missing(channel) for record in records for channel in record.outputs]
    inputs = [channel.history_and_samples for record in records for channel in record.inputs]
    measured = np.concatenate([channel.values for channel in outputs])
    driven = np.concatenate([channel.values for channel in inputs]) if inputs else np.zeros(1)
    span, driven_span = float(np.ptp(measured)), float(np.ptp(driven))
    areas = [float(np.ptp(_integrate(channel))) for channel in inputs]
    means = [_measure_slow_span(channel) for channel in inputs]
    gain = _divide(span, min(driven_span, max(means, default=0.0) / _SLOW))
    return _Spans(
        outputs=(float(np.min(measured)), float(np.max(measured))),
        gain=gain,
        rate=_divide(span, max(areas, default=0.0)),
        offset=0.0 if np.isnan(gain) else gain * float(np.max(np.abs(driven))),
        period=min(_find_period(channel) for channel in outputs),
        duration=min(record.stop - record.start for record in records),
    )


def _drop_missing(channel: Channel) -> Channel:
    is_measured = np.isfinite(channel.values)
    return replace(
        channel,
        times=channel.times[is_measured],
        values=channel.values[is_measured],
        repeats=None,
    )


def _integrate(channel: Channel) -> FloatArray:
    means = 0.5 * (channel.values[1:] + channel.values[:-1])
    return np.concatenate([[0.0], np.cumsum(means * np.diff(channel.times))])


def _measure_slow_span(channel: Channel) -> float:
    """Measure how far an input moves a process that is as slow as the record."""
    centred = replace(channel, values=channel.values - np.mean(channel.values))
    return _divide(float(np.ptp(_integrate(centred))), float(np.ptp(channel.times)))


def _find_period(channel: Channel) -> float:
    steps = np.diff(channel.times)
    steps = steps[steps > 0]
    return float(np.median(steps)) if steps.size else float("nan")


def _divide(above: float, below: float) -> float:
    return above / below if above > 0 and below > 0 else float("nan")
