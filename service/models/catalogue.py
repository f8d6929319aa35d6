"""The built-in models, and checks of model documents: all that needs no database."""

from collections.abc import Mapping
from typing import Any

from service.core.bodies.wire import FaultOut
from service.core.errors import to_field_errors
from service.models.model_schemas import CheckOut, EquationOut, ModelOut
from sysid.core.errors import SysidError
from sysid.models.catalogue import load
from sysid.models.equation_display import format_equations
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.models.unused import find_unused_names


def list_catalogue() -> list[ModelOut]:
    """List the built-in models."""
    return [to_builtin_out(name) for name in load.catalogue()]


def check_model(document: Any) -> CheckOut:
    """Check a model document and report every fault in it."""
    if not isinstance(document, Mapping):
        message = f"found {document!r:.60}; need an object with 'equations' and other fields"
        return CheckOut(valid=False, errors=[FaultOut(pointer="", detail=message)])
    try:
        model = parse_model(document)
    except SysidError as error:
        problems = [FaultOut(**fault.to_dict()) for fault in to_field_errors(error)]
        return CheckOut(valid=False, errors=problems)
    unused = [
        FaultOut(pointer=fault.pointer, detail=fault.detail) for fault in find_unused_names(model)
    ]
    return CheckOut(
        valid=True,
        errors=[],
        warnings=unused,
        normal_form=dict(model.document),
        equations=list_equations(model),
    )


def to_builtin_out(name: str, *, with_document: bool = False) -> ModelOut:
    """Convert a built-in model to an answer."""
    return to_model_out(
        load.load_model(name),
        0,
        load.copy_catalogue_document(name) if with_document else None,
    )


def to_model_out(model: Model, version: int, document: Mapping[str, Any] | None) -> ModelOut:
    """Convert a model to an answer; built-in models have version 0."""
    fields = ("lower", "upper", "bounds", "unit", "scale", "fixed", "tied", "physical")
    return ModelOut.from_source(
        model,
        version=version,
        builtin=version == 0,
        inputs={quantity.name: quantity.unit for quantity in model.inputs},
        outputs={output.name: output.unit for output in model.outputs},
        parameters={p.name: {name: getattr(p, name) for name in fields} for p in model.parameters},
        note=None,
        tags=[],
        document=document,
        equations=[] if document is None else list_equations(model),
    )


def list_equations(model: Model) -> list[EquationOut]:
    """List the equations of a model as a page shows them."""
    return [EquationOut.from_source(equation) for equation in format_equations(model)]
