"""Whether a model's lags stay in the past for bounds other than its document's."""

from collections.abc import Sequence

from sysid.errors import InvalidSettings
from sysid.language.intervals import bounds
from sysid.language.lags import past_values
from sysid.language.printer import text
from sysid.language.tree import Past
from sysid.models.model import Model
from sysid.models.sections import interval
from sysid.parameters import Parameter


def check_lags(model: Model, parameters: Sequence[Parameter], period: float | None = None) -> None:
    """Raise if a lag could be negative inside these bounds.

    Parameters
    ----------
    model : Model
    parameters : sequence of Parameter
        The model's, with the bounds and fixed values of a request.
    period : float or None
        Sampling period in s, if it is known.

    Raises
    ------
    InvalidSettings
        Naming the past value and the smallest lag.
    """
    ends = {parameter.name: interval(parameter) for parameter in parameters}
    clock = "t" if model.form == "differential" else "k"
    unit = "s" if model.form == "differential" else "samples"
    for value in _signals(model):
        low = bounds(value.lag, ends, period)[0] if value.lag is not None else 0.0
        if low < 0:
            smallest = f"{low + value.offset:g} {unit}"
            raise InvalidSettings(
                "/parameters",
                f"inside these bounds the lag of {text(value, clock)} can be as small as "
                f"{smallest}; the model needs {value.offset} {unit} or more",
            )


def _signals(model: Model) -> list[Past]:
    trees = (*model.equations, *(output.expression for output in model.outputs))
    return [value for tree in trees for value in past_values(tree)]
