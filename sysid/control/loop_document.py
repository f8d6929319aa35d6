"""Document of a closed loop: a model with its input replaced by the controller's signal.

The plant's equations read the controller's signal, delayed by the transport, or a state that
follows it. The model's own parser reads this document again.
"""

from collections.abc import Callable, Mapping
from math import ceil, floor, inf, log2
from typing import Any

from sysid.control.control_law import build_control_law
from sysid.control.controllers import PidControl, Transport
from sysid.core.errors import InvalidSettings, suggest_name
from sysid.language.delays import collect_past_values, has_varying_delay
from sysid.language.printer import format_expression
from sysid.language.transform import add_delays, shift_expression, substitute
from sysid.language.tree import Binary, Expression, Number, PastValue, Symbol
from sysid.language.value_intervals import bound_expression
from sysid.models.model import DerivedInitial, EstimatedInitial, FixedInitial, InitialState, Model
from sysid.models.model_delays import list_past_values
from sysid.models.parameters import Parameter
from sysid.models.sections import get_interval
from sysid.models.ties import resolve_ties

_PERIOD_SYMBOL = Symbol("h", "period")
_STEP_ROUNDING = 1e-9  # of a step: a delay shorter than a whole step by this counts as one
_MIN_STEPS_PER_TIME_CONSTANT = 2.0  # steps of integration, for each one of the controller
_MAX_SUBSTEPS = 1000


