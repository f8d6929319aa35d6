"""Readers of delayed states on the cubics of Runge-Kutta steps.

A step of the Runge-Kutta method has values at both ends, and slopes there: its first and its last.
The cubic through them is the natural continuous extension of the method (Zennaro 1986): it is as
accurate as the steps. Both slopes are those inside the step, so an input that jumps between two
steps bends no cubic.

The delay is constant in time. So each lane needs one position of every cubic, and a second one
for the middle stages. These values are computed at the end of the step and stored. A read loads
them.
"""

from sysid.kernels.signals.block_signals import States
from sysid.kernels.signals.delayed_reads import TimeStep
from sysid.kernels.vectors import IrValue, KernelLoop, VectorBuilder
from sysid.language.tree import Expression


class CubicReader:
    """Reader of a state at one delay ℓ (steps) on cubics of the steps.

    A row of its history has the value ℓ before the end of the step. In the second column is the
    value that a middle stage reads there: half a step more or less than ℓ before the end.
    """

    def __init__(
        self,
        lanes: VectorBuilder,
        states: States,
        past: tuple[str, Expression],
        delay: IrValue,
    ) -> None:
        b = lanes.builder
        self._lanes, self._states, self._name, self._delay = lanes, states, past[0], delay
        self._history = states.get_history(*past)
        self._forward = self._history.columns > 1
        whole, fraction = lanes.split_fraction(delay)
        zero, unit = (lanes.splat(lanes.make_integer(value)) for value in (0, 1))
        self._within = b.icmp_signed("==", whole, zero)
        self._is_some_within = lanes.test_any(self._within)
        half = lanes.make_number(0.5)
        self._is_later = lanes.compare("<", fraction, half)
        half_fraction = lanes.select(
            self._is_later, lanes.add(fraction, half), lanes.sub(fraction, half)
        )
        self._weights = [self._compute_weights(part) for part in (fraction, half_fraction)]
        # a delay below one step has no finished step ahead: it reads the last one instead
        back = b.select(self._within, unit, whole) if self._forward else whole
        stride = lanes.splat(lanes.make_integer(lanes.width * self._history.columns))
        columns = lanes.splat(lanes.make_integer(self._history.columns))
        offsets = b.sub(b.mul(lanes.make_lane_numbers(), columns), b.mul(back, stride))
        self._addresses = lanes.compute_addresses(self._history.base, offsets)

    def _compute_weights(self, fraction: IrValue) -> tuple[IrValue, IrValue, IrValue]:
        """Compute the weights of the older value and of both slopes, `fraction` before the end."""
        lanes = self._lanes
        rest = lanes.sub(lanes.make_number(1.0), fraction)
        both = lanes.mul(fraction, rest)
        first, last = (
            lanes.mul(both, fraction),
            lanes.mul(both, lanes.sub(fraction, lanes.make_number(1.0))),
        )
        return lanes.add(fraction, lanes.add(first, last)), first, last

    def open_loop(self, loop: KernelLoop) -> None:
        """Create the values that are carried from step to step."""
        if self._forward:
            before = self._lanes.splat(self._states.get_value_before(self._name))
            self._carried = [loop.carry(before), loop.carry(before)]

    def begin_step(self, time_step: TimeStep) -> None:
        """Store the values of the last finished step, and read those that this step needs."""
        lanes, b = self._lanes, self._lanes.builder
        values = self._interpolate_finished_step()[: self._history.columns]
        width = lanes.make_integer(lanes.width * self._history.columns)
        lanes.store_columns(values, self._history.base, b.mul(time_step.row, width))
        if not self._forward:
            self._now = lanes.gather(self._addresses, b.mul(time_step.row, width))
            return
        following = b.add(time_step.row, lanes.make_integer(1))
        self._ahead = lanes.gather_pairs(self._addresses, b.mul(following, width))
        self._now, middle = (
            b.select(self._within, new, old) for new, old in zip(values, self._carried, strict=True)
        )
        self._middle = b.select(self._is_later, self._ahead[1], middle)

    def read_value(self, halves: int, now: IrValue, stage: IrValue) -> IrValue:
        """Value at `halves` half steps."""
        if halves == 0:
            return self._now
        lanes = self._lanes
        finished = self._middle if halves == 1 else self._ahead[0]

        def emit_inside() -> list[IrValue]:
            is_inside = lanes.compare("<", self._delay, lanes.make_number(halves / 2))
            return [lanes.select(is_inside, self._read_inside(halves, now, stage), finished)]

        return lanes.branch(self._is_some_within, emit_inside, [finished])[0]

    def end_step(self, loop: KernelLoop, following: IrValue) -> None:
        """Update the carried values."""
        if self._forward:
            for carried, value in zip(self._carried, self._ahead, strict=True):
                loop.update(carried, value)

    def _interpolate_finished_step(self) -> list[IrValue]:
        """Interpolate the last finished step at both positions."""
        lanes, newest = self._lanes, self._states.now[self._name]
        start, first_rise, last_rise = self._states.get_finished_step(self._name)
        values = []
        for older, first, last in self._weights:
            line = lanes.interpolate(newest, older, start)
            bent = lanes.add(line, lanes.mul(first, first_rise))
            values.append(lanes.add(bent, lanes.mul(last, last_rise)))
        return values

    def _read_inside(self, halves: int, now: IrValue, stage: IrValue) -> IrValue:
        """Read inside the present step, on the parabola of its first slope and the stage.

        It tends to the stage as ℓ → 0.
        """
        lanes = self._lanes
        part = lanes.sub(
            lanes.make_number(1.0), lanes.mul(self._delay, lanes.make_number(2.0 / halves))
        )
        tangent = lanes.mul(lanes.make_number(halves / 2), self._states.first_rises[self._name])
        bent = lanes.interpolate(tangent, part, lanes.sub(stage, now))
        return lanes.add(now, lanes.mul(part, bent))


