"""Code generation of a kernel: blocks of individuals, a time loop in each, and the loss."""

from collections.abc import Mapping
from dataclasses import dataclass

from llvmlite import ir

from sysid.kernels.abi import KERNEL_ARGUMENTS, KERNEL_NAME, LANES, NARROW_LANES, build_kernel_type
from sysid.kernels.expression_code import emit_expression
from sysid.kernels.integrators import EnvironmentBuilder, StepEnvironment, emit_next_states
from sysid.kernels.layout import ExperimentLayout, KernelVariant
from sysid.kernels.loss_code import LossAccumulator
from sysid.kernels.signals import past_reads
from sysid.kernels.signals.block_signals import (
    Delays,
    ExperimentHead,
    ParameterEnvironment,
    StartEnvironment,
    States,
)
from sysid.kernels.signals.delayed_reads import TimeStep
from sysid.kernels.signals.signal_readers import SignalReaders
from sysid.kernels.vectors import IrValue, KernelLoop, VectorBuilder
from sysid.language.tree import Binary, FunctionCall, walk
from sysid.models.model import DerivedInitial, EstimatedInitial, MeasuredInitial, Model


def emit_kernel(model: Model, variant: KernelVariant) -> str:
    """Emit the LLVM assembly of a model's kernel."""
    module = ir.Module("lagid")
    function = ir.Function(module, build_kernel_type(), KERNEL_NAME)
    for argument, name in zip(function.args, KERNEL_ARGUMENTS, strict=True):
        argument.name = name
        if isinstance(argument.type, ir.PointerType):
            argument.add_attribute("noalias")
    lanes = VectorBuilder(function, LANES)
    arguments = dict(zip(KERNEL_ARGUMENTS, function.args, strict=True))
    experiment = ExperimentHead(
        lanes, ExperimentLayout.from_model(model), arguments["ints"], arguments["floats"]
    )
    blocks = KernelLoop(lanes)
    first = blocks.carry(lanes.make_integer(0))
    remaining = lanes.builder.sub(arguments["P"], first)
    blocks.leave_if(lanes.builder.icmp_signed("<=", remaining, lanes.make_integer(NARROW_LANES)))
    _add_loss(lanes, _Block(lanes, model, variant, experiment, arguments, first))
    blocks.update(first, lanes.builder.add(first, lanes.make_integer(LANES)))
    blocks.repeat()

    def emit_narrow_block() -> list[IrValue]:
        _add_loss(narrow, _Block(narrow, model, variant, experiment, arguments, first))
        return []

    narrow = lanes.copy_with_width(NARROW_LANES)
    lanes.branch(
        lanes.builder.icmp_signed(">", remaining, lanes.make_integer(0)), emit_narrow_block, []
    )
    lanes.builder.ret_void()
    if _has_repeated_calls(model):
        _declare_pure_functions(module)
    return str(module)


def _has_repeated_calls(model: Model) -> bool:
    """Whether a function is called twice with the same arguments, as by intermediate names."""
    trees = (*model.equations, *(output.expression for output in model.outputs))
    calls = [
        node
        for tree in trees
        for node in walk(tree)
        if isinstance(node, FunctionCall) or (isinstance(node, Binary) and node.operator == "**")
    ]
    return len(set(calls)) < len(calls)


def _declare_pure_functions(module: ir.Module) -> None:
    """Declare called functions as pure: the compiler computes what occurs twice only once."""
    for function in module.functions:
        if not function.blocks and not function.name.startswith("llvm."):
            for attribute in ("readnone", "nounwind"):
                function.attributes.add(attribute)


def _add_loss(lanes: VectorBuilder, block: "_Block") -> None:
    """Simulate a block and add its sums to the stored ones."""
    target, index = block.arguments["loss"], block.first
    for value in block.emit_simulation():
        total = lanes.load_row(target, index)
        lanes.store_row(lanes.add(total, value), target, index)
        index = lanes.builder.add(index, block.arguments["stride"])


