"""Suspects: what may have left residuals that are not noise, compared by likelihood.

Drift, a step disturbance, a wrong start, outliers, a sensor at its limit or stuck, coloured noise
and missing dynamics look alike to a test of whiteness. So each is fitted to the residuals together
with the linear model of the outputs, which costs no simulation. The largest gain names the suspect:

    gain = n ln(Σe²₀/Σe²) − q ln n

with the sums of squares before and after, and q parameters (Schwarz 1978). The position of a step
counts as one. Outliers are compared by the likelihood of Student's t, slow noise by that of a
first-order process. Samples at a limit are left out: any value beyond it gives the same reading.
So are runs of equal readings, where a reading otherwise differs from the one before.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import lgamma, log
from typing import Any

import numpy as np

from sysid.core.linear_algebra import compute_truncated_svd
from sysid.core.types import BoolArray, FloatArray
from sysid.core.units import format_unit
from sysid.data.interpolation import interpolate_channel
from sysid.residuals.series import ResidualPart, iterate_parts
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis

_MIN_GAIN = 10.0
_MIN_SAMPLES = 40
_POSITIONS = 100  # of a record, between which an offset begins and ends
_START_SHARE = 0.1  # of a record: an offset that ends so early is one of the start
_OWN_SHARE = 1e-3  # of an offset that no parameter explains: less says nothing
_OUTLYING = 6.0  # robust deviations
_LARGE, _MOST_PAIRS = 4.0, 0.3  # robust deviations; share of large residuals
_LAGS = 16  # past values of each input, denser towards the present, over a quarter of the record
_NOISE_SHARE = 0.5  # of its likelihood gain
_TAIL_DEGREES = 3.0  # of Student's t
_MIN_LIMIT_SAMPLES = 5  # at the largest or smallest value
_LIMIT_SHARE = 0.02  # of the samples
_STUCK_SAMPLES = 10  # equal readings in a row
_MOVING = 0.7  # of the other readings: they differ from those before
_ONE_SIDED = 0.8  # of the residuals at a limit: the model is beyond it


@dataclass(frozen=True, slots=True)
class Suspect:
    """What may explain residuals, its likelihood gain, and the option that cures it.

    `is_seen`: the measurement itself shows it, so it is named before what only fits. `share` of the
    gain counts: a noise model follows any slow misfit, of whatever cause.
    """

    name: str
    gain: float
    cure: str
    is_seen: bool = False
    share: float = 1.0


DYNAMICS = "dynamics that the model lacks"


def find_suspects(problem: Problem, analysis: Analysis, *, are_white: bool) -> list[Suspect]:
    """Find what explains the residuals of least squares, the most likely first.

    White residuals are searched for single values only, such as outliers. Beside a noise model,
    which follows any course, only those count that the measurement itself shows.
    """
    if analysis.residuals_and_sensitivities is None or problem.loss_scale:
        return []
    error, columns = analysis.residuals_and_sensitivities
    if not np.any(error) or error.size < max(_MIN_SAMPLES, 2 * columns.shape[1]):
        return []
    known = None if analysis.is_whitened else analysis.decomposition
    left, _, _, retained = known or compute_truncated_svd(columns)
    fit = _LinearFit(problem, error, left[:, retained])
    suspects = [one for part in iterate_parts(problem) for one in fit.list_values(part)]
    if analysis.is_whitened:
        suspects = [one for one in suspects if one.is_seen]
    elif not are_white:
        suspects += [one for part in iterate_parts(problem) for one in fit.list_courses(part)]
        suspects.append(fit.fit_dynamics())
    clear = (one for one in suspects if one.gain > _MIN_GAIN)
    return sorted(clear, key=lambda one: (not one.is_seen, -one.share * one.gain))


def describe_suspects(suspects: Sequence[Suspect]) -> str:
    """Describe the most likely suspect with its cure, and the next one."""
    first, *others = suspects
    other = next((f"; {one.name}: {one.gain:.0f}" for one in others if one.name != first.name), "")
    return f"{first.name} (likelihood gain {first.gain:.0f}{other}). {first.cure}"


@dataclass(frozen=True, slots=True)
class _LeftOut:
    """Residuals of samples that were left out, and the likelihood gain of the others."""

    left_out: FloatArray
    gain: float


class _LinearFit:
    """Residuals (n,) without what the parameters explain, and the basis (n, D) of their slopes."""

    def __init__(self, problem: Problem, error: FloatArray, basis: FloatArray) -> None:
        self._problem, self._basis = problem, basis
        self._error = error - basis @ (basis.T @ error)
        self._power = float(self._error @ self._error)

    def list_values(self, part: ResidualPart) -> Iterator[Suspect]:
        """List what single values of one output of one experiment may show."""
        if part.times.size >= _MIN_SAMPLES:
            where = self._name_part(part)
            sizes = np.abs(self._error[part.rows])
            if np.max(sizes) > _OUTLYING * 1.4826 * float(np.median(sizes)):
                yield self._fit_tails(part, where)
            at_limit = list(self._leave_out_limit(part, where))
            yield from at_limit or self._leave_out_stuck(part, where)

    def list_courses(self, part: ResidualPart) -> Iterator[Suspect]:
        """List what the course of one output of one experiment may show."""
        if part.times.size >= _MIN_SAMPLES:
            where = self._name_part(part)
            yield self._fit_drift(part, where)
            yield self._fit_change(part, where)
            yield self._fit_noise(part, where)

    def _name_part(self, part: ResidualPart) -> str:
        several = len(self._problem.records) > 1
        return f"{part.output} of experiment {part.experiment + 1}" if several else part.output

    def fit_dynamics(self) -> Suspect:
        """Fit past values of the inputs."""
        regressors = [
            self._pad(part, values)
            for part in iterate_parts(self._problem)
            for values in self._list_past_inputs(part)
        ]
        gain = 0.0  # no input moves
        if regressors:
            gain = self._compute_gain(np.column_stack(regressors), len(regressors))
        return Suspect(DYNAMICS, gain, "Try a model of another order")

    def _list_past_inputs(self, part: ResidualPart) -> Iterator[FloatArray]:
        record = self._problem.records[part.experiment]
        names = {one.name for one in self._problem.model.inputs}
        period = float(np.ptp(part.times)) / part.times.size
        lags = np.unique(np.geomspace(1.0, part.times.size / 4, _LAGS).astype(np.int64)) - 1
        for channel in record.inputs:
            if channel.name in names and np.ptp(channel.values) > 0:
                for lag in lags.tolist():
                    values = interpolate_channel(channel, part.times - lag * period)
                    yield values - np.mean(values)

    def _fit_drift(self, part: ResidualPart, where: str) -> Suspect:
        line = [self._pad(part, part.times**power) for power in (0, 1)]
        cure = (
            f"Add drift*t to output {part.output} in the model's document, and drift to its "
            "parameters"
        )
        return Suspect(f"a drift of {where}", self._compute_gain(np.column_stack(line), 2), cure)

    def _fit_change(self, part: ResidualPart, where: str) -> Suspect:
        """Fit an offset of a span, at the best of some positions."""
        n, start = part.times.size, part.rows.start
        edges = np.unique(np.linspace(0, n, _POSITIONS + 1).astype(np.int64))
        first, last = (edges[index] for index in np.triu_indices(edges.size, 1))
        is_part = last - first < n
        first, last = first[is_part], last[is_part]
        sums = np.vstack([np.zeros(self._basis.shape[1]), np.cumsum(self._basis, axis=0)])
        totals = np.concatenate([[0.0], np.cumsum(self._error)])
        own = last - first - np.sum(np.square(sums[start + last] - sums[start + first]), axis=1)
        moved = np.square(totals[start + last] - totals[start + first])
        explained = np.where(own > _OWN_SHARE * (last - first), moved / np.maximum(own, 1e-9), 0.0)
        ends = (first > 0).astype(np.int64) + (last < n)
        gains = self._to_gain(explained, 1 + ends)
        best = int(np.argmax(gains))
        begin, end = float(part.times[first[best]]), float(part.times[last[best] - 1])
        gain = float(gains[best])
        cure = "Leave that span out, or record the disturbance as an input"
        index = int(first[best] or last[best])  # of the only change; an offset covers either side
        if ends[best] == 1 and index <= _START_SHARE * n:
            cure = "Estimate the initial states, or leave the start out with skip"
            return Suspect(f"a wrong start of {where}", gain, cure)
        if ends[best] == 1:
            moment = float(part.times[index])
            return Suspect(f"a step disturbance of {where} at about {moment:.4g} s", gain, cure)
        return Suspect(f"a disturbance of {where} from {begin:.4g} to {end:.4g} s", gain, cure)

    def _fit_noise(self, part: ResidualPart, where: str) -> Suspect:
        values = self._error[part.rows]
        pole = float(values[1:] @ values[:-1]) / max(float(values @ values), 1e-300)
        gain = -values.size * log(max(1.0 - pole**2, 1e-12)) - log(values.size)
        cure = "The errors allow for it; loss: {noise_model: ar1} may sharpen the estimates"
        return Suspect(f"slow noise of {where}", gain, cure, share=_NOISE_SHARE)

    def _fit_tails(self, part: ResidualPart, where: str) -> Suspect:
        """Compare Student's t of few degrees of freedom, its scale by iteration, with a Gauss."""
        values, nu = self._error[part.rows], _TAIL_DEGREES
        if _are_side_by_side(values):
            return Suspect("", 0.0, "")
        n, gauss = values.size, float(np.mean(np.square(values)))
        power = gauss
        for _ in range(50):
            power = float(np.mean((nu + 1) * values**2 / (nu + values**2 / max(power, 1e-300))))
        peak = lgamma((nu + 1) / 2) - lgamma(nu / 2) - 0.5 * log(nu * np.pi)
        spread = float(np.sum(np.log1p(values**2 / (nu * max(power, 1e-300)))))
        student = 2.0 * n * (peak - 0.5 * log(max(power, 1e-300))) - (nu + 1) * spread
        gain = student + n * (log(2.0 * np.pi * max(gauss, 1e-300)) + 1.0)
        scale = 1.5 * power**0.5 / float(self._problem.output_weights[part.output])
        cure = f"Use loss: {{kind: soft-l1, scale: {scale:.2g}}}"
        return Suspect(f"outliers of {where}", gain, cure)

    def _leave_out_limit(self, part: ResidualPart, where: str) -> Iterator[Suspect]:
        """Leave samples at the largest or the smallest value out, if the model is beyond it."""
        measured = self._problem.evaluator.measured[self._problem.scored_rows[part.rows]]
        for limit, side in ((np.max(measured), 1.0), (np.min(measured), -1.0)):
            at_limit: BoolArray = measured == limit
            count = int(np.count_nonzero(at_limit))
            if count < max(_MIN_LIMIT_SAMPLES, _LIMIT_SHARE * measured.size):
                continue
            fitted = self._leave_out(part, at_limit)
            if fitted is None or np.mean(side * fitted.left_out > 0) < _ONE_SIDED:
                continue
            yield Suspect(
                f"a sensor at its limit: {where} is {self._format(part, limit)} in {count} samples",
                fitted.gain,
                "Leave these samples out: empty cells are not compared",
                is_seen=True,
            )

    def _leave_out_stuck(self, part: ResidualPart, where: str) -> Iterator[Suspect]:
        """Leave long runs of equal readings out, if the others move from sample to sample."""
        measured = self._problem.evaluator.measured[self._problem.scored_rows[part.rows]]
        moves = np.concatenate([[True], np.diff(measured) != 0])
        starts = np.flatnonzero(moves)
        lengths = np.diff(np.append(starts, measured.size))
        stuck = np.repeat(lengths >= _STUCK_SAMPLES, lengths)
        if not stuck.any() or stuck.all() or np.mean(moves[~stuck]) < _MOVING:
            return
        fitted = self._leave_out(part, stuck)
        if fitted is None:
            return
        first = starts[lengths >= _STUCK_SAMPLES][0]
        value, moment = float(measured[first]), float(part.times[first])
        yield Suspect(
            f"a sensor that is stuck: {where} repeats its value in "
            f"{np.count_nonzero(stuck)} samples, such as {self._format(part, value)} from "
            f"{moment:.4g} s",
            fitted.gain,
            "Leave these samples out: empty cells are not compared",
            is_seen=True,
        )

    def _leave_out(self, part: ResidualPart, samples: BoolArray) -> _LeftOut | None:
        """Fit without some samples of a part; None if too few are left."""
        free = np.ones(self._error.size, dtype=np.bool_)
        free[part.rows] = ~samples
        if np.count_nonzero(free) <= self._basis.shape[1]:
            return None
        move = np.linalg.lstsq(self._basis[free], self._error[free], rcond=None)[0]
        left = self._error - self._basis @ move
        n, power = self._error.size, float(np.mean(np.square(left[free])))
        return _LeftOut(left[~free], n * log(self._power / n / max(power, 1e-300)) - log(n))

    def _format(self, part: ResidualPart, value: float) -> str:
        outputs = self._problem.model.outputs
        unit = next(one.unit for one in outputs if one.name == part.output)
        return f"{value:.4g}{format_unit(unit)}"

    def _pad(self, part: ResidualPart, values: FloatArray) -> FloatArray:
        padded = np.zeros(self._error.size)
        padded[part.rows] = (
            values * self._problem.evaluator.weight[self._problem.scored_rows[part.rows]]
        )
        return padded

    def _compute_gain(self, regressors: FloatArray, parameters: int) -> float:
        """Compute the gain of regressors (n, q) that are fitted together with the parameters."""
        own = regressors - self._basis @ (self._basis.T @ regressors)
        left, _, _, retained = compute_truncated_svd(own)
        explained = np.sum(np.square(left[:, retained].T @ self._error))
        return float(self._to_gain(explained, parameters))

    def _to_gain(self, explained: Any, parameters: Any) -> Any:
        n, rest = self._error.size, np.maximum(self._power - explained, 1e-12 * self._power)
        return n * np.log(self._power / rest) - parameters * log(n)


def _are_side_by_side(values: FloatArray) -> bool:
    """Whether large residuals are neighbours of one sign: those of a disturbance, not outliers."""
    limit = _LARGE * 1.4826 * float(np.median(np.abs(values)))
    signs = np.where(np.abs(values) > limit, np.sign(values), 0.0)
    pairs = np.count_nonzero(signs[1:] * signs[:-1] > 0)
    return bool(pairs > _MOST_PAIRS * np.count_nonzero(signs))
