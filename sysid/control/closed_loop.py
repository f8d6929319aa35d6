"""Closing the loop: a model whose input is what a controller makes of one of its outputs.

The result is a model like any other, whose input is the reference; `ClosedLoop.simulate` runs it.
Gain, times, limits and transport are parameters of that model, fixed at their values: its kernel
is compiled once, whatever their numbers. The plant's input is that of `sysid.control.controllers`,
proportional at its simplest,

    u = ± limit at most of gain · (reference - output),

and may pass a transport element G e^(-Ls)/(Ts + 1), such as the long tube of section 5.2, before
it enters the plant (Asakura and Guo, Figure 21).
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
from sysid.language.evaluation import evaluate_expression as value_of
from sysid.language.transform import substitute
from sysid.language.tree import Expression, Number, PastValue, Symbol
from sysid.models.model import FixedInitial, Model, name_initial_state
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
    filter : Filter or None
        That of the derivative.
    """

    model: Model
    reference: str
    input: str
    command: str
    controller_delay_steps: int
    new_names: Mapping[str, str]
    derivative_filter: DerivativeFilter | None = None

    def rename_values(self, values: Mapping[str, float]) -> dict[str, float]:
        """Values of the plant's parameters as those of the closed loop."""
        return {self.new_names.get(name, name): value for name, value in values.items()}

    def simulate(
        self, inputs: Sequence[Channel], values: Mapping[str, float], *, times: FloatArray
    ) -> Recording:
        """Outputs of the loop at given times, as `sysid.simulation.simulate.simulate` of its model.

        The integral starts at 0, the derivative's filter at rest.

        Parameters
        ----------
        inputs : sequence of Channel
            The reference, of the name `reference`, and the plant's other inputs.
        values : mapping of str to float
            The plant's parameters and starts, by the plant's names.
        """
        loop_values = self.rename_values(values)
        return simulate(
            self.model,
            inputs,
            self._compute_filter_start(inputs, loop_values, times) | loop_values,
            times=times,
        )

    def _compute_filter_start(
        self, inputs: Sequence[Channel], values: Mapping[str, float], times: FloatArray
    ) -> dict[str, float]:
        """Where the derivative's filter is at rest: a reference that steps first comes after."""
        if self.derivative_filter is None:
            return {}
        name, followed, lag = self.derivative_filter
        is_sampled = self.model.form != "differential"
        begins = [times[0]] if is_sampled else [times[0], *(channel.times[0] for channel in inputs)]
        start = float(min(begins))
        before = self._evaluate_start(followed, inputs, values, start, "left")
        if is_sampled:  # its first value is that of a first step, not of the time before
            period = float(times[1] - times[0]) / self.model.solver.substeps
            now = self._evaluate_start(followed, inputs, values, start, "right")
            before += period / (lag + period) * (now - before)
        return {name_initial_state(name, 0): before if isfinite(before) else 0.0}

    def _evaluate_start(
        self,
        tree: Expression,
        inputs: Sequence[Channel],
        values: Mapping[str, float],
        time: float,
        side: str,
    ) -> float:
        """Value of an expression where the loop starts, just before or just after."""
        input_values = {
            channel.name: _interpolate_channel(channel, time, side) for channel in inputs
        }
        starts = {
            state.name: start.value
            for state, start in zip(self.model.states, self.model.initial, strict=True)
            if isinstance(start, FixedInitial)
        }

        def substitute_values(node: Expression) -> Expression | None:
            match node:
                case PastValue(name):
                    start = values.get(name_initial_state(name, 0), starts.get(name, 0.0))
                    return Number(input_values.get(name, start))
                case Symbol(_, "time" | "index"):
                    return Number(time if node.kind == "time" else 0.0)
                case _:
                    return None

        fixed = {p.name: p.fixed for p in self.model.parameters if p.fixed is not None}
        return value_of(substitute(tree, substitute_values), {**fixed, **values})


def close_loop(model: Model, control: PidControl, period: float | None = None) -> ClosedLoop:
    """The model under a controller.

    Behind a transport with a time constant the plant's input becomes a state. It starts at 0, or
    at the value that is given for ``u(0)`` if the input is called u.

    Parameters
    ----------
    period : float or None
        Step (s) at which the model will be simulated. If it is known, a transport's delay of a
        step or more is one for a model in the difference form: the controller need not act late;
        and in the differential form the steps are divided until two of them are in each time
        constant of the controller. The loop then holds for that step only.

    Raises
    ------
    InvalidSettings
        If the model has no such input or output, if the output contains the input itself with
        nothing between them that takes time (an algebraic loop), or if a time constant of the
        controller is too short for the step.
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
    """Names for parameters whose own are none in the language, such as ``a[y(k-1)]``."""
    taken = {q.name for group in (model.inputs, model.states, model.outputs) for q in group}
    taken |= {p.name for p in model.parameters}
    odd = [p.name for p in model.parameters if not p.name.isidentifier()]
    return {name: choose_free_name(f"a_{i}", taken) for i, name in enumerate(odd, 1)}


def _rename_parameters(model: Model, renamed: Mapping[str, str]) -> Model:
    """The model with parameters of other names."""

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
    """Value of a signal just before ("left") or just after ("right") a time."""
    times, values = channel.history_and_samples.times, channel.history_and_samples.values
    if channel.hold != "zero":
        return float(np.interp(time, times, values))
    last = int(np.searchsorted(times, time, side=side)) - 1  # type: ignore[call-overload]
    return float(values[max(last, 0)])
