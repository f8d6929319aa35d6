"""What is wrong with the settings of a body, whatever records there are.

It needs no database, so that the command line checks as the service does.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from service.conversion import algorithm_of, faults_of, loss_of
from service.errors import FieldError
from sysid.core.errors import SysidError, nearest
from sysid.models.model import Model
from sysid.models.parameters import Parameter, override

Body = dict[str, Any]


def signal_faults(body: Body, model: Model) -> Iterator[FieldError]:
    """Channels, holds and weights of signals that the model does not have."""
    inputs, outputs = [one.name for one in model.inputs], [one.name for one in model.outputs]
    for name in body["channels"]:
        if name not in (*inputs, *outputs):
            hint = nearest(name, (*inputs, *outputs))
            yield FieldError(
                f"/channels/{name}", f"model {model.name!r} has no signal {name!r}{hint}"
            )
    for name in body["hold"]:
        if name not in inputs:
            hint = nearest(name, inputs)
            yield FieldError(f"/hold/{name}", f"model {model.name!r} has no input {name!r}{hint}")
    for name, weight in (body["weights"] or {}).items():
        if name not in outputs:
            hint = nearest(name, outputs)
            yield FieldError(f"/weights/{name}", f"the model has no output {name!r}{hint}")
        elif not weight > 0:
            yield FieldError(f"/weights/{name}", f"found {weight:g}; need a positive number")


def conversion_faults(body: Body) -> list[FieldError]:
    """Settings of search and loss that do not go together."""
    found: list[FieldError] = []
    tried(algorithm_of, found, body["algorithm"])
    tried(loss_of, found, body["loss"])
    if body["prediction"] == "one-step" and body["loss"].get("noise_model") == "ar1":
        detail = "ar1 is for free runs; predictions one step ahead contain the noise"
        found.append(FieldError("/loss/noise_model", detail))
    return found


def setting_faults(body: Body, model: Model, parameters: tuple[Parameter, ...]) -> list[FieldError]:
    """Faults of a body that its model shows: names that it does not have, values that are none."""
    found = conversion_faults(body)
    overridden(found, parameters, body["parameters"])
    return [*found, *signal_faults(body, model)]


def overridden(
    errors: list[FieldError], parameters: tuple[Parameter, ...], changes: Mapping[str, Any]
) -> tuple[Parameter, ...]:
    """The parameters with all changes that can be made; of each of the others its fault."""
    for name, change in changes.items():
        parameters = tried(override, errors, parameters, {name: change}) or parameters
    return parameters


def tried(make: Any, errors: list[FieldError], *arguments: Any) -> Any:
    """What `make` gives; None where it raises, and its faults among `errors`."""
    try:
        return make(*arguments)
    except SysidError as error:
        errors += faults_of(error)
        return None
