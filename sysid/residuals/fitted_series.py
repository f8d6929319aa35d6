"""Residuals of measured and simulated outputs that are kept, when their problem is gone."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.records import Channel
from sysid.residuals.residual_tests import ResidualSeries, make_residual_series


class FittedSeries(NamedTuple):
    """Measured and simulated values (N,) of one output in one experiment (from 0).

    `first` samples of the record lie before them: the part that the model was fitted to.
    """

    experiment: int
    output: str
    times: FloatArray
    measured: FloatArray
    simulated: FloatArray
    first: int = 0


def list_fitted_residuals(
    fits: Iterable[FittedSeries],
    inputs: Sequence[tuple[Channel, ...]],
    weights: Mapping[str, float],
    skip: int = 0,
    loss_scale: float = 0.0,
    correlation_times: Mapping[str, float] | None = None,
) -> Iterator[ResidualSeries]:
    """Iterate over the residuals as the loss uses them, without skipped and missing samples.

    Parameters
    ----------
    inputs : sequence of tuple of Channel
        Of every experiment; an experiment beyond them has none.
    weights : mapping of str to float
        Of every output.
    loss_scale : float
        Scale of the soft-l1 loss, or 0 for squares.
    correlation_times : mapping of str to float, optional
        Correlation time (s) of the noise of outputs that have one.
    """
    for fit in fits:
        scored = np.arange(fit.first, fit.first + fit.times.size) >= skip
        weight = weights[fit.output]
        yield make_residual_series(
            fit.experiment,
            fit.output,
            fit.times,
            weight * fit.measured,
            weight * fit.simulated,
            scored & np.isfinite(fit.measured),
            inputs[fit.experiment] if fit.experiment < len(inputs) else (),
            loss_scale,
            (correlation_times or {}).get(fit.output, 0.0),
        )
