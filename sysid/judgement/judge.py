"""The judge: which explanations of the residuals are more likely than noise, and what they move."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.text import plain_estimate, plain_unit
from sysid.core.types import FloatArray
from sysid.judgement.explanations import actuator, constancy, history, reading, sensor, structure
from sysid.judgement.explanations.noise import (
    find_disagreement_of_frequencies,
    find_noise,
)
from sysid.judgement.levels import DEFECT_GAIN, NOTABLE_MOVE, STRONG_ODDS
from sysid.judgement.residual_context import Candidate, ResidualContext
from sysid.judgement.residual_model import ColumnFit
from sysid.results.findings import Finding, Move

_PROPOSERS = (
    constancy.propose,
    sensor.propose,
    structure.propose,
    history.propose,
    reading.propose,
    actuator.propose,
)
_MOST_FINDINGS = 3  # that are found beside each other
_MOST_TOLD = 3  # moves in a sentence


class _Scored(NamedTuple):
    candidate: Candidate
    fit: ColumnFit
    gain: float


class Explained(NamedTuple):
    """Findings about residuals; `is_done`: whether they were looked for."""

    findings: tuple[Finding, ...] = ()
    is_done: bool = False

    @property
    def is_noise(self) -> bool:
        """Whether no explanation moves an estimate: what is left is noise."""
        return all(one.severity == "note" for one in self.findings)


def explain_residuals(context: ResidualContext) -> Explained:
    """Explain the residuals of an estimate by the likeliest explanations, the largest gain first.

    The likeliest one is taken, then the likeliest beside it, as long as one gains clearly
    (stepwise by Schwarz's criterion).
    """
    if not _is_possible(context):
        return Explained()
    base = context.residual_model.without
    candidates = list(_list_candidates(context))
    taken = np.zeros((context.times.size, 0))
    counted = 0
    findings: list[Finding] = []
    while len(findings) < _MOST_FINDINGS:
        scored = _score(context, candidates, taken, counted, base.criterion)
        if not scored or scored[0].gain <= DEFECT_GAIN:
            break
        best = scored[0]
        rivals = [
            one
            for one in scored[1:]
            if best.gain - one.gain < STRONG_ODDS
            and one.candidate.explanation != best.candidate.explanation
        ]
        findings.append(_describe(context, best, base, rivals))
        taken = np.hstack([taken, best.candidate.columns])
        counted += best.candidate.counted
        base = best.fit
        candidates = [one.candidate for one in scored if one.gain > DEFECT_GAIN][1:]
    findings += find_noise(context, base)
    if not findings:
        findings += find_disagreement_of_frequencies(context)
    return Explained(tuple(findings), True)


def _is_possible(context: ResidualContext) -> bool:
    analysis = context.analysis
    if analysis.residuals_and_sensitivities is None or context.problem.loss_scale:
        return False
    error, columns = analysis.residuals_and_sensitivities
    return bool(np.any(error)) and error.size > 2 * columns.shape[1] + 10


def _list_candidates(context: ResidualContext) -> Iterator[Candidate]:
    for propose in _PROPOSERS:
        for candidate in propose(context):
            if candidate.columns.any() and np.all(np.isfinite(candidate.columns)):
                yield candidate


def _score(
    context: ResidualContext,
    candidates: Sequence[Candidate],
    taken: FloatArray,
    counted: int,
    criterion: float,
) -> list[_Scored]:
    """Score candidates beside the columns (n, t) that are taken, the largest gain first."""
    scored = []
    for candidate in candidates:
        fit = context.residual_model.fit(
            np.hstack([taken, candidate.columns]), counted + candidate.counted
        )
        scored.append(_Scored(candidate, fit, criterion - fit.criterion))
    return sorted(scored, key=lambda one: -one.gain)


def _describe(
    context: ResidualContext, best: _Scored, base: ColumnFit, rivals: Sequence[_Scored]
) -> Finding:
    candidate = best.candidate
    moves = context.compute_moves(best.fit, base)
    notable = {move.parameter for move in moves if abs(move.stderrs) > NOTABLE_MOVE}
    for rival in rivals:
        notable |= _list_notable(context.compute_moves(rival.fit, base))
    text = f"{candidate.text}."
    if candidate.describe is not None:
        text += f" {candidate.describe(best.fit)}"
    text += _tell_moves(context, moves)
    if rivals:
        others = dict.fromkeys(one.candidate.brief for one in rivals)
        text += f" As likely: {'; '.join(list(others)[:2])}."
    return Finding(
        candidate.explanation,
        candidate.family,
        "caution" if notable else "note",
        candidate.brief,
        text,
        candidate.advice,
        best.gain,
        moves,
        tuple(move.parameter for move in moves if move.parameter in notable),
    )


def _list_notable(moves: Sequence[Move]) -> set[str]:
    return {move.parameter for move in moves if abs(move.stderrs) > NOTABLE_MOVE}


def _tell_moves(context: ResidualContext, moves: Sequence[Move]) -> str:
    known = {one.name: one for one in context.analysis.estimates}
    told = [
        f"{move.parameter} = {plain_estimate(move.value, move.stderr)}"
        f"{plain_unit(known[move.parameter].unit)} instead of {known[move.parameter].value:.4g}"
        for move in moves[:_MOST_TOLD]
        if abs(move.stderrs) > NOTABLE_MOVE
    ]
    return f" With that, about {', '.join(told)}." if told else ""


def select_explanations(
    explained: Sequence[Finding], refitted: Sequence[Finding]
) -> tuple[Finding, ...]:
    """Select among explanations by columns and those that were fitted in full, on one scale.

    Each of them was compared with the model alone, so they compete. Those with strong evidence
    against them, beside the likeliest one, are left out. What was found beside the likeliest one
    stays with it.
    """
    first = max((one.gain or 0.0 for one in explained), default=0.0)
    other = max((one.gain or 0.0 for one in refitted), default=0.0)
    kept = [one for one in refitted if one.gain is None or (one.gain or 0.0) > first - STRONG_ODDS]
    if other - first > STRONG_ODDS:
        return tuple(kept)
    return (*explained, *kept)
