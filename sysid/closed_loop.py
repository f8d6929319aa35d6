"""Closing the loop: a model whose input is proportional control of one of its outputs.

The result is a model like any other, whose input is the reference; `sysid.simulation.simulate`
runs it. Gain, limit and transport are parameters of that model, fixed at their values: its kernel
is compiled once, whatever their numbers. The plant's input becomes

    u = ± limit at most of gain · (reference - output),

and may pass a transport element G e^(-Ls)/(Ts + 1), such as the long tube of section 5.2, before
it enters the plant (Asakura and Guo, Figure 21).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import floor, isfinite
from typing import Any

from sysid.errors import InvalidSettings, nearest
from sysid.language.intervals import bounds
from sysid.language.lags import past_values
from sysid.language.printer import text
from sysid.language.substitution import substitute
from sysid.language.tree import Binary, Call, Expression, Number, Past, Symbol, Unary
from sysid.models.model import EstimatedInitial, FixedInitial, Initial, Model
from sysid.models.sections import interval
from sysid.models.spec import parse_model
from sysid.parameters import Parameter

_PERIOD = Symbol("h", "period")
_ROUNDING = 1e-9  # of a step: a delay of so much less than a whole step is one


@dataclass(frozen=True, slots=True)
class Transport:
    """What lies between controller and plant: gain · e^(-delay s) / (time_constant s + 1).

    Attributes
    ----------
    gain : float
    time_constant, delay : float
        In s, 0 or more. Without time constant it is a pure delay.
    """

    gain: float = 1.0
    time_constant: float = 0.0
    delay: float = 0.0

    def __post_init__(self) -> None:
        for name in ("gain", "time_constant", "delay"):
            value = getattr(self, name)
            if not isfinite(value) or (name != "gain" and value < 0):
                raise InvalidSettings(f"/transport/{name}", f"{value!r} is not a number 0 or more")


@dataclass(frozen=True, slots=True)
class ProportionalControl:
    """Proportional control of one output by one input.

    Attributes
    ----------
    input, output : str
        Signals of the model.
    gain : float
        Unit of the input per unit of the output.
    limit : float or None
        Largest absolute value that the controller gives, in the unit of the input.
    transport : Transport or None
        What its signal passes before it enters the plant.
    """

    input: str
    output: str
    gain: float
    limit: float | None = None
    transport: Transport | None = None

    def __post_init__(self) -> None:
        if not isfinite(self.gain):
            raise InvalidSettings("/gain", f"{self.gain!r} is not a finite number")
        if self.limit is not None and not (isfinite(self.limit) and self.limit > 0):
            raise InvalidSettings("/limit", f"{self.limit!r} is not a number above 0")


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """A closed loop as a model.

    Attributes
    ----------
    model : Model
        Its outputs are those of the plant, then `input` and `command`.
    reference : str
        The model's input that stands for the reference, in the unit of the controlled output.
    input : str
        The output that tells what enters the plant.
    command : str
        The output that tells what the controller gives, before the transport.
    steps_late : int
        In the difference form, steps by which the controller acts late where without them its
        present value would depend on itself: as a sampled controller does. Else 0.
    renamed : mapping of str to str
        Coefficients of a polynomial, which are no names of the language, and what they are called.
    """

    model: Model
    reference: str
    input: str
    command: str
    steps_late: int
    renamed: Mapping[str, str]

    def values(self, values: Mapping[str, float]) -> dict[str, float]:
        """Values of the plant's parameters as those of the closed loop."""
        return {self.renamed.get(name, name): value for name, value in values.items()}


def close_loop(
    model: Model, control: ProportionalControl, period: float | None = None
) -> ClosedLoop:
    """The model under proportional control.

    Behind a transport with a time constant the plant's input becomes a state. It starts at 0, or
    at the value that is given for ``u(0)`` if the input is called u.

    Parameters
    ----------
    period : float or None
        Step (s) at which a model in the difference form will be simulated. If it is known, a
        transport's delay of a step or more is one: the controller need not act late. The loop
        then holds for that step only.

    Raises
    ------
    InvalidSettings
        If the model has no such input or output, or if the output contains the input itself with
        nothing between them that takes time (an algebraic loop).
    InvalidModel
        If the closed loop is too long to be a model.
    """
    renamed = _renamed(model)
    loop = _Loop(_called(model, renamed), control, period)
    document = loop.differential() if model.form == "differential" else loop.difference()
    closed = parse_model(document)
    return ClosedLoop(closed, loop.reference, control.input, loop.command, loop.steps_late, renamed)


