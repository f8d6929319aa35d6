"""Compare where the states start: at rest, at estimated values, or as the document says.

A plant that stands still before its record needs no start to be estimated. An estimated one then
costs precision: in a step test with two samples before the step it takes nearly all that is known
of the gain. In a record that begins amid a motion the rest is wrong, and moves all estimates.

So each start is fitted by least squares from the estimate, and again from the end of a better one.
They are compared by Schwarz's criterion (BIC, 1978) on the same samples. If the residuals with most
starts free are not white, each start has first-order noise of its own, with the correlation time of
its largest likelihood. The start of lowest BIC is preferred. Those whose BIC is less than 6 above
it are open: odds of 20 to 1 (Kass and Raftery, J. Am. Stat. Assoc. 90 (1995) 773). One that has
more parameters is so only if its likelihood gains more than by chance (Wilks 1938): otherwise
nothing speaks for it, and every short record would leave it open. As with orders, an open start
makes estimates doubtful if it is at least as likely as the problem's own. A less likely one is a
note: in about 2000 records (`benchmarks.judgement`) it hedged ten, and no value that was more
than two errors off for that reason.

Beside a filter the noise has moved the states before the record, and soon hides where they started.
So the likelihood of a rest is an average over such starts already, and that of an estimated start
is one too: over its bounds, by Laplace's method (Kass and Raftery 1995, eq. 5). Schwarz's ln n is
that of a parameter of which all n samples tell. With it, 45 of 240 plants at rest had a free start.

A fit whose time lag ends at its upper bound is no explanation, if there is another: its likelihood
still grows beyond the bound, and the criterion is that of a maximum. Behind half a record of lag, a
transient from free starts can take the place of the answer to a step.

A start at the first measured value has the noise of that sample, which no standard error contains.
In 16 Mackey-Glass series with 2 % of noise, its errors were 4 times the stated ones, and those of
free starts 1.1 times. So it is compared where the document has it, and is never preferred.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np

from sysid.core.distributions import chi_square_limit
from sysid.core.errors import InvalidSettings, SysidError
from sysid.core.findings import Finding, Move
from sysid.core.settings import InitialSetting, StartKind
from sysid.core.text import plain_estimate, plain_unit
from sysid.core.types import FloatArray
from sysid.judgement.levels import NOTABLE_MOVE, SOLVER_SHARE, STRONG_ODDS
from sysid.judgement.residual_context import find_delay_parameters
from sysid.minima.minima import scan_by_projection
from sysid.models.model import Model
from sysid.models.starts import compares_starts, replace_starts
from sysid.noise_models.first_order_fit import fit_first_order_noise
from sysid.noise_models.generalised_least_squares import select_coloured_outputs
from sysid.results.findings import list_moves
from sysid.search.refine import RefinedCandidate, refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import is_at_bounds, to_unit
from sysid.simulation.start_values import convert_point
from sysid.uncertainty.analysis import analyse_estimate, compute_criteria
from sysid.uncertainty.estimates import Criteria, Estimate

_COMPARED: tuple[StartKind, ...] = ("rest", "free")
_NAMED: tuple[StartKind, ...] = (*_COMPARED, "measured")
_CHANCE = 0.05  # of a gain of the likelihood by more parameters alone
_MAX_STEPS = 30  # of least squares, with as many simulations as there are parameters and one
_FITS = 4  # of a start: from the estimate, from another start, under a noise model, its errors
_SCAN, _SEED = 1000, 1  # simulations of a scan for a lower minimum of a start that is not open
_MOST_TOLD = 3  # moves in a sentence


@dataclass(frozen=True, slots=True, eq=False)
class FittedStart:
    """The fit of one start.

    Attributes
    ----------
    name : {"rest", "measured", "free"} or None
        None: the start of the model's document, if it is none of these.
    problem : Problem
        With this start.
    theta : FloatArray, shape (D,)
        The estimate by least squares.
    values, stderrs : mapping of str to float
        The estimates, and their standard errors if they have one, under the noise of the
        comparison.
    rms : float
        Fitness of `theta`.
    criteria : Criteria
        Under that noise.
    is_open : bool
        Whether its odds against the best one are above 1 to 20.
    """

    name: StartKind | None
    problem: Problem
    theta: FloatArray
    values: Mapping[str, float]
    stderrs: Mapping[str, float]
    rms: float
    criteria: Criteria
    is_open: bool = True

    @property
    def bic(self) -> float:
        """Schwarz's criterion."""
        return self.criteria.bic


