"""Parse the form of a simulation: its query becomes a body of the REST interface."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from math import isfinite
from typing import Any, Literal, get_args

from service.core.errors import FieldError, InvalidRequest
from service.datasets.dataset_schemas import MAX_SERIES_SAMPLES
from service.jobs.record_checks import list_signals
from sysid.control.controllers import AntiWindup, DerivativeOn
from sysid.control.tuning import CONTROLLERS, RULES
from sysid.core.errors import suggest_name
from sysid.models.model import Model

SimulationKind = Literal["loop", "recording", "signal"]
SIMULATION_KINDS: Mapping[SimulationKind, str] = {
    "loop": "Closed loop: a step of the reference",
    "recording": "Free run over a recording",
    "signal": "Free run on a signal",
}
FIELD_LABELS = {
    "kind": "kind",
    "input": "controlled input",
    "output": "controlled output",
    "gain": "gain",
    "integral_time": "integral time",
    "derivative_time": "derivative time",
    "derivative_filter": "derivative filter N",
    "derivative_on": "derivative on",
    "setpoint_weight": "setpoint weight",
    "tuning": "tuning",
    "closed_loop_time_constant": "closed-loop time constant",
    "lower": "lower limit",
    "upper": "upper limit",
    "anti_windup": "anti-windup",
    "tracking_time": "tracking time",
    "limit": "limit of the command",
    "amplitude": "height of the step",
    "time": "time of the step",
    "offset": "reference before the step",
    "transport_gain": "transport gain",
    "time_constant": "transport time constant",
    "transport_delay": "transport time lag",
    "duration": "duration",
    "sample_time": "sampling period",
    "dataset": "recording",
    "skip": "skipped samples",
}
MANUAL_TUNING = "by hand"
TUNINGS = {
    MANUAL_TUNING: "by hand",
    **{f"{rule} {kind}": f"{rule.upper()}, {kind}" for rule in RULES for kind in CONTROLLERS},
}
"""Choices of rule and controller; a rule chooses gain and times itself."""
CHOICES = {
    "derivative_on": [(name, name) for name in get_args(DerivativeOn)],
    "anti_windup": [(name, name) for name in get_args(AntiWindup)],
}
"""Values and texts of the controller's fields with fixed choices."""
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(e[-+]?\d+)?", re.IGNORECASE | re.ASCII)
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}", re.ASCII)
_NUMBER_FIELDS = (
    "derivative_filter",
    "setpoint_weight",
    "limit",
    "lower",
    "upper",
    "tracking_time",
)
_TUNED_FIELDS = ("gain", "integral_time", "derivative_time")
_CHOICE_FIELDS = tuple(CHOICES)
_POINTER_FIELDS = {
    "/control/tuning/closed_loop_time_constant": "closed_loop_time_constant",
    **{
        f"/control/{name}": name
        for name in ("tuning", *_TUNED_FIELDS, *_NUMBER_FIELDS, *_CHOICE_FIELDS)
    },
    "/control/input": "input",
    "/control/output": "output",
    "/control/transport/gain": "transport_gain",
    "/control/transport/time_constant": "time_constant",
    "/control/transport/delay": "transport_delay",
    "/control/reference/amplitude": "amplitude",
    "/control/reference/time": "time",
    "/control/reference/offset": "offset",
    "/sample_time": "sample_time",
    "/samples": "duration",
    "/dataset": "dataset",
    "/skip": "skip",
}


@dataclass(frozen=True, slots=True)
class SimulationQuery:
    """A valid query: its kind, and the body for it."""

    kind: SimulationKind
    body: Mapping[str, Any]


def read_kind(query: Mapping[str, str]) -> SimulationKind:
    """Read the kind of simulation; the default is a closed loop.

    Raises
    ------
    InvalidRequest
        If the kind is unknown.
    """
    wanted = query.get("kind", "loop")
    for kind in SIMULATION_KINDS:
        if kind == wanted:
            return kind
    raise InvalidRequest.from_fault(
        "?kind", f"found {wanted!r}; need one of {', '.join(SIMULATION_KINDS)}"
    )


