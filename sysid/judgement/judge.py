"""The judge: which explanations of the residuals are more likely than noise, and what they move."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np

from sysid.core.distributions import chi_square_limit
from sysid.core.errors import SysidError
from sysid.core.findings import Finding, Move
from sysid.core.text import join_names, plain_estimate, plain_unit
from sysid.core.types import FloatArray
from sysid.judgement.explanations import (
    actuator,
    constancy,
    history,
    other_input,
    reading,
    sensor,
    structure,
    switches,
)
from sysid.judgement.explanations.noise import (
    find_disagreement_of_frequencies,
    find_noise,
)
from sysid.judgement.full_fits import refit, refit_experiments, refit_parts
from sysid.judgement.levels import (
    ADDED_SHARE,
    BENT_SHARE,
    DEFECT_GAIN,
    NOTABLE_MOVE,
    STRONG_ODDS,
    UNLIKELY_MOVE,
)
from sysid.judgement.residual_context import (
    CUT_THERE,
    Candidate,
    ResidualContext,
    Simulations,
)
from sysid.judgement.residual_model import ColumnFit
from sysid.kernels.signals.past_reads import is_difference
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.start_values import convert_point
from sysid.uncertainty.analysis import analyse_estimate

_Proposer = Callable[[ResidualContext], Iterator[Candidate]]
_FREE_PROPOSERS: tuple[_Proposer, ...] = (constancy.propose, sensor.propose)
_CHEAP_PROPOSERS: tuple[_Proposer, ...] = (
    structure.propose,
    history.propose,
    reading.propose,
    other_input.propose,
)
_COSTLY_PROPOSERS: tuple[_Proposer, ...] = (
    actuator.propose,
    actuator.propose_loads,
    switches.propose,
)
"""Each of their explanations takes a simulation: only if the residuals depend on anything."""
_AGAINST_DEFECTS = DEFECT_GAIN - STRONG_ODDS  # a record in twenty has one
_LIKELY = 0.01  # of the ratio of one candidate: then the costly ones are looked at as well
_BY_ORDER = ("one more time constant", "filter of a sensor")  # another order is the full fit
_SETTABLE = ("order", "reading of an input", "start")  # their advice is a setting
_MOST_SHARE = 0.5  # columns for a sample: with 0.8, noise gains 12 in one of 20 records of 30
_MOST_FINDINGS = 3  # that are found beside each other
_MOST_TOLD = 3  # moves in a sentence
_MOST_RIVALS = 2  # in a sentence
_MOST_REFITTED = 6  # explanations that are fitted in full
_FULL_FIT = 30  # steps of least squares of a setting that is tried


class _Scored(NamedTuple):
    """A candidate with its gain; `moves` are those of a full fit, if there was one."""

    candidate: Candidate
    fit: ColumnFit
    gain: float
    moves: tuple[Move, ...] | None = None


class Explained(NamedTuple):
    """Findings about residuals; `is_done`: whether all explanations were looked for.

    Attributes
    ----------
    is_doubtful : bool
        Whether something has strong odds against noise alone, but not those of a defect. Or not all
        were looked for.
    is_of_the_solver : bool
        Whether the residuals are errors of the integration.
    criterion : float
        Schwarz's criterion of coloured noise alone; minus infinity if it was not computed.
    odds : float
        Twice the logarithm of the odds of what was found against that, as a record in twenty has a
        defect; 0 if nothing was.
    """

    findings: tuple[Finding, ...] = ()
    is_done: bool = False
    is_doubtful: bool = False
    is_of_the_solver: bool = False
    criterion: float = -inf
    odds: float = 0.0

    @property
    def is_noise(self) -> bool:
        """Whether no explanation but those of noise has strong odds against it."""
        return self.is_sound and all(one.is_of_noise for one in self.findings)

    @property
    def is_sound(self) -> bool:
        """Whether no explanation moves an estimate, and none was left out."""
        is_clear = self.is_done and not self.is_doubtful
        return is_clear and all(one.severity == "note" for one in self.findings)


def explain_residuals(context: ResidualContext) -> Explained:
    """Explain the residuals of an estimate by the likeliest explanations, the largest gain first.

    The likeliest one is taken, then the likeliest beside it, as long as one gains clearly
    (stepwise by Schwarz's criterion). Beside another it gains no more than that. One that is taken
    twice, such as a limit at two levels, is told once. If no simulations are left for some
    explanations, it is not done. Settings that it advises are tried.
    """
    if not _is_possible(context):
        return Explained(is_doubtful=context.simulations.is_cut_short)
    if context.is_of_the_solver:
        return Explained(is_done=True, is_doubtful=True, is_of_the_solver=True)
    scored = _score_at_once(context, (*_FREE_PROPOSERS, *_CHEAP_PROPOSERS))
    return _explain(context, scored, advises=True)


def explain_if_noise(context: ResidualContext) -> Explained:
    """Explain the residuals as far as it takes to tell whether nothing but noise is left.

    If an explanation that takes few simulations or none has strong odds and moves an estimate, it
    is not done: the others would have to explain more and move nothing. No setting is advised.
    """
    if not _is_possible(context):
        return Explained()
    scored = list[_Scored]()
    for proposers in (_FREE_PROPOSERS, _CHEAP_PROPOSERS):
        scored = _order([*scored, *_score_at_once(context, proposers)])
        is_likely = bool(scored) and scored[0].gain > STRONG_ODDS
        if is_likely and _describe(context, scored[0], None, ()).parameters:
            criterion = context.residual_model.without.criterion
            odds = scored[0].gain - _AGAINST_DEFECTS
            return Explained(is_doubtful=True, criterion=criterion, odds=odds)
    return _explain(context, scored, advises=False)


def _score_at_once(context: ResidualContext, proposers: Sequence[_Proposer]) -> list[_Scored]:
    """Score the explanations that take few simulations or none."""
    criterion = context.residual_model.without.criterion
    return _score(context, list(_list_candidates(context, proposers)), criterion)


def _explain(context: ResidualContext, scored: list[_Scored], *, advises: bool) -> Explained:
    """Explain residuals, beginning with the explanations that are scored already."""
    base = context.residual_model.without
    before: ColumnFit | None = None
    taken, counted = list[FloatArray](), 0
    if base.is_coloured or any(_is_likely(one, context.times.size) for one in scored):
        costly = list(_list_candidates(context, _COSTLY_PROPOSERS))
        scored += _score(context, costly, base.criterion)
        scored = _refit_finalists(context, _order(scored), base.criterion)
    criterion, odds = base.criterion, 0.0
    is_doubtful = bool(scored) and STRONG_ODDS < scored[0].gain <= DEFECT_GAIN
    if is_doubtful:
        odds = scored[0].gain - _AGAINST_DEFECTS
    findings: list[Finding] = []
    while len(findings) < _MOST_FINDINGS:
        if not scored or scored[0].gain <= DEFECT_GAIN:
            break
        best = scored[0]
        rivals = [
            one
            for one in scored[1:]
            if best.gain - one.gain < STRONG_ODDS
            and one.candidate.explanation != best.candidate.explanation
        ]
        if all(one.brief != best.candidate.brief for one in findings):
            found = _describe(context, best, before, rivals)
            is_tried = advises and not rivals
            findings.append(_try_setting(context, best.candidate, found) if is_tried else found)
        odds -= _AGAINST_DEFECTS
        if best.moves is not None:
            odds += best.gain
            break  # the estimate is another one then
        taken.append(best.candidate.columns)
        counted += best.candidate.counted
        base = before = best.fit
        candidates = _propose_beside(
            context.take(np.hstack(taken)), [one.candidate for one in scored[1:]]
        )
        scored = [
            one._replace(gain=min(one.gain, best.gain))
            for one in _score(context, candidates, base.criterion, taken, counted)
        ]
    findings += find_noise(context, base)
    if not findings:
        findings += find_disagreement_of_frequencies(context)
    is_cut_short = context.simulations.is_cut_short
    is_doubtful |= is_cut_short
    odds += criterion - base.criterion
    return Explained(tuple(findings), not is_cut_short, is_doubtful, criterion=criterion, odds=odds)


def _propose_beside(beside: ResidualContext, others: Sequence[Candidate]) -> list[Candidate]:
    """Propose anew what takes no simulation, such as other moments of a change; keep the rest."""
    anew = list(_list_candidates(beside, _FREE_PROPOSERS))
    names = {one.explanation for one in anew}
    return [*anew, *(one for one in others if one.explanation not in names)]


def _is_possible(context: ResidualContext) -> bool:
    analysis = context.analysis
    if analysis.residuals_and_sensitivities is None or context.problem.loss_scale:
        return False
    error, columns = analysis.residuals_and_sensitivities
    if context.problem.model.inputs and not context.moving_inputs:
        return False  # nothing excites the plant
    if context.problem.prediction != "simulation" and is_difference(context.problem.model):
        return False  # its first samples are predicted from an assumed past, which looks like more
    if any(part.repeats is not None for part in context.parts):
        return False  # samples of a repeat share their noise, which is no series in time
    if not (np.any(error) and error.size > 2 * columns.shape[1] + 10):
        return False
    return bool(np.all(np.isfinite(context.simulation)))


def _is_likely(scored: _Scored, samples: int) -> bool:
    """Whether a likelihood ratio test at 1 % finds a candidate, or its gain does."""
    columns = scored.candidate.columns.shape[1]
    used = columns + scored.candidate.counted
    ratio = scored.gain + used * np.log(samples)
    return scored.gain > 0.0 or ratio > chi_square_limit(used, _LIKELY)


def _list_candidates(
    context: ResidualContext, proposers: Sequence[_Proposer]
) -> Iterator[Candidate]:
    for propose in proposers:
        for candidate in propose(context):
            columns = candidate.columns
            used = context.theta.size + columns.shape[1]
            if used <= _MOST_SHARE * context.times.size and _have_lengths(columns):
                yield candidate


def _have_lengths(columns: FloatArray) -> bool:
    """Whether each column (n, q) has a length: that of a run that diverges is no number."""
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(columns, axis=0)
    return bool(np.all(np.isfinite(lengths)) and lengths.any())


def _score(
    context: ResidualContext,
    candidates: Sequence[Candidate],
    criterion: float,
    taken: Sequence[FloatArray] = (),
    counted: int = 0,
) -> list[_Scored]:
    """Score candidates against a criterion, the largest gain first.

    They are beside the columns (n, t) that are `taken`, of so many parameters more (`counted`).
    """
    fits = context.residual_model.fit_each(
        [one.columns for one in candidates], [counted + one.counted for one in candidates], taken
    )
    pairs = zip(candidates, fits, strict=True)
    return _order(
        [
            _Scored(one, fit, criterion - fit.criterion - _compute_loss(one, fit))
            for one, fit in pairs
        ]
    )


def _compute_loss(candidate: Candidate, fit: ColumnFit) -> float:
    """Compute what a likelihood ratio loses if the coefficient is kept within its range.

    The likelihood is that of a linear model with normal noise of unknown size.
    """
    if candidate.most is None:
        return 0.0
    value, error = float(fit.coefficients[-1]), max(float(fit.errors[-1]), 1e-300)
    beyond = max(-value, value - candidate.most, 0.0) / error
    samples = candidate.columns.shape[0]
    return float(2.0 * samples * np.log(np.hypot(1.0, beyond / np.sqrt(samples))))


def _order(scored: Sequence[_Scored]) -> list[_Scored]:
    """Order by gain, the largest first."""
    return sorted(scored, key=lambda one: -one.gain)


def _refit_finalists(
    context: ResidualContext, scored: Sequence[_Scored], criterion: float
) -> list[_Scored]:
    """Fit in full the likeliest explanations of which each is another record or start.

    They may move the parameters by far more than a linear step. Of a whole other record, the full
    fit counts: a column may be scaled, and then says something else.
    """
    refitted, tried = list(scored), dict[str, int]()
    for position, one in enumerate(scored):
        name = one.candidate.text if one.candidate.is_whole else one.candidate.explanation
        if len(tried) == _MOST_REFITTED or one.gain <= 0.0:
            break
        if name in tried or not one.candidate.is_refitted:
            continue
        tried[name] = position
        found = refit(context, one.candidate.change)
        if found is None:
            continue
        added = one.candidate.columns.shape[1] + one.candidate.counted
        used = added * np.log(max(context.times.size, 2))
        gain = float(criterion - found.criterion - used)
        if one.candidate.is_whole:
            refitted[position] = one._replace(gain=gain, moves=found.moves)
        elif gain > one.gain - STRONG_ODDS:
            refitted[position] = one._replace(gain=max(gain, one.gain), moves=found.moves)
    return _order([*refitted, *_refit_moments(context, scored, criterion)])


def _refit_moments(
    context: ResidualContext, scored: Sequence[_Scored], criterion: float
) -> list[_Scored]:
    """Fit in full what begins at the likeliest moment of a change, and after a gap."""
    if not scored or scored[0].gain <= 0.0:
        return []
    refitted, moments = list[_Scored](), list(context.gap_ends)
    changes = ((one, one.candidate.moment) for one in scored)
    likeliest, change = next((pair for pair in changes if pair[1] is not None), (scored[0], None))
    if change is not None and likeliest.gain > 0.0:
        moments.append(change)
        refitted += _part_finalist(context, likeliest, change, criterion)
    for moment in dict.fromkeys(moments):
        refitted += _divide_finalist(context, scored[0], moment, criterion)
    return refitted


def _divide_finalist(
    context: ResidualContext, likeliest: _Scored, moment: float, criterion: float
) -> list[_Scored]:
    """Let another experiment begin at a moment (s), which counts as a parameter."""
    found = refit_experiments(context, moment)
    if found is None:
        return []
    gain = float(criterion - found.criterion - np.log(max(context.times.size, 2)))
    gap = ", after a gap of the stamps," if moment in context.gap_ends else ""
    candidate = Candidate(
        "another experiment",
        "record",
        likeliest.candidate.columns,
        f"another experiment begins at about {moment:.4g} s",
        f"at about {moment:.4g} s{gap} another experiment begins: the parameters stay, and the "
        "states and the earlier input are others",
        "Label the rows of each experiment in a column of their own, and divide the recording by "
        "it (segments).",
        moment=moment,
    )
    return [_Scored(candidate, likeliest.fit, gain, found.moves)]


def _part_finalist(
    context: ResidualContext, likeliest: _Scored, moment: float, criterion: float
) -> list[_Scored]:
    """Fit both sides of the moment (s) of the likeliest change by themselves."""
    found = refit_parts(context, moment)
    if found is None:
        return []
    gain = criterion - found.criterion
    changed = [one for one in found.changes if one[0] > UNLIKELY_MOVE][:_MOST_TOLD]
    if not changed or gain < likeliest.gain + STRONG_ODDS:
        return []
    if likeliest.candidate.explanation == "change of a unit" and context.scales(changed[0][1]):
        return [likeliest._replace(gain=gain, moves=found.moves)]  # both parts, in other words
    names = join_names([name for _, name, _, _ in changed])
    verb = "change" if len(changed) > 1 else "changes"
    told = ", ".join(f"{name} from {a:.4g} to {b:.4g}" for _, name, a, b in changed)
    is_lag = changed[0][1] in context.delays
    candidate = replace(
        likeliest.candidate,
        explanation="change of a time lag" if is_lag else "change of a parameter",
        family="constancy",
        brief=f"{names} {verb} at about {moment:.4g} s",
        text=f"at about {moment:.4g} s {names} {verb}, or what is measured does: {told}",
        advice=CUT_THERE,
        describe=None,
    )
    return [_Scored(candidate, likeliest.fit, gain, found.moves)]


def _describe(
    context: ResidualContext,
    best: _Scored,
    before: ColumnFit | None,
    rivals: Sequence[_Scored],
) -> Finding:
    candidate = best.candidate
    moves = best.moves or context.compute_moves(best.fit, before, candidate.varies)
    notable = _list_notable(moves)
    for rival in rivals:
        would = rival.moves or context.compute_moves(rival.fit, before, rival.candidate.varies)
        notable |= _list_notable(would)
    notable |= set(candidate.doubtful)
    parameters = tuple(dict.fromkeys(m.parameter for m in moves if m.parameter in notable))
    if candidate.is_vague or _is_large(context, best):
        parameters = context.problem.free_names
    text = f"{candidate.text}."
    if candidate.describe is not None and (told := candidate.describe(best.fit)):
        text += f" {told}"
    text += _tell_moves(context, moves)
    if rivals:
        others = {one.candidate.explanation: one.candidate.brief for one in reversed(rivals)}
        text += f" As likely: {'; '.join([*reversed(others.values())][:_MOST_RIVALS])}."
    return Finding(
        candidate.explanation,
        candidate.family,
        "caution" if parameters else "note",
        candidate.brief,
        text,
        candidate.advice if parameters else "",
        best.gain,
        moves,
        parameters,
    )


def _try_setting(context: ResidualContext, candidate: Candidate, finding: Finding) -> Finding:
    """Advise the setting of an explanation if nothing but noise is left with it.

    One that moves nothing needs no setting, but for the start: its errors are too small.
    """
    if not candidate.setting or (finding.severity == "note" and candidate.family != "start"):
        return finding
    problem, changes = context.problem, candidate.change
    try:
        other = problem.rebuild(**{"weights": problem.output_weights, **changes})
    except SysidError:
        return finding
    start = convert_point(problem, other, context.theta)
    if not leaves_noise(other, start, context.simulations):
        return finding
    return replace(finding, advice=f"{finding.advice} {candidate.setting}".lstrip())


def leaves_noise(problem: Problem, start: FloatArray, simulations: Simulations) -> bool:
    """Fit a problem in full from a start (D,), and judge whether nothing is left that moves it.

    That is what makes an alternative of an explanation: only then its estimates are better. False
    if simulations do not suffice, or if an estimate ends at a bound.
    """
    if not simulations.allow(2 * _FULL_FIT * (start.size + 1)):
        return False
    (end,) = refine_candidates(problem, [start], _FULL_FIT * (start.size + 1), simulations.is_late)
    if end is None:
        return False
    analysis = analyse_estimate(problem, end.theta)
    simulations.spent += end.evaluations + analysis.evaluations
    if any(one.status == "at bound" for one in analysis.estimates):
        return False
    context = ResidualContext(problem, end.theta, analysis, simulations)
    return explain_if_noise(context).is_sound


def _is_large(context: ResidualContext, best: _Scored) -> bool:
    """Whether an explanation is too large for its moves to be linear: no parameter is safe then.

    What only adds to the output leaves the sensitivities as they are, so it may be larger.
    """
    share = ADDED_SHARE if best.candidate.is_added else BENT_SHARE
    return best.moves is None and best.gain > -np.log1p(-share) * context.times.size


def _list_notable(moves: Sequence[Move]) -> set[str]:
    return {move.parameter for move in moves if abs(move.stderrs) > NOTABLE_MOVE}


def _tell_moves(context: ResidualContext, moves: Sequence[Move]) -> str:
    """Tell the largest moves. A step out of the bounds is too long for its value to be told."""
    known = {one.name: one for one in context.analysis.estimates}
    told = [
        f"{move.parameter} = {plain_estimate(move.value, move.stderr)}"
        f"{plain_unit(known[move.parameter].unit)} instead of {known[move.parameter].value:.4g}"
        for move in moves[:_MOST_TOLD]
        if abs(move.stderrs) > NOTABLE_MOVE and known[move.parameter].may_be(move.value)
    ]
    return f" With that, about {', '.join(told)}." if told else ""


def select_explanations(
    explained: Sequence[Finding], refitted: Sequence[Finding]
) -> tuple[Finding, ...]:
    """Select among explanations by columns and those that were fitted in full, on one scale.

    Each of them was compared with the model alone, so they compete. Those with strong evidence
    against them, beside the likeliest one, are left out. What was found beside the likeliest one
    stays with it. Another order that was fitted in full takes the place of its columns.
    Explanations of the noise compete with none of them, and always stay. A setting is advised only
    if nothing competes with it.
    """
    if any(one.explanation == "order" and (one.gain or 0.0) > DEFECT_GAIN for one in refitted):
        explained = [one for one in explained if one.explanation not in _BY_ORDER]
    names = {one.explanation for one in explained}
    refitted = [one for one in refitted if one.explanation not in names or not one.parameters]
    of_noise = [one for one in explained if one.is_of_noise]
    first = max((one.gain or 0.0 for one in explained if not one.is_of_noise), default=0.0)
    other = max((one.gain or 0.0 for one in refitted), default=0.0)
    kept = [one for one in refitted if one.gain is None or one.gain > first - STRONG_ODDS]
    if other - first > STRONG_ODDS:
        return (*of_noise, *_leave_out_rival_settings(kept))
    return _leave_out_rival_settings([*explained, *kept])


def _leave_out_rival_settings(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Leave out the settings of findings that others, without strong evidence, compete with."""
    gains = [(one.explanation, one.gain) for one in findings if not one.is_of_noise]
    return tuple(
        replace(one, advice="")
        if one.explanation in _SETTABLE
        and any(
            name != one.explanation and gain is not None and gain > (one.gain or 0.0) - STRONG_ODDS
            for name, gain in gains
        )
        else one
        for one in findings
    )
