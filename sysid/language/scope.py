"""Scope: the names that an expression may use, and their meanings."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from sysid.language.functions import FUNCTIONS
from sysid.language.tree import Expression

OPERATOR_WORDS = ("and", "or", "not")

EquationForm = Literal["difference", "differential"]


def list_reserved_names(form: EquationForm) -> tuple[str, ...]:
    """List the names that a model of this form must not declare."""
    clock_names = ("k", "h") if form == "difference" else ()
    return ("t", "pi", *clock_names, *FUNCTIONS, *OPERATOR_WORDS)


@dataclass(frozen=True, slots=True)
class Scope:
    """Declared names of an expression's context.

    Attributes
    ----------
    form : {"difference", "differential"}
        Whether past values count samples or seconds.
    states, inputs : tuple of str
    parameters : mapping of str to (lower, upper)
    constants : mapping of str to float
    intermediates : mapping of str to Expression
        Trees of the intermediate names; they replace the names.
    """

    form: EquationForm
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    parameters: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    intermediates: Mapping[str, Expression] = field(default_factory=dict)

    @property
    def signals(self) -> tuple[str, ...]:
        """States and inputs."""
        return (*self.states, *self.inputs)

    @property
    def clock(self) -> str:
        """Name of the time index: ``k`` or ``t``."""
        return "k" if self.form == "difference" else "t"

    @property
    def names(self) -> tuple[str, ...]:
        """Every name that is not a function."""
        clock_names = ("k", "h") if self.form == "difference" else ()
        declared = (*self.signals, *self.parameters, *self.constants, *self.intermediates)
        return (*declared, "t", "pi", *clock_names)
