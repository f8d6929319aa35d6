"""Signals of datasets and runs out of the object store, as figures want them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import inf
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.fitted import fits_of
from service.recordings import recording_of
from service.rms_units import model_of
from service.signals.writer import FittedOutput
from service.storage.datasets import DatasetRepository
from service.storage.errors import StorageError
from service.storage.objects import ObjectStore
from service.storage.tables import Dataset, Job, Run
from service.web.evidence import Experiment, Floats, OutputTraces, Trace
from service.web.reading import run_body
from sysid.core.errors import SysidError
from sysid.data.records import Channel, Recording
from sysid.models.model import Model


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
