"""Loss: comparison of simulated and measured outputs, inside the time loop."""

from sysid.kernels.expression_code import emit_expression
from sysid.kernels.integrators import EnvironmentBuilder
from sysid.kernels.layout import KernelVariant
from sysid.kernels.signals.block_signals import ExperimentHead, States
from sysid.kernels.signals.delayed_reads import TimeStep
from sysid.kernels.vectors import INT, IrValue, KernelLoop, VectorBuilder
from sysid.language.tree import match_plain_state
from sysid.models.model import Model


class LossAccumulator:
    """Sums of the loss over the grid points; predictions are stored on request.

    `sums` are the loss, and if measurements correct the states that of log S.
    """

    def __init__(
        self,
        lanes: VectorBuilder,
        model: Model,
        variant: KernelVariant,
        experiment: ExperimentHead,
        arguments: dict[str, IrValue],
        first: IrValue,
    ) -> None:
        self._lanes, self._model, self._variant = lanes, model, variant
        self._experiment, self._arguments, self._column = experiment, arguments, first
        b = lanes.builder
        address = b.ptrtoint(arguments["predictions"], INT)
        self._stores = b.icmp_signed("!=", address, lanes.make_integer(0))
        number = 2 if model.corrections else 1
        self.sums = [lanes.splat(lanes.make_number(0.0))] * number
        self._earlier: list[IrValue] = []

    def open_loop(self, loop: KernelLoop) -> None:
        """Carry the sums, and the last outputs if samples lie between grid points."""
        self._carried_sums = [loop.carry(value) for value in self.sums]
        self.sums = list(self._carried_sums)
        if not self._variant.on_grid:
            zero = self._lanes.splat(self._lanes.make_number(0.0))
            self._earlier = [loop.carry(zero) for _ in self._model.outputs]
        self._carried_earlier = list(self._earlier)

    def compare_step(
        self, time_step: TimeStep, states: States, build_environment: EnvironmentBuilder
    ) -> None:
        """Compare if the step is a grid point; predictions then correct or replace the states."""
        lanes, b = self._lanes, self._lanes.builder
        substeps = self._substeps
        if substeps == 1:
            self._compare_grid_point(time_step.index, states, build_environment)
            return
        number = lanes.make_integer(substeps)
        grid = b.sdiv(time_step.index, number)
        before = [*self.sums, *self._earlier, *states.now.values()]

        def body() -> list[IrValue]:
            self._compare_grid_point(grid, states, build_environment)
            return [*self.sums, *self._earlier, *states.now.values()]

        is_grid = b.icmp_signed("==", b.mul(grid, number), time_step.index)
        merged = lanes.branch(is_grid, body, before)
        first, last = len(self.sums), len(self.sums) + len(self._earlier)
        self.sums, self._earlier = merged[:first], merged[first:last]
        states.now = dict(zip(states.names, merged[last:], strict=True))

    def end_step(self, loop: KernelLoop) -> None:
        """Update the carried values; after the loop, `sums` are those of the last step."""
        carried = [*self._carried_sums, *self._carried_earlier]
        for before, value in zip(carried, [*self.sums, *self._earlier], strict=True):
            loop.update(before, value)

    @property
    def _substeps(self) -> int:
        return self._model.solver.substeps

    def _compare_grid_point(
        self, grid: IrValue, states: States, build_environment: EnvironmentBuilder
    ) -> None:
        lanes = self._lanes
        if self._model.corrections:
            self._correct_states(grid, states, build_environment)
            return
        scope = build_environment(0, dict(states.now), -1)
        outputs = [
            lanes.splat(emit_expression(lanes, output.expression, scope))
            for output in self._model.outputs
        ]
        for i, value in enumerate(outputs):
            if self._variant.on_grid:
                self._compare_sample(i, grid, value)
            else:
                self._compare_interval(i, grid, value)
        if self._variant.one_step:
            self._replace_states(grid, states)

    def _compare_sample(self, i: int, grid: IrValue, value: IrValue) -> None:
        """Compare the one sample that an output may have on this grid point."""
        self.sums[0] = self._lanes.add(self.sums[0], self._emit_cost(i, grid, value))
        self._store_sample(i, grid, [value])

    def _store_sample(self, i: int, grid: IrValue, values: list[IrValue]) -> None:
        """Store the prediction of a sample on this grid point, and its deviation."""
        lanes, b = self._lanes, self._lanes.builder

        def store() -> list[IrValue]:
            index = b.add(self._experiment.get_output_field(i, "samples"), grid)
            row = lanes.load_integer(self._experiment.ints, index)
            is_sample = b.icmp_signed(">=", row, lanes.make_integer(0))
            lanes.branch(is_sample, lambda: store_in(row), [])
            return []

        def store_in(row: IrValue) -> list[IrValue]:
            for value in values:
                self._store_prediction(row, value)
                row = b.add(row, self._experiment.get_head("deviations"))
            return []

        lanes.branch(self._stores, store, [])

    def _compare_interval(self, i: int, grid: IrValue, value: IrValue) -> None:
        """Compare the samples between the last grid point and this one."""
        lanes, b, experiment = self._lanes, self._lanes.builder, self._experiment
        bounds = b.add(experiment.get_output_field(i, "samples"), grid)
        start = lanes.load_integer(experiment.ints, bounds)
        stop = lanes.load_integer(experiment.ints, b.add(bounds, lanes.make_integer(1)))
        loop = KernelLoop(lanes)
        sample, loss = loop.carry(start), loop.carry(self.sums[0])
        loop.leave_if(b.icmp_signed(">=", sample, stop))
        index = b.add(experiment.get_output_field(i, "fraction"), sample)
        between = lanes.interpolate(
            self._earlier[i], lanes.load_double(experiment.floats, index), value
        )
        following = lanes.add(loss, self._emit_cost(i, sample, between))

        def store() -> list[IrValue]:
            return self._store_prediction(
                b.add(experiment.get_output_field(i, "first"), sample), between
            )

        lanes.branch(self._stores, store, [])
        loop.update(sample, b.add(sample, lanes.make_integer(1)))
        loop.update(loss, following)
        loop.repeat()
        self.sums[0] = loss
        self._earlier[i] = value

    def _emit_cost(self, i: int, sample: IrValue, value: IrValue) -> IrValue:
        """Emit the loss of one sample: w²e², or 2s²(√(1 + (we/s)²) - 1) without cancellation."""
        lanes = self._lanes
        error = lanes.sub(value, self._load_of_output(i, "measured", sample))
        if self._variant.weighted:
            error = lanes.mul(error, self._load_of_output(i, "weight", sample))
        square = lanes.mul(error, error)
        if not self._variant.soft:
            return square
        scale, unit = self._experiment.get_number("scale"), lanes.make_number(1.0)
        ratio = lanes.div(square, lanes.mul(scale, scale))
        root = lanes.call_intrinsic("sqrt", lanes.add(unit, ratio))
        return lanes.div(lanes.mul(lanes.make_number(2.0), square), lanes.add(unit, root))

    def _load_of_output(self, i: int, field: str, place: IrValue) -> IrValue:
        index = self._lanes.builder.add(self._experiment.get_output_field(i, field), place)
        return self._lanes.load_double(self._experiment.floats, index)

    def _store_prediction(self, row: IrValue, value: IrValue) -> list[IrValue]:
        b = self._lanes.builder
        index = b.add(b.mul(row, self._arguments["predictions_stride"]), self._column)
        self._lanes.store_row(value, self._arguments["predictions"], index)
        return []

    def _correct_states(
        self, grid: IrValue, states: States, build_environment: EnvironmentBuilder
    ) -> None:
        """Compare each output in turn, and correct the states by it before the next one.

        So an output is predicted from all samples before it, those of the other outputs at the
        same time included (Durbin and Koopman, Time Series Analysis by State Space Methods, 2nd
        ed., ch. 6.4).
        """
        lanes, unit = self._lanes, self._lanes.make_number(1.0)
        corrections = {one.output: one for one in self._model.corrections}
        for i, output in enumerate(self._model.outputs):
            scope = build_environment(0, dict(states.now), -1)
            value = lanes.splat(emit_expression(lanes, output.expression, scope))
            correction, weight = (
                corrections[output.name],
                self._load_of_output(i, "precision", grid),
            )
            squared = lanes.mul(weight, weight)
            own = emit_expression(lanes, correction.variance, scope)
            variance = lanes.splat(lanes.add(unit, lanes.mul(squared, own)))
            self._add_innovation(i, grid, value, variance)
            factor = lanes.div(squared, variance)
            innovation = lanes.sub(self._load_of_output(i, "measured", grid), value)
            for pairs, change in (
                (correction.gains, lanes.mul(factor, innovation)),
                (correction.losses, lanes.sub(lanes.make_number(0.0), factor)),
            ):
                for state, tree in pairs:
                    moved = lanes.mul(emit_expression(lanes, tree, scope), change)
                    states.now[state] = lanes.splat(lanes.add(states.now[state], moved))

    def _add_innovation(self, i: int, grid: IrValue, value: IrValue, variance: IrValue) -> None:
        lanes = self._lanes
        logarithm = lanes.call_intrinsic("log", variance)
        if self._variant.weighted:
            weight, zero = self._load_of_output(i, "weight", grid), lanes.make_number(0.0)
            is_scored = lanes.compare("!=", weight, zero)
            logarithm = lanes.select(is_scored, logarithm, lanes.splat(zero))
        cost = lanes.div(self._emit_cost(i, grid, value), variance)
        self.sums = [lanes.add(a, b) for a, b in zip(self.sums, (cost, logarithm), strict=True)]
        self._store_sample(i, grid, [value, lanes.call_intrinsic("sqrt", variance)])

    def _replace_states(self, grid: IrValue, states: States) -> None:
        """Replace states by measurements, for one-step prediction."""
        for i, output in enumerate(self._model.outputs):
            name = match_plain_state(output.expression)
            if name is not None:
                index = self._lanes.builder.add(self._experiment.get_output_field(i, "grid"), grid)
                value = self._lanes.load_double(self._experiment.floats, index)
                states.now[name] = self._lanes.splat(value)
