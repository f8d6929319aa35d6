"""Closed loop: a model whose input is computed by a controller from one of its outputs.

The result is a model like any other, with the reference as input; `ClosedLoop.simulate` runs it.
Gain, times, limits and transport are parameters of that model, fixed at their values. So its kernel
is compiled once for all values. `sysid.control.controllers` defines the plant's input. The simplest
controller is proportional,

    u = gain · (reference - output), limited to ± limit.

Before it enters the plant, the signal may pass a transport element G e^(-Ls)/(Ts + 1). An example
is the long tube of section 5.2 (Asakura and Guo, Figure 21).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np

from sysid.control.control_law import DerivativeFilter
from sysid.control.controllers import PidControl
from sysid.control.loop_document import LoopDocumentBuilder, choose_free_name
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording
from sysid.language.evaluation import evaluate_expression
from sysid.language.transform import substitute
from sysid.language.tree import Expression, Number, PastValue, Symbol
from sysid.models.model import DerivedInitial, FixedInitial, Model, name_initial_state
from sysid.models.parse import parse_model
from sysid.simulation.simulate import simulate


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """A closed loop as a model.

    Attributes
    ----------
    model : Model
        Its outputs are those of the plant, then `input` and `command`.
    reference : str
        The model's input for the reference, in the unit of the controlled output.
    input : str
        The output for the signal that enters the plant.
    command : str
        The output for the controller's signal, before the transport.
    controller_delay_steps : int
        In the difference form, steps by which the controller is late, as a sampled controller is.
        Without them its present value would depend on itself. Otherwise 0.
    new_names : mapping of str to str
        New names of polynomial coefficients, whose names are not valid in the language.
    derivative_filter : DerivativeFilter or None
    """

    model: Model
    reference: str
    input: str
    command: str
    controller_delay_steps: int
    new_names: Mapping[str, str]
    derivative_filter: DerivativeFilter | None = None

    def rename_values(self, values: Mapping[str, float]) -> dict[str, float]:
        """Rename values of the plant's parameters to those of the closed loop."""
        return {self.new_names.get(name, name): value for name, value in values.items()}

    def simulate(
        self, inputs: Sequence[Channel], values: Mapping[str, float], *, times: FloatArray
    ) -> Recording:
        """Simulate the outputs of the loop, by `sysid.simulation.simulate.simulate`.

        The integral starts at 0, the derivative's filter at rest.

        Parameters
        ----------
        inputs : sequence of Channel
            The reference, named `reference`, and the plant's other inputs.
        values : mapping of str to float
            The plant's parameters and initial values, by the plant's names.
        times : FloatArray, shape (N,)
            Times of the outputs in s.
        """
        values = self.complete_values(inputs, values, times)
        return simulate(self.model, inputs, values, times=times)

    def complete_values(
        self, inputs: Sequence[Channel], values: Mapping[str, float], times: FloatArray
    ) -> dict[str, float]:
        """Complete the plant's values to those of `model`, for the arguments of `simulate`."""
        loop_values = self.rename_values(values)
        return self._compute_filter_start(inputs, loop_values, times) | loop_values

    def _compute_filter_start(
        self, inputs: Sequence[Channel], values: Mapping[str, float], times: FloatArray
    ) -> dict[str, float]:
        """Compute the rest position of the derivative's filter, before the first step."""
        if self.derivative_filter is None:
            return {}
        name, followed, time_constant = self.derivative_filter
        is_sampled = self.model.form != "differential"
        begins = [times[0]] if is_sampled else [times[0], *(channel.times[0] for channel in inputs)]
        start = float(min(begins))
        before = self._evaluate_start(followed, inputs, values, start, "left")
        if is_sampled:  # its first value is that after the first step
            period = float(times[1] - times[0]) / self.model.solver.substeps
            now = self._evaluate_start(followed, inputs, values, start, "right")
            before += period / (time_constant + period) * (now - before)
        return {name_initial_state(name, 0): before if isfinite(before) else 0.0}

    def _evaluate_start(
        self,
        tree: Expression,
        inputs: Sequence[Channel],
        values: Mapping[str, float],
        time: float,
        side: str,
    ) -> float:
        """Evaluate an expression just before or just after the start of the loop."""
        input_values = {
            channel.name: _interpolate_channel(channel, time, side) for channel in inputs
        }
        starts = {
            state.name: start.value
            for state, start in zip(self.model.states, self.model.initial, strict=True)
            if isinstance(start, FixedInitial)
        }
        derived = {
            state.name: start.expression
            for state, start in zip(self.model.states, self.model.initial, strict=True)
            if isinstance(start, DerivedInitial)
        }

        def substitute_values(node: Expression) -> Expression | None:
            match node:
                case PastValue(name):
                    if name in derived and name_initial_state(name, 0) not in values:
                        return substitute(derived[name], substitute_values)
                    start = values.get(name_initial_state(name, 0), starts.get(name, 0.0))
                    return Number(input_values.get(name, start))
                case Symbol(_, "time" | "index"):
                    return Number(time if node.kind == "time" else 0.0)
                case _:
                    return None

        fixed = {p.name: p.fixed for p in self.model.parameters if p.fixed is not None}
        return evaluate_expression(substitute(tree, substitute_values), {**fixed, **values})


