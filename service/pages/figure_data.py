"""Signals of datasets and runs out of the object store, as figures want them.

From stored rows to what figures are made of.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from math import inf, nan
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.json_pointer import body_of
from service.datasets.recordings import recording_of
from service.datasets.rms_unit import Body, model_of, unit_of
from service.figures.data import (
    Experiment,
    Floats,
    Improvement,
    OutputTraces,
    RunEvidence,
    SoughtParameter,
    Trace,
)
from service.formats.mcap import FittedOutput
from service.jobs.job_parameters import parameters_of_job
from service.repositories.datasets import DatasetRepository
from service.repositories.runs import RunRepository
from service.runs.fitted import fits_of
from service.storage.errors import StorageError
from service.storage.objects import ObjectStore
from service.storage.tables import Dataset, Job, Run
from sysid.core.errors import SysidError
from sysid.data.records import Channel, Recording
from sysid.models.model import Model
from sysid.models.parameters import Parameter, Scale, override

__all__ = ["Body", "evidence_of", "fitness_of", "model_of", "run_body", "sought_parameters",
           "unit_of"]  # fmt: skip


def run_body(job: Job, run: Run) -> dict[str, Any]:
    """The body of one run: the job's, with the values of the run's cell."""
    return body_of(job.spec, run.cell)


def fitness_of(body: Body) -> str:
    """What the search minimises, as figures of it call it: with soft-l1 it is not J."""
    robust = (body.get("loss") or {}).get("kind") == "soft-l1"
    return "soft-l1 loss, as RMS" if robust else "RMS"


def sought_parameters(session: Session, run: Run, body: Body) -> list[SoughtParameter]:
    """The free parameters in the order of the history's columns.

    The result names them once the run has ended; until then the model and the request do.
    """
    model = model_of(body)
    everything = parameters_of_job(session, model, body) if model else ()
    known = override(everything, body.get("parameters", {}))
    result = (run.result or {}).get("parameters")
    if result:
        scales = {one.name: one.scale for one in known}
        return [
            _estimated(one, scales) for one in result if one.get("status") not in ("fixed", "tied")
        ]
    if model is not None and model.rule is not None:
        return []  # which of the candidates are sought is told with the result
    return [_sought(one) for one in known if one.is_free]


def evidence_of(session: Session, job: Job, run: Run) -> RunEvidence:
    """All that is known of a run's search and result."""
    body = run_body(job, run)
    runs = RunRepository(session)
    history = _islands(runs.history(run.id))
    algorithm = body.get("algorithm", {})
    result = run.result or {}
    return RunEvidence(
        id=run.id, unit=unit_of(session, body), fitness=fitness_of(body),
        generations=run.generations or (job.generation if job.n_runs == 1 else 0),
        evaluations=run.evaluations, history=history,
        parameters=_covering(sought_parameters(session, run, body), history),
        epoch=int((algorithm.get("migration") or {}).get("every", 0)),
        migrations=sorted({one.epoch for one in runs.migrations(run.id)}),
        islands=[(_or(one.get("champion_rms"), inf), one.get("refined_rms"))
                 for one in result.get("islands", ())],
        correlation=_correlation(result.get("correlation")),
    )  # fmt: skip


