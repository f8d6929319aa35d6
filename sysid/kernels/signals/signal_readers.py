"""Readers of all signals of a model, in one block of individuals."""

from sysid.kernels.expression_code import Environment
from sysid.kernels.signals import past_reads
from sysid.kernels.signals.block_signals import Delays, ExperimentHead, States
from sysid.kernels.signals.cubic_reads import CubicReader, StepCubicReader
from sysid.kernels.signals.delayed_reads import (
    DelayedReader,
    DirectReader,
    InputReader,
    LinearReader,
    TimeStep,
    interpolate_points,
)
from sysid.kernels.vectors import DOUBLE, IrValue, KernelLoop, VectorBuilder
from sysid.language.tree import Expression, PastValue
from sysid.models.model import Model


class SignalReaders:
    """Readers of all delayed signals of a model, and the inputs without delay."""

    def __init__(
        self,
        lanes: VectorBuilder,
        model: Model,
        experiment: ExperimentHead,
        states: States,
        delays: Delays,
        changes_past: bool,
    ) -> None:
        self._lanes, self._model, self._experiment = lanes, model, experiment
        self._delays, self._states = delays, states
        self._inputs = {signal.name: i for i, signal in enumerate(model.inputs)}
        self._readers: dict[tuple[str, Expression, int], DelayedReader] = {}
        self._owners: list[tuple[str, DelayedReader]] = []
        self._part_readers: dict[tuple[str, Expression], DirectReader | StepCubicReader] = {}
        cubic = model.solver.interpolation == "cubic"
        for past, positions in past_reads.group_delayed_reads(model, "state").items():
            delay = lanes.clamp(delays.to_steps(past[1]), experiment.get_number("cap"))
            if past_reads.reads_cubics(model):
                self._add_cubic_reader(past, positions, delay)
                continue
            history = states.get_history(past[0])
            if past_reads.list_switch_sides(model):
                reader = DirectReader(lanes, history, delay, set(), cubic)
                self._part_readers[past] = reader
                self._owners.append((past[0], reader))
            if changes_past or cubic:
                self._add_reader(
                    past, positions, DirectReader(lanes, history, delay, positions, cubic)
                )
                continue
            for chain in _group_state_positions(positions):
                linear = LinearReader(lanes, history, delay, chain, experiment.get_head("reach"))
                served = positions if chain[0] > 0 else set()
                self._add_reader(past, {*chain, *(p for p in served if p > 0)}, linear)
        for past, positions in past_reads.group_delayed_reads(model, "input").items():
            for chain in past_reads.group_positions(positions):
                self._add_reader(
                    past,
                    {*chain},
                    self._build_input_reader(past[0], delays.to_steps(past[1]), chain),
                )

    def _add_cubic_reader(
        self, past: tuple[str, Expression], positions: set[int], delay: IrValue
    ) -> None:
        if not past_reads.list_switch_sides(self._model):
            reader = CubicReader(self._lanes, self._states, past, delay)
            self._add_reader(past, positions, reader)
            return
        anywhere = StepCubicReader(self._lanes, self._states, past, delay)
        self._part_readers[past] = anywhere
        self._add_reader(past, positions, anywhere)

    def _add_reader(
        self, past: tuple[str, Expression], positions: set[int], reader: DelayedReader
    ) -> None:
        for position in positions:
            self._readers[*past, position] = reader
        self._owners.append((past[0], reader))

    def _build_input_reader(self, name: str, delay: IrValue, chain: list[int]) -> InputReader:
        lanes, number, experiment = self._lanes, self._inputs[name], self._experiment
        points = experiment.get_input_field(number, "points")
        fine = lanes.mul(delay, lanes.builder.sitofp(points, DOUBLE))
        cap = lanes.builder.sitofp(experiment.get_input_field(number, "cap"), DOUBLE)
        zero = self._find_input_start(number)
        return InputReader(lanes, experiment.floats, zero, points, lanes.clamp(fine, cap), chain)

    def _find_input_start(self, number: int) -> IrValue:
        """Find the position of an input at step 0; difference equations read just after a jump."""
        zero = self._experiment.get_input_field(number, "zero")
        if not past_reads.is_difference(self._model):
            return zero
        return self._lanes.builder.add(zero, self._experiment.get_input_field(number, "begin"))

    def get_reader(self, past: PastValue, halves: int) -> DelayedReader:
        """Return the reader of a delayed signal at a position."""
        if past.delay is None:
            raise AssertionError(f"{past.name} is read without delay")
        return self._readers[past.name, past.delay, halves]

    def get_state_delay(self, past: PastValue) -> IrValue:
        """Return the delay of a delayed state, in integration steps, however long."""
        if past.delay is None:
            raise AssertionError(f"{past.name} is read without delay")
        return self._delays.to_steps(past.delay)

    def read_varying_input(
        self, past: PastValue, halves: int, time_step: TimeStep, scope: Environment
    ) -> IrValue:
        """Read an input whose delay depends on present inputs, once for this position."""
        if past.delay is None:
            raise AssertionError(f"{past.name} is read without delay")
        steps = self._delays.to_present_steps(past.delay, scope)
        reader = self._build_input_reader(past.name, steps, [halves])
        return reader.load_once(time_step.index)

    def read_input_part(
        self, past: PastValue, part: IrValue, time_step: TimeStep, scope: Environment
    ) -> IrValue:
        """Read an input at any `part` of a step, for each lane."""
        b, lanes, experiment = self._lanes.builder, self._lanes, self._experiment
        number = self._inputs[past.name]
        points, begin, end, cap = (
            experiment.get_input_field(number, field) for field in ("points", "begin", "end", "cap")
        )
        start = b.add(self._find_input_start(number), b.mul(time_step.index, points))
        if past.delay is None:
            width = b.sitofp(b.sub(end, begin), DOUBLE)
            place = lanes.add(b.sitofp(begin, DOUBLE), lanes.mul(part, width))
        else:
            count = b.sitofp(points, DOUBLE)
            fine = lanes.mul(self._delays.to_present_steps(past.delay, scope), count)
            place = lanes.sub(lanes.mul(part, count), lanes.clamp(fine, b.sitofp(cap, DOUBLE)))
        return interpolate_points(lanes, experiment.floats, start, place)

    def read_state_part(
        self, past: PastValue, part: IrValue, now: IrValue, stage: IrValue
    ) -> IrValue:
        """Read a delayed state at any `part` of a step, for each lane."""
        if past.delay is None:
            raise AssertionError(f"{past.name} is read without delay")
        return self._part_readers[past.name, past.delay].read_part(part, now, stage)

    def load_input(self, name: str, halves: int, step: IrValue) -> IrValue:
        """Load an input without delay: the same for all individuals."""
        b, lanes, number = self._lanes.builder, self._lanes, self._inputs[name]
        points = self._experiment.get_input_field(number, "points")
        start = b.add(self._find_input_start(number), b.mul(step, points))
        if past_reads.is_difference(self._model):
            shift = b.mul(points, lanes.make_integer(halves // 2))
        elif halves == 1:
            shift = b.ashr(points, lanes.make_integer(1))
        else:
            shift = self._experiment.get_input_field(number, "end" if halves == 2 else "begin")
        return lanes.load_double(self._experiment.floats, b.add(start, shift))

    def open_loop(self, loop: KernelLoop) -> None:
        """Open the readers at the head of the time loop."""
        for _, reader in self._owners:
            reader.open_loop(loop)

    def begin_step(self, time_step: TimeStep) -> None:
        """Begin a step of all readers."""
        for _, reader in self._owners:
            reader.begin_step(time_step)

    def end_step(self, loop: KernelLoop, following: dict[str, IrValue]) -> None:
        """End a step of all readers."""
        for name, reader in self._owners:
            reader.end_step(loop, following.get(name, self._lanes.make_number(0.0)))


def _group_state_positions(positions: set[int]) -> list[list[int]]:
    """Group whole steps into chains; one that reaches the present step has its start too."""
    forward = {0, 2} if any(position > 0 for position in positions) else set()
    return past_reads.group_positions(
        {position for position in positions if position % 2 == 0} | forward
    )
