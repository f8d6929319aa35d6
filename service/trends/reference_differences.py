"""Differences between a reference run and a batch, such as another hold of the inputs."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy.orm import Session

from service.jobs.record_checks import list_signals
from service.jobs.stored_run import load_run
from service.models import models
from service.repositories.dataset_rows import DatasetRepository
from service.storage.tables import Run
from service.trends.points import DatasetChannels
from sysid.core.errors import UnknownModel
from sysid.models.model import Model
from sysid.models.parameters import override_parameters

JobBody = Mapping[str, Any]
RunFacts = Mapping[str, str]

_NO_VALUE = "none"


def describe_differences(
    session: Session, run: Run, bodies: Sequence[JobBody], dataset_channels: DatasetChannels
) -> str:
    """Describe settings of a reference run that differ from those of a batch; empty if none do.

    Parameters
    ----------
    bodies : sequence of dict
        Requests of the runs of the batch.
    dataset_channels : DatasetChannels
        Channels of their datasets.
    """
    body = load_run(session, run.id).body
    reference_facts = _collect_facts(session, body, read_channels(session, set(body["datasets"])))
    differences: dict[str, None] = {}
    for facts in _list_distinct_facts(session, bodies, dataset_channels):
        for name in dict.fromkeys([*reference_facts, *facts]):
            reference_value, value = (
                reference_facts.get(name, _NO_VALUE),
                facts.get(name, _NO_VALUE),
            )
            if reference_value != value:
                differences[f"{name} = {reference_value} (here {value})"] = None
    return f"the reference was made with {', '.join(differences)}" if differences else ""


def read_channels(session: Session, datasets: set[str]) -> DatasetChannels:
    """Read the channels of datasets, by name."""
    datasets_found = DatasetRepository(session).get_all(sorted(datasets)) if datasets else ()
    return {
        dataset.id: {channel["name"]: channel for channel in dataset.channels}
        for dataset in datasets_found
    }


def _list_distinct_facts(
    session: Session, bodies: Sequence[JobBody], dataset_channels: DatasetChannels
) -> Iterator[RunFacts]:
    """Iterate over the distinct settings of a batch."""
    seen: set[str] = set()
    for body in bodies:
        settings = {name: body.get(name) for name in _COMPARED_FIELDS}
        kinds = [
            sorted(
                (channel_row["name"], channel_row["unit"], channel_row["hold"])
                for channel_row in dataset_channels.get(dataset, {}).values()
            )
            for dataset in body["datasets"]
        ]
        key = repr((settings, kinds))
        if key not in seen:
            seen.add(key)
            yield _collect_facts(session, body, dataset_channels)


_COMPARED_FIELDS = (
    "model",
    "channels",
    "hold",
    "loss",
    "weights",
    "prediction",
    "skip",
    "initial",
    "noise",
    "parameters",
)


def _collect_facts(session: Session, body: JobBody, dataset_channels: DatasetChannels) -> RunFacts:
    """Describe the settings that an estimate depends on, besides the data."""
    try:
        model, _ = models.resolve_model(session, body["model"])
    except UnknownModel:
        return {}  # no longer in the catalogue
    inputs, outputs = list_signals(model)
    facts = {"model": model.name}
    for signal in (*inputs, *outputs):
        channel = body["channels"].get(signal, signal)
        stored = [
            dataset_channels[dataset][channel]
            for dataset in body["datasets"]
            if channel in dataset_channels.get(dataset, {})
        ]
        facts[signal] = channel
        facts[f"unit of {signal}"] = ", ".join(_list_distinct(row["unit"] for row in stored))
        if signal in inputs:
            hold = body["hold"].get(signal)
            held = [hold or row["hold"] for row in stored]
            facts[f"hold of {signal}"] = ", ".join(_list_distinct(held))
    return {
        **facts,
        **dict(_describe_settings(body)),
        **dict(_describe_fixed_parameters(model, body)),
    }


def _list_distinct(words: Any) -> list[str]:
    return list(dict.fromkeys(words)) or ["unknown"]


def _describe_weight(weight: float | list[float]) -> str:
    numbers = weight if isinstance(weight, list) else [weight]
    return " and ".join(f"{number:g}" for number in numbers)


def _describe_settings(body: JobBody) -> Iterator[tuple[str, str]]:
    loss, weights = body["loss"], body["weights"]
    scale = "" if loss["kind"] == "squares" else f" of scale {loss['scale']:g}"
    yield "loss", loss["kind"] + scale
    yield (
        "weights",
        (
            ", ".join(f"{name} {_describe_weight(weights[name])}" for name in sorted(weights))
            if weights
            else "by the noise"
        ),
    )
    yield "prediction", body["prediction"]
    yield "skip", f"{body['skip']:d}"
    yield "initial", body.get("initial") or "as in the model"
    yield "added noise", f"{body['noise']['sigma']:g}"


def _describe_fixed_parameters(model: Model, body: JobBody) -> Iterator[tuple[str, str]]:
    """Describe the parameters that are not estimated."""
    names = {parameter.name for parameter in model.parameters}
    changes = {name: change for name, change in body["parameters"].items() if name in names}
    for parameter in override_parameters(model.parameters, changes):
        if parameter.fixed is not None:
            yield parameter.name, f"{parameter.fixed:g}, fixed"
        elif parameter.tied is not None:
            yield parameter.name, f"{parameter.tied}, tied"
