"""Initial states that are to be estimated, as parameters: once for each experiment."""

from sysid.models.model import EstimatedInitial, Model
from sysid.parameters import Parameter


def initial_name(state: str, experiment: int) -> str:
    """Name of an estimated initial state: ``x(0)``, in the second experiment ``x(0)[2]``."""
    return f"{state}(0)" if experiment == 0 else f"{state}(0)[{experiment + 1}]"


def initial_parameters(model: Model, experiments: int) -> tuple[Parameter, ...]:
    """The initial states to be estimated, for each experiment on its own."""
    return tuple(
        Parameter(initial_name(state.name, e), start.lower, start.upper, state.unit)
        for e in range(experiments)
        for state, start in zip(model.states, model.initial, strict=True)
        if isinstance(start, EstimatedInitial)
    )
