"""Another input: a recorded channel that the model does not use acts on the output.

It acts after a lag and through a part of the first order, beside the plant, or at the plant's
input and through the plant. Each lag and time constant is a column, of which the likeliest counts.

A channel is an input only if its past tells of the residuals what their own past, the inputs and
the simulated output do not (causality: Granger, Econometrica 37 (1969) 424). So the output in
another unit, a clock, or the set point of a loop is none. A second sensor has noise of its own, and
may tell more. But it follows the output, and what the output or an input drives is no input.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray
from sysid.judgement.explanations.structure import filter_signal
from sysid.judgement.levels import DEFECT_GAIN, STRONG_ODDS
from sysid.judgement.residual_context import (
    Candidate,
    ResidualContext,
    interpolate_known,
    read_channel,
)
from sysid.judgement.unrecorded_input import compute_reach
from sysid.kernels.signals.past_reads import is_difference

_LAGS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0)  # samples
_TIMES = (0.0, 1.0, 1.7, 3.0, 5.0, 9.0, 15.0, 26.0, 45.0, 80.0, 140.0)  # samples
_PAST = 4  # samples that follow each other, of what is known already
_LATE = (6, 9, 14, 22, 34)  # earlier ones of the inputs
_SAMPLES_PER_COLUMN = 4  # at least
"""Measured with `benchmarks.judgement`, of six records with a missing input and six in which it was
recorded: 2 to 8 give the same verdicts, and so do a `_PAST` of 2 to 6, and a `_REACH` of 32 to
128."""
_COUNTED = 2  # a lag and a time constant
_RANK = 1e-7  # of columns of length 1: less is rounding
_REACH = 64  # samples, in which an input drives a channel


class _Response(NamedTuple):
    """Columns (n, q) of a channel's response, and how it acts in words."""

    columns: FloatArray
    way: str
    advice: str


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose that a recorded channel acts beside the inputs."""
    if is_difference(context.problem.model) or context.problem.prediction != "simulation":
        return  # predictions know the noise of their samples
    names = dict.fromkeys(one.name for record in context.problem.records for one in record.others)
    if not names:
        return
    known = _list_known(context)
    for name in names:
        signal = _read(context, name)
        if not np.ptp(signal) > 0 or _is_driven(context, signal):
            continue
        for response in _list_responses(context, name):
            for number in context.choose_columns(response.columns):
                column = response.columns[:, number]
                if _tells_more(context, known, column):
                    yield Candidate(
                        "another input",
                        "input",
                        context.weigh(column),
                        f"{name} acts as another input",
                        f"the recorded channel {name} acts on the output {response.way}, and the "
                        "model does not have it",
                        response.advice,
                        counted=_COUNTED,
                    )


def _list_responses(context: ResidualContext, name: str) -> Iterator[_Response]:
    lagged = np.column_stack([_read(context, name, lag) for lag in _LAGS])
    filtered = [_filter(context, lagged, samples) for samples in _TIMES]
    outputs = " and ".join(output.name for output in context.problem.model.outputs)
    yield _Response(
        np.hstack(filtered),
        "beside the plant",
        f"Add {name} to the inputs of the model's document. Add a state that {name} drives by a "
        f"first-order part, and add it to the output {outputs}.",
    )
    for channel in context.moving_inputs:
        plant = _simulate_at_input(context, name, channel.name)
        if plant is not None:
            yield _Response(
                _delay(context, plant),
                f"at the input of the plant, as {channel.name} does",
                f"Add {name} to the inputs of the model's document, and a term c*{name} to "
                f"{channel.name} in its equations, with c as a parameter.",
            )


def _read(context: ResidualContext, name: str, lag: float = 0.0) -> FloatArray:
    """Read a channel at the times (n,) of the samples, `lag` periods before; 0 where there is none.

    Its mean over each experiment is taken away. A held channel is read after its jump.
    """
    values = np.zeros(context.times.size)
    for part in context.parts:
        for channel in context.problem.records[part.experiment].others:
            if channel.name == name:
                found = read_channel(channel, part.times, lag)
                values[part.rows] = found - np.mean(found)
    return values


def _simulate_at_input(context: ResidualContext, name: str, at: str) -> FloatArray | None:
    """Simulate what a channel adds (n,) if it acts where an input does, without its time lag."""
    reach = compute_reach(context.problem, context.analysis)
    records = []
    for record in context.problem.records:
        others = [one for one in record.others if one.name == name]
        inputs = list(record.inputs)
        for number, channel in enumerate(inputs):
            if channel.name == at and others:
                added = interpolate_known(others[0], channel.times + reach)
                span = float(np.ptp(added))
                scale = float(np.ptp(channel.values)) / span if span > 0 else 0.0
                inputs[number] = replace(
                    channel,
                    values=channel.values + scale * (added - added[0]),
                    hold=channel.effective_hold,
                )
        records.append(replace(record, inputs=tuple(inputs)))
    return context.compute_effect(records)


def _delay(context: ResidualContext, values: FloatArray) -> FloatArray:
    """Delay values (n,) by each of the lags, as columns (n, q)."""
    columns = np.zeros((values.size, len(_LAGS)))
    for part in context.parts:
        own = values[part.rows]
        at = np.arange(own.size)
        for number, lag in enumerate(_LAGS):
            columns[part.rows, number] = np.interp(at - lag, at, own)
    return columns


def _filter(context: ResidualContext, columns: FloatArray, samples: float) -> FloatArray:
    """Filter columns (n, q) within each series by a time constant of some samples."""
    if not samples:
        return columns
    filtered = np.zeros(columns.shape)
    for part in context.parts:
        filtered[part.rows] = filter_signal(columns[part.rows], samples)
    return filtered


def _is_driven(context: ResidualContext, signal: FloatArray) -> bool:
    """Whether an input or the output tells of a signal (n,) what its own past does not."""
    own = [_shift(context, signal, lag) for lag in range(1, _PAST + 1)]
    known = np.column_stack([*_list_trend(context), *own])
    outputs = [
        _shift(context, values, lag)
        for values in (context.simulation, context.measurement)
        for lag in range(_PAST)
    ]
    if _compute_gain(context, signal, known, np.column_stack(outputs)) > STRONG_ODDS:
        return True
    for channel in context.moving_inputs:
        values = context.read_input(channel.name)
        past = np.column_stack([_shift(context, values, lag) for lag in range(_REACH)])
        if _compute_gain(context, signal, known, past, is_one=True) > STRONG_ODDS:
            return True
    return False


def _tells_more(context: ResidualContext, known: FloatArray, column: FloatArray) -> bool:
    """Whether the past of a column (n,) tells of the residuals what is not known of them.

    Their own past is the noise model's part.
    """
    past = context.weigh(_shift(context, column, 1))
    model = context.residual_model
    more = model.fit(np.hstack([known, past]), _COUNTED)
    return model.fit(known).criterion - more.criterion > DEFECT_GAIN


def _list_known(context: ResidualContext) -> FloatArray:
    """List columns (n, q) that tell of the residuals: the past of inputs and simulated output."""
    lags = range(_PAST + 1)
    known = [*_list_trend(context), *(_shift(context, context.simulation, lag) for lag in lags)]
    for channel in context.moving_inputs:
        values = context.read_input(channel.name)
        known += [_shift(context, values, lag) for lag in (*lags, *_LATE)]
    return context.weigh(np.column_stack(known))


def _list_trend(context: ResidualContext) -> list[FloatArray]:
    """List a constant and a straight line (n,) for each series."""
    columns = []
    for part in context.parts:
        constant, line = np.zeros(context.times.size), np.zeros(context.times.size)
        constant[part.rows] = 1.0
        line[part.rows] = np.linspace(-1.0, 1.0, part.times.size)
        columns += [constant, line]
    return columns


def _shift(context: ResidualContext, values: FloatArray, lag: int) -> FloatArray:
    """Shift values (n,) by some samples within each series."""
    shifted = np.zeros(values.size)
    for part in context.parts:
        own = values[part.rows]
        shifted[part.rows] = own[np.maximum(np.arange(own.size) - lag, 0)]
    return shifted


def _compute_gain(
    context: ResidualContext,
    values: FloatArray,
    known: FloatArray,
    more: FloatArray,
    *,
    is_one: bool = False,
) -> float:
    """Compute how much better values (n,) are explained with more columns (Schwarz's criterion).

    With `is_one` the likeliest of them counts, and its choice counts as a parameter.
    """
    is_later = np.concatenate([np.arange(part.times.size) >= _PAST for part in context.parts])
    n, used = int(np.count_nonzero(is_later)), 2 if is_one else more.shape[1]
    if n < _SAMPLES_PER_COLUMN * (known.shape[1] + used):
        return 0.0
    basis = _find_basis(known[is_later])
    rest, added = (one - basis @ (basis.T @ one) for one in (values[is_later], more[is_later]))
    before = float(rest @ rest)
    if is_one:
        lengths = np.linalg.norm(added, axis=0)
        is_own = lengths > _RANK * np.linalg.norm(more[is_later], axis=0)
        shares = np.where(is_own, (rest @ added) / np.where(is_own, lengths, 1.0), 0.0)
        after = before - float(np.max(np.square(shares)))
    else:
        further = _find_basis(added, np.linalg.norm(more[is_later], axis=0))
        after = before - float(np.sum(np.square(further.T @ rest)))
    least = _RANK**2 * float(values[is_later] @ values[is_later])
    return float(n * np.log(max(before, least) / max(after, least)) - used * np.log(n))


def _find_basis(columns: FloatArray, lengths: FloatArray | None = None) -> FloatArray:
    """Find an orthonormal basis of columns (n, q), by default each of length 1."""
    length = np.linalg.norm(columns, axis=0) if lengths is None else lengths
    left, singular, _ = np.linalg.svd(
        columns / np.where(length > 0, length, 1.0), full_matrices=False
    )
    return np.asarray(left[:, singular > _RANK])
