"""Sources of noise that the data do not tell apart: loads, drifting sensors, defects.

A slow load behind a fast plant is nearly a drift of the sensor. In one step, a load that moves once
is nearly a jump of the sensor, or another gain. Each source is a filter, fitted to the same samples
(`sysid.identification.plant_noise_choice`), and all are compared by Schwarz's criterion (1978). One
whose odds are above 1 to 20 is open (Kass and Raftery 1995). It makes those parameters doubtful
that it moves, and their intervals average over it (Hoeting et al. 1999).

In a loop that only a load moves, the load may be all that the record shows. So the filter is
fitted with constant inputs too. If the inputs have no strong odds against that, the gain may be 0,
and then a lag has no meaning at all (Davies, Biometrika 64 (1977) 247).

More samples tell sources apart: the logarithm of their odds grows with the length of the record. So
do more moves of the input, which no source follows.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sysid.core.findings import Finding
from sysid.core.text import join_names, plain_estimate, plain_unit
from sysid.core.types import RANK_TOLERANCE, FloatArray
from sysid.data.records import Record
from sysid.judgement.levels import NOTABLE_MOVE, STRONG_ODDS
from sysid.judgement.residual_context import Simulations
from sysid.models.kalman_filter import is_noise_parameter
from sysid.results.findings import list_moves
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.sensitivities import compute_sensitivities

_MOST_TOLD = 3  # moves in a sentence
_STEPS = 30  # of least squares with constant inputs


class OpenSource(NamedTuple):
    """A source of noise that the data do not rule out.

    Attributes
    ----------
    name : str
        As `name_source` gives it.
    setting : str
        That assumes it.
    gain : float
        How much lower Schwarz's criterion is with it than with the model's own noise.
    values, stderrs : mapping of str to float
        The estimates with it, and their standard errors if they have one.
    """

    name: str
    setting: str
    gain: float
    values: Mapping[str, float]
    stderrs: Mapping[str, float]


class SourceComparison(NamedTuple):
    """The estimates that were compared with those of other sources.

    Attributes
    ----------
    name : str
        The source that they assume; empty if none acts inside the plant.
    values : mapping of str to float
    others : tuple of OpenSource
        The likeliest first.
    """

    name: str
    values: Mapping[str, float]
    others: tuple[OpenSource, ...]


def name_source(problem: Problem) -> str:
    """Name the source of noise that a problem's filter assumes."""
    places = [name.partition("[")[2][:-1] for name in problem.free_names if _is_size(name)]
    kind = problem.loss.noise_model
    if kind == "drift":
        return f"a drift of {join_names(places)}"
    return f"{'a slow load at' if kind == 'load' else 'noise in'} {join_names(places)}"


def open_defect(finding: Finding, values: Mapping[str, float], gain: float) -> OpenSource:
    """Make a source of a defect that a free run with these values shows."""
    moves = finding.moves
    return OpenSource(
        f"a defect: {finding.brief}",
        "loss: {noise_model: white}",
        gain,
        {**values, **{one.parameter: one.value for one in moves}},
        {one.parameter: one.stderr for one in moves if one.stderr},
    )


def _is_size(name: str) -> bool:
    return is_noise_parameter(name) and not name.startswith("tau[")


def compute_response_gain(
    problem: Problem, theta: FloatArray, simulations: Simulations
) -> float | None:
    """Compute how much lower Schwarz's criterion is with the inputs than without, beside a filter.

    None without a filter or inputs, or if simulations do not suffice.
    """
    if not problem.model.corrections or not problem.model.inputs:
        return None
    most = _STEPS * (theta.size + 1)
    if not simulations.allow(most + 2 * theta.size):
        return None
    still = problem.replace_inputs([_make_still(record) for record in problem.records])
    (end,) = refine_candidates(still, [theta], most, simulations.is_late)
    if end is None:
        return None
    slopes = compute_sensitivities(still, end.theta)
    simulations.spent += end.evaluations + slopes.evaluations
    lost = theta.size - int(np.linalg.matrix_rank(slopes.columns, rtol=RANK_TOLERANCE))
    (own,) = problem.evaluate_fitness(theta[None])
    ratio = 2.0 * problem.n_scored * float(np.log(end.rms / own))
    return ratio - lost * float(np.log(problem.n_scored))


def _make_still(record: Record) -> Record:
    return replace(
        record,
        inputs=tuple(
            replace(one, values=np.full(one.values.size, one.values[0])) for one in record.inputs
        ),
    )


def find_no_response(
    problem: Problem, gain: float | None, estimates: Sequence[Estimate]
) -> Iterator[Finding]:
    """Find a record in which nothing shows that the inputs act on the outputs."""
    if gain is None or gain > STRONG_ODDS:
        return
    inputs = join_names([signal.name for signal in problem.model.inputs])
    outputs = join_names([output.name for output in problem.model.outputs])
    brief = f"nothing shows that {inputs} moves {outputs}"
    yield Finding(
        "no response",
        "noise",
        "caution",
        brief,
        f"{brief}: the noise alone explains the record as well. So it does not tell the parameters "
        "of the plant.",
        f"Move {inputs}; in a loop move the set point, several times.",
        parameters=tuple(one.name for one in estimates if one.is_free),
        reason=brief,
    )


def find_open_sources(
    comparison: SourceComparison | None, problem: Problem, estimates: Sequence[Estimate]
) -> Iterator[Finding]:
    """Find sources of noise that the data do not rule out; one that moves nothing is a note."""
    if comparison is None:
        return
    known = {one.name: one for one in estimates}
    inputs = join_names([signal.name for signal in problem.model.inputs])
    for other in comparison.others:
        moves = list_moves(
            [one for one in estimates if not is_noise_parameter(one.name)],
            other.values,
            other.stderrs,
            comparison.values,
        )
        notable = tuple(one.parameter for one in moves if abs(one.stderrs) > NOTABLE_MOVE)
        told = ", ".join(
            f"{one.parameter} is {plain_estimate(one.value, one.stderr)}"
            f"{plain_unit(known[one.parameter].unit)}"
            for one in moves[:_MOST_TOLD]
            if one.parameter in notable
        )
        if comparison.name:
            brief = f"the data do not tell {comparison.name} from {other.name}"
            text = f"the estimates assume {comparison.name}, and {brief}"
        else:
            brief = f"{other.name} explains as much"
            text = f"{other.name} explains the residuals as well as what was found"
        yield Finding(
            "source of noise",
            "noise",
            "caution" if notable else "note",
            brief,
            f"{text}. With that ({other.setting}), {told or 'the estimates are nearly the same'}.",
            f"Move {inputs} there and back several times in a longer record, which tells them "
            "apart."
            if notable
            else "",
            other.gain,
            moves,
            notable,
        )