@dataclass(frozen=True, slots=True, eq=False)
class StartComparison:
    """Starts compared on the same samples.

    Attributes
    ----------
    fits : tuple of FittedStart
        That of the problem first.
    noise_model : {"white", "ar1"}
    evaluations : int
        Simulations spent.
    """

    fits: tuple[FittedStart, ...]
    noise_model: str
    evaluations: int

    @property
    def own(self) -> FittedStart:
        """The start of the problem."""
        return self.fits[0]

    @property
    def best(self) -> FittedStart:
        """The open start of lowest BIC."""
        return min((fit for fit in self.fits if fit.is_open), key=lambda fit: fit.bic)

    def take(self, fit: FittedStart) -> "StartComparison":
        """Return the comparison as that of a problem with another of these starts."""
        return replace(self, fits=(fit, *(one for one in self.fits if one is not fit)))

    def list_moves(self, fit: FittedStart, estimates: Sequence[Estimate]) -> tuple[Move, ...]:
        """List how another start moves the estimates, the furthest first.

        Moves are those between the fits of this comparison, in the errors of the estimates.
        """
        return list_moves(estimates, fit.values, fit.stderrs, self.own.values)


def _compute_gain(fit: FittedStart, other: FittedStart) -> float:
    """Compute the likelihood ratio 2 (ln ℓ - ln ℓ₀) of a fit over another one."""
    more = fit.criteria.parameters - other.criteria.parameters
    return other.criteria.aic - fit.criteria.aic + 2.0 * more


def _is_open(fit: FittedStart, best: FittedStart) -> bool:
    """Whether the data do not rule out a fit, and speak for the parameters that it has more."""
    more = fit.criteria.parameters - best.criteria.parameters
    if more > 0 and _compute_gain(fit, best) <= chi_square_limit(more, _CHANCE):
        return False
    return fit.bic <= best.bic + STRONG_ODDS


_NAMES: Mapping[StartKind | None, str] = {
    "rest": "at rest",
    "free": "at estimated values",
    "measured": "at the first measured values",
    None: "as the model's document says",
}


def find_open_starts(
    comparison: StartComparison | None, estimates: Sequence[Estimate]
) -> Iterator[Finding]:
    """Find other starts that the data do not rule out, and that move an estimate.

    If the data rule the own start out, which was not compared before, the best is told anyway.
    """
    if comparison is None:
        return
    own = comparison.own
    known = {one.name: one for one in estimates}
    for fit in comparison.fits[1:]:
        moves = comparison.list_moves(fit, estimates)
        notable = tuple(one.parameter for one in moves if abs(one.stderrs) > NOTABLE_MOVE)
        if not fit.is_open or not (notable or (fit is comparison.best and not own.is_open)):
            continue
        is_doubt = bool(notable) and fit.bic <= own.bic
        told = [
            f"{one.parameter} is {plain_estimate(one.value, one.stderr)}"
            f"{plain_unit(known[one.parameter].unit)}"
            for one in moves
            if one.parameter in notable or not notable
        ]
        yield Finding(
            "start",
            "start",
            "caution" if is_doubt else "note",
            f"the states may start {_NAMES[fit.name]}",
            f"the estimates assume that the states start {_NAMES[own.name]}. The data do not rule "
            f"out that they start {_NAMES[fit.name]}"
            f"{f' (initial: {fit.name})' if fit.name else ''}. Then "
            f"{', '.join(told[:_MOST_TOLD])}.",
            "",
            own.bic - fit.bic,
            moves,
            notable if is_doubt else (),
        )


