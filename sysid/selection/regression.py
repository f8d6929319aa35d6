"""The regression y(k) = Σ aᵢ · termᵢ(k) over measured past values, compressed to a triangle.

Rows with a missing value, unscored rows and rows before the longest lag are omitted. The rows of
several experiments are stacked. Selection needs only inner products of the columns. So the rows are
folded into the triangular factor of a QR decomposition, block by block. This keeps full accuracy;
normal equations would lose half of the digits.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from sysid.core.types import FloatArray, IntArray
from sysid.data.interpolation import FineInput
from sysid.data.records import Record
from sysid.language.tree import PastValue
from sysid.language.value_intervals import bound_expression
from sysid.models.model import Model, Term, build_initial_parameters
from sysid.models.parameters import Parameter
from sysid.models.sections import get_interval
from sysid.models.ties import collect_parameter_names
from sysid.simulation.experiments import GridExperiment, place_on_grid

BLOCK_ROWS = 4096
"""Rows that are folded at once."""

_WHOLE_TOLERANCE = 1e-9  # samples: a lag nearer to a whole number is rounded

PastReader = Callable[[PastValue], FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class RegressionExperiment:
    """One experiment of a regression.

    Attributes
    ----------
    output : FloatArray, shape (points,)
        The measured output at the grid points; nan where it is missing.
    inputs : mapping of str to FineInput
    period : float
        Sampling period in s.
    rows : IntArray
        Grid points to explain: scored, with a value, later than the longest lag.
    """

    output: FloatArray
    inputs: Mapping[str, FineInput]
    period: float
    rows: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Regression of a polynomial on experiments, for any values of its lags."""

    experiments: tuple[RegressionExperiment, ...]

    @classmethod
    def from_records(
        cls, model: Model, records: Sequence[Record], parameters: Sequence[Parameter], skip: int = 0
    ) -> "Regression":
        """Place records on the grid, with a polynomial's parameters and their bounds.

        Raises
        ------
        InvalidRecord, RecordTooShort
            If a record does not have what the model needs.
        """
        all_parameters = (*parameters, *build_initial_parameters(model, len(records)))
        weights = {output.name: 1.0 for output in model.outputs}
        placed = [
            place_on_grid(model, record, e, all_parameters, weights, skip)
            for e, record in enumerate(records)
        ]
        return cls.from_experiments(model, records, placed, parameters)

    @classmethod
    def from_experiments(
        cls,
        model: Model,
        records: Sequence[Record],
        experiments: Sequence[GridExperiment],
        parameters: Sequence[Parameter],
    ) -> "Regression":
        """Make the regression on records that are already on a grid."""
        spans = {item.name: get_interval(item) for item in parameters}
        pairs = zip(records, experiments, strict=True)
        return cls(
            tuple(_make_regression_experiment(model, record, item, spans) for record, item in pairs)
        )

    @property
    def most_rows(self) -> int:
        """Upper limit of the number of rows; it counts those with missing regressors."""
        return sum(piece.rows.size for piece in self.experiments)

    def thin_rows(self, most: int) -> "Regression":
        """Thin the rows evenly to about `most`."""
        stride = max(1, ceil(self.most_rows / max(most, 1)))
        return Regression(
            tuple(
                RegressionExperiment(piece.output, piece.inputs, piece.period, piece.rows[::stride])
                for piece in self.experiments
            )
        )

    def factor_terms(
        self,
        terms: Sequence[Term],
        lags: Mapping[str, float],
        simulated: Sequence[FloatArray] | None = None,
    ) -> tuple[FloatArray, int]:
        """Compute R of the QR decomposition of [terms, y], (M + 1, M + 1), and count the rows.

        `simulated` has one output at the grid points for each experiment. With it, R is that of
        [terms of that output, terms, y], (2M + 1, 2M + 1).
        """
        width = (1 if simulated is None else 2) * len(terms) + 1
        folded, count = np.zeros((0, width)), 0
        for number, piece in enumerate(self.experiments):
            outputs = [piece.output]
            if simulated is not None:
                outputs.insert(0, simulated[number])
            for first in range(0, piece.rows.size, BLOCK_ROWS):
                rows = piece.rows[first : first + BLOCK_ROWS]
                parts = [
                    evaluate_terms(terms, make_past_reader(piece, lags, rows, y), rows.size)
                    for y in outputs
                ]
                block = np.column_stack([*parts, piece.output[rows]])
                block = block[np.all(np.isfinite(block), axis=1)]
                count += block.shape[0]
                folded = fold_rows(folded, block)
        short = max(width - folded.shape[0], 0)
        return np.vstack([folded, np.zeros((short, width))]), count


