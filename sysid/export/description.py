"""Description of a model in every exported text, and export as JSON.

A description has facts, values with standard errors, and origin. The JSON document has the model's
document, its values and their provenance.
"""

import json
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sysid.control.linear_form import IdentifiedModel, IdentifiedValue
from sysid.core.text import find_shown_error
from sysid.core.value_documents import encode
from sysid.export.identifiers import to_one_line
from sysid.models.model import DerivedInitial, MeasuredInitial, name_initial_state

_NO_BREAK_SPACE = "\N{NO-BREAK SPACE}"


def wrap_source(source: str, width: int) -> list[str]:
    """Wrap source text on lines that end before an operator or behind a comma."""
    tied = re.sub(r"(?<=[-+<>=*/]) ", _NO_BREAK_SPACE, source)
    lines = textwrap.wrap(tied, width, break_long_words=False, break_on_hyphens=False)
    return [line.replace(_NO_BREAK_SPACE, " ") for line in lines]


def describe_unit(unit: str) -> str:
    """Describe a unit in a sentence."""
    return "without unit" if unit == "1" else unit


def describe_model(identified: IdentifiedModel) -> list[str]:
    """Describe title, source, sampling, hold and provenance, one line each."""
    model = identified.model
    lines = [model.title or model.name, f"Model {model.name!r}, {model.form} form."]
    about = {key: model.document.get(key) for key in ("source", "description")}
    lines += [f"{key.capitalize()}: {text}" for key, text in about.items() if text]
    if identified.sample_time is not None:
        lines.append(f"The data had a sampling period of {identified.sample_time:.10g} s.")
    if model.form == "polynomial":
        lines.append("The coefficients hold for that sampling period only.")
    lines += [_describe_hold(identified, signal.name) for signal in model.inputs]
    if identified.version:
        lines.append(f"Identified by lagid {identified.version}.")
    for key, value in identified.provenance.items():
        lines.append(f"{key}: {_describe_origin(value)}")
    return [part for line in lines for part in textwrap.wrap(to_one_line(line), 94) or [""]]


def _describe_origin(value: Any) -> str:
    """Describe a JSON value of the provenance in words: ``name tube.csv, sha256 …``."""
    if isinstance(value, Mapping):
        pairs = ((key, entry) for key, entry in value.items() if entry is not None)
        return ", ".join(f"{key} {_describe_origin(entry)}" for key, entry in pairs)
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "; ".join(map(_describe_origin, value))
    return "none" if value is None else str(value)


def _describe_hold(identified: IdentifiedModel, name: str) -> str:
    hold = identified.get_hold(name)
    if hold == "zero":
        return f"Input {name} is held from each sample to the next."
    if hold == "mean-after":
        return f"Input {name} is a mean from each sample to the next, and held there."
    if hold == "mean":
        return (
            f"Input {name} was a mean from each sample to the next one, where it was stamped. Here "
            "it is held from each sample to the next: give each mean one sample earlier."
        )
    if hold == "first":
        return f"Input {name} is interpolated linearly between its samples."
    return (
        f"Input {name} was band-limited between its samples; here it is interpolated linearly. "
        "Give it resampled to a period short enough for that."
    )


def describe_values(
    identified: IdentifiedModel, parameters: Mapping[str, str], starts: Mapping[str, str]
) -> Iterator[tuple[str, str]]:
    """Yield identifier and description of every parameter and initial state."""
    model = identified.model
    texts = model.document.get("parameters") or {}
    for parameter in model.parameters:
        value = identified.find_value(parameter.name)
        about = (texts.get(parameter.name) or {}).get("description", "")
        name = f"{parameter.name}: " if parameters[parameter.name] != parameter.name else ""
        head = name + (f"{about}, " if about else "")
        yield (
            parameters[parameter.name],
            head + _describe_value(value or IdentifiedValue(parameter.name, 0.0, parameter.unit)),
        )
    for state, initial in zip(model.states, model.initial, strict=True):
        if isinstance(initial, DerivedInitial):
            continue  # the program computes it
        name = name_initial_state(state.name, 0)
        value = identified.find_value(name)
        head = f"{name}: start of {state.name}, "
        if value is not None:
            yield starts[state.name], head + _describe_value(value)
        elif isinstance(initial, MeasuredInitial):
            about = f"{head}{describe_unit(state.unit)}; measured: give its first value."
            yield starts[state.name], about
        else:
            yield starts[state.name], f"{head}{describe_unit(state.unit)}."


def _describe_value(value: IdentifiedValue) -> str:
    stderr = find_shown_error(value.stderr, value.status)
    error = "" if stderr is None else f"; standard error {stderr:.3g}"
    status = f"; {value.status}" if value.status and value.status != "identified" else ""
    return f"{describe_unit(value.unit)}{error}{status}."


JSON_FORMAT = "lagid-model/1"


def write_json_source(identified: IdentifiedModel) -> str:
    """Write a JSON document from which the model can be built and simulated again.

    ``model`` is the document that `sysid.load_model` and the service read. Each entry of
    ``values`` has the unit of value and standard error.
    """
    return (
        json.dumps(_to_document(identified), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    )


def _to_document(identified: IdentifiedModel) -> dict[str, Any]:
    return {
        "format": JSON_FORMAT,
        "lagid": identified.version or None,
        "model": dict(identified.model.document),
        "values": [encode(item) for item in identified.values],
        "covariance": None if identified.covariance is None else encode(identified.covariance),
        "data": {
            "sample_time": identified.sample_time,
            "hold": {item.name: identified.get_hold(item.name) for item in identified.model.inputs},
            "units": {
                **{item.name: identified.get_unit(item) for item in identified.model.inputs},
                **{item.name: identified.get_unit(item) for item in identified.model.outputs},
            },
        },
        "provenance": dict(identified.provenance),
    }
