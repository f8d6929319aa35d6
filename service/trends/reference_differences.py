"""Differences between a reference run and a batch, such as another hold of the inputs."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy.orm import Session

from service.jobs.record_checks import list_signals
from service.jobs.stored_run import load_run
from service.models import models
from service.repositories.datasets import DatasetRepository
from service.storage.tables import Run
from service.trends.points import DatasetChannels
from sysid.core.errors import UnknownModel
from sysid.models.model import Model
from sysid.models.parameters import override_parameters

JobBody = Mapping[str, Any]
RunFacts = Mapping[str, str]

_NO_VALUE = "none"


def describe_differences(
    session: Session, run: Run, bodies: Sequence[JobBody], known: DatasetChannels
) -> str:
    """Describe settings of a reference run that differ from those of a batch; empty if none do.

    Parameters
    ----------
    bodies : sequence of dict
        Requests of the runs of the batch.
    known : DatasetChannels
        Channels of their datasets.
    """
    body = load_run(session, run.id).body
    theirs = _collect_facts(session, body, read_channels(session, set(body["datasets"])))
    told: dict[str, None] = {}
    for ours in _list_distinct_facts(session, bodies, known):
        for name in dict.fromkeys([*theirs, *ours]):
            one, other = theirs.get(name, _NO_VALUE), ours.get(name, _NO_VALUE)
            if one != other:
                told[f"{name} = {one} (here {other})"] = None
    return f"the reference was made with {', '.join(told)}" if told else ""


def read_channels(session: Session, datasets: set[str]) -> DatasetChannels:
    """Read the channels of datasets, by name."""
    found = DatasetRepository(session).get_all(sorted(datasets)) if datasets else ()
    return {one.id: {channel["name"]: channel for channel in one.channels} for one in found}


def _list_distinct_facts(
    session: Session, bodies: Sequence[JobBody], known: DatasetChannels
) -> Iterator[RunFacts]:
    """Iterate over the distinct settings of a batch."""
    told: set[str] = set()
    for body in bodies:
        settings = {name: body[name] for name in _COMPARED_FIELDS}
        kinds = [
            sorted(
                (one["name"], one["unit"], one["hold"]) for one in known.get(dataset, {}).values()
            )
            for dataset in body["datasets"]
        ]
        key = repr((settings, kinds))
        if key not in told:
            told.add(key)
            yield _collect_facts(session, body, known)


_COMPARED_FIELDS = (
    "model",
    "channels",
    "hold",
    "loss",
    "weights",
    "prediction",
    "skip",
    "noise",
    "parameters",
)


def _collect_facts(session: Session, body: JobBody, known: DatasetChannels) -> RunFacts:
    """Describe the settings that an estimate depends on, besides the data."""
    try:
        model, _ = models.resolve_model(session, body["model"])
    except UnknownModel:
        return {}  # no longer in the catalogue
    inputs, outputs = list_signals(model)
    found = {"model": model.name}
    for signal in (*inputs, *outputs):
        channel = body["channels"].get(signal, signal)
        stored = [known[one][channel] for one in body["datasets"] if channel in known.get(one, {})]
        found[signal] = channel
        found[f"unit of {signal}"] = ", ".join(_list_distinct(one["unit"] for one in stored))
        if signal in inputs:
            given = body["hold"].get(signal)
            held = [given or one["hold"] for one in stored]
            found[f"hold of {signal}"] = ", ".join(_list_distinct(held))
    return {
        **found,
        **dict(_describe_settings(body)),
        **dict(_describe_fixed_parameters(model, body)),
    }


def _list_distinct(words: Any) -> list[str]:
    return list(dict.fromkeys(words)) or ["unknown"]


def _describe_settings(body: JobBody) -> Iterator[tuple[str, str]]:
    loss, weights = body["loss"], body["weights"]
    scale = "" if loss["kind"] == "squares" else f" of scale {loss['scale']:g}"
    yield "loss", loss["kind"] + scale
    yield (
        "weights",
        (
            ", ".join(f"{name} {value:g}" for name, value in sorted(weights.items()))
            if weights
            else "by standard deviation"
        ),
    )
    yield "prediction", body["prediction"]
    yield "skip", f"{body['skip']:d}"
    yield "added noise", f"{body['noise']['sigma']:g}"


def _describe_fixed_parameters(model: Model, body: JobBody) -> Iterator[tuple[str, str]]:
    """Describe the parameters that are not estimated."""
    own = {one.name for one in model.parameters}
    changes = {name: one for name, one in body["parameters"].items() if name in own}
    for one in override_parameters(model.parameters, changes):
        if one.fixed is not None:
            yield one.name, f"{one.fixed:g}, fixed"
        elif one.tied is not None:
            yield one.name, f"{one.tied}, tied"
