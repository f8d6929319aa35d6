"""Structure: a part of the response that the model lacks.

One more time constant and a zero are columns of the simulated output itself. What no part of them
explains, past values of the inputs explain: a model-error model (Ljung, Model validation and model
error modeling, 1999).
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.fft import irfft, rfft

from sysid.core.types import FloatArray
from sysid.judgement.residual_context import Candidate, ResidualContext

_PARTS = (1.0, 3.0, 10.0, 30.0, 100.0)  # time constants of the new part, in samples
_LAGS = 12  # past values of each input, denser towards the present, over a quarter of the record
_SAMPLES_PER_LAG = 4  # at least: of a short record with many inputs fewer values are looked at


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose one more part, and dynamics of no certain form."""
    for samples in _PARTS:
        filtered = np.zeros(context.times.size)
        for part in context.parts:
            values = context.simulation[part.rows]
            filtered[part.rows] = filter_signal(values, samples) - values
        yield Candidate(
            "one more time constant",
            "structure",
            context.weigh(filtered),
            "a time constant is missing",
            "a time constant is missing from the model",
            "Use a model of one order more.",
            counted=1,
            is_vague=True,
        )
    if context.problem.is_free_run:  # predictions know the noise of their samples
        yield from _propose_zero(context)
    columns = list(_list_past_inputs(context))
    if columns:
        yield from _propose_dynamics(context, columns)


def _propose_zero(context: ResidualContext) -> Iterator[Candidate]:
    yield Candidate(
        "zero of the response",
        "structure",
        context.weigh(np.column_stack([context.slope, _differentiate(context)])),
        "the beginning of the response is missing",
        "the response begins otherwise than the model's, as with a zero or an inverse response",
        "Add a lead time (a zero) to the model.",
        is_vague=True,
    )


def _propose_dynamics(
    context: ResidualContext, columns: Sequence[FloatArray]
) -> Iterator[Candidate]:
    """Propose past values of the inputs, and their squares."""
    yield Candidate(
        "missing dynamics",
        "structure",
        context.weigh(np.column_stack(columns)),
        "a part of the response is missing",
        "the residuals follow the inputs: a part of the response is missing from the model",
        "Try a model of another structure.",
        is_vague=True,
    )
    squares = [np.square(column) - np.mean(np.square(column)) for column in columns[::2]]
    yield Candidate(
        "missing nonlinearity",
        "structure",
        context.weigh(np.column_stack(squares)),
        "a nonlinear part of the response is missing",
        "the residuals follow squares of the inputs: the plant is less linear than the model",
        "Try a nonlinear model.",
        is_vague=True,
    )


def filter_signal(values: FloatArray, samples: float) -> FloatArray:
    """Filter values (n, …) by a time constant of some samples; they rest at their first one."""
    n = values.shape[0]
    length = 1 << (2 * n - 1).bit_length()
    decay = np.exp(-np.arange(n) / samples) * -np.expm1(-1.0 / samples)
    spectra = rfft((values - values[0]).T, length) * rfft(decay, length)
    return np.asarray(irfft(spectra, length)[..., :n].T + values[0])


def _differentiate(context: ResidualContext) -> FloatArray:
    curvature = np.zeros(context.times.size)
    for part in context.parts:
        if part.times.size > 1:
            with np.errstate(all="ignore"):  # samples of several repeats may share a time
                found = np.gradient(context.slope[part.rows], part.times)
            curvature[part.rows] = np.where(np.isfinite(found), found, 0.0)
    return curvature


def _list_past_inputs(context: ResidualContext) -> Iterator[FloatArray]:
    """List columns (n,) of past values of each input that moves.

    A controller computes the present value from the output's, noise included. So predictions from
    measured outputs have no column of it.
    """
    longest = max(part.times.size for part in context.parts)
    most = context.times.size // (_SAMPLES_PER_LAG * max(len(context.moving_inputs), 1))
    spaced = np.geomspace(1.0, max(longest / 4, 1.0), min(_LAGS, max(most, 1)))
    lags = np.unique(spaced.astype(np.int64)) - (0 if context.problem.model.corrections else 1)
    for channel in context.moving_inputs:
        for lag in lags.tolist():
            column = context.read_input(channel.name, lag)
            if np.ptp(column) > 0:
                yield column - np.mean(column)