def compare_starts(
    problem: Problem,
    theta: FloatArray,
    initial: InitialSetting | None = "auto",
    max_simulations: int | None = None,
    is_late: Callable[[], bool] = lambda: False,
) -> StartComparison | None:
    """Compare the start of a problem with the others that its model can have.

    None if the request gives the start: by the setting, by the model's document, or by changes of
    initial states. Also for other fits than least squares of a free run, if the model fits nearly
    without residuals, or if budget or time do not suffice.

    Parameters
    ----------
    problem : Problem
        With any of the starts.
    theta : FloatArray, shape (D,)
        The estimate.
    initial : {"rest", "free", "measured", "auto"} or None
        Setting of the request.
    max_simulations : int or None
    is_late : callable
        Whether the time of the run is over.
    """
    others = [] if is_late() else _list_other_starts(problem, initial)
    if not others:
        return None
    named = [(_find_name(problem), problem), *others]
    steps = _MAX_STEPS * (1 + max(len(one.free_parameters) for _, one in named))
    if max_simulations is not None and max_simulations < _FITS * steps * len(named):
        return None
    ends, spent = _fit_starts([one for _, one in named], theta, steps, is_late)
    known = [(name, one, end) for (name, one), end in zip(named, ends, strict=True) if end]
    if len(known) < 2 or ends[0] is None or is_late():
        return None
    if min(end.rms for _, _, end in known) <= SOLVER_SHARE * problem.output_scale:
        return None
    _, largest, end = max(known, key=lambda one: one[2].theta.size)
    error = largest.compute_residuals(end.theta[None])[0]
    has_colour = problem.loss.noise_model == "ar1" or bool(select_coloured_outputs(largest, error))
    fits = list[FittedStart]()
    for name, one, end in known:
        fit, count = _assess_start(name, one, end, steps, has_colour=has_colour)
        fits.append(fit)
        spent += count
    exact = [fit for fit in fits if fit.name != "measured"]
    inside = [fit for fit in exact if not _is_lag_at_limit(fit)] or exact
    best = min(inside, key=lambda fit: fit.bic)
    if not isfinite(best.bic):
        return None
    marked = (replace(fit, is_open=fit in inside and _is_open(fit, best)) for fit in fits)
    return StartComparison(tuple(marked), "ar1" if has_colour else "white", spent)


def _list_other_starts(
    problem: Problem, initial: InitialSetting | None
) -> list[tuple[StartKind | None, Problem]]:
    """List the problems with other starts, unless the request says where the states start."""
    if (
        not compares_starts(problem.given_model, initial)
        or problem.loss.kind != "squares"
        or problem.prediction != "simulation"
    ):
        return []
    states = {state.name for state in problem.model.states}
    if any(name.partition("(")[0] in states for name in problem.settings.parameters):
        return []
    known = [(kind, model) for kind, model in _list_models(problem) if kind in _COMPARED]
    found = [problem.untied_model.initial]
    problems = list[tuple[StartKind | None, Problem]]()
    for kind, model in (*known, (None, problem.given_model)):
        if model.initial in found:
            continue
        found.append(model.initial)
        with suppress(SysidError):  # this start cannot be used with the settings
            other = problem.rebuild(initial=kind or "auto")
            problems.append((kind or _find_name(other), other))
    return problems


def _list_models(problem: Problem) -> Iterator[tuple[StartKind | None, Model]]:
    """Iterate over the starts that a model can have and that have a name."""
    for kind in _NAMED:
        with suppress(InvalidSettings):  # the model has no such start
            yield kind, replace_starts(problem.given_model, kind)


def _find_name(problem: Problem) -> StartKind | None:
    """Find the name of a problem's starts; None if they are those of the document only."""
    own = problem.untied_model.initial
    return next((kind for kind, model in _list_models(problem) if model.initial == own), None)


