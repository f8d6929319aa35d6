"""Signals of datasets and runs out of the object store, as figures want them.

From stored rows to what figures are made of.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from math import inf, nan
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.datasets.recordings import recording_of
from service.figures.data import (
    Experiment,
    Floats,
    Improvement,
    OutputTraces,
    RunEvidence,
    SoughtParameter,
    Trace,
)
from service.formats.mcap import FitRole, FittedOutput
from service.jobs.results import is_free
from service.jobs.stored_run import StoredRun
from service.repositories.runs import RunRepository
from service.runs.fitted import fits_of
from service.storage.errors import StorageError
from service.storage.objects import ObjectStore
from service.storage.tables import Dataset
from sysid.core.errors import SysidError
from sysid.data.records import Channel
from sysid.models.parameters import Parameter, Scale


def fitness_of(body: Mapping[str, Any]) -> str:
    """What the search minimises, as figures of it call it: with soft-l1 it is not J."""
    robust = (body.get("loss") or {}).get("kind") == "soft-l1"
    return "soft-l1 loss, as RMS" if robust else "RMS"


def sought_parameters(session: Session, stored: StoredRun) -> list[SoughtParameter]:
    """The free parameters in the order of the history's columns.

    The result names them once the run has ended; until then the model and the request do.
    """
    known = stored.parameters(session)
    if stored.estimates:
        scales = {one.name: one.scale for one in known}
        return [_estimated(one, scales) for one in stored.estimates if is_free(one)]
    if stored.model.rule is not None:
        return []  # which of the candidates are sought is told with the result
    return [_sought(one) for one in known if one.is_free]


def evidence_of(session: Session, stored: StoredRun) -> RunEvidence:
    """All that is known of a run's search and result."""
    job, run, body = stored.job, stored.run, stored.body
    runs = RunRepository(session)
    history = _islands(runs.history(run.id))
    return RunEvidence(
        id=run.id, unit=stored.rms_unit(session), fitness=fitness_of(body),
        generations=run.generations or (job.generation if job.n_runs == 1 else 0),
        evaluations=run.evaluations, history=history,
        parameters=_covering(sought_parameters(session, stored), history),
        epoch=int((body["algorithm"].get("migration") or {}).get("every", 0)),
        migrations=sorted({one.epoch for one in runs.migrations(run.id)}),
        islands=[(_or(one.get("champion_rms"), inf), one.get("refined_rms"))
                 for one in stored.result.get("islands", ())],
        correlation=_correlation(stored.result.get("correlation")),
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


def experiments_of(session: Session, store: ObjectStore, stored: StoredRun) -> list[Experiment]:
    """What a run was fitted to, record by record; empty as long as nothing is stored."""
    if stored.run.signals_sha256 is None:
        return []
    fitted = _by_experiment(fits_of(store, stored.run))
    estimation, validation = fitted["estimation"], fitted["validation"]
    kept = stored.body["validation"] or {}
    inputs = list(_inputs(session, store, stored, stored.body["datasets"]))
    found = [
        Experiment(f"estimation {number}", _outputs(parts), _at(inputs, number))
        for number, parts in estimation.items()
    ]
    if kept.get("fraction") is not None:
        return [_joined(one, validation.get(n, ())) for n, one in enumerate(found, 1)]
    other = list(_inputs(session, store, stored, kept.get("datasets") or []))
    return found + [
        Experiment(f"validation {number}", _outputs(parts), _at(other, number), -inf)
        for number, parts in validation.items()
    ]


def _by_experiment(
    fits: Iterable[FittedOutput],
) -> dict[FitRole, dict[int, Sequence[FittedOutput]]]:
    """Of each role, the outputs of its experiments by number, in order."""
    found: dict[FitRole, dict[int, list[FittedOutput]]] = {"estimation": {}, "validation": {}}
    for fit in fits:
        found[fit.role].setdefault(fit.number, []).append(fit)
    return {role: dict(sorted(numbered.items())) for role, numbered in found.items()}


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
    session: Session, store: ObjectStore, stored: StoredRun, datasets: Sequence[str]
) -> Iterator[tuple[Trace, ...]]:
    """Inputs of every record; a dataset that is gone takes only its own inputs off the plot."""
    for name in datasets:
        try:
            for record in stored.read_datasets(session, store, [name]):
                yield tuple(_trace(channel) for channel in record.inputs)
        except (StorageError, SysidError):
            yield ()


def _trace(channel: Channel) -> Trace:
    held, before = channel.hold == "zero", None
    if channel.history is not None:  # as far as the first sample, so that the lines meet
        pairs = zip(channel.history, (channel.times, channel.values), strict=True)
        times, values = (np.append(known, own[0]) for known, own in pairs)
        before = Trace(channel.name, channel.unit, times, values, held)
    return Trace(channel.name, channel.unit, channel.times, channel.values, held, before)
