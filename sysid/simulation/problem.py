"""A problem: a model, the records it is to explain, and the fitness of a population on them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import sqrt
from typing import Any

import numpy as np

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.settings import PREDICTION_KINDS, Loss, Prediction
from sysid.core.types import FloatArray, IntArray
from sysid.data.records import Record
from sysid.kernels.build import kernel_address
from sysid.kernels.layout import Variant
from sysid.models.delays import check_lags
from sysid.models.model import Model, initial_parameters
from sysid.models.parameters import Parameter, override
from sysid.models.ties import Ties, tied_model, ties_of
from sysid.simulation.evaluator import Evaluator, population_fitness, population_predictions
from sysid.simulation.experiments import Experiment, lay_out, measured_anew, output_weights
from sysid.simulation.metrics import ChannelMetrics, Metrics, fit_percent, rms
from sysid.simulation.packing import Numbers, fits_grid, has_weights, numbers

_Rebuild = tuple[Callable[..., "Problem"], tuple[Any, ...]]


@dataclass(frozen=True, eq=False)
class Problem:
    """Fitness and predictions of candidates, J = √(Σ w²(y - ŷ)² / n) (Eq. 10).

    Make one with `Problem.build`. Pickling sends what it was built from, since the address of
    compiled code means nothing in another process.

    Attributes
    ----------
    model : Model
        With tied parameters replaced by what they are tied to.
    records : tuple of Record
    all_parameters : tuple of Parameter
        K: the model's, then the estimated initial states, named ``x(0)`` in the first experiment
        and ``x(0)[2]`` in the second.
    space : tuple of Parameter
        D: those of them that are free.
    ties : mapping of str to Expression
        What each tied parameter is, in terms of free and fixed ones.
    evaluator : Evaluator
        The problem as compiled code sees it.
    experiments : tuple of Experiment
    output_weights : mapping of str to float
        Weight of each output, as given or found from the records.
    scored_from : tuple of float or None
        For each experiment the time (s) before which no sample is scored; None: all are.
    """

    model: Model
    records: tuple[Record, ...]
    all_parameters: tuple[Parameter, ...]
    space: tuple[Parameter, ...]
    evaluator: Evaluator
    experiments: tuple[Experiment, ...]
    output_weights: Mapping[str, float]
    scored_from: tuple[float, ...] | None
    arguments: tuple[Any, ...]
    ties: Ties

    @classmethod
    def build(
        cls,
        model: Model,
        records: Sequence[Record],
        *,
        parameters: Mapping[str, Mapping[str, Any]] | None = None,
        prediction: Prediction = "simulation",
        loss: Loss | None = None,
        weights: Mapping[str, float] | None = None,
        skip: int = 0,
        scored_from: Sequence[float] | None = None,
    ) -> "Problem":
        """Lay the records out for the model and compile it.

        Parameters
        ----------
        parameters : mapping of str to mapping
            Changed bounds, scales or fixed values, or what a parameter is tied to.
        prediction : {"simulation", "one-step"}
        loss : Loss
            Squares if not given.
        weights : mapping of str to float
            Weight of each output; by default 1 for one output, else 1 / its standard deviation.
        skip : int
            First samples of each output that are not scored.
        scored_from : sequence of float
            For each record the time (s) from which on samples are scored: a part that is kept
            for validation is simulated with all that went before it.

        Raises
        ------
        InvalidRecord, RecordTooShort
            If a record does not have what the model needs.
        InvalidSettings, InvalidBounds
            If an option cannot be used.
        """
        arguments = (model, tuple(records), dict(parameters or {}), prediction, loss or Loss(),
                     None if weights is None else dict(weights), skip,
                     None if scored_from is None else tuple(scored_from))  # fmt: skip
        return _built(*arguments)

    @property
    def prediction(self) -> Prediction:
        """Free run or one step ahead."""
        return "simulation" if len(self.arguments) < 4 else self.arguments[3]

    @property
    def loss(self) -> Loss:
        """What is minimised."""
        return Loss() if len(self.arguments) < 5 else self.arguments[4]

    def __reduce__(self) -> _Rebuild:
        rebuild = _built if len(self.arguments) > 2 else simulation_problem
        return rebuild, self.arguments

    def measured_anew(self, records: Sequence[Record]) -> "Problem":
        """What `build` would make of records that differ in the values of their outputs only.

        Where their noise is all that runs have of their own, most of the work is done once.
        """
        model, _, _, prediction, loss, weights, skip, since = self.arguments
        per_output = output_weights(self.model, records, weights, skip)
        experiments = tuple(
            measured_anew(laid, self.model, record, e, self.all_parameters, per_output, skip,
                          -np.inf if since is None else since[e])
            for e, (laid, record) in enumerate(zip(self.experiments, records, strict=True))
        )  # fmt: skip
        one_step = prediction == "one-step"
        evaluator = _evaluator(self.model, experiments, self.all_parameters, one_step, loss)
        return replace(
            self, records=tuple(records), evaluator=evaluator, experiments=experiments,
            output_weights=per_output, arguments=(model, tuple(records), *self.arguments[2:]),
        )  # fmt: skip

    def fitness(self, theta: FloatArray) -> FloatArray:
        """J of individuals (P, D) → (P,), smaller is better; ``inf`` where one diverges."""
        return population_fitness(self.evaluator, _population(theta, len(self.space)))

    def predictions(self, theta: FloatArray) -> FloatArray:
        """Simulated values at the measured times, (P, D) → (P, M)."""
        return population_predictions(self.evaluator, _population(theta, len(self.space)))

    def split(self, values: FloatArray) -> list[dict[str, FloatArray]]:
        """Values (M,) as one array for each output of each experiment."""
        parts: list[dict[str, FloatArray]] = []
        first = 0
        for experiment in self.experiments:
            part = {}
            for output, samples in zip(self.model.outputs, experiment.outputs, strict=True):
                part[output.name] = values[first : first + samples.places.size]
                first += samples.places.size
            parts.append(part)
        return parts

    @property
    def unit(self) -> str:
        """Unit of J: that of the output, or 1 if several are weighted together."""
        return self.model.outputs[0].unit if len(self.model.outputs) == 1 else "1"

    @cached_property
    def scored(self) -> IntArray:
        """Which of the M measured values enter J."""
        return np.flatnonzero(self.evaluator.weight > 0)

    @property
    def n_scored(self) -> int:
        """Number of samples that enter J."""
        return self.scored.size

    @cached_property
    def n_steps(self) -> int:
        """Steps of integration, or of the recursion, that a simulation takes."""
        return sum(one.grid.points * one.grid.substeps for one in self.experiments)

    @cached_property
    def output_scale(self) -> float:
        """J of a simulation that gives each output's mean: what a model should stay well below."""
        total = 0.0
        for measured, weight in self._channels(self.evaluator.measured):
            scored = weight > 0
            if np.any(scored):
                centred = measured[scored] - np.mean(measured[scored])
                total += float(np.sum(np.square(weight[scored] * centred)))
        return sqrt(total / max(self.n_scored, 1))

    def metrics(self, theta: FloatArray) -> Metrics:
        """Agreement of one individual (D,) with the records; what `skip` leaves out is not in."""
        simulated = self.predictions(np.atleast_2d(theta))[0]
        return metrics_of(self, simulated)

    def _channels(self, values: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        pairs = zip(self.split(values), self.split(self.evaluator.weight), strict=True)
        return [(value[name], weight[name]) for value, weight in pairs for name in value]


def metrics_of(problem: Problem, simulated: FloatArray) -> Metrics:
    """Agreement of simulated values (M,) with the records of a problem."""
    weight = problem.evaluator.weight
    error = weight * (problem.evaluator.measured - simulated)
    one = len(problem.model.outputs) == 1
    with np.errstate(all="ignore"):  # a diverged simulation has an infinite residual
        channels = tuple(_channel_metrics(problem, simulated))
        scored = weight > 0
        total = rms((error / np.where(scored, weight, 1.0) if one else error)[scored])
        scale = problem.output_scale
        fit = 100.0 * (1.0 - rms(error[scored]) / scale) if scale > 0 else float("nan")
    return Metrics(total, problem.unit, fit, channels)


def rms_against(
    problem: Problem, simulated: Sequence[Sequence[FloatArray]], records: Sequence[Record]
) -> float:
    """J of simulated outputs against other values at the same samples, such as noise-free ones.

    Parameters
    ----------
    simulated : sequence of sequence of FloatArray
        By experiment and output, as `Identification.simulated`.
    records : sequence of Record
        As many, of the same channels and times as those of the problem.
    """
    one, errors = len(problem.model.outputs) == 1, []
    for part, outputs, record in zip(
        problem.split(problem.evaluator.weight), simulated, records, strict=True
    ):
        for (name, values), channel in zip(
            zip(part, outputs, strict=True), record.outputs, strict=True
        ):
            scored = part[name] > 0
            weight = 1.0 if one else part[name][scored]
            errors.append(weight * (channel.values - values)[scored])
    return rms(np.concatenate(errors))


def _channel_metrics(problem: Problem, simulated: FloatArray) -> list[ChannelMetrics]:
    found = []
    parts = zip(
        problem.split(problem.evaluator.measured), problem.split(simulated),
        problem.split(problem.evaluator.weight), strict=True,
    )  # fmt: skip
    for experiment, (measured, model, weight) in enumerate(parts):
        for output in problem.model.outputs:
            scored = weight[output.name] > 0
            if np.any(scored):
                y, computed = measured[output.name][scored], model[output.name][scored]
                found.append(
                    ChannelMetrics(experiment, output.name, output.unit, int(y.size),
                                   rms(y - computed), fit_percent(y, computed),
                                   (float(np.min(y)), float(np.max(y))))
                )  # fmt: skip
    return found


def _built(
    model: Model, records: tuple[Record, ...], parameters: Mapping[str, Mapping[str, Any]],
    prediction: Prediction, loss: Loss, weights: Mapping[str, float] | None, skip: int,
    scored_from: tuple[float, ...] | None,
) -> Problem:  # fmt: skip
    if model.rule is not None:
        raise InvalidSettings("/model/terms", "the terms are not selected yet; see `selected`")
    if not records:
        raise InvalidRecord("there is no record to compare the model with; need one or more")
    if prediction not in PREDICTION_KINDS:
        names = " or ".join(map(repr, PREDICTION_KINDS))
        raise InvalidSettings("/prediction", f"{prediction!r} is not {names}")
    if prediction == "one-step" and loss.noise_model == "ar1":
        raise InvalidSettings(
            "/loss/noise_model",
            f"{loss.noise_model} is for free runs; predictions one step ahead contain the noise",
        )
    if skip < 0:
        raise InvalidSettings("/skip", f"{skip!r} is not a number of samples, 0 or more")
    since = (-np.inf,) * len(records) if scored_from is None else scored_from
    if len(since) != len(records):
        raise InvalidSettings(
            "/scored_from", f"found {len(since)} times for {len(records)} records; need one each"
        )
    arguments = (model, records, parameters, prediction, loss, weights, skip, scored_from)
    everything = override((*model.parameters, *initial_parameters(model, len(records))), parameters)
    ties = ties_of(model, everything)
    model = tied_model(model, ties)
    check_lags(model, everything)
    per_output = output_weights(model, records, weights, skip)
    experiments = tuple(
        lay_out(model, record, e, everything, per_output, skip, scored_from=since[e])
        for e, record in enumerate(records)
    )
    free = tuple(parameter for parameter in everything if parameter.is_free)
    evaluator = _evaluator(model, experiments, everything, prediction == "one-step", loss)
    return Problem(
        model, records, everything, free, evaluator, experiments, per_output, scored_from,
        arguments, ties,
    )  # fmt: skip


def simulation_problem(model: Model, record: Record) -> Problem:
    """A problem that only simulates: every parameter is fixed, and nothing is compared."""
    arguments = (model, record)
    weights = {output.name: 1.0 for output in model.outputs}
    experiment = lay_out(model, record, 0, model.parameters, weights, 0, simulates_only=True)
    evaluator = _evaluator(model, (experiment,), model.parameters, False, Loss())
    return Problem(
        model, (record,), model.parameters, (), evaluator, (experiment,), weights, None, arguments,
        {},
    )  # fmt: skip


def _evaluator(
    model: Model, experiments: Sequence[Experiment], parameters: Sequence[Parameter],
    one_step: bool, loss: Loss,
) -> Evaluator:  # fmt: skip
    on_grid = all(fits_grid(experiment.outputs) for experiment in experiments)
    weighted = any(has_weights(e.outputs, e.grid, on_grid) for e in experiments)
    variant = Variant(one_step, loss.kind == "soft-l1", on_grid, weighted)
    laid = [
        numbers(model, variant, e.grid, e.inputs, e.outputs, e.starts, e.lag, loss.scale)
        for e in experiments
    ]
    rows = [i for i, parameter in enumerate(parameters) if parameter.is_free]
    free = [parameters[i] for i in rows]
    samples = [samples for e in experiments for samples in e.outputs]
    weight = np.concatenate([s.weights for s in samples])
    return Evaluator(
        kernel=kernel_address(model, variant),
        template=np.array([p.lower if p.fixed is None else p.fixed for p in parameters]),
        rows=np.array(rows, dtype=np.int64),
        lower=np.array([p.lower for p in free], dtype=np.float64),
        upper=np.array([p.upper for p in free], dtype=np.float64),
        log=np.array([p.scale == "log" for p in free], dtype=np.int64),
        plans=_plans(laid, experiments),
        ints=np.concatenate([one.ints for one in laid]),
        floats=np.concatenate([one.floats for one in laid]),
        n_work=max(one.n_work for one in laid),
        n_measured=weight.size,
        weight=weight,
        measured=np.concatenate([s.values for s in samples]),
        n_weight=max(float(np.count_nonzero(weight)), 1.0),
    )


def _plans(laid: Sequence[Numbers], experiments: Sequence[Experiment]) -> Any:
    """Where each experiment's numbers and its measured values begin."""
    lengths = [
        (one.ints.size, one.floats.size, sum(s.places.size for s in e.outputs))
        for one, e in zip(laid, experiments, strict=True)
    ]
    ends = np.cumsum(np.array(lengths, dtype=np.int64), axis=0)
    return np.ascontiguousarray(np.vstack([np.zeros((1, 3), dtype=np.int64), ends[:-1]]))


def _population(theta: FloatArray, free: int) -> FloatArray:
    values = np.ascontiguousarray(theta, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != free:
        raise InvalidSettings(
            "/parameters",
            f"candidates have shape {values.shape}; need (P, {free}), one column for each free "
            "parameter",
        )
    return values


def loss_scale(problem: Problem) -> float:
    """Scale of the soft-l1 loss, 0 for squares: what compiled code is told."""
    loss = next(a for a in problem.arguments if isinstance(a, Loss))
    return float(loss.scale) if loss.kind == "soft-l1" else 0.0


def record_progress(problem: Problem) -> FloatArray:
    """Part of its experiment (0 … 1) that has to be simulated for each of the M measured values."""
    return np.concatenate([
        np.ceil(samples.places) / max(experiment.grid.points - 1, 1)
        for experiment in problem.experiments for samples in experiment.outputs
    ])  # fmt: skip
