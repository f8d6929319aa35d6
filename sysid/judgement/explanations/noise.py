"""Noise: its tails, its variance and its colour, and what they do to the estimates.

Innovations are what coloured noise is built from. Outliers give them tails, compared by the
likelihood of Student's t (Lange, Little and Taylor, J. Am. Stat. Assoc. 84 (1989) 881). A variance
that follows the output, its slope or time is found by their squares (Breusch and Pagan,
Econometrica 47 (1979) 1287; Koenker 1981). If the model is true, least squares with and without the
colour of the noise estimate the same values (Hausman, Econometrica 46 (1978) 1251).
"""

from collections.abc import Iterator
from dataclasses import replace
from math import lgamma, log

import numpy as np

from sysid.core.findings import Family, Finding, Move
from sysid.core.robust import estimate_deviation
from sysid.core.text import join_names
from sysid.core.types import FloatArray, IntArray
from sysid.judgement.levels import DEFECT_GAIN, NOTABLE_MOVE, UNLIKELY_MOVE
from sysid.judgement.residual_context import ResidualContext
from sysid.judgement.residual_model import ColumnFit

_OUTLYING = 6.0  # robust deviations: one such innovation, and tails are looked at
_TAIL_DEGREES = 3.0  # of Student's t
_LARGE, _MOST_PAIRS = 4.0, 0.3  # robust deviations; share of large innovations that are neighbours
_SOFT_SCALE = 1.5  # robust deviations: scale of the loss that is advised (H15: Andrews et al. 1972)
_ROUNDS = 20  # of the scale of Student's t
_MOST_SQUARE = 8.0  # over the mean: larger squares are outliers, and found by tails
_LEAST_WEIGHT = 0.05  # of the mean: a variance is not known better
"""Measured with `benchmarks.judgement`, a record of each of 102 kinds: `_OUTLYING` of 5 or 8,
`_TAIL_DEGREES` of 2 or 5 and `_MOST_PAIRS` of 0.15 or 0.6 leave all statuses."""


def find_noise(context: ResidualContext, fit: ColumnFit) -> Iterator[Finding]:
    """Find tails and unequal variances of the innovations of a fit."""
    for name, rows, _ in context.iterate_outputs():
        if rows.sum() > 4 * context.theta.size:
            yield from _find_tails(context, fit, name, np.flatnonzero(rows))
            yield from _find_variance(context, fit, name, np.flatnonzero(rows))


def find_disagreement_of_frequencies(context: ResidualContext) -> Iterator[Finding]:
    """Find parameters that differ between the slow and the fast part of the record."""
    model = context.residual_model
    base = model.without
    if not base.is_coloured:
        return
    moves = context.compute_moves(base)
    moved = [move.parameter for move in moves if abs(move.stderrs) > UNLIKELY_MOVE]
    if moved:
        size = max(abs(move.stderrs) for move in moves)
        yield Finding(
            "slow and fast parts",
            "structure",
            "caution",
            "the slow and the fast part of the record disagree",
            f"with and without the colour of the noise, {join_names(moved)} differ by up to "
            f"{size:.2g} standard errors. Under a true model both agree: a part of the response or "
            "a disturbance is missing.",
            "",
            size**2 - log(context.times.size),
            moves,
            tuple(moved),
        )


