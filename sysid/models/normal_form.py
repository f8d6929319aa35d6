"""Normal form of a document: every default filled in, so that equal models are equal texts."""

from collections.abc import Mapping
from typing import Any

from sysid.models.model import (
    DerivedInitial,
    EstimatedInitial,
    FixedInitial,
    InitialState,
    Model,
    Output,
)
from sysid.models.noise_places import write_noise
from sysid.models.parameters import Parameter
from sysid.models.sections import AUTO

_TEXT_FIELDS = ("description", "source")


def to_normal_form(fields: Mapping[str, Any], model: Model) -> dict[str, Any]:
    """Build the normal form of a model's document; it is its own normal form.

    Parameters
    ----------
    fields : mapping
        The checked document as written.
    model : Model
        The model that it describes.
    """
    head: dict[str, Any] = {"name": model.name, "title": model.title}
    for key in _TEXT_FIELDS:
        if fields.get(key):
            head[key] = " ".join(fields[key].split())
    head["form"] = model.form
    head["inputs"] = {signal.name: signal.unit for signal in model.inputs}
    body = (
        _write_polynomial(fields, model)
        if model.form == "polynomial"
        else _write_equations(fields, model)
    )
    declared = fields.get("parameters") or {}
    return {
        **head,
        **_write_intermediates(fields.get("let")),
        **body,
        "parameters": {
            p.name: _write_parameter(p, declared) for p in model.parameters if p.name in declared
        },
        "constants": {k: float(v) for k, v in (fields.get("constants") or {}).items()},
        **_write_histories(fields.get("history"), model),
        "initial": AUTO if fields.get("initial") == AUTO else write_starts(model),
        "solver": _write_solver(model),
        **write_noise(model.noise),
    }


def _write_intermediates(declared: Mapping[str, Any] | None) -> dict[str, Any]:
    if not declared:
        return {}  # so that the normal form of other models has no such field
    return {"let": {name: _write_text(text) for name, text in declared.items()}}


def _write_histories(declared: Mapping[str, Any] | None, model: Model) -> dict[str, Any]:
    if not model.histories or declared is None:
        return {}
    return {"history": {one.state: _write_text(declared[one.state]) for one in model.histories}}


def _write_equations(fields: Mapping[str, Any], model: Model) -> dict[str, Any]:
    return {
        "states": {state.name: state.unit for state in model.states},
        "equations": {s.name: _write_text(fields["equations"][s.name]) for s in model.states},
        "outputs": {o.name: _write_output(o, fields["outputs"][o.name]) for o in model.outputs},
    }


def _write_polynomial(fields: Mapping[str, Any], model: Model) -> dict[str, Any]:
    [state] = model.states
    body: dict[str, Any] = {"output": {state.name: state.unit}}
    if fields.get("degree") is not None:
        body["degree"] = int(fields["degree"])
    if fields.get("lags") is not None:
        body["lags"] = {k: [_write_text(entry) for entry in v] for k, v in fields["lags"].items()}
    body["coefficients"] = {k: _write_value(v) for k, v in fields["coefficients"].items()}
    body["constant"] = bool(fields.get("constant", False))
    body["terms"] = _write_terms(fields.get("terms", "all"), model)
    return body


def _write_terms(written: Any, model: Model) -> object:
    if model.rule is None:
        return written if isinstance(written, str) else [_write_text(term) for term in written]
    rule: dict[str, Any] = {"select": written["select"], "keep": model.rule.keep}
    if model.rule.err is not None:
        rule["err"] = model.rule.err
    candidates = written.get("candidates", "all")
    listed = (
        candidates if isinstance(candidates, str) else [_write_text(term) for term in candidates]
    )
    rule |= {"criterion": model.rule.criterion, "exchange": model.rule.exchange}
    rule["error"] = model.rule.error
    return {**rule, "candidates": listed}


def _write_text(written: object) -> str:
    return " ".join(written.split()) if isinstance(written, str) else repr(written)


def _write_value(written: object) -> object:
    is_number = isinstance(written, int | float) and not isinstance(written, bool)
    return float(written) if is_number else written  # type: ignore[arg-type]


def _write_output(output: Output, written: Any) -> dict[str, str]:
    text = written["expression"] if isinstance(written, Mapping) else written
    return {"expression": _write_text(text), "unit": output.unit}


def _write_parameter(parameter: Parameter, declared: Mapping[str, Any]) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "lower": parameter.lower,
        "upper": parameter.upper,
        "unit": parameter.unit,
        "scale": parameter.scale,
    }
    if parameter.fixed is not None:
        entry["fixed"] = parameter.fixed
    if parameter.bounds is not None:
        entry["bounds"] = parameter.bounds
    if parameter.tied is not None:
        entry["tied"] = _write_text(parameter.tied)
    if parameter.physical is not None:
        entry["physical"] = parameter.physical
    if description := declared[parameter.name].get("description"):
        entry["description"] = " ".join(description.split())
    return entry


def write_starts(model: Model) -> dict[str, object]:
    """Write the starts of a model's states as its document has them."""
    pairs = zip(model.states, model.initial, strict=True)
    return {state.name: _write_initial_state(start) for state, start in pairs}


def _write_initial_state(start: InitialState) -> object:
    if isinstance(start, FixedInitial):
        return start.value
    if isinstance(start, EstimatedInitial):
        entry: dict[str, Any] = {"lower": start.lower, "upper": start.upper}
        return entry if start.bounds is None else {**entry, "bounds": start.bounds}
    return start.text if isinstance(start, DerivedInitial) else "measured"


def _write_solver(model: Model) -> dict[str, Any]:
    solver = model.solver
    past = {"history": solver.history, "interpolation": solver.interpolation}
    if model.form == "polynomial":
        return past
    if model.form == "difference":
        return {"substeps": solver.substeps, **past}
    step = "sample" if solver.step is None else solver.step
    return {"method": solver.method, "step": step, "substeps": solver.substeps, **past}
