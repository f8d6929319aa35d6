"""Sources of noise that the data do not tell apart: loads, drifting sensors, defects.

A slow load behind a fast plant is nearly a drift of the sensor. In one step, a load that moves once
is nearly a jump of the sensor, or another gain. Each source is a filter, fitted to the same samples
(`sysid.identification.plant_noise_choice`), and all are compared by Schwarz's criterion (1978). One
whose odds are above 1 to 20 is open (Kass and Raftery 1995). It makes those parameters doubtful
that it moves, and their intervals average over it (Hoeting et al. 1999).

More samples tell sources apart: the logarithm of their odds grows with the length of the record. So
do more moves of the input, which no source follows.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from sysid.core.text import join_names, plain_estimate, plain_unit
from sysid.judgement.levels import NOTABLE_MOVE
from sysid.models.kalman_filter import is_noise_parameter
from sysid.results.findings import Finding, list_moves
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import Estimate

_MOST_TOLD = 3  # moves in a sentence


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
