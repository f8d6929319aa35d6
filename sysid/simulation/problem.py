"""A problem: a model, its records, and the fitness of a population of candidates on them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import sqrt
from typing import Any, TypeVar

import numpy as np

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.settings import FitSettings, InitialSetting, Loss, PredictionKind, Weights
from sysid.core.types import FloatArray, IntArray
from sysid.data.records import Record
from sysid.kernels.compilation.build import get_kernel_address
from sysid.kernels.layout import KernelVariant
from sysid.kernels.signals.past_reads import list_delaying_inputs
from sysid.language.tree import Number
from sysid.models.channel_assignment import hold_commands
from sysid.models.kalman_filter import add_kalman_filter, check_noise_changes
from sysid.models.model import Correction, Model, Output, build_initial_parameters
from sysid.models.model_delays import check_delays
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.starts import replace_starts
from sysid.models.ties import Ties, apply_ties, resolve_ties
from sysid.simulation.data_bounds import (
    add_units_of_data,
    bound_by_data,
    measure_noise_scales,
)
from sysid.simulation.evaluator import (
    Evaluator,
    evaluate_population,
    predict_ahead,
    predict_population,
)
from sysid.simulation.experiment_arrays import (
    OutputSamples,
    PackedExperiment,
    are_on_grid,
    find_range,
    has_weights,
    pack_experiment,
    replace_input_values,
    replace_measured,
)
from sysid.simulation.experiments import (
    GridExperiment,
    compute_output_weights,
    place_on_grid,
    replace_inputs,
    replace_outputs,
    split_weights,
)
from sysid.simulation.fit_metrics import (
    ChannelMetrics,
    Metrics,
    compute_fit_percent,
    compute_line_rms,
    compute_mean,
    rms,
)
from sysid.simulation.output_means import average_outputs

_Value = TypeVar("_Value")
_ReduceResult = tuple[Callable[..., "Problem"], tuple[Any, ...]]
_WriteValues = Callable[[GridExperiment, IntArray, FloatArray], None]


@dataclass(frozen=True, eq=False)
class Problem:
    """Fitness and predictions of candidates, J = √(Σ w²(y - ŷ)² / n) (Eq. 10).

    Create it with `Problem.build` or `Problem.from_settings`. Pickling sends the arguments of its
    construction, because the address of compiled code is valid in one process only. What records
    have beside the model's signals is not sent: a search does not read it.

    Attributes
    ----------
    model : Model
        With tied parameters replaced by their expressions.
    averaged_model : Model
        The same with outputs that are means: what is simulated.
    given_model : Model
        The model as it was given: before its starts were replaced, and its ties.
    records : tuple of Record
    settings : FitSettings
    all_parameters : tuple of Parameter
        K: the model's, then the estimated initial states. Their names are ``x(0)`` in the first
        experiment and ``x(0)[2]`` in the second.
    free_parameters : tuple of Parameter
        D: the free ones among them.
    ties : mapping of str to Expression
        Each tied parameter in terms of free and fixed ones.
    evaluator : Evaluator
        The problem as compiled code sees it.
    experiments : tuple of GridExperiment
    output_weights : mapping of str to float
        Weight of each output, from the settings or computed from the records.
    simulates_only : bool
        Whether every parameter is fixed and nothing is compared with the records.

    Examples
    --------
    >>> t = [0.1 * k for k in range(100)]
    >>> record = Record(Channel("u", t, [k > 9 for k in range(100)]), Channel("y", t, t))
    >>> problem = Problem.build(load_model("fopdt"), [record], parameters={"y0": {"fixed": 0}})
    >>> [parameter.name for parameter in problem.free_parameters]
    ['K', 'T', 'L', 'x(0)']
    """

    model: Model
    averaged_model: Model
    given_model: Model
    records: tuple[Record, ...]
    settings: FitSettings
    all_parameters: tuple[Parameter, ...]
    free_parameters: tuple[Parameter, ...]
    evaluator: Evaluator
    experiments: tuple[GridExperiment, ...]
    output_weights: Mapping[str, float]
    ties: Ties
    simulates_only: bool = False
    _shared: dict[str, Any] = field(default_factory=dict, repr=False)

    @classmethod
    def build(
        cls,
        model: Model,
        records: Sequence[Record],
        *,
        parameters: Mapping[str, Mapping[str, Any]] | None = None,
        prediction: PredictionKind = "simulation",
        loss: Loss | None = None,
        weights: Weights | None = None,
        skip: int = 0,
        initial: InitialSetting | None = None,
        scored_from: Sequence[float] | None = None,
    ) -> "Problem":
        """Build a problem from the fields of `FitSettings`; raises as `from_settings` does."""
        scoring_starts = None if scored_from is None else tuple(scored_from)
        settings = FitSettings(
            parameters or {}, prediction, loss or Loss(), weights, skip, initial, scoring_starts
        )
        return cls.from_settings(model, records, settings)

    @classmethod
    def from_settings(
        cls, model: Model, records: Sequence[Record], settings: FitSettings
    ) -> "Problem":
        """Place the records on the grid of the model and compile it.

        Raises
        ------
        InvalidRecord, RecordTooShort
            If a record does not have what the model needs.
        InvalidSettings, InvalidBounds
            If a setting cannot be used.
        """
        records = hold_commands(model, records, settings.commands)
        if model.rule is not None:
            raise InvalidSettings(
                "/model/terms",
                "the terms of this model are not selected yet. Use `identify`, or "
                "`sysid.selection.select.select_model_terms`",
            )
        if not records:
            raise InvalidRecord("there is no record to compare the model with. Need one or more")
        scoring_starts = (
            (-np.inf,) * len(records) if settings.scored_from is None else settings.scored_from
        )
        if len(scoring_starts) != len(records):
            raise InvalidSettings(
                "/scored_from",
                f"found {len(scoring_starts)} times for {len(records)} records. Need one each",
            )
        given, model = model, replace_starts(model, settings.initial)
        noise = settings.loss.noise_model
        check_noise_changes(settings.parameters, noise)
        if noise == "plant" or noise == "load" or noise == "drift":
            scales = measure_noise_scales(records)
            model = add_kalman_filter(model, noise, scales, settings.parameters)
        declared = (*model.parameters, *build_initial_parameters(model, len(records)))
        bounded = bound_by_data(add_units_of_data(declared, records), records)
        all_parameters = override_parameters(bounded, settings.parameters)
        ties = resolve_ties(model, all_parameters)
        tied = apply_ties(model, ties)
        check_delays(tied, all_parameters)
        averaged = average_outputs(tied, records, settings.prediction)
        settings = split_weights(settings, tied, len(records))
        per_output = compute_output_weights(tied, records, settings.weights, settings.skip)
        experiments = tuple(
            place_on_grid(
                tied,
                record,
                e,
                all_parameters,
                _divide_weights(per_output, settings, e),
                settings.skip,
                scored_from=scoring_starts[e],
            )
            for e, record in enumerate(records)
        )
        return cls(
            model=tied,
            averaged_model=averaged,
            given_model=given,
            records=records,
            settings=settings,
            all_parameters=all_parameters,
            free_parameters=tuple(parameter for parameter in all_parameters if parameter.is_free),
            evaluator=_build_evaluator(averaged, experiments, all_parameters, settings),
            experiments=experiments,
            output_weights=per_output,
            ties=ties,
        )

    def rebuild(
        self, *, model: Model | None = None, records: Sequence[Record] | None = None, **changes: Any
    ) -> "Problem":
        """Build the problem again with another model, other records or changed settings.

        Raises as `from_settings` does.
        """
        return self.from_settings(
            self.given_model if model is None else model,
            self.records if records is None else records,
            replace(self.settings, **changes),
        )

    @property
    def untied_model(self) -> Model:
        """The model with the starts of these settings, before its ties were replaced."""
        return replace_starts(self.given_model, self.settings.initial)

    @property
    def prediction(self) -> PredictionKind:
        """Free run or one step ahead."""
        return self.settings.prediction

    @property
    def is_free_run(self) -> bool:
        """Whether outputs follow from the inputs alone, and not from outputs measured before."""
        return self.settings.prediction == "simulation" and not self.model.corrections

    @property
    def loss(self) -> Loss:
        """Loss that is minimised."""
        return self.settings.loss

    @property
    def loss_scale(self) -> float:
        """Scale of the soft-l1 loss, 0 for squares: the form that compiled code takes."""
        return float(self.loss.scale) if self.loss.kind == "soft-l1" else 0.0

    @cached_property
    def free_names(self) -> tuple[str, ...]:
        """Names of the free parameters, D."""
        return tuple(parameter.name for parameter in self.free_parameters)

    def __reduce__(self) -> _ReduceResult:
        if self.simulates_only:
            return build_simulation_problem, (self.given_model, self.records[0])
        records = tuple(replace(record, others=()) for record in self.records)
        return Problem.from_settings, (self.given_model, records, self.settings)

    def share(self, key: str, compute: Callable[[], _Value]) -> _Value:
        """Return what does not depend on the values of the outputs, computed once for a sweep.

        All problems that `replace_outputs` makes of one another share it.
        """
        if key not in self._shared:
            self._shared[key] = compute()
        value: _Value = self._shared[key]
        return value

    def replace_outputs(self, records: Sequence[Record]) -> "Problem":
        """Build the problem again for records that differ in the values of their outputs only.

        If runs differ in their noise only, most of the work is done once.
        """
        if any(p.bounds for p in self.all_parameters) or self.model.corrections:
            return self.rebuild(records=records)  # bounds follow the noise too
        skip, scoring_starts = self.settings.skip, self.settings.scored_from
        per_output = compute_output_weights(self.model, records, self.settings.weights, skip)
        experiments = tuple(
            replace_outputs(
                placed,
                self.model,
                record,
                e,
                self.all_parameters,
                _divide_weights(per_output, self.settings, e),
                skip,
                -np.inf if scoring_starts is None else scoring_starts[e],
            )
            for e, (placed, record) in enumerate(zip(self.experiments, records, strict=True))
        )
        are_alike = all(
            new is old
            for before, after in zip(self.experiments, experiments, strict=True)
            for new, old in zip(
                [samples.weights for samples in after.outputs],
                [samples.weights for samples in before.outputs],
                strict=True,
            )
        )
        evaluator = self._fill_evaluator(experiments, are_alike, self._write_outputs)
        return replace(
            self,
            records=tuple(records),
            evaluator=evaluator,
            experiments=experiments,
            output_weights=per_output,
        )

    def replace_inputs(self, records: Sequence[Record]) -> "Problem":
        """Build the problem again for records that differ in their inputs only, not in times.

        Values, holds and histories may differ. Bounds that follow the data stay as they are: what
        is simulated has nothing to do with them.
        """
        experiments = tuple(
            replace_inputs(placed, self.averaged_model, before, record, self.all_parameters)
            for placed, before, record in zip(self.experiments, self.records, records, strict=True)
        )
        are_alike = all(
            new.is_placed_as(old)
            for before, after in zip(self.experiments, experiments, strict=True)
            for new, old in zip(after.inputs, before.inputs, strict=True)
        )
        evaluator = self._fill_evaluator(experiments, are_alike, self._write_inputs)
        return replace(
            self,
            records=tuple(records),
            evaluator=evaluator,
            experiments=experiments,
            _shared={},  # may depend on inputs
        )

    def observe(self, outputs: Sequence[Output]) -> "Problem":
        """Build the problem with more outputs, read at each grid point before any sample there.

        They come first, and nothing is compared with them.
        """
        experiments = tuple(
            replace(
                experiment,
                outputs=(*[_observe_grid(experiment)] * len(outputs), *experiment.outputs),
            )
            for experiment in self.experiments
        )
        unseen = [Correction(output.name, Number(0.0), (), ()) for output in outputs]
        model, averaged = (
            replace(
                one,
                outputs=(*outputs, *one.outputs),
                corrections=(*unseen, *one.corrections) if one.corrections else (),
            )
            for one in (self.model, self.averaged_model)
        )
        return replace(
            self,
            model=model,
            averaged_model=averaged,
            experiments=experiments,
            evaluator=_build_evaluator(averaged, experiments, self.all_parameters, self.settings),
            _shared={},
        )

    def _fill_evaluator(
        self, experiments: Sequence[GridExperiment], are_alike: bool, write: _WriteValues
    ) -> Evaluator:
        """Write experiments into the evaluator; it is built again if they are of another form."""
        if are_alike:
            return _replace_values(self.evaluator, experiments, write)
        return _build_evaluator(
            self.averaged_model, experiments, self.all_parameters, self.settings
        )

    def _write_inputs(self, experiment: GridExperiment, ints: IntArray, floats: FloatArray) -> None:
        replace_input_values(
            self.averaged_model, ints, floats, experiment.inputs, experiment.first_inputs
        )

    def _write_outputs(
        self, experiment: GridExperiment, ints: IntArray, floats: FloatArray
    ) -> None:
        replace_measured(
            self.averaged_model,
            ints,
            floats,
            experiment.outputs,
            experiment.starts,
            on_grid=self._has_grid_samples,
        )

    @cached_property
    def delaying_ranges(self) -> Mapping[str, tuple[float, float]]:
        """Range over all experiments of each input that a delay reads."""
        numbers = {signal.name: i for i, signal in enumerate(self.model.inputs)}
        return {
            name: (min(low), max(high))
            for name in list_delaying_inputs(self.model)
            for low, high in [
                zip(*(find_range(e.inputs[numbers[name]]) for e in self.experiments), strict=True)
            ]
        }

    @property
    def _has_grid_samples(self) -> bool:
        """Whether every sample has a grid point of its own."""
        return self.share(
            "samples on grid points",
            lambda: all(are_on_grid(experiment.outputs) for experiment in self.experiments),
        )

    def evaluate_fitness(self, theta: FloatArray) -> FloatArray:
        """Compute J of individuals (P, D) → (P,); smaller is better, ``inf`` if one diverged."""
        return evaluate_population(
            self.evaluator, _check_population(theta, len(self.free_parameters))
        )

    def predict(self, theta: FloatArray) -> FloatArray:
        """Simulate the values at the measured times, (P, D) → (P, M)."""
        return predict_population(
            self.evaluator, _check_population(theta, len(self.free_parameters))
        )

    def predict_ahead(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predict the measured values from those before, with their deviations: (P, M) each.

        A deviation is that of the innovation over the sensor's. Without a filter the values are
        those of `predict`, and the deviations 1.
        """
        if not self.model.corrections:
            simulated = self.predict(theta)
            return simulated, np.ones_like(simulated)
        values = predict_ahead(self.evaluator, _check_population(theta, len(self.free_parameters)))
        return values[:, : self.evaluator.n_measured], values[:, self.evaluator.n_measured :]

    def compute_residuals(self, theta: FloatArray) -> FloatArray:
        """Compute the weighted residuals w(ŷ - y) of the scored samples, (P, D) → (P, n)."""
        rows, evaluator = self.scored_rows, self.evaluator
        errors = self.predict(theta)[:, rows] - evaluator.measured[rows]
        return np.asarray(evaluator.weight[rows] * errors)

    def split_by_output(self, values: FloatArray) -> list[dict[str, FloatArray]]:
        """Split values (M,) into one array for each output of each experiment."""
        parts: list[dict[str, FloatArray]] = []
        first = 0
        for experiment in self.experiments:
            part = {}
            for output, samples in zip(self.model.outputs, experiment.outputs, strict=True):
                part[output.name] = values[first : first + samples.positions.size]
                first += samples.positions.size
            parts.append(part)
        return parts

    @property
    def unit(self) -> str:
        """Unit of J: that of the output, or 1 if several are weighted together."""
        return self.model.outputs[0].unit if len(self.model.outputs) == 1 else "1"

    @cached_property
    def scored_rows(self) -> IntArray:
        """Indices of the M measured values that enter J."""
        return np.flatnonzero(self.evaluator.weight > 0)

    @property
    def n_scored(self) -> int:
        """Number of samples that enter J."""
        return self.scored_rows.size

    @cached_property
    def plain_weight(self) -> FloatArray:
        """Weights (M,) of outputs alone, as if their noise were equal: the measure of J."""
        if self.settings.deviations is None:
            return self.evaluator.weight
        plain = [
            np.where(weight > 0, self.output_weights[name], 0.0)
            for part in self.split_by_output(self.evaluator.weight)
            for name, weight in part.items()
        ]
        return np.concatenate(plain)

    @cached_property
    def n_steps(self) -> int:
        """Steps of a simulation: of the integration or of the recursion."""
        return sum(
            experiment.grid.points * experiment.grid.substeps for experiment in self.experiments
        )

    @cached_property
    def output_scale(self) -> float:
        """J of a simulation that returns each output's mean; a good model is well below."""
        total = 0.0
        for measured, weight in self._list_channels(self.evaluator.measured):
            scored = weight > 0
            if np.any(scored):
                centred = measured[scored] - compute_mean(measured[scored])
                total += float(np.sum(np.square(weight[scored] * centred)))
        return sqrt(total / max(self.n_scored, 1))

    def _list_channels(self, values: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        pairs = zip(
            self.split_by_output(values), self.split_by_output(self.plain_weight), strict=True
        )
        return [(value[name], weight[name]) for value, weight in pairs for name in value]


def _observe_grid(experiment: GridExperiment) -> OutputSamples:
    """Make samples at each grid point that nothing is compared with."""
    zeros = np.zeros(experiment.grid.points)
    return OutputSamples(np.arange(zeros.size, dtype=np.float64), zeros, zeros, zeros, zeros)


def _divide_weights(
    weights: Mapping[str, float], settings: FitSettings, experiment: int
) -> dict[str, float]:
    """Divide the weight of each output by its relative deviation in an experiment."""
    deviations = (1.0,) * len(weights)
    if settings.deviations is not None:
        deviations = settings.deviations[experiment]
    pairs = zip(weights.items(), deviations, strict=True)
    return {name: weight / deviation for (name, weight), deviation in pairs}


def compute_metrics(problem: Problem, simulated: FloatArray) -> Metrics:
    """Compute the agreement of simulated values (M,) with the records of a problem."""
    weight = problem.plain_weight
    error = weight * (problem.evaluator.measured - simulated)
    with np.errstate(all="ignore"):  # a diverged simulation has an infinite residual
        channels = tuple(_compute_channel_metrics(problem, simulated))
        total, scale = rms(error[weight > 0]), problem.output_scale
        fit = 100.0 * (1.0 - total / scale) if scale > 0 else float("nan")
    return Metrics(total, problem.unit, fit, channels)


def compute_reference_rms(
    problem: Problem, simulated: Sequence[Sequence[FloatArray]], records: Sequence[Record]
) -> float:
    """Compute J of simulated outputs against other values, such as noise-free ones.

    Parameters
    ----------
    simulated : sequence of sequence of FloatArray
        By experiment and output, as `Identification.simulated`.
    records : sequence of Record
        As many as in the problem, with the same channels and times.
    """
    errors = []
    for part, outputs, record in zip(
        problem.split_by_output(problem.plain_weight), simulated, records, strict=True
    ):
        for (name, values), channel in zip(
            zip(part, outputs, strict=True), record.outputs, strict=True
        ):
            scored = part[name] > 0
            errors.append((part[name] * (channel.values - values))[scored])
    return rms(np.concatenate(errors))


def _compute_channel_metrics(problem: Problem, simulated: FloatArray) -> list[ChannelMetrics]:
    channels = []
    parts = zip(
        problem.split_by_output(problem.evaluator.measured),
        problem.split_by_output(simulated),
        problem.split_by_output(problem.evaluator.weight),
        strict=True,
    )
    for experiment, (measured, model, weight) in enumerate(parts):
        places = (samples.positions for samples in problem.experiments[experiment].outputs)
        for output, x in zip(problem.model.outputs, places, strict=True):
            scored = weight[output.name] > 0
            if np.any(scored):
                y, computed = measured[output.name][scored], model[output.name][scored]
                channels.append(
                    ChannelMetrics(
                        experiment,
                        output.name,
                        output.unit,
                        int(y.size),
                        rms(y - computed),
                        compute_fit_percent(y, computed),
                        (float(np.min(y)), float(np.max(y))),
                        compute_line_rms(x[scored], y),
                    )
                )
    return channels


def build_simulation_problem(model: Model, record: Record) -> Problem:
    """Build a problem that only simulates: all parameters are fixed and nothing is compared."""
    weights = {output.name: 1.0 for output in model.outputs}
    averaged = average_outputs(model, [record])
    experiment = place_on_grid(model, record, 0, model.parameters, weights, 0, simulates_only=True)
    settings = FitSettings(weights=weights)
    return Problem(
        model=model,
        averaged_model=averaged,
        given_model=model,
        records=(record,),
        settings=settings,
        all_parameters=model.parameters,
        free_parameters=(),
        evaluator=_build_evaluator(averaged, (experiment,), model.parameters, settings),
        experiments=(experiment,),
        output_weights=weights,
        ties={},
        simulates_only=True,
    )


def _build_evaluator(
    model: Model,
    experiments: Sequence[GridExperiment],
    parameters: Sequence[Parameter],
    settings: FitSettings,
) -> Evaluator:
    on_grid = all(are_on_grid(experiment.outputs) for experiment in experiments)
    if model.corrections and not on_grid:
        raise InvalidSettings(
            "/loss/noise_model",
            "noise inside the plant needs regular samples. Resample the record, or set "
            "/solver/step of the model to a period that all sample times are multiples of",
        )
    weighted = any(has_weights(e.outputs, e.grid, on_grid) for e in experiments)
    loss = settings.loss
    one_step, is_robust = settings.prediction == "one-step", loss.kind == "soft-l1"
    variant = KernelVariant(one_step, is_robust, on_grid, weighted)
    samples = [samples for e in experiments for samples in e.outputs]
    weight = np.concatenate([s.weights for s in samples])
    packed = [
        pack_experiment(
            model,
            variant,
            e.grid,
            e.inputs,
            e.outputs,
            e.starts,
            e.first_inputs,
            e.largest_delay_steps,
            loss.scale,
            weight.size,
        )
        for e in experiments
    ]
    rows = [i for i, parameter in enumerate(parameters) if parameter.is_free]
    free = [parameters[i] for i in rows]
    return Evaluator(
        kernel=get_kernel_address(model, variant),
        template=np.array([p.lower if p.fixed is None else p.fixed for p in parameters]),
        free_rows=np.array(rows, dtype=np.int64),
        lower=np.array([p.lower for p in free], dtype=np.float64),
        upper=np.array([p.upper for p in free], dtype=np.float64),
        is_log=np.array([p.scale == "log" for p in free], dtype=np.int64),
        offsets=_locate_experiments(packed, experiments),
        ints=np.concatenate([experiment.ints for experiment in packed]),
        floats=np.concatenate([experiment.floats for experiment in packed]),
        n_work=max(experiment.n_work for experiment in packed),
        n_measured=weight.size,
        n_stored=(2 if model.corrections else 1) * weight.size,
        weight=weight,
        measured=np.concatenate([s.values for s in samples]),
        n_scored=max(float(np.count_nonzero(weight)), 1.0),
    )


def _replace_values(
    evaluator: Evaluator, experiments: Sequence[GridExperiment], write: _WriteValues
) -> Evaluator:
    """Replace values of an evaluator by those that are written of experiments of the same form."""
    floats = evaluator.floats.copy()
    for experiment, (first_int, first_float, _) in zip(
        experiments, evaluator.offsets.tolist(), strict=True
    ):
        write(experiment, evaluator.ints[first_int:], floats[first_float:])
    measured = np.concatenate([s.values for e in experiments for s in e.outputs])
    return evaluator._replace(floats=floats, measured=measured)


def _locate_experiments(
    packed_experiments: Sequence[PackedExperiment], experiments: Sequence[GridExperiment]
) -> Any:
    """Compute where each experiment's numbers and its measured values begin."""
    lengths = [
        (packed.ints.size, packed.floats.size, sum(s.positions.size for s in e.outputs))
        for packed, e in zip(packed_experiments, experiments, strict=True)
    ]
    ends = np.cumsum(np.array(lengths, dtype=np.int64), axis=0)
    return np.ascontiguousarray(np.vstack([np.zeros((1, 3), dtype=np.int64), ends[:-1]]))


def _check_population(theta: FloatArray, free: int) -> FloatArray:
    values = np.ascontiguousarray(theta, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != free:
        raise InvalidSettings(
            "/parameters",
            f"candidates have shape {values.shape}. Need (P, {free}), one column for each free "
            "parameter",
        )
    return values


def compute_record_progress(problem: Problem) -> FloatArray:
    """Compute the share of its experiment (0 … 1) that each measured value (M,) requires."""
    return problem.share(
        "record progress",
        lambda: np.concatenate(
            [
                np.ceil(samples.positions) / max(experiment.grid.points - 1, 1)
                for experiment in problem.experiments
                for samples in experiment.outputs
            ]
        ),
    )
