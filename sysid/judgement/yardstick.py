"""A yardstick: a linear black box, compared with the user's model on blocks that it did not see.

The user's model is compared on the same samples, but it was fitted to them too. So it is at an
advantage, and what is said against it is safe. Poles and time lags of the black box were chosen
with all blocks, and the best of many choices fits even noise. So the logarithm of their number is
subtracted from the gain (Bonferroni).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, log

import numpy as np
from numpy.fft import rfft

from sysid.core.types import FloatArray, IntArray
from sysid.data.interpolation import interpolate_channel
from sysid.data.records import Channel
from sysid.judgement.black_box import Samples, simulate_left_out
from sysid.residuals.autocorrelation import ROUNDING_SHARE, space_residuals
from sysid.residuals.series import iterate_parts
from sysid.simulation.fit_metrics import EXPLAINED_PERCENT, rms
from sysid.simulation.problem import Problem

CLEAR_GAIN = log(20.0)
"""Gain from which on a yardstick is clearly better: odds of 20 : 1.

The true model was never called worse in 575 records of linear and nonlinear plants, half of them
with AR(1) noise of correlation times up to a twelfth of the record. The largest gain was -2.
"""

NOTABLE_SHARE = 0.15
"""Share of the mean square error of the user's model that a notable yardstick saves.

It is a measure of importance, not of chance. It is 8 % of the RMS error.
"""

_BLOCKS = 10  # left out in turn, over all experiments
_WARM_UP = 0.1  # of every experiment: it tells where the states start, and is not compared
_MIN_SAMPLES = 40


@dataclass(frozen=True, slots=True)
class Yardstick:
    """A linear model and the user's, compared on blocks that only the linear one did not see.

    Attributes
    ----------
    output : str
    order : int
        Number of poles.
    samples : int
        Samples that are compared.
    fit_percent, own_fit_percent : float
        Fit (%) of the linear model on left-out blocks, and of the user's on the same samples.
    rms, own_rms : float
        RMS error of both, in the unit of the output.
    gain : float
        Logarithm of the likelihood ratio, from as many samples as are independent, less that of the
        number of linear models that were tried.
    """

    output: str
    order: int
    samples: int
    fit_percent: float
    own_fit_percent: float
    rms: float
    own_rms: float
    gain: float

    @property
    def saved_share(self) -> float:
        """Share of the user's mean square error that the linear model saves; negative: it adds."""
        return 1.0 - (self.rms / self.own_rms) ** 2

    @property
    def is_clearly_better(self) -> bool:
        """Whether the linear model is better beyond chance, and by a notable share."""
        return self.gain > CLEAR_GAIN and self.saved_share > NOTABLE_SHARE


def fit_yardstick(problem: Problem, simulated: FloatArray) -> Yardstick | None:
    """Fit linear models to each output and compare the best with the user's model.

    Every output is explained by all inputs. That of the largest gain is returned.

    Parameters
    ----------
    problem : Problem
    simulated : FloatArray, shape (M,)
        Values that the user's model simulates at the measured times.

    Returns
    -------
    Yardstick or None
        None if no input moves, no output has 40 samples, or the user's model diverged or leaves
        errors of the solver only.
    """
    inputs = [[record[one.name] for record in problem.records] for one in problem.model.inputs]
    compared = [
        _compare(output, inputs, *_read_samples(problem, simulated, output))
        for output in dict.fromkeys(part.output for part in iterate_parts(problem))
    ]
    known = [yardstick for yardstick in compared if yardstick is not None]
    return max(known, key=lambda one: (one.is_clearly_better, one.gain), default=None)


def fit_reverse(
    problem: Problem, simulated: FloatArray, cause: str, effect: str
) -> Yardstick | None:
    """Fit linear models to an input with an output as their input, and compare as fits in %.

    The user's model counts as if it left the same share of the input as it leaves of the output.

    Parameters
    ----------
    simulated : FloatArray, shape (M,)
        Values that the user's model simulates at the measured times.
    cause, effect : str
        Input and output of the model.
    """
    samples, model = _read_samples(problem, simulated, effect)
    if not _tells(samples, model):
        return None
    values, drivers = np.zeros(samples.times.size), list[Channel]()
    for number, record in enumerate(problem.records):
        [given] = [one for one in record.inputs if one.name == cause]
        [answer] = [one for one in record.outputs if one.name == effect]
        own = samples.experiment == number
        values[own] = interpolate_channel(replace(given, hold="first"), samples.times[own])
        drivers.append(replace(answer, hold="first"))
    left = (samples.values - model) * float(np.std(values) / np.std(samples.values))
    return _compare(cause, [drivers], samples._replace(values=values), values - left)