class _Loop:
    """A model and its controller, on the way to the document of the closed loop."""

    def __init__(self, model: Model, control: ProportionalControl, period: float | None) -> None:
        self.model, self.control, self.period = model, control, period
        self.transport = control.transport or Transport()
        self.clock = "t" if model.form == "differential" else "k"
        self.output = _named(model.outputs, control.output, "output")
        self.input = _named(model.inputs, control.input, "input")
        taken = {q.name for group in (model.inputs, model.states, model.outputs) for q in group}
        taken |= {p.name for p in model.parameters}
        self.reference = _free("reference", taken)
        self.command = _free("command", taken)
        self.taken = taken
        self.own: dict[str, dict[str, Any]] = {}
        self.gain = self._fixed("gain", control.gain)
        self.limit = None if control.limit is None else self._fixed("limit", control.limit)
        self.transport_gain = (
            None
            if control.transport is None
            else self._fixed("transport_gain", self.transport.gain)
        )
        self.delay = self._delay()
        self.steps = self.steps_late = 0

    def _fixed(self, name: str, value: float, unit: str = "1") -> Symbol:
        """A number of the controller or the transport as a parameter of the closed loop."""
        name = _free(name, self.taken)
        self.taken.add(name)
        self.own[name] = {
            "lower": min(value, 0.0), "upper": max(value, 0.0) or 1.0, "unit": unit, "fixed": value,
        }  # fmt: skip
        return Symbol(name, "parameter")

    def differential(self) -> dict[str, Any]:
        """Document of a closed loop in the differential form."""
        if self.transport.time_constant > 0:
            delayed = self._given(0, self.delay)
            entered = f"{text(delayed, self.clock)} - {self.input.name}"
            return self._document(f"({entered})/{self._time_constant()}", None)
        if any(past.name == self.input.name for past in past_values(self.output.expression)):
            raise InvalidSettings(
                "/output",
                f"output {self.output.name!r} contains the input {self.input.name!r} itself, so "
                "the controller would depend on its own present value (an algebraic loop); "
                "control another output, or give a transport with a time constant",
            )
        return self._document(None, self._fed_back)

    def difference(self) -> dict[str, Any]:
        """Document of a closed loop in the difference form (a polynomial becomes one)."""
        if self.transport.time_constant > 0:
            kept = f"exp(-h/{self._time_constant()})"
            drive = text(self._given(1, self.delay))
            before = f"{self.input.name}(k-1)"
            return self._document(f"{drive} + {kept}*({before} - ({drive}))", None)
        if self._is_circular():
            self.steps, self.delay = self._whole_steps()
            self.steps_late = int(self.steps == 0)
        return self._document(None, self._fed_back)

    def _time_constant(self) -> str:
        return self._fixed("transport_time_constant", self.transport.time_constant, "s").name

    def _delay(self) -> Expression | None:
        """The transport's delay as a lag: in seconds, or in steps in the difference form."""
        if self.transport.delay == 0:
            return None
        delay = self._fixed("transport_delay", self.transport.delay, "s")
        return Binary("/", delay, _PERIOD) if self.clock == "k" else delay

    def _whole_steps(self) -> tuple[int, Expression | None]:
        """The transport's delay as a whole step and a rest in steps, if a step or more is in it.

        Such a delay cuts the circle: the plant's input is one of an earlier sample.
        """
        if self.period is None:
            return 0, self.delay
        steps = self.transport.delay / self.period
        whole = floor(steps + _ROUNDING)
        if not whole:
            return 0, self.delay
        return 1, self._fixed("transport_steps", whole - 1 + max(steps - whole, 0.0))

    def _given(self, steps: int, lag: Expression | None) -> Expression:
        """What leaves the transport but for its time constant, some steps and a lag ago."""
        command = self._command(steps, lag)
        gain = self.transport_gain
        return command if gain is None else Binary("*", gain, command)

    def _command(self, steps: int, lag: Expression | None) -> Expression:
        """Gain times (reference - output), limited, some steps and a lag ago."""
        reference = Past(self.reference, "input", steps, lag)
        output = _shifted(self.output.expression, steps, lag, self.clock == "k")
        error = Binary("-", reference, output)
        command: Expression = Binary("*", self.gain, error)
        if self.limit is not None:
            least = Call("min", (self.limit, command))
            command = Call("max", (Unary("-", self.limit), least))
        return command

    def _fed_back(self, node: Expression) -> Expression | None:
        """The controller's signal where the plant reads its input."""
        match node:
            case Past(self.input.name, "input", offset, own):
                lag = _together(self.delay, own)
                return self._given(offset + self.steps + self.steps_late, lag)
            case _:
                return None

    def _is_circular(self) -> bool:
        """Whether the controlled output at a sample depends on the plant's input at that sample."""
        spans = {p.name: interval(p) for p in self.model.parameters}
        trees = dict(zip((s.name for s in self.model.states), self.model.equations, strict=True))
        reached: set[str] = set()
        waiting = [self.output.expression]
        while waiting:
            for past in past_values(waiting.pop()):
                lag = past.lag
                is_now = past.offset == 0 and (lag is None or bounds(lag, spans)[0] < 1)
                if is_now and past.name == self.input.name:
                    return True
                if is_now and past.kind == "state" and past.name not in reached:
                    reached.add(past.name)
                    waiting.append(trees[past.name])
        return False

    def _document(
        self, equation: str | None, change: Callable[[Expression], Expression | None] | None
    ) -> dict[str, Any]:
        """The closed loop, with an equation of the plant's input or with its reads replaced."""
        model, name = self.model, self.input.name

        def written(tree: Expression) -> str:
            return text(tree if change is None else substitute(tree, change), self.clock)

        states = {state.name: state.unit for state in model.states}
        equations = {
            state.name: written(tree)
            for state, tree in zip(model.states, model.equations, strict=True)
        }
        initial = {s.name: _start(one) for s, one in zip(model.states, model.initial, strict=True)}
        if equation is not None:
            states[name], equations[name], initial[name] = self.input.unit, equation, 0.0
        inputs = {q.name: q.unit for q in model.inputs if q.name != name}
        command = text(self._command(0, None), self.clock)
        entering = name if equation is not None else written(Past(name, "input"))
        outputs = {o.name: (written(o.expression), o.unit) for o in model.outputs}
        outputs |= {name: (entering, self.input.unit), self.command: (command, self.input.unit)}
        return {
            "name": f"{model.name[:50]}-closed-loop",
            "form": "differential" if model.form == "differential" else "difference",
            "inputs": {self.reference: self.output.unit, **inputs},
            "states": states,
            "parameters": {p.name: _declared(p) for p in model.parameters} | self.own,
            "equations": equations,
            "outputs": {k: {"expression": e, "unit": unit} for k, (e, unit) in outputs.items()},
            "initial": initial,
            "solver": dict(model.document["solver"]),
        }


