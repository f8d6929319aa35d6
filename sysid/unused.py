"""What a request gives without any effect: refused, since it is a mistake more often than not."""

from collections.abc import Mapping, Sequence

from sysid.errors import Fault, InvalidSettings
from sysid.models.initial import initial_parameters
from sysid.models.model import Model
from sysid.parameters import Parameter, override
from sysid.ties import names_in, tied_model, ties_of


def unused(
    model: Model, parameters: Sequence[Parameter], weights: Mapping[str, float] | None
) -> list[Fault]:
    """Free parameters that no equation reads, and a weight beside which there is no other output.

    Parameters
    ----------
    model : Model
        Its ties resolved.
    parameters : sequence of Parameter
        The model's own, as they are sought.
    """
    trees = (*model.equations, *(output.expression for output in model.outputs))
    read = {name for tree in trees for name in names_in(tree)}
    where = "no term" if model.form == "polynomial" else "no equation and no output"
    found = [
        Fault(
            f"/parameters/{one.name}",
            f"{where} of model {model.name!r} uses {one.name!r}, so no data can tell its value; "
            "take it out of the model, or fix it",
        )
        for one in parameters
        if one.is_free and one.name not in read
    ]
    only = [output.name for output in model.outputs]
    if len(only) == 1 and only[0] in (weights or {}):
        detail = (
            f"{only[0]!r} is the model's only output, so a weight would change nothing; leave it "
            "out"
        )
        found.append(Fault(f"/weights/{only[0]}", detail))
    return found


def check_used(
    model: Model,
    experiments: int,
    changes: Mapping[str, Mapping[str, object]] | None,
    weights: Mapping[str, float] | None,
) -> None:
    """Raise for the first of these.

    Raises
    ------
    InvalidSettings, InvalidBounds
        With its pointer; also if the changes of parameters cannot be used.
    """
    everything = override(
        (*model.parameters, *initial_parameters(model, experiments)), dict(changes or {})
    )
    tied = tied_model(model, ties_of(model, everything))
    for fault in unused(tied, everything[: len(model.parameters)], weights):
        raise InvalidSettings(fault.pointer, fault.detail)