class LoopDocumentBuilder:
    """Builds the document of a closed loop from a model and its controller."""

    def __init__(self, model: Model, control: PidControl, period: float | None) -> None:
        if any(map(has_varying_delay, list_past_values(model))):
            raise InvalidSettings(
                "/model", "a loop cannot be closed around a lag that changes with an input"
            )
        self.model, self.control, self.period = model, control, period
        self.transport = control.transport or Transport()
        self.clock = "t" if model.form == "differential" else "k"
        self.output = _find_signal(model.outputs, control.output, "output")
        self.input = _find_signal(model.inputs, control.input, "input")
        taken = {q.name for group in (model.inputs, model.states, model.outputs) for q in group}
        taken |= {p.name for p in model.parameters}
        self.reference = choose_free_name("reference", taken)
        self.command = choose_free_name("command", taken)
        self.taken = taken
        self.new_parameters: dict[str, dict[str, Any]] = {}
        self.law = build_control_law(
            control,
            self.reference,
            self.output.expression,
            is_sampled=self.clock == "k",
            fixed=self._add_parameter,
            state=self._reserve_state_name,
        )
        self.transport_gain = (
            None
            if control.transport is None
            else self._add_parameter("transport_gain", self.transport.gain)
        )
        self.delay = self._add_delay()
        self.steps = self.controller_delay_steps = 0

    def _add_parameter(self, name: str, value: float, unit: str = "1") -> Symbol:
        """Add a number of the controller or transport as a parameter of the closed loop."""
        name = choose_free_name(name, self.taken)
        self.taken.add(name)
        self.new_parameters[name] = {
            "lower": min(value, 0.0),
            "upper": max(value, 0.0) or 1.0,
            "unit": unit,
            "fixed": value,
        }
        return Symbol(name, "parameter")

    def _reserve_state_name(self, name: str) -> str:
        """Reserve a name for a state of the controller."""
        name = choose_free_name(name, self.taken)
        self.taken.add(name)
        return name

    def build_differential(self) -> dict[str, Any]:
        """Build the document of a closed loop in the differential form."""
        if self.transport.time_constant > 0:
            delayed = self._build_plant_input(0, self.delay)
            entered = f"{format_expression(delayed, self.clock)} - {self.input.name}"
            return self._build_document(f"({entered})/{self._add_time_constant()}", None)
        if any(
            past.name == self.input.name for past in collect_past_values(self.output.expression)
        ):
            raise InvalidSettings(
                "/output",
                f"output {self.output.name!r} contains the input {self.input.name!r} itself. "
                "The controller would depend on its own present value (an algebraic loop). "
                "Control another output, or give a transport with a time constant.",
            )
        return self._build_document(None, self._replace_plant_input)

    def build_difference(self) -> dict[str, Any]:
        """Build the document of a closed loop in the difference form, also of a polynomial."""
        if self.transport.time_constant > 0:
            decay = f"exp(-h/{self._add_time_constant()})"
            drive = format_expression(self._build_plant_input(1, self.delay))
            before = f"{self.input.name}(k-1)"
            return self._build_document(f"{drive} + {decay}*({before} - ({drive}))", None)
        if self._has_algebraic_loop():
            self.steps, self.delay = self._split_whole_steps()
            self.controller_delay_steps = int(self.steps == 0)
        return self._build_document(None, self._replace_plant_input)

    def _add_time_constant(self) -> str:
        return self._add_parameter(
            "transport_time_constant", self.transport.time_constant, "s"
        ).name

    def _add_delay(self) -> Expression | None:
        """Add the transport's delay: in seconds, or in steps in the difference form."""
        if self.transport.delay == 0:
            return None
        delay = self._add_parameter("transport_delay", self.transport.delay, "s")
        return Binary("/", delay, _PERIOD_SYMBOL) if self.clock == "k" else delay

    def _split_whole_steps(self) -> tuple[int, Expression | None]:
        """Split the transport's delay into a whole step and a rest, if it is a step or more.

        Such a delay breaks the algebraic loop: the plant's input is that of an earlier sample.
        """
        if self.period is None:
            return 0, self.delay
        steps = self.transport.delay / self.period
        whole = floor(steps + _STEP_ROUNDING)
        if not whole:
            return 0, self.delay
        return 1, self._add_parameter("transport_steps", whole - 1 + max(steps - whole, 0.0))

    def _build_plant_input(self, steps: int, delay: Expression | None) -> Expression:
        """Build the delayed signal after the transport's gain, without its time constant."""
        command = self._build_command(steps, delay)
        gain = self.transport_gain
        return command if gain is None else Binary("*", gain, command)

    def _build_command(self, steps: int, delay: Expression | None) -> Expression:
        """Build the controller's signal, delayed by some steps and a time lag."""
        return shift_expression(self.law.command, steps, delay, counts=self.clock == "k")

    def _replace_plant_input(self, node: Expression) -> Expression | None:
        """Replace a read of the plant's input by the controller's signal."""
        match node:
            case PastValue(self.input.name, "input", offset, own):
                delay = add_delays(self.delay, own)
                return self._build_plant_input(
                    offset + self.steps + self.controller_delay_steps, delay
                )
            case _:
                return None

    def _has_algebraic_loop(self) -> bool:
        """Whether the controlled output at a sample depends on the plant's input at that sample."""
        spans = {p.name: get_interval(p) for p in self.model.parameters}
        trees = dict(zip((s.name for s in self.model.states), self.model.equations, strict=True))
        reached: set[str] = set()
        waiting = [self.output.expression]
        while waiting:
            for past in collect_past_values(waiting.pop()):
                delay = past.delay
                is_now = past.offset == 0 and (
                    delay is None or bound_expression(delay, spans)[0] < 1
                )
                if is_now and past.name == self.input.name:
                    return True
                if is_now and past.kind == "state" and past.name not in reached:
                    reached.add(past.name)
                    waiting.append(trees[past.name])
        return False

    def _build_document(
        self, equation: str | None, change: Callable[[Expression], Expression | None] | None
    ) -> dict[str, Any]:
        """Build the document, with an equation of the plant's input or with its reads replaced."""
        model, name = self.model, self.input.name

        def write_tree(tree: Expression) -> str:
            return format_expression(
                tree if change is None else substitute(tree, change), self.clock
            )

        states = {state.name: state.unit for state in model.states}
        equations = {
            state.name: write_tree(tree)
            for state, tree in zip(model.states, model.equations, strict=True)
        }
        initial = {
            s.name: _to_initial_value(start, name)
            for s, start in zip(model.states, model.initial, strict=True)
        }
        if equation is not None:
            states[name], equations[name], initial[name] = self.input.unit, equation, 0.0
        for controller_state in self.law.states:
            states[controller_state.name] = (
                self.input.unit if controller_state.has_input_unit else self.output.unit
            )
            equations[controller_state.name], initial[controller_state.name] = (
                write_tree(controller_state.equation),
                0.0,
            )
        inputs = {q.name: q.unit for q in model.inputs if q.name != name}
        command = format_expression(self._build_command(0, None), self.clock)
        entering = name if equation is not None else write_tree(PastValue(name, "input"))
        outputs = {o.name: (write_tree(o.expression), o.unit) for o in model.outputs}
        outputs |= {name: (entering, self.input.unit), self.command: (command, self.input.unit)}
        return {
            "name": f"{model.name[:50]}-closed-loop",
            "form": "differential" if model.form == "differential" else "difference",
            "inputs": {self.reference: self.output.unit, **inputs},
            "states": states,
            "parameters": self._declare_parameters() | self.new_parameters,
            "equations": equations,
            "outputs": {k: {"expression": e, "unit": unit} for k, (e, unit) in outputs.items()},
            "initial": initial,
            "history": {
                one.state: format_expression(one.expression, self.clock) for one in model.histories
            },
            "solver": dict(model.document["solver"]) | self._choose_substeps(),
        }

    def _declare_parameters(self) -> dict[str, dict[str, Any]]:
        """Declare the plant's parameters; ties lose their constants and intermediate names."""
        ties = resolve_ties(self.model, self.model.parameters)
        declared = {p.name: _to_declaration(p) for p in self.model.parameters}
        for name, tree in ties.items():
            declared[name]["tied"] = format_expression(tree)
        return declared

    def _choose_substeps(self) -> dict[str, int]:
        """Choose more substeps if the controller's time constants need them.

        The model's number is multiplied by a power of two, because every number needs its kernel.
        """
        control, substeps = self.control, self.model.solver.substeps
        if self.clock == "k" or self.period is None:
            return {}
        shortest = (
            [(control.filter_time, "derivative_filter")] if control.has_derivative_action else []
        )
        if control.active_tracking_time is not None:
            shortest.append((control.active_tracking_time, "tracking_time"))
        for time, name in shortest:
            wanted = _MIN_STEPS_PER_TIME_CONSTANT * self.period / time if time > 0 else inf
            if wanted * self.model.solver.substeps > _MAX_SUBSTEPS:
                raise InvalidSettings(f"/{name}", self._describe_short_time(name, time))
            if wanted > 1:
                refined = self.model.solver.substeps * 2 ** ceil(log2(wanted))
                substeps = max(substeps, min(refined, _MAX_SUBSTEPS))
        return {"substeps": substeps} if substeps > self.model.solver.substeps else {}

    def _describe_short_time(self, name: str, time: float) -> str:
        sampling = (self.period or 0.0) * self.model.solver.substeps
        quantity = (
            "the filter's time constant T_d/N is" if name == "derivative_filter" else "T_t is"
        )
        remedy = "a smaller N" if name == "derivative_filter" else "a longer one"
        return (
            f"{quantity} {time:.4g} s, too short for steps of {sampling:.4g} s even if each is "
            f"divided into {_MAX_SUBSTEPS}. Give {remedy}, or a shorter sampling period."
        )