def _find_tails(
    context: ResidualContext, fit: ColumnFit, name: str, rows: IntArray
) -> Iterator[Finding]:
    values, nu = fit.innovations[rows], _TAIL_DEGREES
    deviation = estimate_deviation(values)
    if not np.max(np.abs(values)) > _OUTLYING * deviation or _are_neighbours(values):
        return
    n, gauss = values.size, float(np.mean(np.square(values)))
    power = gauss
    for _ in range(_ROUNDS):
        power = float(np.mean((nu + 1) * values**2 / (nu + values**2 / max(power, 1e-300))))
    peak = lgamma((nu + 1) / 2) - lgamma(nu / 2) - 0.5 * log(nu * np.pi)
    spread = float(np.sum(np.log1p(values**2 / (nu * max(power, 1e-300)))))
    student = 2.0 * n * (peak - 0.5 * log(max(power, 1e-300))) - (nu + 1) * spread
    gain = student + n * (log(2.0 * np.pi * max(gauss, 1e-300)) + 1.0)
    if gain <= DEFECT_GAIN:
        return
    weights = np.ones(context.times.size)
    weights[rows] = (nu + 1) / (nu + values**2 / max(power, 1e-300))
    moves = _weigh(context, fit, weights)
    residuals = context.residual_model.residuals[rows] / context.weight[rows]
    scale = _SOFT_SCALE * estimate_deviation(residuals)
    count = int(np.count_nonzero(np.abs(values) > _OUTLYING * deviation))
    yield _make_finding(
        "outliers",
        "sensor",
        f"{name} has outliers",
        f"{count} sample{'s' if count > 1 else ''} of {name} {'lie' if count > 1 else 'lies'} far "
        "outside its noise: outliers, or drop-outs of the sensor",
        f"Use loss: {{kind: soft-l1, scale: {scale:.2g}}}.",
        gain,
        moves,
    )


def _find_variance(
    context: ResidualContext, fit: ColumnFit, name: str, rows: IntArray
) -> Iterator[Finding]:
    squares = np.square(fit.innovations[rows])
    mean = float(np.mean(squares))
    if not mean > 0:
        return
    size, slope = context.simulation[rows], np.abs(context.slope[rows])
    causes = {
        f"the size of {name}": np.abs(size - np.mean(size)),
        f"{name} itself": size,
        f"the slope of {name}": slope,
        "time": context.times[rows],
    }
    best = (DEFECT_GAIN, "", np.zeros(0))
    relative = squares / mean - 1.0
    clipped = np.minimum(relative, _MOST_SQUARE)
    for cause, values in causes.items():
        spread = float(np.std(values))
        if not spread > 0:
            continue
        z = (values - np.mean(values)) / spread
        rise = float(z @ clipped) / z.size
        gain = z.size * rise**2 / max(float(np.var(clipped)), 1e-300) - log(z.size)
        if gain > best[0]:
            best = (gain, cause, 1.0 + rise * z)
    gain, cause, variance = best
    if not cause:
        return
    weights = np.ones(context.times.size)
    weights[rows] = 1.0 / np.maximum(variance, _LEAST_WEIGHT)
    yield _make_finding(
        "unequal variance",
        "variance",
        f"the noise of {name} follows {cause}",
        f"the variance of the noise of {name} follows {cause}",
        "",
        gain,
        _weigh(context, fit, weights),
    )


def _make_finding(
    explanation: str,
    family: Family,
    brief: str,
    text: str,
    advice: str,
    gain: float,
    moves: tuple[Move, ...],
) -> Finding:
    notable = tuple(one.parameter for one in moves if abs(one.stderrs) > UNLIKELY_MOVE)
    return Finding(
        explanation,
        family,
        "caution" if notable else "note",
        brief,
        f"{text}.",
        advice,
        gain,
        tuple(one for one in moves if abs(one.stderrs) > NOTABLE_MOVE),
        notable,
    )


def _weigh(context: ResidualContext, fit: ColumnFit, weights: FloatArray) -> tuple[Move, ...]:
    """Compute the moves of the parameters if innovations (n,) count by weights."""
    model = context.residual_model
    columns = model.whiten(model.columns, fit.noise)
    target = model.whiten(model.residuals, fit.noise)
    root = np.sqrt(weights)
    plain, moved = (
        np.asarray(
            np.linalg.lstsq(columns * one[:, None], target * one, rcond=1e-10)[0], np.float64
        )
        for one in (np.ones(root.size), root)
    )
    still = replace(fit, coefficients=plain, errors=np.zeros(plain.size))
    return context.compute_moves(replace(still, coefficients=moved), still)


def _are_neighbours(values: FloatArray) -> bool:
    """Whether large values are neighbours of one sign: those of a disturbance, not outliers."""
    limit = _LARGE * estimate_deviation(values)
    signs = np.where(np.abs(values) > limit, np.sign(values), 0.0)
    pairs = np.count_nonzero(signs[1:] * signs[:-1] > 0)
    return bool(pairs > _MOST_PAIRS * max(int(np.count_nonzero(signs)), 1))
