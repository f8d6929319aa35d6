"""What explanations of residuals start from: residuals, sensitivities, and the model itself."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from sysid.core.errors import SysidError
from sysid.core.findings import Family, Move
from sysid.core.linear_algebra import compute_truncated_svd
from sysid.core.types import BoolArray, FloatArray, IntArray
from sysid.core.units import format_unit
from sysid.data.holds import Hold
from sysid.data.interpolation import interpolate_channel
from sysid.data.records import Channel, Record
from sysid.judgement.lagged_products import OutputNoise
from sysid.judgement.residual_model import ColumnFit, ResidualModel
from sysid.judgement.start_slopes import compute_start_slopes, list_assumed_starts
from sysid.kernels.signals.past_reads import is_difference, list_delayed_values
from sysid.models.kalman_filter import is_noise_parameter
from sysid.models.model import MAX_SUBSTEPS, replace_substeps
from sysid.models.ties import collect_parameter_names
from sysid.residuals.series import ResidualPart, iterate_parts
from sysid.results.findings import order_moves
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import is_at_bounds, to_unit
from sysid.uncertainty.analysis import Analysis, compute_physical_scale
from sysid.uncertainty.estimates import Estimate

_EDGE_SHARE = 0.1
"""Of an experiment at either end, in which no change is looked for. Andrews (1993) takes 0.15."""
_AFTER = 0.01  # of a period: a held input has jumped then
_MOST_STATES = 8  # whose starts are looked at
_FINER = 4  # times as many integration steps; three times where no more are allowed
_LEFT_BY_FINER = 4.0  # finer steps by 3 leave ½ of what they take out, at order 1: in squares ¼
_GAP = 30.0
"""Median intervals: a longer one is a gap of the record. Intervals between random times are
exponential, and exceed g medians with probability 2**-g. So a million of them have a longer one in
a record of a thousand (`UNLIKELY`). Measured with `benchmarks.judgement`, over eight kinds with
missing rows, uneven stamps or joined records: 10 to 100 give the same verdicts in 32 of 32."""
_MOST_GAPS = 2
"""After which another experiment may begin; each takes two full fits. In those records, and in one
of each of the 102 kinds, 1 to 4 of them give the same verdicts."""
_SHOCKS = 3  # innovations that are looked at
_START_SIMULATIONS, _MOST_START_SIMULATIONS = 3, 13  # of the slopes in a start
_MOST_POWER = 50.0  # of e: a move that is no number is no move
_SCALED_SHARE = 0.01  # of a column that a scale and an offset of the output do not explain
"""Measured with `benchmarks.judgement`, a record of each of 102 kinds, all values changed at once,
and those of `full_fits.py` too. With an `_EDGE_SHARE` of 0.05, one shock and a share of 0.001, all
statuses stay. With 0.15, six and 0.05, three records have other statuses. In both, each verdict
keeps its first word."""
_OWN_SHARE = 1e-6  # of a column that no parameter explains: less says nothing

AS_TOLD, TO_THE_NEXT = 1.5, 3.0
"""Most of the coefficient of a change that is told as it is, and of one of a size on a grid.

