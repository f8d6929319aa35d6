"""Holds chosen by the data: what the estimate is if an input is read the other way.

Read held, an input acts half a sample earlier than in straight lines. Mostly both fit equally, with
two time lags. So a choice is in doubt in three cases. The other reading fits clearly better. Or an
input in straight lines follows the residuals, as a command that a controller computes and holds.
Or the samples beside each of its samples say nothing of it, so no line leads there.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import log
from typing import NamedTuple

import numpy as np

from sysid.core.findings import Finding, Move, note
from sysid.core.types import FloatArray
from sysid.data.holds import Hold
from sysid.data.records import Channel, Record
from sysid.judgement.judge import leaves_noise
from sysid.judgement.levels import DEFECT_GAIN, NOTABLE_MOVE, STRONG_ODDS
from sysid.judgement.residual_context import Simulations
from sysid.judgement.residual_model import ResidualModel
from sysid.kernels.signals.past_reads import is_difference
from sysid.residuals.feedback import find_commands
from sysid.residuals.residual_tests import list_residual_series
from sysid.residuals.series import iterate_parts
from sysid.results.findings import list_moves
from sysid.results.parts import InputHold
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.sensitivities import compute_sensitivities

_MAX_NAMED = 3  # estimates in one sentence
_MIN_ROUGH = 50  # samples: fewer may be rough by chance
_READINGS = {"zero": "held", "first": "as straight lines", "band-limited": "band-limited"}


def list_input_holds(problem: Problem) -> tuple[InputHold, ...]:
    """List how each input is read; one whose experiments differ is listed once for each reading."""
    is_recursion = is_difference(problem.model)
    return problem.share(
        "input holds",
        lambda: tuple(
            hold
            for signal in problem.model.inputs
            for hold in _list_holds(signal.name, problem.records, is_recursion)
        ),
    )


def _list_holds(name: str, records: Sequence[Record], is_recursion: bool) -> list[InputHold]:
    channels = _find_channels(name, records)
    moving = [channel for channel in channels if np.ptp(channel.values) > 0] or channels[:1]
    holds = {(channel.effective_hold, channel.hold == "auto"): channel for channel in moving[::-1]}
    listed = []
    for (chosen, is_chosen), channel in sorted(holds.items(), key=lambda item: item[0]):
        has_effect = is_chosen and not is_recursion and np.ptp(channel.values) > 0
        other: Hold = "first" if chosen == "zero" else "zero"
        reason = channel.hold_choice.reason if is_chosen else None
        listed.append(InputHold(name, chosen, reason, other if has_effect else None))
    return listed


def refit_other_holds(
    problem: Problem,
    holds: Sequence[InputHold],
    theta: FloatArray,
    start: FloatArray,
    max_simulations: int | None,
    is_late: Callable[[], bool],
) -> tuple[tuple[InputHold, ...], int]:
    """Estimate by least squares with each chosen hold replaced; return the simulations too.

    Parameters
    ----------
    theta, start : FloatArray, shape (D,)
        The estimates, and those by least squares. A noise model keeps its difference of the two.
    max_simulations : int or None
        Budget; what exceeds it is left out.
    """
    compared, spent = [], 0
    for hold in holds:
        left = None if max_simulations is None else max_simulations - spent
        if hold.other is None or is_late() or (left is not None and left <= 0):
            compared.append(hold)
            continue
        other = replace_holds(problem, [hold])
        end = refine_candidates(other, [start], left, is_late)[0]
        if end is not None:
            spent += end.evaluations
            values = (theta + end.theta - start).tolist()
            estimates = dict(zip(problem.free_names, values, strict=True))
            hold = replace(hold, estimates_other=estimates, rms_other=end.rms)
        compared.append(hold)
    return tuple(compared), spent


class HoldDoubt(NamedTuple):
    """Why the other reading of an input is as likely; empty if it is not.

    Attributes
    ----------
    text : str
        A sentence without its full stop.
    gain : float
        How much lower the criterion is with the other reading.
    """

    text: str = ""
    gain: float = 0.0


def find_hold_doubts(
    problem: Problem,
    holds: Sequence[InputHold],
    theta: FloatArray,
    simulated: FloatArray,
    rms: float,
    simulations: Simulations,
) -> list[HoldDoubt]:
    """Find for each hold why the other reading is as likely.

    A reading whose RMS is clearly smaller is compared under coloured noise, as explanations are.
    `theta` (D,), `simulated` (n,) and `rms` are those with the chosen readings.
    """
    open_holds = [hold.chosen == "first" and hold.rms_other is not None for hold in holds]
    commands = find_commands(list_residual_series(problem, simulated)) if any(open_holds) else set()
    doubts = []
    for hold, is_open in zip(holds, open_holds, strict=True):
        gain, text = _compute_evidence(hold, problem.n_scored, rms), ""
        if gain > STRONG_ODDS:
            gain = _compute_gain(problem, hold, theta, simulations, gain)
        if gain > DEFECT_GAIN:
            text = f"That fits better: RMS {hold.rms_other:.4g}, not {rms:.4g}"
        elif is_open and gain >= -DEFECT_GAIN:
            if hold.input in commands:
                text = "The input follows the residuals as a command does, which is held"
            elif _is_rough(hold.input, problem.records):
                text = "Its samples do not follow each other, so hardly in straight lines"
        doubts.append(HoldDoubt(text, gain))
    return doubts


def find_held_commands(
    problem: Problem, theta: FloatArray, simulations: Simulations
) -> tuple[str, ...]:
    """Find inputs in straight lines that follow the residuals as held commands do, at (D,).

    The likelihood hardly tells both readings apart, because a lag takes half a sample. So a command
    is read held unless the data clearly speak against it.
    """
    open_holds = {
        hold.input: hold
        for hold in list_input_holds(problem)
        if hold.chosen == "first" and hold.other is not None
    }
    if not open_holds:
        return ()
    series = list_residual_series(problem, problem.predict(theta[None])[0])
    commands = find_commands(series, is_clear=problem.is_free_run)
    followers = [hold for name, hold in open_holds.items() if name in commands]
    most, late = simulations.most, simulations.is_late
    refitted, spent = refit_other_holds(problem, followers, theta, theta, most, late)
    simulations.spent += spent
    (rms,) = problem.evaluate_fitness(theta[None])
    found = list[str]()
    for hold in refitted:
        gain = _compute_evidence(hold, problem.n_scored, float(rms))
        if hold.rms_other is None or not simulations.allow(4 * theta.size + 4):
            continue
        if problem.is_free_run:  # coloured; that of a filter has its noise already
            gain = _compute_gain(problem, hold, theta, simulations, gain)
        if gain >= -DEFECT_GAIN:
            found.append(hold.input)
    return tuple(found)


def replace_holds(problem: Problem, holds: Sequence[InputHold]) -> Problem:
    """Replace each of these holds that the data chose by the other one."""
    records = list(problem.records)
    for hold in holds:
        records = [_replace_hold(record, hold) for record in records]
    return problem.rebuild(records=records, weights=problem.output_weights)


def write_hold(hold: InputHold) -> str:
    """Write the option that sets the reading that was not chosen."""
    return f"hold: {{{hold.input}: {hold.other}}}"


def find_other_readings(
    problem: Problem,
    holds: Sequence[InputHold],
    doubts: Sequence[HoldDoubt],
    estimates: Sequence[Estimate],
    simulations: Simulations,
) -> Iterator[Finding]:
    """Find holds chosen by the data where the other reading is as likely, or moves an estimate.

    That an input is read as straight lines is reported only where that is in doubt. The other
    reading is advised if it leaves nothing but noise, as far as simulations allow to tell.
    """
    known = {one.name: one for one in estimates}
    for hold, (doubt, gain) in zip(holds, doubts, strict=True):
        moves = list_moves(estimates, hold.estimates_other or {}, {})
        notable = [move for move in moves if abs(move.stderrs) > NOTABLE_MOVE]
        if doubt or (notable and hold.chosen == "zero"):
            other = f"{_READINGS[str(hold.other)]} ({write_hold(hold)})"
            would = _describe_moves(notable, estimates) or "the same estimates"
            is_likelier = gain > STRONG_ODDS
            moved = [
                one.parameter
                for one in notable
                if is_likelier or known[one.parameter].excludes(one.value)
            ]
            yield Finding(
                "reading of an input",
                "reading",
                "caution" if doubt and moved else "note",
                f"{hold.input} may be read {_READINGS[str(hold.other)]}",
                f"input {hold.input!r} {hold.reason}, so it is read {_READINGS[hold.chosen]}. Read "
                f"{other} it would give {would}.{f' {doubt}.' if doubt else ''}",
                f"Use {write_hold(hold)}."
                if gain > DEFECT_GAIN and _is_cure(problem, hold, simulations)
                else "",
                gain,
                moves,
                tuple(moved) if doubt else (),
            )
        if hold.chosen == "zero" and hold.other is not None:
            yield from _find_uncertain_jumps(hold.input, problem.records)


def _is_cure(problem: Problem, hold: InputHold, simulations: Simulations) -> bool:
    """Whether an input is sampled regularly, and its other reading leaves nothing but noise."""
    channels = _find_channels(hold.input, problem.records)
    if not all(one.sampling.is_regular for one in channels) or not hold.estimates_other:
        return False
    start = np.array([hold.estimates_other[name] for name in problem.free_names])
    return leaves_noise(replace_holds(problem, [hold]), start, simulations)


def _describe_moves(moves: Sequence[Move], estimates: Sequence[Estimate]) -> str:
    known = {one.name: one for one in estimates}
    texts = []
    for move in moves[:_MAX_NAMED]:
        one = known[move.parameter]
        unit = "" if one.unit == "1" else f" {one.unit}"
        texts.append(f"{one.name} = {move.value:.4g}{unit} instead of {one.value:.4g}")
    return ", ".join(texts)


def _compute_gain(
    problem: Problem,
    hold: InputHold,
    theta: FloatArray,
    simulations: Simulations,
    evidence: float,
) -> float:
    """Compute the gain of the other reading, each with coloured noise of its own.

    It is the `evidence` under white noise if no simulations are left.
    """
    estimates = hold.estimates_other or {}
    other = np.array([estimates[name] for name in problem.free_names])
    criteria = []
    for read, point in ((problem, theta), (replace_holds(problem, [hold]), other)):
        if not simulations.allow(2 * theta.size + 1):
            return evidence
        slopes = compute_sensitivities(read, point)
        simulations.spent += slopes.evaluations
        model = ResidualModel(-slopes.residuals, slopes.columns, list(iterate_parts(read)))
        criteria.append(model.without.criterion)
    return float(criteria[0] - criteria[1])


def _compute_evidence(hold: InputHold, samples: int, rms: float) -> float:
    """Compute twice the logarithm of the likelihood ratio in favour of the other reading."""
    if not hold.rms_other or not rms > 0:
        return 0.0
    return 2 * samples * log(rms / hold.rms_other)


def _is_rough(name: str, records: Sequence[Record]) -> bool:
    """Whether the mean of an input tells more of its samples than their two neighbours do."""
    for channel in _find_channels(name, records):
        values = channel.values
        between = values[1:-1] - 0.5 * (values[:-2] + values[2:])
        if values.size > _MIN_ROUGH and np.mean(np.square(between)) >= np.var(values):
            return True
    return False


def _find_uncertain_jumps(name: str, records: Sequence[Record]) -> Iterator[Finding]:
    """Say by how much the times of jumps are uncertain where the sampling is irregular."""
    gaps = []
    for channel in _find_channels(name, records):
        if channel.hold == "auto" and not channel.sampling.is_regular:
            jumps = np.flatnonzero(np.diff(channel.values))
            gaps += np.diff(channel.times)[jumps].tolist()
    if gaps:
        yield note(
            "irregular sampling",
            "reading",
            f"input {name!r} is sampled irregularly, and each of its jumps lies between two "
            f"samples. So a time lag is uncertain by up to one period, {np.median(gaps):.3g} s",
        )


def _find_channels(name: str, records: Sequence[Record]) -> list[Channel]:
    return [channel for record in records for channel in record.inputs if channel.name == name]


def _replace_hold(record: Record, hold: InputHold) -> Record:
    assert hold.other is not None
    return replace(
        record,
        inputs=tuple(
            replace(channel, hold=hold.other)
            if channel.name == hold.input
            and channel.hold == "auto"
            and channel.effective_hold == hold.chosen
            else channel
            for channel in record.inputs
        ),
    )