@dataclass(frozen=True, slots=True)
class _Block:
    """Simulation of as many individuals as lanes, over the whole experiment."""

    lanes: VectorBuilder
    model: Model
    variant: KernelVariant
    experiment: ExperimentHead
    arguments: dict[str, IrValue]
    first: IrValue

    def emit_simulation(self) -> list[IrValue]:
        """Emit the simulation; return the sums of the loss."""
        lanes, model, experiment = self.lanes, self.model, self.experiment
        step = experiment.get_number("step")
        scope = ParameterEnvironment(
            {
                p.name: self._load_parameter(lanes.make_integer(i))
                for i, p in enumerate(model.parameters)
            },
            step,
        )
        start = self._emit_start(scope)
        states = States(lanes, model, experiment, self.arguments["work"], start, scope)
        row = states.fill_history()
        delays = Delays(lanes, model, scope, step)
        changes_past = self.variant.one_step or past_reads.corrects_past(model)
        signals = SignalReaders(lanes, model, experiment, states, delays, changes_past)
        comparison = LossAccumulator(
            lanes, model, self.variant, experiment, self.arguments, self.first
        )

        loop = KernelLoop(lanes)
        time_step = TimeStep(loop.carry(lanes.make_integer(0)), loop.carry(row))
        states.open_loop(loop)
        signals.open_loop(loop)
        comparison.open_loop(loop)
        signals.begin_step(time_step)
        build_environment = _bind_environment(lanes, model, scope, states, signals, time_step)
        comparison.compare_step(time_step, states, build_environment)
        loop.leave_if(lanes.builder.icmp_signed(">=", time_step.index, experiment.get_head("last")))
        if changes_past:
            states.store_states(time_step.row)
            signals.begin_step(time_step)
        following = self._emit_following_states(time_step, states, build_environment, start)
        signals.end_step(loop, following)
        states.end_step(loop, following)
        comparison.end_step(loop)
        loop.update(time_step.row, states.advance_row(time_step.row))
        loop.update(time_step.index, lanes.builder.add(time_step.index, lanes.make_integer(1)))
        loop.repeat()
        loss, *others = comparison.sums
        return [self._mark_divergence(loss, states), *others]

    def _mark_divergence(self, loss: IrValue, states: States) -> IrValue:
        """Turn the loss into nan if a state is not finite, even if the outputs hide it."""
        for name in states.names:
            last = states.line[name][0]
            loss = self.lanes.add(loss, self.lanes.sub(last, last))
        return loss

    def _load_parameter(self, row: IrValue) -> IrValue:
        b = self.lanes.builder
        index = b.add(b.mul(row, self.arguments["stride"]), self.first)
        return self.lanes.load_row(self.arguments["theta"], index)

    def _emit_start(self, scope: ParameterEnvironment) -> list[IrValue]:
        """Emit the initial values: numbers of the experiment, rows of theta, or expressions."""
        names = [signal.name for signal in self.model.inputs]
        first_values = dict(zip(names, self.experiment.first_inputs, strict=True))
        environment = StartEnvironment(scope.values, scope.period, first_values)
        values = []
        for i, initial in enumerate(self.model.initial):
            value = self.experiment.initial[i]
            if isinstance(initial, EstimatedInitial):
                value = self._load_parameter(self.experiment.get_state_field(i, "row"))
            elif isinstance(initial, DerivedInitial):  # the number shifts it
                derived = emit_expression(self.lanes, initial.expression, environment)
                value = self.lanes.add(derived, value)
            values.append(value)
            first_values[self.model.states[i].name] = value  # a lagged state starts there too
        return values

    def _emit_following_states(
        self,
        time_step: TimeStep,
        states: States,
        build_environment: EnvironmentBuilder,
        start: list[IrValue],
    ) -> dict[str, IrValue]:
        """Emit the next states: computed, or in the first samples of a recursion measured."""
        lanes, model = self.lanes, self.model
        is_computed = not past_reads.is_difference(model) or model.memory <= 1
        if is_computed or model.corrections:  # a filter holds its first states by itself
            return emit_next_states(
                lanes, model, self.experiment.get_number("step"), states, build_environment
            )
        following = lanes.builder.add(time_step.index, lanes.make_integer(1))
        measured = [
            lanes.splat(self._load_measured_state(i, following, start[i]))
            for i in range(len(states.names))
        ]

        def emit_computed() -> list[IrValue]:
            values = emit_next_states(
                lanes, model, self.experiment.get_number("step"), states, build_environment
            )
            return [lanes.splat(values[name]) for name in states.names]

        is_computed = lanes.builder.icmp_signed(">=", following, lanes.make_integer(model.memory))
        merged = lanes.branch(is_computed, emit_computed, measured)
        return dict(zip(states.names, merged, strict=True))

    def _load_measured_state(self, i: int, sample: IrValue, start: IrValue) -> IrValue:
        if not isinstance(self.model.initial[i], MeasuredInitial):
            return start
        b, lanes = self.lanes.builder, self.lanes
        last = lanes.make_integer(self.model.memory - 1)
        inside = b.select(b.icmp_signed("<", sample, last), sample, last)
        index = b.add(self.experiment.get_state_field(i, "given"), inside)
        return lanes.load_double(self.experiment.floats, index)


def _bind_environment(
    lanes: VectorBuilder,
    model: Model,
    scope: ParameterEnvironment,
    states: States,
    signals: SignalReaders,
    time_step: TimeStep,
) -> EnvironmentBuilder:
    """Bind the environment of this step; its positions and the states' values stay open."""

    def build_environment(
        halves: int,
        values: dict[str, IrValue],
        equation: int = 0,
        parts: Mapping[int, IrValue] | None = None,
    ) -> StepEnvironment:
        return StepEnvironment(
            lanes, model, scope, states, signals, time_step, halves, values, equation, parts
        )

    return build_environment
