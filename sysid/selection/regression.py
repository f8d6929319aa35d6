"""The regression y(k) = Σ aᵢ · termᵢ(k) over measured past values, compressed to a triangle.

Rows without a value somewhere (missing samples, those not scored, those before the longest lag)
are left out; several experiments lie one below the other. All that follows needs only inner
products of the columns, so the rows are folded into the triangular factor of a QR decomposition,
block by block. That keeps full accuracy, where normal equations would keep half the digits.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from sysid.core.types import FloatArray, IntArray
from sysid.data.interpolation import FineInput
from sysid.data.records import Record
from sysid.language.intervals import bound_expression
from sysid.language.tree import PastValue
from sysid.models.model import Model, Term, build_initial_parameters
from sysid.models.parameters import Parameter
from sysid.models.sections import get_interval
from sysid.models.ties import collect_parameter_names
from sysid.simulation.experiments import GridExperiment, place_on_grid

BLOCK_ROWS = 4096
"""Rows folded in at once."""

_WHOLE_TOLERANCE = 1e-9  # samples: nearer, a lag is a whole number of them

PastReader = Callable[[PastValue], FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class RegressionExperiment:
    """One experiment of a regression.

    Attributes
    ----------
    output : FloatArray, shape (points,)
        The measured output at the grid points; nan where there is none.
    inputs : mapping of str to FineInput
    period : float
        Sampling period in s.
    rows : IntArray
        Grid points that are explained: scored, with a value, later than the longest lag.
    """

    output: FloatArray
    inputs: Mapping[str, FineInput]
    period: float
    rows: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """A polynomial's regression on some experiments, for any values of its lags."""

    experiments: tuple[RegressionExperiment, ...]

    @classmethod
    def from_records(
        cls, model: Model, records: Sequence[Record], parameters: Sequence[Parameter], skip: int = 0
    ) -> "Regression":
        """Lay the records out, with a polynomial's parameters and their bounds.

        Raises
        ------
        InvalidRecord, RecordTooShort
            If a record does not have what the model needs.
        """
        everything = (*parameters, *build_initial_parameters(model, len(records)))
        weights = {output.name: 1.0 for output in model.outputs}
        laid = [
            place_on_grid(model, record, e, everything, weights, skip)
            for e, record in enumerate(records)
        ]
        return cls.from_experiments(model, records, laid, parameters)

    @classmethod
    def from_experiments(
        cls,
        model: Model,
        records: Sequence[Record],
        experiments: Sequence[GridExperiment],
        parameters: Sequence[Parameter],
    ) -> "Regression":
        """The regression on records that are laid out already."""
        spans = {one.name: get_interval(one) for one in parameters}
        pairs = zip(records, experiments, strict=True)
        return cls(
            tuple(_make_regression_experiment(model, record, one, spans) for record, one in pairs)
        )

    @property
    def most_rows(self) -> int:
        """Rows at most: those with missing regressors are still among them."""
        return sum(piece.rows.size for piece in self.experiments)

    def thin_rows(self, most: int) -> "Regression":
        """At most about that many rows, evenly taken."""
        stride = max(1, ceil(self.most_rows / max(most, 1)))
        return Regression(
            tuple(
                RegressionExperiment(one.output, one.inputs, one.period, one.rows[::stride])
                for one in self.experiments
            )
        )

    def factor_terms(
        self,
        terms: Sequence[Term],
        lags: Mapping[str, float],
        simulated: Sequence[FloatArray] | None = None,
    ) -> tuple[FloatArray, int]:
        """R of the QR decomposition of [terms, y], (M + 1, M + 1), and the number of rows.

        With `simulated`, one output at the grid points for each experiment, of [the terms of
        that output, the terms, y], (2M + 1, 2M + 1).
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
    """R of the QR decomposition of all rows so far, with a block of further rows in it."""
    return np.asarray(np.linalg.qr(np.vstack([folded, block]), mode="r"))


def evaluate_terms(terms: Sequence[Term], read: PastReader, rows: int) -> FloatArray:
    """The terms' values, (rows, M), each past value read once."""
    known: dict[PastValue, FloatArray] = {}
    matrix = np.empty((rows, len(terms)))
    with np.errstate(over="ignore", invalid="ignore"):
        for column, term in enumerate(terms):
            product = np.ones(rows)
            for factor in term.factors:
                if factor not in known:
                    known[factor] = read(factor)
                product = product * known[factor]
            matrix[:, column] = product
    return matrix


def make_past_reader(
    piece: RegressionExperiment, lags: Mapping[str, float], rows: IntArray, output: FloatArray
) -> PastReader:
    """How past values are read at rows, those of the output from `output`."""

    def read(past: PastValue) -> FloatArray:
        lag = evaluate_lag(past, lags, piece.period)
        if past.kind == "state":
            return _interpolate_places(
                output, np.asarray(rows - past.offset - lag, dtype=np.float64)
            )
        signal = piece.inputs[past.name]
        # At a jump the fine grid holds the mean of both sides: without lag, read behind it.
        jump = signal.begin if past.delay is None else 0
        places = signal.start_index + (rows - past.offset - lag) * signal.points_per_step + jump
        return _interpolate_places(signal.values, np.asarray(places, dtype=np.float64))

    return read


def find_lag_parameters(model: Model) -> set[str]:
    """Names of the parameters in a polynomial's lags."""
    lags = {factor.delay for term in model.terms for factor in term.factors}
    return {name for lag in lags if lag is not None for name in collect_parameter_names(lag)}


def evaluate_lag(past: PastValue, lags: Mapping[str, float], period: float) -> float:
    """The unknown part of a lag in samples, for values of the parameters in it."""
    if past.delay is None:
        return 0.0
    value = bound_expression(past.delay, {name: (one, one) for name, one in lags.items()}, period)[
        0
    ]
    whole = round(value)
    return float(whole) if abs(value - whole) < _WHOLE_TOLERANCE else value


def _interpolate_places(values: FloatArray, places: FloatArray) -> FloatArray:
    places = np.clip(places, 0.0, values.size - 1.0)
    older = np.floor(places).astype(np.int64)
    share = places - older
    if not np.any(share > 0):
        return values[older]
    newer = np.minimum(older + 1, values.size - 1)
    found: FloatArray = values[older] * (1.0 - share) + values[newer] * share
    return found


def _make_regression_experiment(
    model: Model,
    record: Record,
    experiment: GridExperiment,
    spans: Mapping[str, tuple[float, float]],
) -> RegressionExperiment:
    [samples] = experiment.outputs
    [channel] = [one for one in record.outputs if one.name == model.outputs[0].name]
    grid = experiment.grid
    places = np.round(samples.places).astype(np.int64)
    output = np.full(grid.points, np.nan)
    output[places] = np.where(np.isfinite(channel.values), channel.values, np.nan)
    longest = 0.0
    for past in {factor for term in model.terms for factor in term.factors}:
        upper = 0.0 if past.delay is None else bound_expression(past.delay, spans, grid.step)[1]
        longest = max(longest, past.offset + upper)
    scored = np.sort(places[samples.weights > 0])
    inputs = {
        quantity.name: signal
        for quantity, signal in zip(model.inputs, experiment.inputs, strict=True)
    }
    return RegressionExperiment(
        output, inputs, grid.step, scored[scored >= ceil(longest - _WHOLE_TOLERANCE)]
    )
