"""Readers of delayed signals: interpolation between samples, lane by lane.

The delay ℓ, in integration steps, is constant in time. Its whole part and its fraction are
computed once. A step reuses the values that the step before has read.
"""

from dataclasses import dataclass
from typing import Protocol

from sysid.kernels.vectors import IrValue, KernelLoop, VectorBuilder


@dataclass(frozen=True, slots=True)
class StateHistory:
    """History in the work array: a row for each step, with `columns` doubles for each lane."""

    base: IrValue
    columns: int


@dataclass(frozen=True, slots=True)
class TimeStep:
    """One step of the time loop: its number, and the history's row of the last finished step."""

    index: IrValue
    row: IrValue


class DelayedReader(Protocol):
    """Reader of one signal at one delay.

    It is created before the loop and opened in the loop's head. Every step begins it, reads from
    it and ends it.
    """

    def open_loop(self, loop: KernelLoop) -> None:
        """Create the values that are carried from step to step."""

    def begin_step(self, time_step: TimeStep) -> None:
        """Read the values that the step needs."""

    def read_value(self, halves: int, now: IrValue, stage: IrValue) -> IrValue:
        """Value at `halves` half steps; a state is `now` at 0 and `stage` at that position."""

    def end_step(self, loop: KernelLoop, following: IrValue) -> None:
        """Update the carried values; `following` is the state's next value."""


def interpolate_points(
    lanes: VectorBuilder, floats: IrValue, start: IrValue, place: IrValue
) -> IrValue:
    """Interpolate an input at places in fine points after the index `start`, one for each lane."""
    whole, fraction = lanes.split_fraction(lanes.splat(place))
    addresses = lanes.compute_addresses(floats, lanes.builder.add(whole, lanes.splat(start)))
    first, second = (lanes.gather(addresses, lanes.make_integer(shift)) for shift in (0, 1))
    return lanes.interpolate(first, fraction, second)


def interpolate_inside_step(
    lanes: VectorBuilder, delay: IrValue, halves: int, now: IrValue, stage: IrValue
) -> IrValue:
    """Interpolate inside the present step: x + (c - ℓ)/c (x_c - x), which tends to x_c as ℓ → 0."""
    portion = lanes.sub(lanes.make_number(1.0), lanes.mul(delay, lanes.make_number(2.0 / halves)))
    return lanes.interpolate(now, portion, stage)