class StepCubicReader:
    """Reader of a state at any place, on cubics of the steps, for steps that are divided.

    A row of its history has the state, and the rises of the step that ends there by its first and
    its last slope.
    """

    def __init__(
        self, lanes: VectorBuilder, states: States, past: tuple[str, Expression], delay: IrValue
    ) -> None:
        self._lanes, self._states, self._name, self._delay = lanes, states, past[0], delay
        self._history = states.get_history(past[0])

    def open_loop(self, loop: KernelLoop) -> None:
        """Create the values that are carried from step to step."""

    def begin_step(self, time_step: TimeStep) -> None:
        """Read the values that the step needs."""
        self._time_step = time_step

    def read_value(self, halves: int, now: IrValue, stage: IrValue) -> IrValue:
        """Value at `halves` half steps."""
        place = self._lanes.splat(self._lanes.make_number(halves / 2))
        return self.read_part(place, now, stage) if halves else self._read_finished(place)

    def read_part(self, part: IrValue, now: IrValue, stage: IrValue) -> IrValue:
        """Value at any `part` of a step; inside it on the parabola as in `CubicReader`."""
        lanes = self._lanes
        share = lanes.div(lanes.sub(part, self._delay), part)
        tangent = lanes.mul(part, self._states.first_rises[self._name])
        bent = lanes.interpolate(tangent, share, lanes.sub(stage, now))
        inside = lanes.add(now, lanes.mul(share, bent))
        is_inside = lanes.compare("<", self._delay, part)
        return lanes.select(is_inside, inside, self._read_finished(part))

    def end_step(self, loop: KernelLoop, following: IrValue) -> None:
        """Update the carried values."""

    def _read_finished(self, part: IrValue) -> IrValue:
        """Read on the cubic of a finished step: x + f (r + (1 - f) ((1 - f) (a - r) - f (b - r))).

        There f is the place in that step, r its rise, and a and b the rises by both slopes.
        """
        lanes = self._lanes
        whole, fraction = lanes.split_fraction(lanes.sub(part, self._delay))
        older, newer, first, last = (
            self._load(whole, steps, column) for steps, column in ((0, 0), (1, 0), (1, 1), (1, 2))
        )
        rise, rest = lanes.sub(newer, older), lanes.sub(lanes.make_number(1.0), fraction)
        bend = lanes.sub(
            lanes.mul(rest, lanes.sub(first, rise)), lanes.mul(fraction, lanes.sub(last, rise))
        )
        return lanes.add(older, lanes.mul(fraction, lanes.add(rise, lanes.mul(rest, bend))))

    def _load(self, whole: IrValue, steps: int, column: int) -> IrValue:
        """Load a column of the row `whole` + `steps` after the last finished one, or of that."""
        lanes, b = self._lanes, self._lanes.builder
        zero = lanes.splat(lanes.make_integer(0))
        place = b.add(whole, lanes.splat(lanes.make_integer(steps)))
        place = b.select(b.icmp_signed("<", place, zero), place, zero)
        size = lanes.make_integer(lanes.width * self._history.columns)
        index = b.add(lanes.make_lane_numbers(), b.mul(place, lanes.splat(size)))
        addresses = lanes.compute_addresses(self._history.base, index)
        shift = b.add(b.mul(self._time_step.row, size), lanes.make_integer(column * lanes.width))
        return lanes.gather(addresses, shift)
