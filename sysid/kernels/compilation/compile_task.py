"""What a compiling child is given, as JSON: model, variant of its kernel, and limits.

The trees are sent, not the document: ties, controllers and starts may have changed them.
"""

import json
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

from sysid.kernels.layout import KernelVariant
from sysid.language.tree import Binary, FunctionCall, Number, PastValue, Symbol, Unary
from sysid.models.model import (
    Correction,
    DerivedInitial,
    EstimatedInitial,
    FixedInitial,
    HistoryFunction,
    MeasuredInitial,
    Model,
    ModelSignal,
    NoisePlaces,
    Output,
    Solver,
)
from sysid.models.parameters import Parameter


@dataclass(frozen=True, slots=True)
class CompileTask:
    """A kernel to compile within `seconds` of processor time and `memory_bytes`."""

    model: Model
    variant: KernelVariant
    seconds: float
    memory_bytes: int


_TYPES = {
    kind.__name__: kind
    for kind in (
        CompileTask,
        Model,
        ModelSignal,
        Output,
        Parameter,
        Solver,
        FixedInitial,
        EstimatedInitial,
        MeasuredInitial,
        DerivedInitial,
        HistoryFunction,
        NoisePlaces,
        Correction,
        Number,
        Symbol,
        PastValue,
        Unary,
        Binary,
        FunctionCall,
        KernelVariant,
    )
}
_TYPE = "type"


def encode_task(task: CompileTask) -> bytes:
    """Encode a task, without those parts of the model that no kernel depends on."""
    return json.dumps(_to_json(replace(task, model=_strip_model(task.model)))).encode()


def decode_task(text: bytes) -> CompileTask:
    """Decode what `encode_task` has encoded."""
    task: CompileTask = _from_json(json.loads(text))
    return task


def encode_model(model: Model) -> Any:
    """Encode a model as JSON values, without those parts that no simulation depends on."""
    return _to_json(_strip_model(model))


def decode_model(value: Any) -> Model:
    """Decode what `encode_model` has encoded."""
    model: Model = _from_json(value)
    return model


def _strip_model(model: Model) -> Model:
    return replace(model, title="", document={}, terms=(), rule=None, selection=None)


def _to_json(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_to_json(item) for item in value]
    if not is_dataclass(value):
        return value
    entries = {field.name: _to_json(getattr(value, field.name)) for field in fields(value)}
    return {_TYPE: type(value).__name__, **entries}


def _from_json(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_from_json(item) for item in value)
    if not isinstance(value, dict) or _TYPE not in value:
        return value
    entries = {name: _from_json(item) for name, item in value.items() if name != _TYPE}
    return _TYPES[value[_TYPE]](**entries)
