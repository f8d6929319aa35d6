"""Bounds that a job would take from its data, for the form of a new identification."""

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from service.datasets.signal_channels import map_channels
from service.datasets.stored_recordings import read_records
from service.models import models
from service.models.models import load_stored_model
from service.repositories.dataset_rows import DatasetRepository
from service.storage.objects import ObjectStore
from sysid.core.errors import InvalidRecord
from sysid.models.model import build_initial_parameters
from sysid.simulation.data_bounds import add_units_of_data, bound_by_data


def propose_bounds(
    session: Session, store: ObjectStore, dataset: str, model: str, channels: Mapping[str, str]
) -> dict[str, dict[str, Any]]:
    """Propose bounds and units of the parameters that follow the data, by their names.

    There are none if the channels cannot be the signals of the model.

    Raises
    ------
    NotFound
        If there is no such dataset or model.
    """
    parsed = load_stored_model(models.get_model(session, model).document)
    rows = [DatasetRepository(session).get(dataset)]
    try:
        records = read_records(store, rows, map_channels(parsed, channels))
    except InvalidRecord:
        return {}
    declared = (*parsed.parameters, *build_initial_parameters(parsed, 1))
    bounded = bound_by_data(add_units_of_data(declared, records), records)
    return {
        parameter.name: {
            "lower": parameter.lower,
            "upper": parameter.upper,
            "unit": parameter.unit,
        }
        for parameter in bounded
        if parameter.bounds is not None
    }