A coefficient of 1 is the change itself. What is further, or negative, is a change of another kind,
such as a dead zone in whose middle an input acts twice. Measured with `benchmarks.judgement`: of
true explanations 0.2 to 1.1, and 0.5 to 2.6 on the grids; of others -22 to 550."""

CUT_THERE = "Cut the record there into two, and identify each part by itself."
"""Advice: experiments of one record would share their parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An explanation of residuals by columns (n, q), in words.

    Attributes
    ----------
    explanation, family, brief, text, advice
        As in `Finding`.
    columns : FloatArray, shape (n, q)
        Weighted as the residuals.
    counted : int
        Parameters beside the coefficients, such as a position that was chosen.
    describe : callable or None
        Completes the text from the fit.
    varies : tuple of int and two floats, or None
        Number of the parameter that is not one value, and the least and largest share of the last
        coefficient that is added to it.
    moment : float or None
        Where something changes, s.
    is_whole : bool
        Whether the records that it changes are all that it says, as another reading is: not a share
        of them.
    most : float or None
        The largest coefficient of its column that its words allow, and the least is 0; None: any.
    doubtful : collection of str
        Parameters that take its place in the model, whatever the step to it: a time lag that of
        missing parts, and of clocks.
    is_vague : bool
        Whether it leaves open what the model lacks: then no parameter is safe.
    is_added : bool
        Whether it adds to the output whatever the parameters are, such as a drift of the sensor.
    setting : str
        Advice that is a setting: told after it was tried.
    change : mapping of str to object
        What it changes in the problem, as `Problem.rebuild` takes it. The model is fitted again so
        before a setting is told, and for moves that are not linear.
    """

    explanation: str
    family: Family
    columns: FloatArray
    brief: str
    text: str
    advice: str = ""
    counted: int = 0
    describe: Callable[[ColumnFit], str] | None = None
    varies: tuple[int, float, float] | None = None
    moment: float | None = None
    is_whole: bool = False
    most: float | None = None
    doubtful: Collection[str] = ()
    is_vague: bool = False
    is_added: bool = False
    setting: str = ""
    change: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_refitted(self) -> bool:
        """Whether it can be fitted in full, to the same samples."""
        return bool(self.change) and "skip" not in self.change


@dataclass(eq=False)
class Simulations:
    """Simulations that explanations take.

    Attributes
    ----------
    most : int or None
        What they may take; None: no limit.
    is_late : callable
        Whether the time of the run is over.
    spent : int
    is_cut_short : bool
        Whether some were refused.
    """

    most: int | None = None
    is_late: Callable[[], bool] = lambda: False
    spent: int = 0
    is_cut_short: bool = False

    def allow(self, count: int) -> bool:
        """Return whether so many more are allowed."""
        is_short = self.most is not None and self.spent + count > self.most
        is_refused = is_short or self.is_late()
        self.is_cut_short |= is_refused
        return not is_refused


@dataclass(frozen=True, eq=False)
class ResidualContext:
    """Residuals and sensitivities of an estimate by squares, and simulations with other inputs.

    Attributes
    ----------
    problem : Problem
    theta : FloatArray, shape (D,)
    analysis : Analysis
        Of squares, not whitened.
    simulations : Simulations
        What is not allowed is not simulated: such values are ``nan``.
    """

    problem: Problem
    theta: FloatArray
    analysis: Analysis
    simulations: Simulations = field(default_factory=Simulations)

    @cached_property
    def parts(self) -> list[ResidualPart]:
        """Scored samples of each output of each experiment."""
        return list(iterate_parts(self.problem))

    @cached_property
    def weight(self) -> FloatArray:
        """Weights (n,) of the scored samples."""
        return self.problem.evaluator.weight[self.problem.scored_rows]

    @cached_property
    def times(self) -> FloatArray:
        """Times (n,) of the scored samples, s."""
        return np.concatenate([part.times for part in self.parts])

    @cached_property
    def gap_ends(self) -> list[float]:
        """Times (s) of the samples after the largest gaps of a single series."""
        if len(self.parts) > 1:
            return []
        is_gap = find_gaps(self.times)
        longest = np.argsort(-np.diff(self.times) * is_gap, kind="stable")[:_MOST_GAPS]
        return [float(self.times[one + 1]) for one in sorted(longest.tolist()) if is_gap[one]]

    @cached_property
    def simulation(self) -> FloatArray:
        """Simulated values (n,) of the scored samples."""
        return self._predict(self.problem)

    @cached_property
    def measurement(self) -> FloatArray:
        """Measured values (n,) of the scored samples."""
        return self.problem.evaluator.measured[self.problem.scored_rows]

    @cached_property
    def slope(self) -> FloatArray:
        """Slope (n,) of the simulated values in time."""
        slope = np.zeros(self.times.size)
        for part in self.parts:
            if part.times.size > 1:
                with np.errstate(all="ignore"):
                    found = np.gradient(self.simulation[part.rows], part.times)
                slope[part.rows] = np.where(np.isfinite(found), found, 0.0)
        return slope

    @cached_property
    def residual_model(self) -> ResidualModel:
        """Likelihood of the residuals under columns and coloured noise.

        Errors of the integration are taken out first. They are the program's, and no defect: an
        input that jumps inside a step leaves one, and under coloured noise even a small one shows.
        A record that was simulated with the same steps has none: then they stay, by the criterion.

        A parameter that the data push over its bound has no column. Where a bound holds, the
        tangent space of a model is that of the others (Chernoff, Ann. Math. Stat. 25 (1954) 573).
        """
        assert self.analysis.residuals_and_sensitivities is not None
        error, columns = self.analysis.residuals_and_sensitivities
        columns = np.where(self._is_held, 0.0, hold_noise(self.problem, columns))
        plain = ResidualModel(-error, columns, self.parts)
        if not self._integration_error.any():
            return plain
        left = float(np.mean(np.square(self._integration_error))) / _LEFT_BY_FINER
        exact = ResidualModel(-error - self._integration_error, columns, self.parts, left)
        return min(exact, plain, key=lambda model: model.without.criterion)

    @property
    def is_of_the_solver(self) -> bool:
        """Whether the residuals are no larger than what the integration's steps leave."""
        model = self.residual_model
        return float(np.mean(np.square(model.residuals))) <= model.least

    @cached_property
    def _is_held(self) -> BoolArray:
        """Which parameters (D,) a bound holds."""
        assert self.analysis.residuals_and_sensitivities is not None
        error, columns = self.analysis.residuals_and_sensitivities
        columns = hold_noise(self.problem, columns)
        return find_held(self.problem, self.theta, -error, columns)

    def take(self, columns: FloatArray) -> "ResidualContext":
        """Return the context beside columns (n, q), as if they were those of parameters."""
        other, model = copy(self), self.residual_model
        joined = np.hstack([model.columns, columns])
        vars(other)["residual_model"] = ResidualModel(
            model.residuals, joined, self.parts, model.least
        )
        vars(other).pop("_bases", None)
        return other

    @cached_property
    def _integration_error(self) -> FloatArray:
        """What a finer step adds to the weighted outputs (n,)."""
        nothing = np.zeros(self.times.size)
        model = self.problem.untied_model
        steps = min(_FINER * model.solver.substeps, MAX_SUBSTEPS)
        if is_difference(model) or steps < (_FINER - 1) * model.solver.substeps:
            return nothing
        try:
            finer = self.problem.rebuild(
                model=replace_substeps(model, steps), weights=self.problem.output_weights
            )
        except SysidError:
            return nothing
        added = self._predict(finer) - self.simulation
        return self.weight * added if np.all(np.isfinite(added)) else nothing

    @cached_property
    def parameter_numbers(self) -> list[tuple[int, str]]:
        """Numbers and names of the free parameters that the document declares.

        So neither initial states nor the noise of a filter are among them.
        """
        names = {parameter.name for parameter in self.problem.given_model.parameters}
        return [(d, name) for d, name in enumerate(self.problem.free_names) if name in names]

    @cached_property
    def delays(self) -> set[str]:
        """Names of the free parameters that time lags depend on."""
        return find_delay_parameters(self.problem)

    def weigh(self, values: FloatArray) -> FloatArray:
        """Weight values (n,) or (n, q) of the outputs, as a column or columns (n, q)."""
        columns = values[:, None] if values.ndim == 1 else values
        return self.weight[:, None] * columns

    def compute_moves(
        self,
        fit: ColumnFit,
        before: ColumnFit | None = None,
        varies: tuple[int, float, float] | None = None,
    ) -> tuple[Move, ...]:
        """Compute how far a fit moves the parameters, the furthest first.

        They move from the estimate, or from the fit `before` to which an explanation is added. A
        parameter that varies moves to that of its values that is furthest.
        """
        d = self.theta.size
        scale = compute_physical_scale(self.problem, self.theta)
        moved, errors = fit.coefficients[:d] * scale, fit.errors[:d] * scale
        start = np.zeros(d) if before is None else before.coefficients[:d] * scale
        ends = {number: [float(moved[number])] for number, _ in self.parameter_numbers}
        if varies is not None:
            number, *shares = varies
            change = float(fit.coefficients[-1] * scale[number])
            ends[number] = [float(moved[number]) + share * change for share in shares]
        known = {estimate.name: estimate for estimate in self.analysis.estimates}
        return order_moves(
            Move(
                name,
                self.move_value(number, end),
                self._move_error(number, end, float(errors[number])),
                float(end - start[number]) / stderr,
            )
            for number, name in self.parameter_numbers
            if (stderr := known[name].stderr) and not self._is_held[number]
            for end in ends[number]
        )

    def move_value(self, number: int, move: float) -> float:
        """Move the value of a parameter, by a step that is linear on its scale.

        On a log scale a move by the value itself is a factor of e, so no value becomes negative.
        """
        value = float(self.theta[number])
        if not self.problem.evaluator.is_log[number]:
            return value + move
        return value * float(np.exp(np.clip(move / value, -_MOST_POWER, _MOST_POWER)))

    def _move_error(self, number: int, move: float, error: float) -> float:
        """Convert the standard error at the estimate to that of a moved value."""
        if not self.problem.evaluator.is_log[number]:
            return error
        return error * self.move_value(number, move) / float(self.theta[number])

    @cached_property
    def declared_estimates(self) -> list[Estimate]:
        """Estimates of the parameters that the model declares."""
        names = {name for _, name in self.parameter_numbers}
        return [one for one in self.analysis.estimates if one.name in names]

    def scales(self, name: str) -> bool:
        """Return whether a parameter only scales or shifts what is simulated."""
        (number,) = (d for d, one in self.parameter_numbers if one == name)
        column = self.residual_model.columns[:, number]
        basis = self.weigh(np.column_stack([np.ones(self.times.size), self.simulation]))
        rest = column - basis @ np.linalg.lstsq(basis, column, rcond=None)[0]
        return bool(rest @ rest < _SCALED_SHARE * (column @ column))

    @cached_property
    def start_slopes(self) -> list[FloatArray]:
        """Slopes (n,) of the outputs in the start of each state, estimated or not."""
        declared = {number for number, _ in self.parameter_numbers}
        columns = self.residual_model.columns
        own = [columns[:, d] for d in range(self.theta.size) if d not in declared]
        own += [np.sum(slopes, axis=1) for slopes in self.fixed_start_slopes]
        return [column for column in own if column.any()]

    def shift_start(self, slope: FloatArray, position: int) -> FloatArray:
        """Let the effect (n,) of a start begin at a sample: that of a jump of the state there.

        It is that on all outputs of its experiment.
        """
        experiment, moment = self.find_experiment(position), float(self.times[position])
        shifted = np.zeros(slope.size)
        for part in self.parts:
            first = int(np.searchsorted(part.times, moment))
            if part.experiment == experiment and first < part.times.size:
                length = part.times.size - first
                shifted[part.rows.start + first : part.rows.stop] = slope[part.rows][:length]
        return shifted

    def simulate(self, records: Sequence[Record]) -> FloatArray:
        """Simulate the scored values (n,) with other inputs, or outputs that are means.

        They are ``nan`` if no more simulations are allowed.
        """
        pairs = zip(self.problem.records, records, strict=True)
        if all(_differ_in_inputs_only(before, after) for before, after in pairs):
            return self._predict(self.problem.replace_inputs(records))
        weights = self.problem.output_weights
        return self._predict(self.problem.rebuild(records=records, weights=weights))

    def compute_effect(self, records: Sequence[Record]) -> FloatArray | None:
        """Compute what other inputs add to the simulated values (n,), as `simulate` has them.

        None if that is nothing, no number, or not to be simulated.
        """
        try:
            added = self.simulate(records) - self.simulation
        except SysidError:
            return None
        return added if np.all(np.isfinite(added)) and added.any() else None

    def replace_input(
        self, name: str, change: Callable[[FloatArray], FloatArray], hold: Hold | None = None
    ) -> list[Record]:
        """Replace the values (N,) of an input in all records, and its hold if one is given."""
        records = []
        for record in self.problem.records:
            inputs = tuple(
                replace(
                    channel,
                    values=change(channel.values),
                    hold=channel.effective_hold if hold is None else hold,
                )
                if channel.name == name
                else channel
                for channel in record.inputs
            )
            records.append(replace(record, inputs=inputs))
        return records

    @cached_property
    def fixed_start_slopes(self) -> list[FloatArray]:
        """Slopes (n, E) of the outputs in each start that is not estimated; none if they are many.

        Not of predictions one step ahead, which forget their start.
        """
        states = list_assumed_starts(self.problem)
        if not self.problem.is_free_run or len(states) > _MOST_STATES:
            return []
        if not self.simulations.allow(_MOST_START_SIMULATIONS * len(states)):
            return []
        noise = float(np.sqrt(np.mean(np.square(self.residual_model.residuals))))
        self.simulations.spent += _START_SIMULATIONS * len(states)
        return [compute_start_slopes(self.problem, self.theta, one, noise) for one in states]

    @cached_property
    def inputs(self) -> list[str]:
        """Names of the inputs of the model."""
        return [signal.name for signal in self.problem.model.inputs]

    @cached_property
    def moving_inputs(self) -> list[Channel]:
        """Inputs of the model that move, as they are in the first record in which they do."""
        names = {signal.name for signal in self.problem.model.inputs}
        found: dict[str, Channel] = {}
        for record in self.problem.records:
            for channel in record.inputs:
                if channel.name in names and np.ptp(channel.values) > 0:
                    found.setdefault(channel.name, channel)
        return list(found.values())

    def read_input(self, name: str, lag: float = 0.0) -> FloatArray:
        """Read an input at the times (n,) of the samples, `lag` periods before.

        A held input is read after its jump.
        """
        values = np.zeros(self.times.size)
        for part in self.parts:
            for channel in self.problem.records[part.experiment].inputs:
                if channel.name == name:
                    values[part.rows] = read_channel(channel, part.times, lag)
        return values

    def choose_columns(self, columns: FloatArray) -> list[int]:
        """Choose the likeliest of columns (n, q) of the outputs, under white and coloured noise."""
        model, chosen = self.residual_model, dict[int, None]()
        weighted = self.weigh(columns)
        for noise, basis, residual in self._bases:
            whitened = (weighted if noise is None else model.whiten(weighted, noise))[self._order]
            own = np.sum(np.square(whitened), axis=0)
            rest = own - np.sum(np.square(basis.T @ whitened), axis=0)
            is_own = rest > _OWN_SHARE * own
            score = np.where(is_own, (residual @ whitened) ** 2 / np.where(is_own, rest, 1.0), 0.0)
            if score.any():
                chosen[int(np.argmax(score))] = None
        return list(chosen)

    def find_breaks(self, column: FloatArray) -> list[tuple[float, FloatArray, str]]:
        """Find where a column (n,) most likely begins to count, under white and coloured noise.

        Returns the time (s), the column from there on, and where that is in words. Each moment of
        each experiment is tried, with the noise of no explanation (sup-F test: Andrews,
        Econometrica 61 (1993) 821).
        """
        model, found = self.residual_model, dict[int, tuple[float, FloatArray, str]]()
        for noise, basis, residual in self._bases:
            whitened = (column if noise is None else model.whiten(column, noise))[self._order]
            ends = self._ends
            own = _sum_from(np.square(whitened), ends)
            shared = _sum_from(basis * whitened[:, None], ends)
            along = _sum_from(residual * whitened, ends)
            rest = own - np.sum(np.square(shared), axis=1)
            is_own = self._may_break & (rest > _OWN_SHARE * float(np.max(own, initial=0.0)))
            score = np.where(is_own, along**2 / np.where(is_own, rest, 1.0), 0.0)
            best = int(np.argmax(score))
            if score[best] > 0 and best not in found:
                found[best] = self._begin_late(column, best)
        return list(found.values())

    def find_late(self, column: FloatArray) -> list[tuple[float, FloatArray, str]]:
        """Let a column (n,) begin to count at each of the largest innovations, as `find_breaks`.

        Not at the ends of an experiment: what is wrong there is its start.
        """
        positions = np.argsort(self._order)[self.find_shocks()].tolist()
        return [self._begin_late(column, one) for one in positions if self._may_break[one]]

    def _begin_late(self, column: FloatArray, position: int) -> tuple[float, FloatArray, str]:
        late, members = np.zeros(column.size), self._order[position : self._ends[position]]
        late[members] = column[members]
        moment = float(self.times[self._order[position]])
        experiment = self.find_experiment(int(self._order[position]))
        return moment, late, self.describe_moment(moment, experiment)

    def find_shocks(self) -> list[int]:
        """Find the largest innovations, as numbers of samples."""
        sizes = np.abs(self.residual_model.without.innovations)
        return [int(row) for row in np.argsort(-sizes)[:_SHOCKS]]

    def find_experiment(self, position: int) -> int:
        """Find the number of the experiment that a sample is of."""
        return int(self._experiments[position])

    def describe_moment(self, moment: float, experiment: int) -> str:
        """Describe a moment (s) of an experiment."""
        where = f" of experiment {experiment + 1}" if len(self.problem.records) > 1 else ""
        return f"{moment:.4g} s{where}"

    @cached_property
    def _experiments(self) -> IntArray:
        numbers = [np.full(part.times.size, part.experiment) for part in self.parts]
        return np.concatenate(numbers)

    @cached_property
    def _order(self) -> IntArray:
        return np.lexsort((self.times, self._experiments))

    @cached_property
    def _ends(self) -> IntArray:
        experiments = self._experiments[self._order]
        return np.searchsorted(experiments, experiments, side="right")

    @cached_property
    def _may_break(self) -> BoolArray:
        experiments, times = self._experiments[self._order], self.times[self._order]
        allowed = np.zeros(times.size, dtype=np.bool_)
        for number in np.unique(experiments):
            rows = np.flatnonzero(experiments == number)
            first = int(_EDGE_SHARE * rows.size) + 1
            allowed[rows[first : rows.size - first]] = True
            if number > 0:
                allowed[rows[0]] = True  # the whole experiment differs
        return allowed

    @cached_property
    def _bases(self) -> list[tuple[tuple[OutputNoise, ...] | None, FloatArray, FloatArray]]:
        """Basis (n, D) of the slopes and residuals (n,), under white and coloured noise."""
        model, bases = self.residual_model, []
        base = model.without
        for noise in (None, base.noise) if base.is_coloured else (None,):
            columns, residuals = model.columns, model.residuals
            if noise is not None:
                columns, residuals = model.whiten(columns, noise), model.whiten(residuals, noise)
            left, _, _, retained = compute_truncated_svd(columns)
            basis = left[:, retained]
            rest = residuals - basis @ (basis.T @ residuals)
            bases.append((noise, basis[self._order], rest[self._order]))
        return bases

    def _predict(self, problem: Problem) -> FloatArray:
        if not self.simulations.allow(1):
            return np.full(self.times.size, np.nan)
        self.simulations.spent += 1
        values = problem.predict(self.theta[None])[0][problem.scored_rows]
        return np.asarray(values)

    def iterate_outputs(self) -> Iterator[tuple[str, BoolArray, str]]:
        """Iterate over the outputs: name, rows (n,), unit."""
        for output in self.problem.model.outputs:
            rows = np.zeros(self.times.size, dtype=np.bool_)
            for part in self.parts:
                if part.output == output.name:
                    rows[part.rows] = True
            if rows.any():
                yield output.name, rows, format_unit(output.unit)


