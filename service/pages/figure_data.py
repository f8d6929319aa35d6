"""Load the data of figures: signals from the object store, results from stored rows."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import Any

from sqlalchemy.orm import Session

from service.core.errors import BudgetExceeded, Conflict
from service.formats.mcap.mcap_files import FitRole, FittedOutput
from service.jobs.stored_run import StoredRun
from service.repositories.run_rows import RunRepository
from service.runs.bands import load_bands
from service.runs.disturbances import load_disturbances
from service.runs.fitted import load_fitted_signals
from service.runs.residuals import analyse_residuals
from service.storage.objects import ObjectStore
from service.storage.storage_errors import ObjectMissing, RowNotFound
from sysid.core.errors import SysidError
from sysid.figures.data import (
    DisturbanceTraces,
    ExperimentTraces,
    OutputTraces,
    SearchTraces,
    SignalTrace,
)
from sysid.models.parameters import Parameter
from sysid.results.figures import (
    RecordTraces,
    TestedResiduals,
    add_bands,
    arrange_experiments,
    label_fitness,
    list_searched_parameters,
    to_disturbance_traces,
    to_signal_trace,
)
from sysid.results.result import Result
from sysid.search.state import Improvement


def list_free_parameters(session: Session, stored: StoredRun) -> list[Parameter]:
    """List the free parameters in the order of the history's columns.

    They come from the result once the run has ended; before, from the model and the request.
    """
    parameters = stored.parameters(session)
    if stored.result is not None:
        scales = {parameter.name: parameter.scale for parameter in parameters}
        return list_searched_parameters(stored.result, scales)
    if stored.model.rule is not None:
        return []  # only the result says which candidates are selected
    return [parameter for parameter in parameters if parameter.is_free]


@dataclass(frozen=True, eq=False)
class StoredRunFigures:
    """What the figures of a stored run are drawn from; a `sysid.results.figures.RunFigures`."""

    session: Session
    store: ObjectStore
    stored: StoredRun

    @property
    def result(self) -> Result | None:
        """The result; None until there is one."""
        return self.stored.result

    @cached_property
    def search(self) -> SearchTraces:
        """The search, so far."""
        session, stored = self.session, self.stored
        job, run, body, runs = stored.job, stored.run, stored.body, RunRepository(session)
        history = _group_by_island(runs.read_history(run.id))
        return SearchTraces(
            unit=stored.rms_unit(session),
            fitness_label=label_fitness(body["loss"]["kind"]),
            generations=run.generations or (job.generation if job.n_runs == 1 else 0),
            history=history,
            parameters=_match_history_width(list_free_parameters(session, stored), history),
            estimates={estimate.name: estimate for estimate in stored.estimates},
            epoch=int((body["algorithm"].get("migration") or {}).get("every", 0)),
            migrations=sorted({migration.epoch for migration in runs.read_migrations(run.id)}),
        )

    @cached_property
    def experiments(self) -> list[ExperimentTraces]:
        """The records that the run was fitted to; empty until it has signals, or without data.

        Outputs have their bands where these can be computed.
        """
        session, store, stored = self.session, self.store, self.stored
        experiments = read_plain_experiments(session, store, stored)
        if not experiments or not stored.estimates:
            return experiments
        try:
            return add_bands(experiments, load_bands(session, store, stored))
        except (BudgetExceeded, Conflict):  # no evaluations left, no standard errors, no dataset
            return experiments

    @cached_property
    def disturbances(self) -> Sequence[DisturbanceTraces]:
        """The estimated disturbances; empty where they cannot be computed."""
        try:
            records = load_disturbances(self.session, self.store, self.stored)
        except Conflict:  # no standard errors, or a dataset was deleted
            return []
        return to_disturbance_traces(records)

    @cached_property
    def residuals(self) -> TestedResiduals | None:
        """The residuals that were tested; None until the run has signals, or without data."""
        try:
            analysis = analyse_residuals(self.session, self.store, self.stored)
        except Conflict:
            return None
        return analysis and TestedResiduals(analysis.correlations, analysis.experiments)


def _group_by_island(rows: Sequence[Any]) -> list[list[Improvement]]:
    by_island: list[list[Improvement]] = []
    for island, points in groupby(rows, key=lambda row: row.island):
        while len(by_island) < island:  # an island without any improvement yet
            by_island.append([])
        by_island.append(
            [
                Improvement(p.generation, p.evaluations, p.rms, p.phase, tuple(p.parameters))
                for p in points
            ]
        )
    return by_island


def _match_history_width(
    parameters: list[Parameter], history: Sequence[Sequence[Improvement]]
) -> list[Parameter]:
    """Match the number of parameters to the history's columns; the model may have changed.

    Bounds that follow the data are unknown: the range of the history is shown instead.
    """
    points = [point for island in history for point in island]
    if not points:
        return parameters
    width = len(points[0].parameters)
    shown = [
        _show_history(parameter, points, column) if parameter.bounds is not None else parameter
        for column, parameter in enumerate(parameters[:width])
    ]
    unknown = range(len(shown), width)
    return shown + [
        _show_history(Parameter(f"parameter {column + 1}", 0.0, 1.0), points, column)
        for column in unknown
    ]


def _show_history(parameter: Parameter, points: Sequence[Improvement], column: int) -> Parameter:
    """Replace the bounds by the range of the history."""
    values = [point.parameters[column] for point in points]
    lower, upper = min(values), max(values)
    return replace(parameter, lower=lower, upper=upper if upper > lower else lower + 1.0)


def read_plain_experiments(
    session: Session, store: ObjectStore, stored: StoredRun
) -> list[ExperimentTraces]:
    """Read the same records without bands, which take simulations."""
    try:
        fits = load_fitted_signals(session, store, stored)
    except Conflict:  # a dataset was deleted: the other figures are shown
        return []
    if fits is None:
        return []
    fitted = _by_experiment(fits)
    estimation, validation = fitted["estimation"], fitted["validation"]
    validation_settings = stored.body["validation"] or {}
    is_part = validation_settings.get("fraction") is not None
    others = [] if is_part else validation_settings.get("datasets") or []
    inputs = list(_read_inputs(session, store, stored, stored.body["datasets"]))
    later = inputs if is_part else list(_read_inputs(session, store, stored, others))
    if is_part:
        validation = {number: validation.get(number, ()) for number in estimation}
    return arrange_experiments(
        _pair_with_inputs(estimation, inputs),
        _pair_with_inputs(validation, later),
        is_part=is_part,
    )


def _pair_with_inputs(
    outputs: Mapping[int, Sequence[FittedOutput]], inputs: Sequence[tuple[SignalTrace, ...]]
) -> list[RecordTraces]:
    return [
        (_to_output_traces(parts), _get_inputs(inputs, number)) for number, parts in outputs.items()
    ]


def _by_experiment(
    fits: Iterable[FittedOutput],
) -> dict[FitRole, dict[int, Sequence[FittedOutput]]]:
    """Group the outputs by role and by number of the experiment."""
    by_role: dict[FitRole, dict[int, list[FittedOutput]]] = {"estimation": {}, "validation": {}}
    for fit in fits:
        by_role[fit.role].setdefault(fit.number, []).append(fit)
    return {role: dict(sorted(numbered.items())) for role, numbered in by_role.items()}


def _to_output_traces(parts: Iterable[FittedOutput]) -> tuple[OutputTraces, ...]:
    return tuple(
        OutputTraces(SignalTrace(part.name, part.unit, part.times, part.measured), part.simulated)
        for part in parts
    )


def _get_inputs(inputs: Sequence[tuple[SignalTrace, ...]], number: int) -> tuple[SignalTrace, ...]:
    return inputs[number - 1] if number <= len(inputs) else ()


def _read_inputs(
    session: Session, store: ObjectStore, stored: StoredRun, datasets: Sequence[str]
) -> Iterator[tuple[SignalTrace, ...]]:
    """Read the inputs of every record; a deleted dataset omits only its own inputs."""
    for name in datasets:
        try:
            for record in stored.read_datasets(session, store, [name]):
                yield tuple(to_signal_trace(channel) for channel in record.inputs)
        except (RowNotFound, ObjectMissing, SysidError):
            yield ()
