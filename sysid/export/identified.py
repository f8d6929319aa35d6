"""What is exported: a model, the values found for it, and where they come from."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sysid.models.model import Model
from sysid.records import Hold
from sysid.types import FloatArray


@dataclass(frozen=True, slots=True)
class Value:
    """One parameter, or initial state of an experiment, as found; `stderr` in `unit`."""

    name: str
    value: float
    unit: str = "1"
    stderr: float | None = None
    status: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """Covariance (D, D) of the free parameters `names`, in products of their units."""

    names: tuple[str, ...]
    matrix: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """A model with values for all its parameters.

    Attributes
    ----------
    model : Model
    values : tuple of Value
        Every parameter in the model's order, then initial states named as in `Problem`.
    covariance : Covariance or None
    sample_time : float or None
        Sampling period of the data in s; None where it is not known or not regular.
    holds : mapping of str to {"zero", "first", "band-limited"}
        How the inputs were held between their samples; ``first`` where nothing is said.
    version : str
        Version of the program that writes the text.
    provenance : mapping
        Run, data sets with their hashes, dates: JSON values, told as they are.
    """

    model: Model
    values: tuple[Value, ...]
    covariance: Covariance | None = None
    sample_time: float | None = None
    holds: Mapping[str, Hold] = field(default_factory=dict)
    version: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def numbers(self) -> dict[str, float]:
        """Value of each name."""
        return {one.name: one.value for one in self.values}

    def find(self, name: str) -> Value | None:
        """The value of that name, if there is one."""
        return next((one for one in self.values if one.name == name), None)

    def hold(self, signal: str) -> Hold:
        """How an input was held between its samples."""
        return self.holds.get(signal, "first")


def variants_of(identified: Identified) -> Mapping[str, str]:
    """Which helpers of a program are written in another way, by the solver of its model."""
    solver = identified.model.solver
    found = {"past": "past cubic"} if solver.interpolation == "cubic" else {}
    if identified.model.form == "differential" and solver.step is not None:
        found["held"] = "held on grid"  # its points need not meet the jumps
    return found
