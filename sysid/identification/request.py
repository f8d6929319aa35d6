"""The arguments of `identify`: they stand here once, and are handed on whole."""

from __future__ import annotations  # the help of `identify` shows `Data`, not all that it is

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields
from functools import update_wrapper
from inspect import signature
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar, get_type_hints

from sysid.core.errors import InvalidSettings
from sysid.core.settings import (
    FitSettings,
    GeneticAlgorithm,
    InitialSetting,
    Loss,
    PredictionKind,
    Weights,
)
from sysid.data.foreign_tables import describe_value
from sysid.data.holds import HoldSetting
from sysid.data.noise import Noise
from sysid.data.records import Channel
from sysid.identification.identify_arguments import Change, Data
from sysid.identification.options import RunOptions
from sysid.islands.run_state import RunState
from sysid.models.catalogue.load import ModelSource

Arguments = ParamSpec("Arguments")
Request = TypeVar("Request")
Answer = TypeVar("Answer")

_FIT = FitSettings()


@dataclass(frozen=True, slots=True)
class IdentificationRequest(RunOptions):
    """The arguments of `identify`, which describes them."""

    model: ModelSource
    records: Data | Sequence[Data]
    settings: GeneticAlgorithm | None = None
    _: KW_ONLY
    channels: Mapping[str, str] | None = None
    hold: Mapping[str, HoldSetting] | None = None
    parameters: Mapping[str, Change] | None = None
    prediction: PredictionKind = _FIT.prediction
    loss: Loss | None = None
    weights: Weights | None = _FIT.weights
    skip: int = _FIT.skip
    initial: InitialSetting | None = _FIT.initial
    commands: Sequence[str] | None = _FIT.commands
    validation: Data | Sequence[Data] | None = None
    progress: Callable[[RunState], None] | None = None

    def __post_init__(self) -> None:
        for argument in fields(self):
            if argument.name in _KINDS:
                value = getattr(self, argument.name)
                if value is not None or argument.default is not None:
                    _check_kind(argument.name, value)
        RunOptions.__post_init__(self)


def _check_kind(name: str, value: object) -> None:
    """Check the kind of an argument that is a value of its own.

    Raises
    ------
    InvalidSettings
        If it is of another kind; the message says what it may be.
    """
    kinds, need = _KINDS[name]
    if isinstance(value, kinds) and not (isinstance(value, bool) and bool not in kinds):
        return
    found = f"found {describe_value(value)}; need {need}"
    if name == "settings" and (
        isinstance(value, Channel | list | tuple) or hasattr(value, "shape")
    ):
        found += ". To identify from two series, join them: Record(inputs, outputs)"
    raise InvalidSettings(f"/{name}", found)


_KINDS: Mapping[str, tuple[tuple[Any, ...], str]] = {
    "channels": ((Mapping,), "a mapping of signals to channels, such as {'u': 'P1'}"),
    "hold": ((Mapping,), "a mapping of inputs to holds, such as {'u': 'zero'}"),
    "parameters": ((Mapping,), "a mapping of parameters to changes, such as {'L': (0, 2)}"),
    "settings": ((GeneticAlgorithm,), "GeneticAlgorithm(…), or None for its defaults"),
    "loss": ((Loss,), "Loss(…), such as Loss('soft-l1', scale=0.5)"),
    "noise": ((Noise,), "Noise(…), such as Noise(sigma=0.1)"),
    "commands": ((list, tuple), "a list of inputs, such as ['u']"),
    "seed": ((Integral,), "a whole number"),
    "skip": ((Integral,), "a number of samples"),
    "weights": (
        (Mapping,),
        "a mapping of outputs to numbers or lists of them",
    ),
    "warm": ((Mapping,), "a mapping of parameters to values"),
    "validation_fraction": ((Real,), "a number between 0 and 1"),
    "posterior": ((bool,), "True or False"),
    "compare_orders": ((bool,), "True or False"),
    "progress": ((Callable,), "a function of the run's state"),
}


def accept_fields(
    kind: Callable[Arguments, Request],
) -> Callable[[Callable[[Request], Answer]], Callable[Arguments, Answer]]:
    """Give a function of one value the arguments that make this value.

    People, editors and type checkers see the fields of the value's class as its signature.

    Examples
    --------
    >>> accept_fields(Loss)(lambda loss: loss.kind)("soft-l1")
    'soft-l1'
    """
    shown = signature(kind)

    def accept(function: Callable[[Request], Answer]) -> Callable[Arguments, Answer]:
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Answer:
            try:
                shown.bind(*args, **kwargs)
            except TypeError as error:
                raise TypeError(f"{function.__qualname__}() {error}") from None
            return function(kind(*args, **kwargs))

        update_wrapper(call, function)
        del vars(call)["__wrapped__"]  # it has other arguments
        answer, types = signature(function).return_annotation, get_type_hints(kind)
        # For people as it is written, such as ``Data``; for programs what that stands for.
        vars(call)["__signature__"] = shown.replace(return_annotation=answer)
        call.__annotations__ = {name: types[name] for name in shown.parameters} | {"return": answer}
        return call

    return accept
