"""Export as JSON: the model's document with its values, and where they come from."""

import json
from math import isfinite
from typing import Any

from sysid.export.identified import Identified, Value

FORMAT = "lagid-model/1"


def json_source(identified: Identified) -> str:
    """A JSON document from which the model can be built and simulated again.

    ``model`` is the document that `sysid.load_model` and the service read; each entry of
    ``values`` has the unit in which value and standard error are.

    Parameters
    ----------
    identified : Identified
    """
    return json.dumps(_document(identified), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _document(identified: Identified) -> dict[str, Any]:
    covariance = identified.covariance
    return {
        "format": FORMAT,
        "lagid": identified.version or None,
        "model": dict(identified.model.document),
        "values": [_value(one) for one in identified.values],
        "covariance": None if covariance is None else {
            "names": list(covariance.names),
            "matrix": [[_finite(value) for value in row] for row in covariance.matrix],
        },
        "data": {
            "sample_time": identified.sample_time,
            "hold": {one.name: identified.hold(one.name) for one in identified.model.inputs},
        },
        "provenance": dict(identified.provenance),
    }  # fmt: skip


def _value(one: Value) -> dict[str, Any]:
    return {
        "name": one.name, "value": float(one.value), "unit": one.unit,
        "stderr": _finite(one.stderr), "status": one.status,
    }  # fmt: skip


def _finite(value: float | None) -> float | None:
    """JSON has no number that is not finite."""
    return None if value is None or not isfinite(value) else float(value)