def _fit_starts(
    problems: Sequence[Problem], theta: FloatArray, steps: int, is_late: Callable[[], bool]
) -> tuple[list[RefinedCandidate | None], int]:
    """Fit problems from an estimate of the first, then from the ends of the others.

    One whose end is far behind is scanned for a lower minimum. If that is the lowest of all, the
    others are fitted from it too: the estimate was in a false minimum.
    """
    points = [convert_point(problems[0], one, theta) for one in problems]
    ends = [
        refine_candidates(one, [point], steps, is_late)[0]
        for one, point in zip(problems, points, strict=True)
    ]
    spent = sum(end.evaluations for end in ends if end)
    spent += _fit_from_others(problems, ends, steps, is_late)
    best = min((end.rms for end in ends if end), default=0.0)
    for i, (one, end) in enumerate(zip(problems, ends, strict=True)):
        if end is None or end.rms <= best * _compute_open_ratio(one):
            continue
        scanned = scan_by_projection(one, end, _SEED, _SCAN, is_late)
        spent += scanned.evaluations
        ends[i] = min((end, *scanned.ends), key=lambda found: found.rms)
    if min((end.rms for end in ends if end), default=0.0) < best:
        spent += _fit_from_others(problems, ends, steps, is_late)
    return ends, spent


def _fit_from_others(
    problems: Sequence[Problem],
    ends: list[RefinedCandidate | None],
    steps: int,
    is_late: Callable[[], bool],
) -> int:
    """Fit problems from the ends of the others, and keep what is lower; count the simulations."""
    spent = 0
    for i, one in enumerate(problems):
        others = [
            convert_point(other, one, end.theta)
            for other, end in zip(problems, ends, strict=True)
            if other is not one and end
        ]
        own = ends[i]
        for candidate in refine_candidates(one, others, steps, is_late) if others else ():
            if candidate is None:
                continue
            spent += candidate.evaluations
            if own is None or candidate.rms < own.rms:
                ends[i] = own = candidate
    return spent


def _compute_open_ratio(problem: Problem) -> float:
    """Compute how far above the best RMS a fit with one parameter less is open, in white noise."""
    n = problem.n_scored
    return float(np.exp(0.5 * (STRONG_ODDS + np.log(n)) / n))


def _is_lag_at_limit(fit: FittedStart) -> bool:
    point = to_unit(fit.problem.evaluator, fit.theta[None])[0]
    delays = find_delay_parameters(fit.problem)
    pairs = zip(fit.problem.free_names, is_at_bounds(point)[1], strict=True)
    return any(at_upper for name, at_upper in pairs if name in delays)


def _assess_start(
    name: StartKind | None,
    problem: Problem,
    end: RefinedCandidate,
    steps: int,
    *,
    has_colour: bool,
) -> tuple[FittedStart, int]:
    """Compute the BIC of a fit, and its errors; count the simulations."""
    theta, whitening, spent = end.theta, None, 1
    if has_colour:
        theta, whitening, spent = fit_first_order_noise(problem, theta, steps)
    with np.errstate(all="ignore"):  # a start may have no effect on the output
        residuals = problem.compute_residuals(theta[None])[0]
        analysis = analyse_estimate(problem, theta, whitening=whitening)
    if whitening is not None:
        residuals = whitening.whiten(residuals)
    criteria = compute_criteria(problem, residuals, whitening)
    if problem.model.corrections:
        criteria = replace(criteria, bic=criteria.bic + _count_starts(problem, analysis.estimates))
    fit = FittedStart(
        name,
        problem,
        end.theta,
        {estimate.name: estimate.value for estimate in analysis.estimates},
        {one.name: one.stderr for one in analysis.estimates if one.stderr},
        end.rms,
        criteria,
    )
    return fit, spent + analysis.evaluations


def _count_starts(problem: Problem, estimates: Sequence[Estimate]) -> float:
    """Count estimated starts as averages over their bounds, and no longer as parameters."""
    declared = {parameter.name for parameter in problem.model.parameters}
    least = float(np.log(problem.n_scored))
    return sum(
        2.0 * float(np.log((one.upper - one.lower) / (np.sqrt(2.0 * np.pi) * one.stderr))) - least
        for one in estimates
        if one.is_free and one.name not in declared and one.stderr
    )
