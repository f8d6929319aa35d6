"""The numbers of one experiment as a kernel reads them (see `sysid.kernels.layout`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Literal

import numpy as np

from sysid.core.types import FloatArray, IntArray, Interval
from sysid.data.interpolation import FineInput, fine_input
from sysid.data.records import Channel
from sysid.kernels.abi import LANES
from sysid.kernels.layout import Layout, Variant
from sysid.kernels.reads import averaged_inputs, furthest, is_difference, lags, with_history
from sysid.language.intervals import bounds
from sysid.models.delays import check_length
from sysid.models.model import Model
from sysid.simulation.grid import Grid, is_on_grid

_SLACK = 512  # rows of history besides those that lags reach back: how often they are moved


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Measured samples of one output: places on the grid, values (0: missing), weights."""

    places: FloatArray
    values: FloatArray
    weights: FloatArray
    on_grid: FloatArray
    """The measurement interpolated to the grid points; empty where it is not needed."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """How a state starts: given first values, and the row of theta if it is estimated."""

    given: FloatArray
    row: int = -1


@dataclass(frozen=True, slots=True, eq=False)
class Numbers:
    """What a kernel gets for one experiment."""

    ints: IntArray
    floats: FloatArray
    n_work: int


def largest_lags(
    model: Model, kind: str, parameters: Mapping[str, Interval], grid: Grid
) -> dict[str, float]:
    """Largest lag of each lagged signal of a kind, in integration steps, inside the bounds.

    Raises
    ------
    RecordTooShort
        If a lag may be as long as the record.
    """
    largest: dict[str, float] = {}
    step = grid.integration_step
    for past in lags(model, kind):
        if past.lag is None:
            continue
        check_length(model, past, parameters, step, grid.duration)
        upper = bounds(past.lag, parameters, step)[1]
        steps = upper if is_difference(model) else upper / step
        largest[past.name] = max(steps, largest.get(past.name, 0.0))
    return largest


def fine_inputs(
    model: Model, channels: Sequence[Channel], parameters: Mapping[str, Interval], grid: Grid
) -> list[FineInput]:
    """The inputs between their samples, as far back as the lags may reach."""
    reach = largest_lags(model, "input", parameters, grid)
    back = furthest(model)
    mean: Literal["around", "after"] = "after" if is_difference(model) else "around"
    averaged = averaged_inputs(model)
    laid = []
    for quantity, channel in zip(model.inputs, channels, strict=True):
        name = quantity.name
        lag = reach.get(name, 0.0) + back + 1
        how = mean if name in averaged else None
        laid.append(fine_input(channel, grid.start, grid.integration_step, grid.last, lag, how))
    return laid


def numbers(
    model: Model, variant: Variant, grid: Grid, inputs: Sequence[FineInput],
    outputs: Sequence[Samples], starts: Sequence[Start], lag: float, scale: float,
) -> Numbers:  # fmt: skip
    """Lay out one experiment.

    Parameters
    ----------
    lag : float
        Largest lag of a state, in integration steps.
    scale : float
        Scale of the soft-l1 loss.
    """
    page = _Page(Layout.of(model))
    cap = ceil(lag)  # a lag rounded to whole steps may exceed its bound by part of one
    reach = cap + furthest(model) + 5
    rows = max(min(grid.last + reach + 3, 2 * reach + _SLACK), 2 * reach + 3)
    page.ints[:3] = [grid.last, reach, rows]
    page.floats[:3] = [grid.integration_step, cap, scale]
    for i, start in enumerate(starts):
        page.floats[page.layout.initial(i)] = start.given[0]
        page.put("state", i, row=start.row, given=page.add_floats(start.given))
    for i, signal in enumerate(inputs):
        place = page.add_floats(signal.values)
        page.put("input", i, zero=place + signal.zero, points=signal.points, begin=signal.begin,
                 end=signal.end, cap=signal.cap)  # fmt: skip
    first = 0
    for i, samples in enumerate(outputs):
        add = _on_grid if variant.on_grid else _between_grid
        add(page, i, samples, grid, first)
        page.put("output", i, first=first, grid=page.add_floats(samples.on_grid))
        first += samples.places.size
    n_work = max(len(with_history(model)) * rows * LANES, 1)
    return Numbers(*page.arrays(), n_work)


class _Page:
    """The two arrays, growing behind their heads."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.ints = [0] * layout.n_ints
        self.floats = [0.0] * layout.n_floats
        self._more_ints: list[IntArray] = []
        self._more_floats: list[FloatArray] = []
        self._n_ints, self._n_floats = layout.n_ints, layout.n_floats

    def put(self, kind: str, number: int, **fields: int) -> None:
        """Write entries of a state, an input or an output into the head."""
        place = getattr(self.layout, kind)
        for field, value in fields.items():
            self.ints[place(number, field)] = value

    def add_ints(self, values: IntArray) -> int:
        """Append whole numbers; gives their place."""
        self._more_ints.append(values)
        self._n_ints += values.size
        return self._n_ints - values.size

    def add_floats(self, values: FloatArray) -> int:
        """Append numbers; gives their place."""
        self._more_floats.append(values)
        self._n_floats += values.size
        return self._n_floats - values.size

    def arrays(self) -> tuple[IntArray, FloatArray]:
        """Both arrays as a whole."""
        ints = np.concatenate([np.array(self.ints, dtype=np.int64), *self._more_ints])
        return ints, np.concatenate([np.array(self.floats), *self._more_floats])


def _on_grid(page: _Page, i: int, samples: Samples, grid: Grid, first: int) -> None:
    """Dense arrays over the grid points: row of the prediction or -1, value, weight."""
    points = samples.places.astype(np.int64)
    rows = np.full(grid.points, -1, dtype=np.int64)
    rows[points] = first + np.arange(points.size)
    values, weights = np.zeros(grid.points), np.zeros(grid.points)
    values[points], weights[points] = samples.values, samples.weights
    page.put("output", i, samples=page.add_ints(rows), measured=page.add_floats(values),
             weight=page.add_floats(weights))  # fmt: skip


def _between_grid(page: _Page, i: int, samples: Samples, grid: Grid, first: int) -> None:
    """Per grid interval (n - 1, n]: the bounds of its samples and their positions inside it."""
    interval = np.ceil(samples.places)
    fraction = samples.places - (interval - 1.0)
    bounds_ = np.searchsorted(interval, np.arange(grid.points + 1), side="left")
    page.put("output", i, samples=page.add_ints(bounds_.astype(np.int64)),
             fraction=page.add_floats(fraction), measured=page.add_floats(samples.values),
             weight=page.add_floats(samples.weights))  # fmt: skip


def fits_grid(outputs: Sequence[Samples]) -> bool:
    """Whether every output has its samples on grid points of their own."""
    return all(is_on_grid(samples.places) for samples in outputs)


def has_weights(outputs: Sequence[Samples], grid: Grid, on_grid: bool) -> bool:
    """Whether some weight is not 1; a grid point without a sample has weight 0."""
    return any(
        bool(np.any(samples.weights != 1.0)) or (on_grid and samples.places.size != grid.points)
        for samples in outputs
    )