def _renamed(model: Model) -> dict[str, str]:
    """Names for parameters whose own are none in the language, such as ``a[y(k-1)]``."""
    taken = {q.name for group in (model.inputs, model.states, model.outputs) for q in group}
    taken |= {p.name for p in model.parameters}
    odd = [p.name for p in model.parameters if not p.name.isidentifier()]
    return {name: _free(f"a_{i}", taken) for i, name in enumerate(odd, 1)}


def _called(model: Model, renamed: Mapping[str, str]) -> Model:
    """The model with parameters of other names."""

    def other(node: Expression) -> Expression | None:
        match node:
            case Symbol(name, "parameter") if name in renamed:
                return Symbol(renamed[name], "parameter")
            case _:
                return None

    if not renamed:
        return model
    parameters = tuple(replace(p, name=renamed.get(p.name, p.name)) for p in model.parameters)
    trees = tuple(substitute(tree, other) for tree in model.equations)
    return replace(model, parameters=parameters, equations=trees)


def _together(lag: Expression | None, other: Expression | None) -> Expression | None:
    """Two lags, one after the other."""
    if lag is None or other is None:
        return other if lag is None else lag
    return Binary("+", lag, other)


def _shifted(tree: Expression, steps: int, lag: Expression | None, counts: bool) -> Expression:
    """An expression as it was some whole steps and a lag ago; `counts`: lags are in samples."""

    def earlier(node: Expression) -> Expression | None:
        match node:
            case Past(name, kind, offset, own):
                return Past(name, kind, offset + steps, _together(own, lag))
            case Symbol(_, "index"):
                return Binary("-", node, back)
            case Symbol(_, "time"):
                return Binary("-", node, Binary("*", back, _PERIOD) if counts else back)
            case _:
                return None

    back = Binary("+", Number(float(steps)), lag or Number(0.0))
    return tree if steps == 0 and lag is None else substitute(tree, earlier)


def _named(signals: Any, name: str, role: str) -> Any:
    for signal in signals:
        if signal.name == name:
            return signal
    known = [signal.name for signal in signals]
    raise InvalidSettings(f"/{role}", f"the model has no {role} {name!r}{nearest(name, known)}")


def _free(name: str, taken: set[str]) -> str:
    """The name, or with underscores behind it until nothing else has it."""
    while name in taken:
        name += "_"
    return name


def _declared(parameter: Parameter) -> dict[str, Any]:
    fields = {
        name: getattr(parameter, name)
        for name in ("lower", "upper", "unit", "scale", "fixed", "tied")
    }
    return {name: value for name, value in fields.items() if value is not None}


def _start(initial: Initial) -> Mapping[str, float] | float:
    """A start that needs no measurement: what is estimated or measured is given as a value."""
    if isinstance(initial, FixedInitial):
        return initial.value
    if isinstance(initial, EstimatedInitial):
        return {"lower": initial.lower, "upper": initial.upper}
    return {"lower": -1.0, "upper": 1.0}