def hold_noise(problem: Problem, columns: FloatArray) -> FloatArray:
    """Hold the sizes of noise in sensitivities (n, D): their columns become 0.

    A size scales the innovations. So its column is nearly the residuals themselves where it is at a
    bound, and a linear step along it would explain anything. The information of Gaussian noise has
    no term between its mean and its sizes, so holding them costs nothing.
    """
    is_size = np.array([is_noise_parameter(name) for name in problem.free_names], dtype=bool)
    return np.where(is_size, 0.0, columns)


def find_held(
    problem: Problem, theta: FloatArray, residuals: FloatArray, columns: FloatArray
) -> BoolArray:
    """Find which parameters (D,) lie at a bound that the data push them over.

    One after another, as an active set: a parameter that is held changes what the others want.
    """
    parts = list(iterate_parts(problem))
    is_low, is_high = is_at_bounds(to_unit(problem.evaluator, theta[None])[0])
    is_held = np.zeros(theta.size, dtype=np.bool_)
    while np.any((is_low | is_high) & ~is_held):
        free = ResidualModel(residuals, np.where(is_held, 0.0, columns), parts)
        step = free.without.coefficients
        is_pushed = ~is_held & ((is_low & (step < 0.0)) | (is_high & (step > 0.0)))
        if not is_pushed.any():
            break
        is_held |= is_pushed
    return is_held