def _read_samples(
    problem: Problem, simulated: FloatArray, output: str
) -> tuple[Samples, FloatArray]:
    """Read the scored samples of an output, in blocks, and the simulated values (N,)."""
    measured, model = (
        problem.evaluator.measured[problem.scored_rows],
        simulated[problem.scored_rows],
    )
    columns = list[tuple[FloatArray, ...]]()
    halves = 2 * max(round(_BLOCKS / len(problem.records)), 1)
    for part in iterate_parts(problem):
        if part.output != output:
            continue
        size = part.times.size
        block = np.full(size, -1)
        for number, own in enumerate(
            np.array_split(np.arange(ceil(_WARM_UP * size), size), halves)
        ):
            block[own] = halves * len(columns) + number
        experiment = np.full(size, part.experiment)
        columns.append((experiment, part.times, measured[part.rows], block, model[part.rows]))
    *joined, own_model = map(np.concatenate, zip(*columns, strict=True))
    return Samples(*joined), own_model


def _tells(samples: Samples, model: FloatArray) -> bool:
    """Whether samples are enough, move, and are not explained by the user's model (N,)."""
    values = samples.values
    spread = float(np.std(values))
    return (
        values.size >= _MIN_SAMPLES
        and bool(np.all(np.isfinite(model)))
        and spread > ROUNDING_SHARE * float(np.max(np.abs(values)))
        and rms(values - model) > (1.0 - EXPLAINED_PERCENT / 100.0) * spread
    )


def _compare(
    output: str, inputs: Sequence[Sequence[Channel]], samples: Samples, model: FloatArray
) -> Yardstick | None:
    """Fit linear models of inputs (U, E) and compare them; None if too little can be compared."""
    left_out = simulate_left_out(inputs, samples) if _tells(samples, model) and inputs else None
    if left_out is None:
        return None
    told = np.isfinite(left_out.values)
    experiments, values = samples.experiment[told], samples.values[told]
    means = np.bincount(experiments, values) / np.maximum(np.bincount(experiments), 1)
    spread = rms(values - means[experiments])
    own_errors, errors = values - model[told], values - left_out.values[told]
    own, other = rms(own_errors), rms(errors)
    if not min(spread, own, other) > 0.0:
        return None
    gain = _compute_gain(experiments, samples.times[told], own_errors, errors)
    return Yardstick(
        output,
        left_out.order,
        values.size,
        100.0 * (1.0 - other / spread),
        100.0 * (1.0 - own / spread),
        other,
        own,
        gain - left_out.choices,
    )


def _compute_gain(
    experiments: IntArray, times: FloatArray, own_errors: FloatArray, errors: FloatArray
) -> float:
    """Compute the logarithm of the likelihood ratio, from as many samples as are independent.

    For Gaussian noise of unknown size it is ν/2 times the logarithm of the ratio of both mean
    squares, without a penalty, because the samples were left out. As the residuals of the user's
    model have a colour, ν is the number of white samples whose variance is as uncertain: n / Σ ρ²
    (Bayley and Hammersley, J. R. Statist. Soc. Suppl. 8 (1946) 184), here with the sum over all
    lags ρ by the periodogram. That counts a misfit as colour, so it is too small rather than too
    large.
    """
    square = fourth = 0.0
    for number in np.unique(experiments):
        own = experiments == number
        spaced = space_residuals(times[own], own_errors[own])
        power = np.square(np.abs(rfft(spaced.values)))
        square += float(np.sum(power))
        fourth += float(np.sum(np.square(power)))
    independent = min(4.0 * square**2 / fourth, float(errors.size)) if fourth > 0 else 0.0
    return 0.5 * independent * log(rms(own_errors) ** 2 / rms(errors) ** 2)