class LinearReader:
    """Linear interpolation of a state between two samples, with one gather in a step.

    `positions` is a chain of whole steps (see `reads.group_positions`). If it reaches into the
    present step, half steps can be read too. Their two neighbours are among the three loaded
    samples.
    """

    def __init__(
        self,
        lanes: VectorBuilder,
        history: StateHistory,
        delay: IrValue,
        positions: list[int],
        row: IrValue,
    ) -> None:
        self._lanes, self._delay = lanes, delay
        self._forward = positions[0] > 0
        self._top = min(positions[0], 0) // 2
        self._length = self._top - positions[-1] // 2
        whole, self._fraction = lanes.split_fraction(delay)
        b = lanes.builder
        lane_count, lane_numbers = (
            lanes.splat(lanes.make_integer(lanes.width)),
            lanes.make_lane_numbers(),
        )
        unit = lanes.splat(lanes.make_integer(1))
        self._within = b.icmp_signed("==", whole, lanes.splat(lanes.make_integer(0)))
        back = b.select(self._within, unit, whole)
        self._addresses = lanes.compute_addresses(
            history.base, b.sub(lane_numbers, b.mul(whole, lane_count))
        )
        # a delay below one step has no finished sample ahead: it reads the last one instead
        self._ahead_addresses = lanes.compute_addresses(
            history.base, b.sub(lane_numbers, b.mul(back, lane_count))
        )
        samples = [self._load_sample(row, self._top - j) for j in range(self._length + 2)]
        self._initial = [samples[0], samples[1]] + [
            lanes.interpolate(samples[j], self._fraction, samples[j + 1])
            for j in range(1, self._length + 1)
        ]

    def _load_sample(self, row: IrValue, steps: int) -> IrValue:
        b, lanes = self._lanes.builder, self._lanes
        index = b.mul(b.add(row, lanes.make_integer(steps)), lanes.make_integer(lanes.width))
        return lanes.gather(self._addresses, index)

    def open_loop(self, loop: KernelLoop) -> None:
        """Create the values that are carried from step to step."""
        newest, *rest = self._initial
        self._newest = loop.carry(newest) if self._forward else None
        self._older, *self._chain = [loop.carry(value) for value in rest]

    def begin_step(self, time_step: TimeStep) -> None:
        """Read the values that the step needs."""
        lanes = self._lanes
        if self._forward:
            b = lanes.builder
            index = b.mul(
                b.add(time_step.row, lanes.make_integer(1)), lanes.make_integer(lanes.width)
            )
            self._sample_now = self._newest
            self._ahead = lanes.gather(self._ahead_addresses, index)
        else:
            self._sample_now = self._load_sample(time_step.row, self._top)
        self._values = [
            lanes.interpolate(self._sample_now, self._fraction, self._older),
            *self._chain,
        ]

    def read_value(self, halves: int, now: IrValue, stage: IrValue) -> IrValue:
        """Value at `halves` half steps."""
        if halves <= 0:
            return self._values[self._top - halves // 2]
        finished = self._read_ahead_whole() if halves == 2 else self._read_ahead_half()
        inside = interpolate_inside_step(self._lanes, self._delay, halves, now, stage)
        limit = self._lanes.make_number(halves / 2)
        is_inside = self._lanes.compare("<", self._delay, limit)
        return self._lanes.select(is_inside, inside, finished)

    def _read_ahead_whole(self) -> IrValue:
        return self._lanes.interpolate(self._ahead, self._fraction, self._sample_now)

    def _read_ahead_half(self) -> IrValue:
        lanes, half = self._lanes, self._lanes.make_number(0.5)
        later = lanes.interpolate(self._ahead, lanes.add(self._fraction, half), self._sample_now)
        earlier = lanes.interpolate(self._sample_now, lanes.sub(self._fraction, half), self._older)
        return lanes.select(lanes.compare("<", self._fraction, half), later, earlier)

    def end_step(self, loop: KernelLoop, following: IrValue) -> None:
        """Update the carried values."""
        if self._newest is not None:
            newest = self._lanes.builder.select(
                self._within, self._lanes.splat(following), self._ahead
            )
            loop.update(self._newest, newest)
        loop.update(self._older, self._sample_now)
        for carried, value in zip(self._chain, self._values, strict=False):
            loop.update(carried, value)


class DirectReader:
    """Interpolation of a state that is read again in every step.

    It serves predictions, which change samples after they were read, steps that are
    divided at switches in time, and cubic interpolation where there are no slopes. Cubic then means
    Lagrange through four samples. Where later samples do not exist yet, it uses three samples, or a
    line inside the present step.
    """

    def __init__(
        self,
        lanes: VectorBuilder,
        history: StateHistory,
        delay: IrValue,
        positions: set[int],
        cubic: bool,
    ) -> None:
        self._lanes, self._history, self._delay = lanes, history, delay
        self._positions, self._cubic = sorted(positions), cubic

    def open_loop(self, loop: KernelLoop) -> None:
        """Create the values that are carried from step to step."""

    def begin_step(self, time_step: TimeStep) -> None:
        """Read the values that the step needs."""
        self._time_step = time_step
        self._finished = {
            halves: self._interpolate(
                self._lanes.sub(self._lanes.make_number(halves / 2), self._delay)
            )
            for halves in self._positions
        }

    def read_value(self, halves: int, now: IrValue, stage: IrValue) -> IrValue:
        """Value at `halves` half steps."""
        if halves <= 0:
            return self._finished[halves]
        inside = interpolate_inside_step(self._lanes, self._delay, halves, now, stage)
        is_inside = self._lanes.compare("<", self._delay, self._lanes.make_number(halves / 2))
        return self._lanes.select(is_inside, inside, self._finished[halves])

    def end_step(self, loop: KernelLoop, following: IrValue) -> None:
        """Update the carried values."""

    def read_part(self, part: IrValue, now: IrValue, stage: IrValue) -> IrValue:
        """Value at any `part` of a step; the state is `now` at its start and `stage` there."""
        lanes = self._lanes
        finished = self._interpolate(lanes.sub(part, self._delay))
        portion = lanes.div(lanes.sub(part, self._delay), part)
        inside = lanes.interpolate(now, portion, stage)
        return lanes.select(lanes.compare("<", self._delay, part), inside, finished)

    def _interpolate(self, position: IrValue) -> IrValue:
        lanes = self._lanes
        whole, fraction = lanes.split_fraction(position)
        if not self._cubic:
            return lanes.interpolate(
                self._load_sample(whole, 0), fraction, self._load_sample(whole, 1)
            )
        samples = [self._load_sample(whole, j) for j in (-1, 0, 1, 2)]
        four = _interpolate_lagrange(lanes, fraction, (-1, 0, 1, 2), samples)
        three = _interpolate_lagrange(lanes, fraction, (-1, 0, 1), samples[:3])
        limit = lanes.splat(lanes.make_integer(-2))
        return lanes.select(lanes.builder.icmp_signed("<=", whole, limit), four, three)

    def _load_sample(self, whole: IrValue, steps: int) -> IrValue:
        """Load the sample `whole` + `steps` after the last finished one, at most that one."""
        lanes, b = self._lanes, self._lanes.builder
        zero = lanes.splat(lanes.make_integer(0))
        position = b.add(whole, lanes.splat(lanes.make_integer(steps)))
        position = b.select(b.icmp_signed("<", position, zero), position, zero)
        index = b.add(
            lanes.make_lane_numbers(), b.mul(position, lanes.splat(lanes.make_integer(lanes.width)))
        )
        addresses = lanes.compute_addresses(self._history.base, index)
        return lanes.gather(addresses, b.mul(self._time_step.row, lanes.make_integer(lanes.width)))


def _interpolate_lagrange(
    lanes: VectorBuilder, position: IrValue, nodes: tuple[int, ...], samples: list[IrValue]
) -> IrValue:
    """Interpolate samples at whole nodes by a polynomial, at a fraction from 0 to 1."""
    total = None
    for node, sample in zip(nodes, samples, strict=True):
        scale = 1.0
        weight = None
        for other in nodes:
            if other != node:
                scale *= node - other
                factor = lanes.sub(position, lanes.make_number(other))
                weight = factor if weight is None else lanes.mul(weight, factor)
        term = lanes.mul(lanes.mul(weight, lanes.make_number(1.0 / scale)), sample)
        total = term if total is None else lanes.add(total, term)
    return total


class InputReader:
    """Linear interpolation of a delayed input between the points of its fine grid.

    `positions` is a chain of whole or of half steps. The first is read; the others are its earlier
    values.
    """

    def __init__(
        self,
        lanes: VectorBuilder,
        floats: IrValue,
        zero: IrValue,
        points: IrValue,
        delay: IrValue,
        positions: list[int],
    ) -> None:
        b = lanes.builder
        self._lanes, self._floats, self._points, self._positions = lanes, floats, points, positions
        whole, self._fraction = lanes.split_fraction(delay)
        self._addresses = lanes.compute_addresses(floats, b.sub(lanes.splat(zero), whole))
        self._initial = [
            self._load_value(lanes.make_integer(0), halves) for halves in positions[1:]
        ]

    def _load_value(self, step: IrValue, halves: int) -> IrValue:
        lanes, b = self._lanes, self._lanes.builder
        position = b.mul(b.add(b.add(step, step), lanes.make_integer(halves)), self._points)
        position = b.ashr(position, lanes.make_integer(1))
        newest = lanes.gather(self._addresses, position)
        older = lanes.gather(self._addresses, b.sub(position, lanes.make_integer(1)))
        return lanes.interpolate(newest, self._fraction, older)

    def load_once(self, step: IrValue) -> IrValue:
        """Load the value at the only position, for a delay that holds there alone."""
        return self._load_value(step, self._positions[0])

    def open_loop(self, loop: KernelLoop) -> None:
        """Create the values that are carried from step to step."""
        self._chain = [loop.carry(value) for value in self._initial]

    def begin_step(self, time_step: TimeStep) -> None:
        """Read the values that the step needs."""
        self._values = [self._load_value(time_step.index, self._positions[0]), *self._chain]

    def read_value(self, halves: int, now: IrValue, stage: IrValue) -> IrValue:
        """Value at `halves` half steps."""
        return self._values[self._positions.index(halves)]

    def end_step(self, loop: KernelLoop, following: IrValue) -> None:
        """Update the carried values."""
        for carried, value in zip(self._chain, self._values, strict=False):
            loop.update(carried, value)
