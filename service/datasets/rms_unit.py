"""The unit of a body's RMS."""

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from service.models.models import load_stored_model
from service.repositories.datasets import DatasetRepository
from service.storage.errors import RowNotFound

JobBody = Mapping[str, Any]


def find_rms_unit(session: Session, body: JobBody) -> str:
    """Unit of the RMS: the output's, or standard deviations of several outputs together.

    A model that fits any unit says "1"; then the unit is that of the recorded channel.
    """
    model = load_stored_model(body["model"])
    if len(model.outputs) > 1:
        return "σ"
    output = model.outputs[0]
    if output.unit != "1":
        return output.unit
    return _find_recorded_unit(
        session, body, body.get("channels", {}).get(output.name, output.name)
    )


def _find_recorded_unit(session: Session, body: JobBody, channel: str) -> str:
    try:
        channels = DatasetRepository(session).get(body["datasets"][0]).channels
    except RowNotFound:
        return "1"
    return next((str(one["unit"]) for one in channels if one["name"] == channel), "1")
