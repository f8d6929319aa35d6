"""95 % bands of a simulated output: of the output itself, and of its next measurement.

The confidence band holds the output of the plant without noise. Its half width is t √(J C Jᵀ), with
the slopes J of the outputs in the parameters and the covariance C of the estimates (delta method;
Seber and Wild 1989, ch. 5). Samples of the posterior give it by their quantiles instead.

The prediction band holds a new measurement. The variance of the noise is added to that of the
output. Both assume that the model is right, and hold at each time by itself, not at all at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from sysid.core.distributions import student_limit
from sysid.core.types import FloatArray
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import compute_physical_scale
from sysid.uncertainty.sensitivities import compute_sensitivities

_MAX_SIMULATED = 20_000_000  # values of all samples of a posterior at once
_MIN_SAMPLES = 100
_LEVELS = (0.025, 0.975)


@dataclass(frozen=True, slots=True, eq=False)
class OutputBands:
    """95 % bands of one output of one record, in `unit`.

    Attributes
    ----------
    output, unit : str
    times : FloatArray, shape (N,)
        Seconds.
    simulated : FloatArray, shape (N,)
        Output at the estimate.
    confidence : FloatArray, shape (N, 2)
        Lower and upper end for the output without noise.
    prediction : FloatArray, shape (N, 2)
        The same for a new measurement.
    source : {"covariance", "posterior"}
        What the bands come from.
    """

    output: str
    unit: str
    times: FloatArray
    simulated: FloatArray
    confidence: FloatArray
    prediction: FloatArray
    source: Literal["covariance", "posterior"]


class ParameterSpread(NamedTuple):
    """How far the free parameters may be from their estimates.

    Attributes
    ----------
    names : tuple of str
    covariance : FloatArray, shape (D, D)
    degrees, noise_degrees : float
        Degrees of freedom of the estimates, and of the variance of the noise.
    samples : FloatArray, shape (m, D), or None
        Samples of the posterior.
    """

    names: tuple[str, ...]
    covariance: FloatArray
    degrees: float
    noise_degrees: float
    samples: FloatArray | None = None


NoiseDeviations = Mapping[tuple[int, str], float]
"""Standard deviation of the noise of each output of each record, in the output's unit."""


def compute_output_bands(
    problem: Problem, theta: FloatArray, spread: ParameterSpread, noise: NoiseDeviations
) -> tuple[tuple[OutputBands, ...], ...]:
    """Compute the bands of every output of every record of a problem at an estimate (D,).

    The free parameters of the problem are among those of the spread.
    """
    columns = [spread.names.index(name) for name in problem.free_names]
    simulated = problem.predict_ahead(theta[None])[0][0]
    quantile, noise_quantile = (
        student_limit(max(degrees, 1.0), 0.025)
        for degrees in (spread.degrees, spread.noise_degrees)
    )
    if spread.samples is None:
        covariance = spread.covariance[np.ix_(columns, columns)]
        half = quantile * _compute_deviations(problem, theta, covariance)
        confidence = np.column_stack([simulated - half, simulated + half])
    else:
        confidence = _compute_quantiles(problem, spread.samples[:, columns])
    source: Literal["covariance", "posterior"] = (
        "covariance" if spread.samples is None else "posterior"
    )
    indices = problem.split_by_output(np.arange(simulated.size, dtype=np.float64))
    return tuple(
        tuple(
            OutputBands(
                channel.name,
                channel.unit,
                channel.times,
                simulated[rows],
                confidence[rows],
                _add_noise(
                    simulated[rows], confidence[rows], noise_quantile * noise[e, channel.name]
                ),
                source,
            )
            for channel in record.outputs
            for rows in [part[channel.name].astype(np.int64)]
        )
        for e, (record, part) in enumerate(zip(problem.records, indices, strict=True))
    )


def _compute_deviations(problem: Problem, theta: FloatArray, covariance: FloatArray) -> FloatArray:
    """Compute the standard deviations (M,) of all simulated values."""
    if not theta.size:
        return np.zeros(problem.evaluator.n_measured)
    unweighted = np.ones(problem.evaluator.n_measured)
    every = replace(problem, evaluator=problem.evaluator._replace(weight=unweighted))
    scale = compute_physical_scale(problem, theta)
    slopes = compute_sensitivities(every, theta).columns / np.where(scale > 0, scale, 1.0)
    variances = np.sum((slopes @ covariance) * slopes, axis=1)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def _compute_quantiles(problem: Problem, samples: FloatArray) -> FloatArray:
    """Compute the quantiles (M, 2) of the outputs of samples (m, D); of fewer on long records."""
    most = max(_MAX_SIMULATED // problem.evaluator.n_measured, _MIN_SAMPLES)
    chosen = samples[:: -(-len(samples) // most)]
    outputs = problem.predict(np.ascontiguousarray(chosen))
    finite = outputs[np.isfinite(outputs).all(axis=1)]
    if not len(finite):
        return np.full((outputs.shape[1], 2), np.nan)
    return np.asarray(np.quantile(finite, _LEVELS, axis=0).T)


def _add_noise(simulated: FloatArray, confidence: FloatArray, noise: float) -> FloatArray:
    """Widen a confidence band (N, 2) by noise: squares of independent half widths add."""
    return np.asarray(
        simulated[:, None]
        + np.array([-1.0, 1.0]) * np.hypot(confidence - simulated[:, None], noise)
    )
