"""The unit of the RMS of a job."""

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from service.models.models import load_stored_model
from service.repositories.dataset_rows import DatasetRepository
from service.storage.storage_errors import RowNotFound
from sysid.core import text
from sysid.core.errors import InvalidModel

JobBody = Mapping[str, Any]


def find_rms_unit(session: Session, body: JobBody) -> str:
    """Return the unit of the RMS of a job: that of its output, or σ for several together.

    A model that an earlier version accepted and this one refuses has none, "1": its jobs stay in
    the lists.
    """
    try:
        outputs = load_stored_model(body["model"]).outputs
    except InvalidModel:
        return "1"
    return text.find_rms_unit(
        {output.name: output.unit for output in outputs},
        lambda output: _find_recorded_unit(session, body, output),
    )


def _find_recorded_unit(session: Session, body: JobBody, output: str) -> str:
    channel = body["channels"].get(output, output)
    try:
        channels = DatasetRepository(session).get(body["datasets"][0]).channels
    except RowNotFound:
        return "1"
    return next((str(entry["unit"]) for entry in channels if entry["name"] == channel), "1")
