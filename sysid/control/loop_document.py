"""The document of a closed loop: a model with its input replaced by what a controller makes.

The plant's equations read the controller's signal, some time ago where a transport lies between,
or a state that follows it. What is written here is read by the model's own parser again.
"""

from collections.abc import Callable, Mapping
from math import ceil, floor, inf, log2
from typing import Any

from sysid.control.control_law import law_of
from sysid.control.controllers import PidControl, Transport
from sysid.core.errors import InvalidSettings, nearest
from sysid.language.delays import past_values
from sysid.language.intervals import bounds
from sysid.language.printer import text
from sysid.language.transform import in_series, shifted, substitute
from sysid.language.tree import Binary, Expression, Past, Symbol
from sysid.models.model import EstimatedInitial, FixedInitial, Initial, Model
from sysid.models.parameters import Parameter
from sysid.models.sections import interval

_PERIOD = Symbol("h", "period")
_ROUNDING = 1e-9  # of a step: a delay of so much less than a whole step is one
_STEPS = 2.0  # integration steps, at least, in each time constant of the controller
_MOST_SUBSTEPS = 1000


class LoopDocument:
    """A model and its controller, on the way to the document of the closed loop."""

    def __init__(self, model: Model, control: PidControl, period: float | None) -> None:
        self.model, self.control, self.period = model, control, period
        self.transport = control.transport or Transport()
        self.clock = "t" if model.form == "differential" else "k"
        self.output = _named(model.outputs, control.output, "output")
        self.input = _named(model.inputs, control.input, "input")
        taken = {q.name for group in (model.inputs, model.states, model.outputs) for q in group}
        taken |= {p.name for p in model.parameters}
        self.reference = free_name("reference", taken)
        self.command = free_name("command", taken)
        self.taken = taken
        self.own: dict[str, dict[str, Any]] = {}
        self.law = law_of(
            control, self.reference, self.output.expression,
            is_sampled=self.clock == "k", fixed=self._fixed, state=self._state,
        )  # fmt: skip
        self.transport_gain = (
            None
            if control.transport is None
            else self._fixed("transport_gain", self.transport.gain)
        )
        self.delay = self._delay()
        self.steps = self.steps_late = 0

    def _fixed(self, name: str, value: float, unit: str = "1") -> Symbol:
        """A number of the controller or the transport as a parameter of the closed loop."""
        name = free_name(name, self.taken)
        self.taken.add(name)
        self.own[name] = {
            "lower": min(value, 0.0), "upper": max(value, 0.0) or 1.0, "unit": unit, "fixed": value,
        }  # fmt: skip
        return Symbol(name, "parameter")

    def _state(self, name: str) -> str:
        """A name for a state of the controller."""
        name = free_name(name, self.taken)
        self.taken.add(name)
        return name

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
        """What the controller gives, some steps and a lag ago."""
        return shifted(self.law.command, steps, lag, counts=self.clock == "k")

    def _fed_back(self, node: Expression) -> Expression | None:
        """The controller's signal where the plant reads its input."""
        match node:
            case Past(self.input.name, "input", offset, own):
                lag = in_series(self.delay, own)
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
        for own in self.law.states:
            states[own.name] = self.input.unit if own.is_of_input else self.output.unit
            equations[own.name], initial[own.name] = written(own.equation), 0.0
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
            "solver": dict(model.document["solver"]) | self._substeps(),
        }

    def _substeps(self) -> dict[str, int]:
        """Substeps by which the controller's own time constants are resolved, if that takes more.

        By a power of two more than the model's: every number of them has a kernel of its own.
        """
        control, substeps = self.control, self.model.solver.substeps
        if self.clock == "k" or self.period is None:
            return {}
        shortest = [(control.filter_time, "derivative_filter")] if control.differentiates else []
        if control.tracking is not None:
            shortest.append((control.tracking, "tracking_time"))
        for time, name in shortest:
            wanted = _STEPS * self.period / time if time > 0 else inf
            if wanted * self.model.solver.substeps > _MOST_SUBSTEPS:
                raise InvalidSettings(f"/{name}", self._too_short(name, time))
            if wanted > 1:
                more = self.model.solver.substeps * 2 ** ceil(log2(wanted))
                substeps = max(substeps, min(more, _MOST_SUBSTEPS))
        return {"substeps": substeps} if substeps > self.model.solver.substeps else {}

    def _too_short(self, name: str, time: float) -> str:
        sampling = (self.period or 0.0) * self.model.solver.substeps
        told = "the filter's time constant T_d/N is" if name == "derivative_filter" else "T_t is"
        right = "a smaller N" if name == "derivative_filter" else "a longer one"
        return (
            f"{told} {time:.4g} s, too short for steps of {sampling:.4g} s even if each is "
            f"divided into {_MOST_SUBSTEPS}; give {right}, or a shorter sampling period"
        )


def _named(signals: Any, name: str, role: str) -> Any:
    for signal in signals:
        if signal.name == name:
            return signal
    known = [signal.name for signal in signals]
    raise InvalidSettings(f"/{role}", f"the model has no {role} {name!r}{nearest(name, known)}")


def free_name(name: str, taken: set[str]) -> str:
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