def close_loop(model: Model, control: PidControl, period: float | None = None) -> ClosedLoop:
    """Close the loop of a model and a controller.

    After a transport with a time constant the plant's input becomes a state. It starts at 0, or at
    the value of ``u(0)`` if the input is called u.

    Parameters
    ----------
    period : float or None
        Step (s) at which the model will be simulated. If it is set, the loop is valid for that
        step only. In the difference form, a transport delay of a step or more then replaces the
        delay of the controller. In the differential form, the steps are divided until each time
        constant of the controller has two of them.

    Raises
    ------
    InvalidSettings
        If the model has no such input or output. If the output contains the input itself without
        a delay or state between them (an algebraic loop). If a time constant of the controller is
        too short for the step.
    InvalidModel
        If the closed loop is too long to be a model.
    """
    renamed = _choose_parameter_names(model)
    loop = LoopDocumentBuilder(_rename_parameters(model, renamed), control, period)
    document = (
        loop.build_differential() if model.form == "differential" else loop.build_difference()
    )
    closed = parse_model(document)
    return ClosedLoop(
        closed,
        loop.reference,
        control.input,
        loop.command,
        loop.controller_delay_steps,
        renamed,
        loop.law.filter,
    )


def _choose_parameter_names(model: Model) -> dict[str, str]:
    """Choose names for parameters whose names are not valid in the language: ``a[y(k-1)]``."""
    taken = {q.name for group in (model.inputs, model.states, model.outputs) for q in group}
    taken |= {p.name for p in model.parameters}
    odd = [p.name for p in model.parameters if not p.name.isidentifier()]
    return {name: choose_free_name(f"a_{i}", taken) for i, name in enumerate(odd, 1)}


def _rename_parameters(model: Model, renamed: Mapping[str, str]) -> Model:
    """Rename parameters of a model."""

    def rename_symbol(node: Expression) -> Expression | None:
        match node:
            case Symbol(name, "parameter") if name in renamed:
                return Symbol(renamed[name], "parameter")
            case _:
                return None

    if not renamed:
        return model
    parameters = tuple(replace(p, name=renamed.get(p.name, p.name)) for p in model.parameters)
    trees = tuple(substitute(tree, rename_symbol) for tree in model.equations)
    return replace(model, parameters=parameters, equations=trees)


def _interpolate_channel(channel: Channel, time: float, side: str) -> float:
    """Interpolate a signal just before ("left") or just after ("right") a time."""
    channel = channel.acting
    times, values = channel.history_and_samples.times, channel.history_and_samples.values
    if channel.effective_hold != "zero":
        return float(np.interp(time, times, values))
    last = int(np.searchsorted(times, time, side=side)) - 1  # type: ignore[call-overload]
    return float(values[max(last, 0)])