def has_request(query: Mapping[str, str]) -> bool:
    """Whether the query requests a simulation, not only the form."""
    return any(name not in ("kind", "format") for name in query)


def list_form_fields(model: Model, kind: SimulationKind) -> list[str]:
    """List the names of the fields of a form."""
    inputs = [f"input.{signal.name}" for signal in model.inputs]
    if kind == "recording":
        signals = list(chain(*list_signals(model)))
        return ["dataset", "skip", *(f"channel.{name}" for name in signals)]
    if kind == "signal":
        return [*inputs, "duration", "sample_time"]
    return [
        "input",
        "output",
        "tuning",
        "closed_loop_time_constant",
        *_TUNED_FIELDS,
        *_NUMBER_FIELDS,
        *_CHOICE_FIELDS,
        "amplitude",
        "time",
        "offset",
        "transport_gain",
        "time_constant",
        "transport_delay",
        *inputs,
        "duration",
        "sample_time",
    ]


def parse_query(model: Model, query: Mapping[str, str]) -> SimulationQuery:
    """Parse a query.

    Raises
    ------
    InvalidRequest
        With a fault for every unknown field and every invalid number; its pointer is ``?name``.
    """
    kind = read_kind(query)
    fields = list_form_fields(model, kind)
    faults = [
        FieldError(f"?{name}", f"there is no such field{suggest_name(name, fields)}")
        for name in query
        if name not in (*fields, "kind", "format")
    ]
    reader = _QueryReader(query)
    make = {"loop": _loop_body, "recording": _recording_body, "signal": _signal_body}[kind]
    body = make(reader, model)
    faults += reader.faults
    if faults:
        raise InvalidRequest(faults)
    return SimulationQuery(kind, body)


def to_form_fault(fault: FieldError) -> FieldError:
    """Move a fault of the body to the field of the form that it comes from."""
    if fault.pointer.startswith("?"):
        return fault
    for theirs, field in _POINTER_FIELDS.items():
        if fault.pointer == theirs or fault.pointer.startswith(f"{theirs}/"):
            return FieldError(f"?{field}", fault.detail, fault.column)
    for theirs, prefix in (("/inputs/", "input."), ("/channels/", "channel.")):
        if fault.pointer.startswith(theirs):
            name = fault.pointer.removeprefix(theirs).partition("/")[0]
            return FieldError(f"?{prefix}{name}", fault.detail, fault.column)
    return fault


def field_label(field: str) -> str:
    """Label of a field in the form."""
    head, _, name = field.partition(".")
    return f"{head} {name}" if name else FIELD_LABELS.get(field, field)


class _QueryReader:
    """Reader of a query's numbers and texts; it collects faults."""

    def __init__(self, query: Mapping[str, str]) -> None:
        self._query = query
        self.faults: list[FieldError] = []

    def read_text(self, name: str, default: str = "") -> str:
        return self._query.get(name, "").strip() or default

    def read_number(self, name: str, default: float | None = None) -> float | None:
        """Read a number; the default if the field is empty or invalid.

        A decimal comma is read. ``1,000`` is refused, since it may be 1 or 1000.
        """
        text = self.read_text(name)
        if not text:
            return default
        is_clear = _DECIMAL_COMMA.fullmatch(text) and not _THOUSANDS.fullmatch(text)
        try:
            value = float(text.replace(",", ".") if is_clear else text)
        except ValueError:
            value = float("nan")
        if isfinite(value):
            return value
        wanted = "a number with a decimal point" if "," in text else "a number"
        self.faults.append(FieldError(f"?{name}", f"found {text!r}; need {wanted}"))
        return default

    def read_samples(self) -> tuple[int, float]:
        """Read number of samples and sampling period (s) from the fields; both are required."""
        duration, period = self.read_number("duration"), self.read_number("sample_time")
        for name, value in (("duration", duration), ("sample_time", period)):
            if any(fault.pointer == f"?{name}" for fault in self.faults):
                continue
            if value is None or value <= 0:
                problem = "it is missing" if value is None else f"found {value:g}"
                self.faults.append(FieldError(f"?{name}", f"{problem}; need a time above 0 s"))
        if not duration or not period or self.faults:
            return 2, 1.0
        count = duration / period
        if not 1 <= count < MAX_SERIES_SAMPLES:
            self.faults.append(
                FieldError(
                    "?duration",
                    f"{duration:g} s with a period of {period:g} s are {count:.3g} samples; "
                    f"need 2 to {MAX_SERIES_SAMPLES}",
                )
            )
            return 2, 1.0
        return round(count) + 1, period


