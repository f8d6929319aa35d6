"""Parameters of a job: those of its model, and the initial states of every fitted experiment."""

import re
from collections.abc import Iterable, Mapping
from typing import Any

from sqlalchemy.orm import Session

from service.datasets.signal_channels import map_channels
from service.repositories.dataset_rows import DatasetRepository
from service.storage.storage_errors import StorageError
from service.storage.tables import Dataset
from sysid.data.outages import count_experiments
from sysid.models.model import Model, build_initial_parameters
from sysid.models.parameters import Parameter

_NUMBERED = re.compile(r"\(0\)\[(\d{1,6})\]$")


def count_dataset_experiments(dataset: Dataset, model: Model, body: Mapping[str, Any]) -> int:
    """Count the experiments of a dataset: its segments, cut at outages of the model's inputs."""
    segments = dataset.details["segments"]
    unseen = dataset.details.get("outages") or {}
    if not unseen:
        return max(1, len(segments))
    measurements = [(one["start"], one["stop"]) for one in segments] or [
        (
            min(channel["start"] for channel in dataset.channels),
            max(channel["stop"] for channel in dataset.channels),
        )
    ]
    inputs = [channel for _, channel in map_channels(model, body["channels"]).inputs]
    return count_experiments(unseen, measurements, inputs)


def list_job_parameters(
    session: Session, model: Model, body: Mapping[str, Any]
) -> tuple[Parameter, ...]:
    """List all parameters of an accepted job, in order.

    For datasets deleted since, only the names in the body are known, such as the initial state
    ``x(0)[3]``.
    """
    repository, experiments = DatasetRepository(session), 0
    for name in body["datasets"]:
        try:
            experiments += count_dataset_experiments(repository.get(name), model, body)
        except StorageError:
            experiments += 1
    experiments = max(experiments, count_named_experiments(body["parameters"]))
    return (*model.parameters, *build_initial_parameters(model, experiments))


def count_named_experiments(parameters: Iterable[str]) -> int:
    """Count the experiments that the named initial states imply (a lower bound)."""
    named = (_NUMBERED.search(name) for name in parameters)
    return max((int(match[1]) for match in named if match), default=1)
