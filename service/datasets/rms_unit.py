"""The unit of the RMS of a job."""

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from service.models.models import load_stored_model
from service.repositories.datasets import DatasetRepository
from service.storage.errors import RowNotFound

JobBody = Mapping[str, Any]


def find_rms_unit(session: Session, body: JobBody) -> str:
    """Return the unit of the RMS: that of the output, or σ for several outputs together.

    σ are standard deviations. A model that fits any unit has the unit "1"; then the unit is that of
    the recorded channel.
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
    return next((str(entry["unit"]) for entry in channels if entry["name"] == channel), "1")