def _loop_body(reader: _QueryReader, model: Model) -> dict[str, Any]:
    control: dict[str, Any] = {
        "input": reader.read_text("input", model.inputs[0].name if model.inputs else ""),
        "output": reader.read_text("output", model.outputs[0].name),
        **_controller_body(reader),
        "reference": {
            "kind": "step",
            "amplitude": reader.read_number("amplitude", 1.0),
            "time": reader.read_number("time", 0.0),
            "offset": reader.read_number("offset", 0.0),
        },
    }
    transport = {
        "gain": reader.read_number("transport_gain"),
        "time_constant": reader.read_number("time_constant"),
        "delay": reader.read_number("transport_delay"),
    }
    present = {name: value for name, value in transport.items() if value is not None}
    if present:
        control["transport"] = present
    samples, period = reader.read_samples()
    others = [signal.name for signal in model.inputs if signal.name != control["input"]]
    return {
        "control": control,
        "inputs": dict(_input_expressions(reader, others, "0")),
        "samples": samples,
        "sample_time": period,
    }


def _controller_body(reader: _QueryReader) -> dict[str, Any]:
    """Read the controller's settings; with a tuning rule only those that the rule does not set."""
    tuning = reader.read_text("tuning", MANUAL_TUNING)
    body: dict[str, Any] = {}
    if tuning == MANUAL_TUNING:
        body["gain"] = reader.read_number("gain", 1.0)
        names: tuple[str, ...] = (*_TUNED_FIELDS[1:], *_NUMBER_FIELDS)
    else:
        rule, _, controller = tuning.partition(" ")
        body["tuning"] = {"rule": rule, "controller": controller}
        wanted = reader.read_number("closed_loop_time_constant")
        if wanted is not None:
            body["tuning"]["closed_loop_time_constant"] = wanted
        names = _NUMBER_FIELDS
        if tuning not in TUNINGS:
            choices = ", ".join(TUNINGS)
            reader.faults.append(FieldError("?tuning", f"found {tuning!r}; need one of {choices}"))
    numbers = {name: reader.read_number(name) for name in names}
    body |= {name: value for name, value in numbers.items() if value is not None}
    return body | {name: text for name in _CHOICE_FIELDS if (text := reader.read_text(name))}


def _signal_body(reader: _QueryReader, model: Model) -> dict[str, Any]:
    names = [signal.name for signal in model.inputs]
    samples, period = reader.read_samples()
    return {
        "inputs": dict(_input_expressions(reader, names, "")),
        "samples": samples,
        "sample_time": period,
    }


def _input_expressions(
    reader: _QueryReader, names: list[str], default: str
) -> Iterator[tuple[str, dict[str, str]]]:
    for name in names:
        text = reader.read_text(f"input.{name}", default)
        if text:
            yield name, {"kind": "expression", "expression": text}
        else:
            fault = "it is missing; give an expression of t in s, such as 10*cos(5*t)"
            reader.faults.append(FieldError(f"?input.{name}", fault))


def _recording_body(reader: _QueryReader, model: Model) -> dict[str, Any]:
    dataset = reader.read_text("dataset")
    if not dataset:
        reader.faults.append(FieldError("?dataset", "it is missing; choose a stored recording"))
    chosen = {name: reader.read_text(f"channel.{name}") for name in chain(*list_signals(model))}
    skip = reader.read_number("skip", 0.0) or 0.0
    if skip != int(skip):
        reader.faults.append(FieldError("?skip", f"found {skip:g}; need a whole number"))
    return {
        "dataset": dataset,
        "channels": {k: v for k, v in chosen.items() if v},
        "skip": int(skip),
    }
