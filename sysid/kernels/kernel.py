"""The code of a kernel: blocks of individuals, the time loop in each, the loss at the end."""

from dataclasses import dataclass

from llvmlite import ir

from sysid.kernels import reads as demand
from sysid.kernels.abi import ARGUMENTS, FEW, LANES, kernel_type
from sysid.kernels.delayed_reads import Turn
from sysid.kernels.integrators import Place, Placing, next_states
from sysid.kernels.layout import Layout, Variant
from sysid.kernels.loss import Comparison
from sysid.kernels.signals import Experiment, Lags, Parameters, Signals, States
from sysid.kernels.vectors import Lanes, Loop, Value
from sysid.models.model import EstimatedInitial, MeasuredInitial, Model

KERNEL = "kernel"
"""Name of the function in its module."""


def kernel_code(model: Model, variant: Variant) -> str:
    """LLVM assembly of a model's kernel."""
    module = ir.Module("lagid")
    function = ir.Function(module, kernel_type(), KERNEL)
    for argument, name in zip(function.args, ARGUMENTS, strict=True):
        argument.name = name
        if isinstance(argument.type, ir.PointerType):
            argument.add_attribute("noalias")
    lanes = Lanes(function, LANES)
    arguments = dict(zip(ARGUMENTS, function.args, strict=True))
    experiment = Experiment(lanes, Layout.of(model), arguments["ints"], arguments["floats"])
    blocks = Loop(lanes)
    first = blocks.carry(lanes.integer(0))
    left = lanes.builder.sub(arguments["P"], first)
    blocks.leave_if(lanes.builder.icmp_signed("<=", left, lanes.integer(FEW)))
    _add_loss(lanes, _Block(lanes, model, variant, experiment, arguments, first))
    blocks.update(first, lanes.builder.add(first, lanes.integer(LANES)))
    blocks.repeat()

    def few() -> list[Value]:
        _add_loss(narrow, _Block(narrow, model, variant, experiment, arguments, first))
        return []

    narrow = lanes.of_width(FEW)
    lanes.branch(lanes.builder.icmp_signed(">", left, lanes.integer(0)), few, [])
    lanes.builder.ret_void()
    return str(module)


def _add_loss(lanes: Lanes, block: "_Block") -> None:
    """Simulate a block and add its losses to those that are there."""
    loss, target = block.simulated(), block.arguments["loss"]
    so_far = lanes.load_row(target, block.first)
    lanes.store_row(lanes.add(so_far, loss), target, block.first)


@dataclass(frozen=True, slots=True)
class _Block:
    """As many individuals as lanes, from the start of the experiment to its end."""

    lanes: Lanes
    model: Model
    variant: Variant
    experiment: Experiment
    arguments: dict[str, Value]
    first: Value

    def simulated(self) -> Value:
        """Write the simulation; gives the sum of the losses."""
        lanes, model, experiment = self.lanes, self.model, self.experiment
        step = experiment.number("step")
        scope = Parameters(
            {p.name: self._theta(lanes.integer(i)) for i, p in enumerate(model.parameters)}, step
        )
        start = [self._initial(i) for i in range(len(model.states))]
        states = States(lanes, model, experiment, self.arguments["work"], start)
        row = states.fill_history()
        lags = Lags(lanes, model, scope, step)
        signals = Signals(lanes, model, experiment, states, lags, self.variant.one_step)
        comparison = Comparison(lanes, model, self.variant, experiment, self.arguments, self.first)

        loop = Loop(lanes)
        turn = Turn(loop.carry(lanes.integer(0)), loop.carry(row))
        states.open(loop)
        signals.open(loop)
        comparison.open(loop)
        signals.begin(turn)
        at = _placing(lanes, model, scope, states, signals, turn)
        comparison.compare(turn, states, at)
        loop.leave_if(lanes.builder.icmp_signed(">=", turn.step, experiment.head("last")))
        if self.variant.one_step:
            states.store(turn.row)
            signals.begin(turn)
        following = self._following(turn, states, at)
        signals.end(loop, following)
        states.end(loop, following)
        comparison.end(loop)
        loop.update(turn.row, states.end_row(turn.row))
        loop.update(turn.step, lanes.builder.add(turn.step, lanes.integer(1)))
        loop.repeat()
        return self._unless_diverged(comparison.loss, states)

    def _unless_diverged(self, loss: Value, states: States) -> Value:
        """The loss, or nan where a state is not finite even if the outputs hide it."""
        for name in states.names:
            last = states.line[name][0]
            loss = self.lanes.add(loss, self.lanes.sub(last, last))
        return loss

    def _theta(self, row: Value) -> Value:
        b = self.lanes.builder
        index = b.add(b.mul(row, self.arguments["stride"]), self.first)
        return self.lanes.load_row(self.arguments["theta"], index)

    def _initial(self, i: int) -> Value:
        """Where a state starts: a number of the experiment, or a row of theta."""
        known = self.experiment.initial[i]
        if not isinstance(self.model.initial[i], EstimatedInitial):
            return known
        return self._theta(self.experiment.state(i, "row"))

    def _following(self, turn: Turn, states: States, at: Placing) -> dict[str, Value]:
        """The next states: computed, or, in the first samples of a recursion, given."""
        lanes, model = self.lanes, self.model
        if not demand.is_difference(model) or model.memory <= 1:
            return next_states(lanes, model, self.experiment.number("step"), states, at)
        following = lanes.builder.add(turn.step, lanes.integer(1))
        given = [lanes.splat(self._given(i, following)) for i in range(len(states.names))]

        def computed() -> list[Value]:
            values = next_states(lanes, model, self.experiment.number("step"), states, at)
            return [lanes.splat(values[name]) for name in states.names]

        is_computed = lanes.builder.icmp_signed(">=", following, lanes.integer(model.memory))
        made = lanes.branch(is_computed, computed, given)
        return dict(zip(states.names, made, strict=True))

    def _given(self, i: int, sample: Value) -> Value:
        if not isinstance(self.model.initial[i], MeasuredInitial):
            return self._initial(i)
        b, lanes = self.lanes.builder, self.lanes
        last = lanes.integer(self.model.memory - 1)
        inside = b.select(b.icmp_signed("<", sample, last), sample, last)
        place = b.add(self.experiment.state(i, "given"), inside)
        return lanes.load(self.experiment.floats, place)


def _placing(
    lanes: Lanes, model: Model, scope: Parameters, states: States, signals: Signals, turn: Turn
) -> Placing:
    """What names mean at a place of this turn, given the states' values there."""

    def at(halves: int, values: dict[str, Value], equation: int = 0) -> Place:
        return Place(lanes, model, scope, states, signals, turn, halves, values, equation)

    return at