def _find_signal(signals: Any, name: str, role: str) -> Any:
    for signal in signals:
        if signal.name == name:
            return signal
    names = [signal.name for signal in signals]
    raise InvalidSettings(
        f"/{role}", f"the model has no {role} {name!r}{suggest_name(name, names)}"
    )


def choose_free_name(name: str, taken: set[str]) -> str:
    """Append underscores to a name until it is unused."""
    while name in taken:
        name += "_"
    return name


def _to_declaration(parameter: Parameter) -> dict[str, Any]:
    fields = {
        name: getattr(parameter, name) for name in ("lower", "upper", "unit", "scale", "fixed")
    }
    return {name: value for name, value in fields.items() if value is not None}


def _to_initial_value(initial: InitialState, plant_input: str) -> Mapping[str, float] | float | str:
    """Convert to a start without measurement; an estimated or measured one becomes a range.

    Before the loop closes the plant's input is 0.
    """

    def stop_input(node: Expression) -> Expression | None:
        is_input = isinstance(node, PastValue) and node.name == plant_input
        return Number(0.0) if is_input else None

    if isinstance(initial, FixedInitial):
        return initial.value
    if isinstance(initial, DerivedInitial):
        return format_expression(substitute(initial.expression, stop_input))
    if isinstance(initial, EstimatedInitial):
        return {"lower": initial.lower, "upper": initial.upper}
    return {"lower": -1.0, "upper": 1.0}
