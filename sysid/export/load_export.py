"""Read an identified model that was exported as JSON."""

from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np

from sysid.control.linear_form import Covariance, IdentifiedModel, IdentifiedValue
from sysid.core.errors import InvalidModel, UnreadableResult
from sysid.export.description import JSON_FORMAT
from sysid.models.parse import parse_model
from sysid.results.saved_result import FORMAT, read_json


def load_identified(path: str | PathLike[str]) -> IdentifiedModel:
    """Read an identified model from the JSON file of `export_model` or ``lagid export``.

    `simulate` takes it instead of values, and its `model` and `parameter_values` are those of
    the export.

    Raises
    ------
    UnreadableResult
        If the file cannot be read, or is something else.

    Examples
    --------
    >>> values = {"K": 3.0, "T": 1.0, "L": 0.5, "y0": 0.0, "x(0)": 0.0}
    >>> text = export_model(load_model("fopdt"), values, "json")
    >>> from pathlib import Path
    >>> _ = Path("model.json").write_text(text, encoding="utf-8")
    >>> load_identified("model.json").parameter_values["L"]
    0.5
    """
    document = read_json(path)
    name = document.get("format") if isinstance(document, dict) else None
    if name != JSON_FORMAT:
        hint = "; read it with Identification.load" if name == FORMAT else ""
        raise UnreadableResult(path, f"its format is {name!r}, not {JSON_FORMAT!r}{hint}")
    try:
        return _build(document)
    except InvalidModel as error:
        raise UnreadableResult(path, f"its model has faults: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UnreadableResult(path, f"it is damaged: {error!r}") from None


def _build(document: Mapping[str, Any]) -> IdentifiedModel:
    covariance, data = document["covariance"], document["data"]
    return IdentifiedModel(
        parse_model(document["model"]),
        tuple(
            IdentifiedValue(
                str(entry["name"]),
                float(entry["value"]),
                str(entry["unit"]),
                None if entry["stderr"] is None else float(entry["stderr"]),
                str(entry["status"]),
            )
            for entry in document["values"]
        ),
        None
        if covariance is None
        else Covariance(
            tuple(covariance["names"]), np.array(covariance["matrix"], dtype=np.float64)
        ),
        data["sample_time"],
        dict(data["hold"]),
        document["lagid"] or "",
        dict(document["provenance"]),
        dict(data["units"]),
    )
