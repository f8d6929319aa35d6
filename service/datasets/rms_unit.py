"""The unit of a body's RMS."""

import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from sqlalchemy.orm import Session

from service.repositories.datasets import DatasetRepository
from service.storage.errors import NotFound
from sysid.core.errors import SysidError
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model

Body = Mapping[str, Any]


def model_of(body: Body) -> Model | None:
    """The model of a body; None if this version of the program cannot read it any more."""
    return _model(json.dumps(body["model"]))


@lru_cache(maxsize=256)
def _model(reference: str) -> Model | None:
    try:
        source = json.loads(reference)
        return load_model(source) if isinstance(source, str) else parse_model(source)
    except SysidError:
        return None


def unit_of(session: Session, body: Body) -> str:
    """Unit of the RMS: the output's, or standard deviations of several outputs together.

    A model that fits any unit says "1"; then the unit is that of the recorded channel.
    """
    model = model_of(body)
    if model is None:
        return "1"
    if len(model.outputs) > 1:
        return "σ"
    output = model.outputs[0]
    if output.unit != "1":
        return output.unit
    return _recorded_unit(session, body, body.get("channels", {}).get(output.name, output.name))


def _recorded_unit(session: Session, body: Body, channel: str) -> str:
    try:
        channels = DatasetRepository(session).get(body["datasets"][0]).channels
    except NotFound:
        return "1"
    return next((str(one["unit"]) for one in channels if one["name"] == channel), "1")