def fold_rows(folded: FloatArray, block: FloatArray) -> FloatArray:
    """Fold a block of rows into R of the QR decomposition of all previous rows."""
    return np.asarray(np.linalg.qr(np.vstack([folded, block]), mode="r"))


def evaluate_terms(terms: Sequence[Term], read: PastReader, rows: int) -> FloatArray:
    """Evaluate the terms, (rows, M), reading each past value once."""
    values: dict[PastValue, FloatArray] = {}
    matrix = np.empty((rows, len(terms)))
    with np.errstate(over="ignore", invalid="ignore"):
        for column, term in enumerate(terms):
            product = np.ones(rows)
            for factor in term.factors:
                if factor not in values:
                    values[factor] = read(factor)
                product = product * values[factor]
            matrix[:, column] = product
    return matrix


def make_past_reader(
    piece: RegressionExperiment, lags: Mapping[str, float], rows: IntArray, output: FloatArray
) -> PastReader:
    """Make a reader of past values at rows; those of the output come from `output`."""

    def read(past: PastValue) -> FloatArray:
        lag = evaluate_lag(past, lags, piece.period)
        if past.kind == "state":
            return _interpolate_positions(
                output, np.asarray(rows - past.offset - lag, dtype=np.float64)
            )
        signal = piece.inputs[past.name]
        # At a jump the fine grid has the mean of both sides. Without lag, read after it.
        jump = signal.begin if past.delay is None else 0
        positions = signal.start_index + (rows - past.offset - lag) * signal.points_per_step + jump
        return _interpolate_positions(signal.values, np.asarray(positions, dtype=np.float64))

    return read


def find_lag_parameters(model: Model) -> set[str]:
    """Find the names of the parameters in a polynomial's lags."""
    lags = {factor.delay for term in model.terms for factor in term.factors}
    return {name for lag in lags if lag is not None for name in collect_parameter_names(lag)}


def evaluate_lag(past: PastValue, lags: Mapping[str, float], period: float) -> float:
    """Evaluate the unknown part of a lag, in samples."""
    if past.delay is None:
        return 0.0
    value = bound_expression(past.delay, {name: (lag, lag) for name, lag in lags.items()}, period)[
        0
    ]
    whole = round(value)
    return float(whole) if abs(value - whole) < _WHOLE_TOLERANCE else value


def _interpolate_positions(values: FloatArray, positions: FloatArray) -> FloatArray:
    positions = np.clip(positions, 0.0, values.size - 1.0)
    older = np.floor(positions).astype(np.int64)
    share = positions - older
    if not np.any(share > 0):
        return values[older]
    newer = np.minimum(older + 1, values.size - 1)
    interpolated: FloatArray = values[older] * (1.0 - share) + values[newer] * share
    return interpolated


def _make_regression_experiment(
    model: Model,
    record: Record,
    experiment: GridExperiment,
    spans: Mapping[str, tuple[float, float]],
) -> RegressionExperiment:
    [samples] = experiment.outputs
    [channel] = [
        output_channel
        for output_channel in record.outputs
        if output_channel.name == model.outputs[0].name
    ]
    grid = experiment.grid
    positions = np.round(samples.positions).astype(np.int64)
    output = np.full(grid.points, np.nan)
    output[positions] = np.where(np.isfinite(channel.values), channel.values, np.nan)
    longest = 0.0
    for past in {factor for term in model.terms for factor in term.factors}:
        upper = 0.0 if past.delay is None else bound_expression(past.delay, spans, grid.step)[1]
        longest = max(longest, past.offset + upper)
    scored = np.sort(positions[samples.weights > 0])
    inputs = {
        quantity.name: signal
        for quantity, signal in zip(model.inputs, experiment.inputs, strict=True)
    }
    return RegressionExperiment(
        output, inputs, grid.step, scored[scored >= ceil(longest - _WHOLE_TOLERANCE)]
    )