def _correlation(stored: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    if not stored:
        return None
    rows = [[_or(value, nan) for value in row] for row in stored["matrix"]]
    return {"names": stored["names"], "matrix": rows}


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _islands(rows: Sequence[Any]) -> list[list[Improvement]]:
    found: list[list[Improvement]] = []
    for island, points in groupby(rows, key=lambda row: row.island):
        while len(found) < island:  # an island that has not told anything yet
            found.append([])
        found.append([
            Improvement(p.generation, p.evaluations, p.rms, p.phase, tuple(p.parameters))
            for p in points
        ])  # fmt: skip
    return found


def _covering(
    known: list[SoughtParameter], history: Sequence[Sequence[Improvement]]
) -> list[SoughtParameter]:
    """As many parameters as the history has columns, whatever the model says today."""
    points = [point for island in history for point in island]
    if not points:
        return known
    width = len(points[0].parameters)
    unknown = range(min(len(known), width), width)
    return known[:width] + [_by_its_values(points, column) for column in unknown]


def _by_its_values(points: Sequence[Improvement], column: int) -> SoughtParameter:
    values = [point.parameters[column] for point in points]
    lower, upper = min(values), max(values)
    return SoughtParameter(f"parameter {column + 1}", "1", lower, upper if upper > lower
                           else lower + 1.0)  # fmt: skip


def _estimated(one: Mapping[str, Any], scales: Mapping[str, Scale]) -> SoughtParameter:
    return SoughtParameter(
        one["name"], one.get("unit", "1"), one["lower"], one["upper"],
        scales.get(one["name"], "linear"), value=one["value"], stderr=one.get("stderr"),
    )  # fmt: skip


def _sought(parameter: Parameter) -> SoughtParameter:
    return SoughtParameter(
        parameter.name, parameter.unit, parameter.lower, parameter.upper, parameter.scale
    )


def traces_of(store: ObjectStore, dataset: Dataset) -> list[Trace]:
    """The channels of a dataset."""
    return [_trace(channel) for channel in recording_of(store, dataset.sha256).channels]


def experiments_of(session: Session, store: ObjectStore, job: Job, run: Run) -> list[Experiment]:
    """What a run was fitted to, record by record; empty as long as nothing is stored."""
    if run.signals_sha256 is None:
        return []
    body = run_body(job, run)
    fitted = _by_name(fits_of(store, run))
    kept = body.get("validation") or {}
    inputs = list(_inputs(session, store, body, body["datasets"]))
    found = [
        Experiment(f"estimation {number}", _outputs(parts), _at(inputs, number))
        for number, parts in _of_role(fitted, "estimation")
    ]
    validation = _of_role(fitted, "validation")
    if kept.get("fraction") is not None:
        return [_joined(one, dict(validation).get(n, ())) for n, one in enumerate(found, 1)]
    other = list(_inputs(session, store, body, kept.get("datasets") or []))
    return found + [
        Experiment(f"validation {number}", _outputs(parts), _at(other, number), -inf)
        for number, parts in validation
    ]


def _by_name(fits: Iterable[FittedOutput]) -> dict[str, list[FittedOutput]]:
    found: dict[str, list[FittedOutput]] = {}
    for one in fits:
        found.setdefault(one.experiment, []).append(one)
    return found


def _of_role(
    fitted: Mapping[str, Sequence[FittedOutput]], role: str
) -> list[tuple[int, Sequence[FittedOutput]]]:
    """Number (from 1) and outputs of the experiments in one role."""
    named = [(name.partition(" "), parts) for name, parts in fitted.items()]
    return sorted(
        ((int(number), parts) for (kind, _, number), parts in named if kind == role),
        key=lambda one: one[0],
    )


def _outputs(parts: Iterable[FittedOutput]) -> tuple[OutputTraces, ...]:
    return tuple(
        OutputTraces(Trace(one.name, one.unit, one.times, one.measured), one.simulated)
        for one in parts
    )


def _joined(experiment: Experiment, later: Sequence[FittedOutput]) -> Experiment:
    """One record again, of which the last part was kept for validation."""
    if not later:
        return experiment
    outputs = tuple(
        OutputTraces(
            Trace(first.measured.name, first.measured.unit, _both(first.measured.times, rest.times),
                  _both(first.measured.values, rest.measured)),
            _both(first.identified, rest.simulated),
        )
        for first, rest in zip(experiment.outputs, later, strict=True)
    )  # fmt: skip
    since = min(float(one.times[0]) for one in later)
    return Experiment(experiment.name.replace("estimation", "record"), outputs,
                      experiment.inputs, since)  # fmt: skip


def _both(first: Floats, rest: Floats) -> Floats:
    joined: Floats = np.concatenate([first, rest])
    return joined


def _at(inputs: Sequence[tuple[Trace, ...]], number: int) -> tuple[Trace, ...]:
    return inputs[number - 1] if number <= len(inputs) else ()


def _inputs(
    session: Session, store: ObjectStore, body: Mapping[str, Any], datasets: Sequence[str]
) -> Iterator[tuple[Trace, ...]]:
    """Inputs of every record; a dataset that is gone takes only its own inputs off the plot."""
    model = model_of(body)
    if model is None:
        return
    for name in datasets:
        try:
            dataset = DatasetRepository(session).get(name)
            yield from _records(recording_of(store, dataset.sha256), model, body["channels"])
        except (StorageError, SysidError):
            yield ()


def _records(
    recording: Recording, model: Model, channels: Mapping[str, str]
) -> Iterator[tuple[Trace, ...]]:
    signals = [[one.name for one in kind] for kind in (model.inputs, model.outputs)]
    inputs, outputs = ({name: channels.get(name, name) for name in kind} for kind in signals)
    for record in recording.records(inputs, outputs):
        yield tuple(_trace(channel) for channel in record.inputs)


def _trace(channel: Channel) -> Trace:
    held, before = channel.hold == "zero", None
    if channel.history is not None:  # as far as the first sample, so that the lines meet
        pairs = zip(channel.history, (channel.times, channel.values), strict=True)
        times, values = (np.append(known, own[0]) for known, own in pairs)
        before = Trace(channel.name, channel.unit, times, values, held)
    return Trace(channel.name, channel.unit, channel.times, channel.values, held, before)