def read_channel(channel: Channel, times: FloatArray, lag: float) -> FloatArray:
    """Read a channel at times (n,) of samples, `lag` periods before; missing values are bridged.

    A held one is read after its jump.
    """
    channel = channel.acting
    period = float(np.ptp(times)) / max(times.size - 1, 1)
    after = _AFTER if channel.effective_hold == "zero" else 0.0
    return interpolate_known(channel, times + (after - lag) * period)


def interpolate_known(channel: Channel, times: FloatArray) -> FloatArray:
    """Interpolate the values of a channel that are not missing."""
    known = np.isfinite(channel.values)
    if not known.all():
        channel = replace(
            channel, times=channel.times[known], values=channel.values[known], repeats=None
        )
    return interpolate_channel(channel, times)


def _differ_in_inputs_only(before: Record, after: Record) -> bool:
    """Whether records have the same outputs, and inputs that begin at the same times."""
    if any(one is not other for one, other in zip(before.outputs, after.outputs, strict=True)):
        return False
    return [one.times[0] for one in before.inputs] == [one.times[0] for one in after.inputs]


def find_gaps(times: FloatArray) -> BoolArray:
    """Find the intervals (N - 1,) between times (N,) that are gaps, and no sampling."""
    intervals = np.diff(times)
    return np.asarray(intervals > _GAP * float(np.median(intervals)))


def find_delay_parameters(problem: Problem) -> set[str]:
    """Find the names of the free parameters that time lags depend on."""
    names = problem.share("delay parameters", lambda: _collect_delay_parameters(problem))
    return names & set(problem.free_names)


def _collect_delay_parameters(problem: Problem) -> set[str]:
    past_values = [
        *list_delayed_values(problem.model, "input"),
        *list_delayed_values(problem.model, "state"),
    ]
    names: set[str] = set()
    for past_value in past_values:
        if past_value.delay is not None:
            names |= collect_parameter_names(past_value.delay)
    return names


def _sum_from(values: FloatArray, ends: IntArray) -> FloatArray:
    """Sum values (n, …) from each position up to the end of its experiment."""
    totals = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    return np.asarray(totals[ends] - totals[:-1])
